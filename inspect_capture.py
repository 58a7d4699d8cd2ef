"""Print and plot what a capture file holds: ``python inspect_capture.py FILE``."""

import sys

from nlos_lit.commands.inspect_capture import inspect_capture

if __name__ == "__main__":
    sys.exit(inspect_capture(sys.argv[1:]))
