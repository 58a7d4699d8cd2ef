"""Say what the simulation gets wrong about a capture: ``python diagnose.py scene=su``."""

import sys

from nlos_lit.commands.nlos import open_command

if __name__ == "__main__":
    sys.exit(open_command("diagnose", sys.argv[1:]))
