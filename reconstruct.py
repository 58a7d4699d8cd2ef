"""Classical baselines in the project's frame: ``python reconstruct.py scene=su method=lct``."""

import sys

from nlos_lit.commands.nlos import open_command

if __name__ == "__main__":
    sys.exit(open_command("reconstruct", sys.argv[1:]))
