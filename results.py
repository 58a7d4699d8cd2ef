"""The paper's tables and figures, one command each: ``python results.py table1 size=full data=DIR``."""

import sys

from nlos_lit.commands.nlos import open_command

if __name__ == "__main__":
    sys.exit(open_command("results", sys.argv[1:]))
