"""Runs side by side, where they differ and what came out: ``python compare.py RUN RUN``."""

import sys

from nlos_lit.commands.nlos import open_command

if __name__ == "__main__":
    sys.exit(open_command("compare", sys.argv[1:]))
