"""Print and plot what a capture file holds: ``python inspect_capture.py FILE``."""

import sys

from nlos_lit.commands.nlos import open_command

if __name__ == "__main__":
    sys.exit(open_command("inspect", sys.argv[1:]))
