"""Self-calibrating, differentiable non-line-of-sight imaging with a critic of its own simulation.

>>> import nlos_lit
>>> nlos_lit.load("nowhere.mat")
Traceback (most recent call last):
nlos_lit.capture.errors.UserError: nowhere.mat does not exist; give a capture file (docs/formats.md lists ...
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nlos_lit.api.measurement import Measurement

__version__ = "0.1.0"


def load(path: Path | str, *settings: str) -> Measurement:
    """Read a capture file; its format is recognised from its content.

    What is needed for it is imported when it is called.

    Args:
        path: of the file, or a folder of files.
        settings: what the file does not say, as commands take it: ``scene.reader.bin_width_ps=16``.

    Returns:
        The capture, to be planned, reconstructed and diagnosed.

    Raises:
        UserError: the file is missing or not usable, or a setting does not exist.
    """
    from nlos_lit.api.measurement import Measurement

    return Measurement(path, settings)
