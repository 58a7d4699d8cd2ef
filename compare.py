"""Runs side by side, where they differ and what came out: ``python compare.py RUN RUN…``.

RUN is the folder of a finished run of train.py. Runs that differ in the seed alone are put together below.
"""

import sys

from nlos_lit.commands.compare import compare

if __name__ == "__main__":
    sys.exit(compare(sys.argv[1:], __doc__))
