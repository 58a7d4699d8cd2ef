"""Open the page of a run or a diagnosis."""

from __future__ import annotations

import argparse
import sys
import tempfile
import webbrowser
from dataclasses import replace
from pathlib import Path

from nlos_lit.capture.errors import UserError, printable
from nlos_lit.io.views import FILE as VIEW
from nlos_lit.io.views import read_view
from nlos_lit.runtime.claim import claim, refuse_links
from nlos_lit.runtime.command_line import REFUSED, sentence_errors, typed


def main(arguments: list[str] | None = None) -> int:
    """Open the page of the folder that ``arguments`` (or the command line's) name; return the exit status."""
    given = parse(sys.argv[1:] if arguments is None else arguments)
    page = sentence_errors(page_of)(given.run)
    print(printable(str(page)))
    if given.open and not webbrowser.open(page.resolve().as_uri()):
        print("no browser was found here: open that file in one", file=sys.stderr)
    return 0


def page_of(run: Path) -> Path:
    """The page of a run's folder, made anew: what opens is never a page that came with a foreign folder.

    Where the run says that it goes on but no process holds its folder, the page says that it was stopped.
    Where nothing can be written to the folder, the page lies among temporary files.

    Args:
        run: folder of a run, of a diagnosis, or of a run that was diagnosed: the diagnosis is shown then.

    Returns:
        ``explore.html``.

    Raises:
        UserError: it is no folder, or one that holds nothing to look at, or links out of it.
    """
    from nlos_lit.report.explore import FILE as PAGE  # after the arguments: it loads torch
    from nlos_lit.report.explore import write_page
    from nlos_lit.training.explored import keep

    if run.is_file():
        raise UserError(
            f"{run} is a file; give the folder that a train or diagnose command has named at its end"
        )
    refuse_links(run)
    folder = run / "diagnosis" if (run / "diagnosis" / VIEW).is_file() else run
    view = read_view(folder)
    try:
        if view.facts["status"] != "running":
            return write_page(folder, view)
        if _held(folder):
            return folder / PAGE  # which that process writes
        view = replace(view, facts={**view.facts, "status": "interrupted"})
        return keep(folder, view)
    except UserError:
        raise
    except OSError as error:
        if error.errno not in REFUSED:
            raise
        return write_page(tempfile.mkdtemp(prefix="nlos-view-"), view)
    except Exception as error:  # a foreign file may be wrong in any way
        raise UserError(f"{folder / VIEW} is damaged: {error}") from error


def parse(arguments: list[str]) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(
        prog=typed("view"), description="Open the page of a run or a diagnosis in the browser."
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run or of a diagnosis")
    parser.add_argument(
        "--no-open", dest="open", action="store_false", help="only print where the page is, and open nothing"
    )
    return parser.parse_args(arguments)


def _held(folder: Path) -> bool:
    """A process is at work in the run's folder."""
    try:
        claim(folder.parent if folder.name == "diagnosis" else folder)
    except UserError:
        return True
    return False
