"""``python -m nlos_lit`` is ``nlos``."""

import sys

from nlos_lit.commands.nlos import main

if __name__ == "__main__":
    sys.exit(main())
