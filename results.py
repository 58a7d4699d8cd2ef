"""The paper's tables and figures, one command each: ``python results.py table1 figure7 size=full data=DIR``.

NAMES are experiments, ``all``, or ``page``, which rewrites the generated parts of docs/results.md from what
is stored.

size=full|reduced   full (default): real captures, renders and the bunny; about an hour on one core.
                    reduced: small procedural scenes in their places, every command once in a few minutes
data=DIR            folder that is searched for captures and meshes (default: data)
out=DIR             where results are kept and found again (default: outputs/evidence/SIZE); finished
                    trainings are never repeated
docs=FILE           the page (default: docs/results.md)
"""

import logging
import sys

from nlos_lit.runtime.arguments import look_over
from nlos_lit.runtime.command_line import sentence_errors

if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    look_over("results", sys.argv, __doc__)
    from nlos_lit.commands.results import results  # after that: it loads torch

    sentence_errors(results)(sys.argv[1:])
