"""The paper's tables and figures, one command each: ``python results.py table1 figure7 size=full data=DIR``.

NAMES are experiments, ``all``, or ``page``, which rewrites the generated parts of docs/results.md from what
is stored.

size=full|reduced   full (default): real captures, renders and the bunny; about an hour on one core. reduced:
small procedural
                    scenes in their places, every command once in a few minutes
data=DIR            folder that is searched for captures and meshes (default: data)
out=DIR             where results are kept and found again (default: outputs/evidence/SIZE); finished
trainings are never repeated docs=FILE           the page (default: docs/results.md)
"""

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path

from nlos_lit.capture.errors import UserError
from nlos_lit.paper.experiments import EXPERIMENTS
from nlos_lit.paper.page import update_page
from nlos_lit.paper.subjects import SIZES
from nlos_lit.paper.workspace import ROOT, Workspace
from nlos_lit.runtime.command_line import sentence_errors

log = logging.getLogger(__name__)
DEFAULTS = {
    "size": "full",
    "data": str(ROOT / "data"),
    "out": None,
    "docs": str(ROOT / "docs" / "results.md"),
}


def parse(arguments: list[str]) -> tuple[list[str], dict[str, str | None]]:
    """Names in the order in which they are run, and options."""
    options: dict[str, str | None] = dict(DEFAULTS)
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
                f"cannot use {argument!r}: names are {', '.join(EXPERIMENTS)}, all and page; options {', '.join(DEFAULTS)}"
            )
    if not wanted:
        raise UserError(f"name what to make: {', '.join(EXPERIMENTS)}, all or page")
    if options["size"] not in SIZES:
        raise UserError(f"size is one of {', '.join(SIZES)}; found {options['size']}")
    return [name for name in (*EXPERIMENTS, "page") if name in wanted], options


@sentence_errors
def main(arguments: list[str]) -> None:
    names, options = parse(arguments)
    size = SIZES[options["size"]]
    out = Path(options["out"]) if options["out"] else ROOT / "outputs" / "evidence" / size.name
    work = Workspace(out, size.experiment, [Path(options["data"])])
    for name in names:
        began = time.perf_counter()
        if name == "page":
            log.info("%s: %s", options["docs"], ", ".join(update_page(Path(options["docs"]), out)))
            continue
        EXPERIMENTS[name](work, size).write(out / name)
        log.info("%s: %s (%.0f s)", name, out / name, time.perf_counter() - began)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    main(sys.argv[1:])
