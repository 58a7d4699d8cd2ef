"""What the classical methods need to know of a scan: its lattice, the paths that reach a volume, the gated
bins.
"""

from __future__ import annotations

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import ScanLattice, find_lattice
from nlos_lit.capture.errors import CaptureError


def confocal_lattice(capture: Capture, method: str) -> ScanLattice:
    """The scan lattice of a confocal capture, for a ``method`` (its name, for the message) that works on
    nothing else.

    Raises:
        CaptureError: the capture is not confocal, or its spots are not a regular planar grid.
    """
    need = f"{method} needs a confocal scan on a regular planar grid; this capture is {capture.kind}"
    instead = "use bp, fbp or phasor imaging instead"
    if not capture.confocal:
        raise CaptureError(f"{need}: {instead}")
    try:
        return find_lattice(capture.sensor)
    except CaptureError as reason:
        raise CaptureError(f"{need}, but {reason}: {instead}") from reason


def gated_transients(capture: Capture, longest: float, falloff: float) -> tuple[torch.Tensor, float]:
    """The bins inside the gate, up to path ``longest`` (m), times ``(path/2)^falloff``.

    Returns:
        ``[S, T']`` float32 and the path at the start of its first bin, m. Bins that begin at a negative path
        are left out: no light from the hidden scene can be in them.
    """
    step, t_start = capture.bin_length, capture.t_start
    first = max(capture.gate[0], int(np.ceil(-t_start / step - 1e-9)))
    last = min(capture.gate[1], int(np.ceil((longest - t_start) / step)) + 1)
    start = t_start + first * step
    counts = torch.from_numpy(capture.counts[:, first:last].astype(np.float32))
    if falloff:
        depth = (start + (torch.arange(last - first, dtype=torch.float64) + 0.5) * step) / 2
        counts *= depth.pow(falloff).float()
    return counts, start
