"""Reconstruct a hidden scene by self-calibration: ``python train.py scene=su``."""

import sys

from nlos_lit.commands.nlos import open_command

if __name__ == "__main__":
    sys.exit(open_command("train", sys.argv[1:]))
