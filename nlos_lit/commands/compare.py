"""Runs side by side."""

from __future__ import annotations

import sys
from pathlib import Path

from nlos_lit.capture.errors import UserError
from nlos_lit.runtime.command_line import as_typed
from nlos_lit.training.sweep_table import run_rows, table

ABOUT = """Show where finished runs differ, and what came out.

    nlos compare RUN RUN …

RUN is the folder of a finished run. A row is a run, the best last: its folder, the settings in which it
differs from the others, its errors. Runs that differ in the seed alone are put together below."""


def main(arguments: list[str]) -> int:
    """Print a table of the runs whose folders ``arguments`` name, and return the exit status."""
    if {"-h", "--help"} & set(arguments):
        print(as_typed(ABOUT))
        return 0
    try:
        if len(arguments) < 2:
            raise UserError(f"give the folders of two runs or more; found {' '.join(arguments) or 'none'}")
        print(table(run_rows([Path(folder) for folder in arguments])))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
