"""Runs side by side."""

from __future__ import annotations

import sys
from pathlib import Path

from nlos_lit.capture.errors import UserError
from nlos_lit.training.sweep_table import run_rows, table


def main(arguments: list[str]) -> int:
    """Print a table of the runs whose folders ``arguments`` name, and return the exit status."""
    try:
        if len(arguments) < 2:
            raise UserError(f"give the folders of two runs or more; found {' '.join(arguments) or 'none'}")
        print(table(run_rows([Path(folder) for folder in arguments])))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
