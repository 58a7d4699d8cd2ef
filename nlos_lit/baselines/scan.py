"""What the classical methods need to know of a scan: its lattice, the paths that reach a volume, the gated bins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.errors import CaptureError
from nlos_lit.grid import VolumeGrid

_TOLERANCE = 0.02  # how far a spot may lie from its lattice point, in lattice pitches


@dataclass(frozen=True)
class Lattice:
    """Wall points on a regular planar grid: ``x_i = origin[0] + i·pitch[0]``, ``y_j = origin[1] + j·pitch[1]``, ascending.

    Args:
        origin: ``(x, y, z)`` of lattice point ``(0, 0)``, m.
        pitch: ``(dx, dy)``, m, positive.
        shape: ``(nx, ny)``.
        spots: ``[nx·ny]`` index of the capture's spot that lies on lattice point ``i·ny + j``.
    """

    origin: tuple[float, float, float]
    pitch: tuple[float, float]
    shape: tuple[int, int]
    spots: np.ndarray


def find_lattice(points: np.ndarray) -> Lattice:
    """The regular planar lattice that ``points [S, 3]`` fill, whatever their order.

    Raises:
        CaptureError: they do not; the message is the reason, as the end of a sentence that names the capture.
    """
    x, dx = _axis(points[:, 0], "x")
    y, dy = _axis(points[:, 1], "y")
    if len(x) * len(y) != len(points):
        raise CaptureError(f"its {len(points)} spots do not fill a lattice of {len(x)} × {len(y)} positions")
    depth = float(np.ptp(points[:, 2]))
    if depth > _TOLERANCE * min(dx, dy):
        raise CaptureError(f"its spots do not lie in a plane z = constant (they differ by {depth:.4g} m in z)")
    cell = np.rint((points[:, 0] - x[0]) / dx).astype(int) * len(y) + np.rint((points[:, 1] - y[0]) / dy).astype(int)
    spots = np.argsort(cell, kind="stable")
    if not np.array_equal(cell[spots], np.arange(len(points))):
        raise CaptureError("several of its spots share one lattice position")
    return Lattice((float(x[0]), float(y[0]), float(points[:, 2].mean())), (dx, dy), (len(x), len(y)), spots)


def _axis(values: np.ndarray, name: str) -> tuple[np.ndarray, float]:
    """Ascending distinct coordinates along one axis and their spacing, which must be uniform."""
    ordered = np.sort(values)
    span = ordered[-1] - ordered[0]
    steps = np.diff(ordered)
    new = steps > max(steps.max(initial=0.0) / 2, 1e-9)
    if not new.any():
        raise CaptureError(f"its spots do not extend along {name}")
    groups = np.split(ordered, np.flatnonzero(new) + 1)
    centres = np.array([g.mean() for g in groups])
    pitch = float(span / (len(groups) - 1))
    off = max(np.abs(g - (ordered[0] + k * pitch)).max() for k, g in enumerate(groups))
    if off > _TOLERANCE * pitch:
        gaps = np.diff(centres)
        raise CaptureError(f"its spots are not evenly spaced along {name} (gaps between {gaps.min():.4g} and {gaps.max():.4g} m)")
    return centres, pitch


def confocal_lattice(capture: Capture, method: str) -> Lattice:
    """The scan lattice of a confocal capture, for a ``method`` (its name, for the message) that works on nothing else.

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


def path_range(capture: Capture, grid: VolumeGrid) -> tuple[float, float]:
    """Shortest and longest optical path, m, from laser through any voxel centre to sensor (bounds over the box).

    Raises:
        CaptureError: no such path falls inside the capture's gate, so nothing of the volume was measured.
    """
    lower = np.array([min(axis[0], axis[-1]) for axis in (grid.x, grid.y, grid.z)])
    upper = np.array([max(axis[0], axis[-1]) for axis in (grid.x, grid.y, grid.z)])
    shortest, longest = 0.0, 0.0
    for points in (capture.laser, capture.sensor):
        below, above = lower - points, points - upper
        shortest = shortest + np.linalg.norm(np.maximum(np.maximum(below, above), 0), axis=1)
        longest = longest + np.linalg.norm(np.maximum(np.abs(below), np.abs(above)), axis=1)
    first, last = capture.path_gate
    shortest, longest = float(np.min(shortest)), float(np.max(longest))
    if shortest >= last or longest <= first:
        raise CaptureError(
            f"the volume lies at paths of {shortest:.3f} to {longest:.3f} m, outside the gate's {first:.3f} to {last:.3f} m; "
            f"move the volume or the gate"
        )
    return shortest, longest


def gated_transients(capture: Capture, longest: float, falloff: float) -> tuple[torch.Tensor, float]:
    """The bins inside the gate, up to path ``longest`` (m), times ``(path/2)^falloff``.

    Returns:
        ``[S, T']`` float32 and the path at the start of its first bin, m. Bins that begin at a negative path are left out: no
        light from the hidden scene can be in them.
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
