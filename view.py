"""Open the page of a run or a diagnosis: ``python view.py RUN``."""

import sys

from nlos_lit.commands.nlos import open_command

if __name__ == "__main__":
    sys.exit(open_command("view", sys.argv[1:]))
