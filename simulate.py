"""Simulate a capture of a hidden scene: ``python simulate.py scene=letters out=letters.hdf5 nx=64 ny=64``.

Writes OUT, a y-tal HDF5 capture, and OUT's name with ``_truth.h5``: depth, normals and albedo as seen
from the wall, and the mesh. A scene of one's own: ``'bodies=[{kind: cone, at: [0, 0, 0.6]}]'``; one drawn
at random: ``random=7`` (docs/simulator.md). With physical effects, each with strengths as
EFFECT.PARAMETER=VALUE (docs/effects.md):

    python simulate.py scene=letters 'effects=[pile_up]' pile_up.detections=0.3 out=X.hdf5
"""

import logging
import sys

from nlos_lit.runtime.arguments import look_over
from nlos_lit.runtime.command_line import sentence_errors

if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    look_over("simulate", sys.argv, __doc__)
    from nlos_lit.commands.simulate import simulate  # after that: it loads torch

    sentence_errors(simulate)(sys.argv[1:])
