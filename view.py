"""Open the page of a run or a diagnosis: ``python view.py RUN``."""

import sys

from nlos_lit.commands.view import main

if __name__ == "__main__":
    sys.exit(main())
