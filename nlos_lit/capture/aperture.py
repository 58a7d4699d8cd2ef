"""The scanned wall points as an aperture: a regular lattice where they form one, and their spacing.

Imaging by convolution needs the lattice; captures without one are imaged by direct sums.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

_TOLERANCE = 0.01  # how far a spot may lie from its lattice point, in lattice pitches


@dataclass(frozen=True)
class ScanLattice:
    """Wall points on a regular planar grid.

    Point (i, j) lies at ``x_i = origin[0] + i·pitch[0]``, ``y_j = origin[1] + j·pitch[1]``, ascending.

    Args:
        origin: ``(x, y, z)`` of lattice point ``(0, 0)``, m.
        pitch: ``(dx, dy)``, m, positive.
        shape: ``(nx, ny)``.
        spots: ``[nx·ny]`` int, index of the capture's spot that lies on lattice point ``i·ny + j``.
    """

    origin: tuple[float, float, float]
    pitch: tuple[float, float]
    shape: tuple[int, int]
    spots: np.ndarray


def find_lattice(points: np.ndarray) -> ScanLattice:
    """The regular planar lattice that wall points fill, whatever their order.

    Args:
        points: ``[S, 3]`` wall points, m; each may lie a hundredth of a pitch from its lattice point.

    Returns:
        The lattice, with S points.

    Raises:
        CaptureError: they fill none; the message is the reason, as the end of a sentence that names the
            capture.

    Examples:
        >>> import numpy as np
        >>> points = np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.2, 0.0], [0.1, 0.2, 0.0]])
        >>> lattice = find_lattice(points)
        >>> lattice.shape, lattice.pitch, lattice.spots.tolist()
        ((2, 2), (0.1, 0.2), [1, 2, 0, 3])
    """
    x, dx = _axis(points[:, 0], "x")
    y, dy = _axis(points[:, 1], "y")
    if len(x) * len(y) != len(points):
        raise CaptureError(f"its {len(points)} spots do not fill a lattice of {len(x)} × {len(y)} positions")
    depth = float(np.ptp(points[:, 2]))
    if depth > _TOLERANCE * min(dx, dy):
        raise CaptureError(
            f"its spots do not lie in a plane z = constant (they differ by {depth:.4g} m in z)"
        )
    cell = np.rint((points[:, 0] - x[0]) / dx).astype(int) * len(y) + np.rint(
        (points[:, 1] - y[0]) / dy
    ).astype(int)
    spots = np.argsort(cell, kind="stable")
    if not np.array_equal(cell[spots], np.arange(len(points))):
        raise CaptureError("several of its spots share one lattice position")
    return ScanLattice(
        (float(x[0]), float(y[0]), float(points[:, 2].mean())), (dx, dy), (len(x), len(y)), spots
    )


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
        raise CaptureError(
            f"its spots are not evenly spaced along {name} "
            f"(gaps between {gaps.min():.4g} and {gaps.max():.4g} m)"
        )
    return centres, pitch


@dataclass(frozen=True)
class ScanGeometry:
    """How a capture splits into scans over one lattice, for convolutional imaging.

    Args:
        lattice: the scanned aperture.
        fixed: ``[L, 3]`` the wall point that stays put in each of the L scans; None when confocal.
        rows: ``[L, nx·ny]`` capture rows (spots) of each scan, in the lattice's order.
    """

    lattice: ScanLattice
    fixed: np.ndarray | None
    rows: np.ndarray


def scan_geometry(capture: Capture) -> ScanGeometry | None:
    """The capture's lattice scans, or None where the direct sum is needed (curved wall, irregular spots)."""
    rows, moving, still = np.arange(capture.n_spots)[None], capture.sensor, None
    if capture.kind == "exhaustive":
        assert capture.scan_shape is not None
        rows = rows.reshape(-1, math.prod(capture.scan_shape[2:]))
        if any(np.abs(capture.sensor[r] - capture.sensor[rows[0]]).max() > 1e-6 for r in rows):
            return None
        still = capture.laser[rows[:, 0]]
    elif capture.kind == "single_laser":
        still = capture.laser[:1]
    elif capture.kind == "single_sensor":
        moving, still = capture.laser, capture.sensor[:1]
    elif capture.kind != "confocal":
        return None
    try:
        lattice = find_lattice(moving[rows[0]])
    except CaptureError:
        return None
    return ScanGeometry(lattice, still, rows[:, lattice.spots])


def spot_spacing(capture: Capture) -> float:
    """Distance between neighbouring scanned wall points, m."""
    geometry = scan_geometry(capture)
    if geometry is not None:
        return float(max(geometry.lattice.pitch))
    points = (
        capture.sensor
        if np.ptp(capture.sensor, axis=0).max() >= np.ptp(capture.laser, axis=0).max()
        else capture.laser
    )
    return float(np.sqrt(np.prod(np.sort(np.ptp(points, axis=0))[1:]) / capture.n_spots))
