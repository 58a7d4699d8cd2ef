"""Simulate a capture of a hidden scene: ``python simulate.py scene=letters out=letters.hdf5``."""

import sys

from nlos_lit.commands.nlos import open_command

if __name__ == "__main__":
    sys.exit(open_command("simulate", sys.argv[1:]))
