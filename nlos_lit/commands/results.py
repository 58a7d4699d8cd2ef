"""The paper's tables and figures, one after the other."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from nlos_lit.capture.errors import UserError, suggest
from nlos_lit.paper.experiments import EXPERIMENTS
from nlos_lit.paper.page import update_page
from nlos_lit.paper.subjects import SIZES
from nlos_lit.paper.workspace import Workspace
from nlos_lit.places import HOME
from nlos_lit.runtime.command_line import sentence_errors

log = logging.getLogger(__name__)
DEFAULTS = {
    "size": "full",
    "data": str(HOME / "data"),
    "out": "",  # outputs/evidence/SIZE
    "docs": str(HOME / "docs" / "results.md"),
}


def main(arguments: list[str]) -> int:
    """Run the command with the arguments of its command line; the exit status."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    sentence_errors(results)(arguments)
    return 0


def parse(arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    """Names in the order in which they are run, and options.

    Raises:
        UserError: a name or an option that does not exist, or no name.

    Examples:
        >>> names, options = parse(["page", "table1", "size=reduced"])
        >>> names, options["size"]
        (['table1', 'page'], 'reduced')
    """
    options = dict(DEFAULTS)
    wanted = set()
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if equals and key in options:
            options[key] = value
        elif not equals and key in (*EXPERIMENTS, "page"):
            wanted.add(key)
        elif key == "all" and not equals:
            wanted |= set(EXPERIMENTS)
        else:
            raise UserError(
                f"cannot use {argument!r}; {suggest(key, [*EXPERIMENTS, 'all', 'page', *DEFAULTS])}"
            )
    if not wanted:
        raise UserError(f"name what to make: {', '.join(EXPERIMENTS)}, all or page")
    if options["size"] not in SIZES:
        raise UserError(f"size is one of {', '.join(SIZES)}; found {options['size']}")
    return [name for name in (*EXPERIMENTS, "page") if name in wanted], options


def results(arguments: list[str]) -> None:
    """Make what ``arguments`` name, in a fixed order; what is stored already is found again.

    Raises:
        UserError: the arguments make no sense, or data are missing.
    """
    names, options = parse(arguments)
    size = SIZES[options["size"]]
    out = Path(options["out"]) if options["out"] else HOME / "outputs" / "evidence" / size.name
    work = Workspace(out, size.experiment, [Path(options["data"])])
    for name in names:
        began = time.perf_counter()
        if name == "page":
            log.info("%s: %s", options["docs"], ", ".join(update_page(Path(options["docs"]), out)))
            continue
        EXPERIMENTS[name](work, size).write(out / name)
        log.info("%s: %s (%.0f s)", name, out / name, time.perf_counter() - began)
