"""What the classical methods take from a capture: its lattice, and the gated bins that a volume can reach."""

from __future__ import annotations

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import ScanLattice, find_lattice
from nlos_lit.capture.errors import CaptureError
from nlos_lit.capture.volume_grid import VolumeGrid, path_range


def confocal_lattice(capture: Capture, method: str) -> ScanLattice:
    """The scan lattice of a confocal capture, for a method that works on nothing else.

    Args:
        capture: what was measured.
        method: its name, for the message.

    Returns:
        The lattice.

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
    """The bins inside the gate, up to a longest path, times ``(path/2)^falloff``.

    Args:
        capture: what was measured.
        longest: path after which bins are left out, m.
        falloff: power of half the path (m) at a bin's centre; 0 leaves the counts as they are.

    Returns:
        ``[S, T']`` float32 and the path at the start of its first bin, m. Bins that begin at a negative path
        are left out: no light from the hidden scene can be in them.
    """
    step, t_start = capture.bin_length, capture.t_start
    first = max(capture.gate[0], int(np.ceil(-t_start / step - 1e-9)))
    last = min(capture.gate[1], int(np.ceil((longest - t_start) / step)) + 1)
    start = t_start + first * step
    # Bins that were not recorded hold zero: they add nothing to an image that is linear in the counts.
    counts = torch.from_numpy(capture.counts[:, first:last].astype(np.float32))
    if falloff:
        depth = (start + (torch.arange(last - first, dtype=torch.float64) + 0.5) * step) / 2
        counts *= depth.pow(falloff).float()
    return counts, start


def gated_bins(capture: Capture, grid: VolumeGrid) -> int:
    """How many bins of the gate light from a volume can reach: those that lct, dlct and fk work on.

    Args:
        capture: what was measured.
        grid: where to reconstruct.

    Returns:
        Bins from the gate's first to one after the longest path's.

    Raises:
        CaptureError: the volume lies outside the gate.
    """
    longest = path_range(capture, grid)[1]
    return (
        min(capture.gate[1], int(np.ceil((longest - capture.t_start) / capture.bin_length)) + 1)
        - capture.gate[0]
    )
