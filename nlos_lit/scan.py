"""The scanned wall points as a regular lattice, and the volume that is imaged through them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nlos_lit.capture import Capture
from nlos_lit.errors import CaptureError, UserError
from nlos_lit.grid import VolumeGrid

_TOLERANCE = 0.01  # how far a spot may lie from its lattice point, in lattice pitches


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


@dataclass(frozen=True)
class ScanGeometry:
    """How a capture splits into scans over one lattice, for convolutional imaging.

    Args:
        lattice: the scanned aperture.
        fixed: ``[L, 3]`` the wall point that stays put in each of the L scans; None when confocal.
        rows: ``[L, nx·ny]`` capture rows (spots) of each scan, in the lattice's order.
    """

    lattice: Lattice
    fixed: np.ndarray | None
    rows: np.ndarray


def scan_geometry(capture: Capture) -> ScanGeometry | None:
    """The capture's lattice scans, or None where the direct sum is needed (curved wall, irregular spots)."""
    rows, moving, still = np.arange(capture.n_spots)[None], capture.sensor, None
    if capture.kind == "exhaustive":
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
    points = capture.sensor if np.ptp(capture.sensor, axis=0).max() >= np.ptp(capture.laser, axis=0).max() else capture.laser
    return float(np.sqrt(np.prod(np.sort(np.ptp(points, axis=0))[1:]) / capture.n_spots))


def volume_grid(
    capture: Capture,
    *,
    depth: tuple[float, float],
    depth_pitch: float | None = None,
    refine: int = 1,
    lateral: tuple[int, int] | None = None,
) -> VolumeGrid:
    """The voxels to image: laterally the scan's lattice (refined and extended on request), in depth ``depth`` metres.

    Args:
        depth: nearest and farthest voxel plane, m from the wall.
        depth_pitch: spacing of planes, m; None takes half a bin length, which is one bin of path there and back.
        refine: voxels per lattice step.
        lateral: numbers of voxels along x and y, centred on the scan; None covers the scan.

    Raises:
        UserError: impossible numbers, or the volume lies outside the time window.
    """
    near, far = (float(v) for v in depth)
    if not 0 < near < far:
        raise UserError(f"the volume's depth must satisfy 0 < nearest < farthest; found [{near:g}, {far:g}] m")
    pitch_z = capture.bin_length / 2 if depth_pitch is None else float(depth_pitch)
    if pitch_z <= 0 or refine < 1:
        raise UserError(f"the depth pitch ({pitch_z:g} m) and the refinement ({refine}) must be positive")
    nz = max(2, math.floor((far - near) / pitch_z + 1e-6) + 1)
    geometry = scan_geometry(capture)
    if geometry is not None:
        lattice = geometry.lattice
        first, steps, counts = lattice.origin, lattice.pitch, lattice.shape
    else:
        low, high = np.minimum(capture.sensor, capture.laser).min(0), np.maximum(capture.sensor, capture.laser).max(0)
        side = max(2, round(math.sqrt(capture.n_spots)))
        steps = tuple(float((high[a] - low[a]) / (side - 1)) for a in (0, 1))
        first, counts = tuple(float(v) for v in low), (side, side)
        if min(steps) <= 0:
            raise UserError("the spots lie on one line; a volume needs spots spread over the wall in x and y")
    fine = tuple(s / refine for s in steps)
    whole = tuple(int(n) for n in lateral) if lateral is not None else tuple(n * refine for n in counts)
    skip = tuple((w - (n - 1) * refine - 1) // 2 for w, n in zip(whole, counts, strict=True))
    origin = (first[0] - skip[0] * fine[0], first[1] - skip[1] * fine[1], first[2] + near)
    grid = VolumeGrid(origin, (*fine, pitch_z), (nz, *whole))
    path_range(capture, grid)
    return grid


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
            f"the volume (depth {grid.z.min():.3g} to {grid.z.max():.3g} m, light paths {shortest:.3g} to {longest:.3g} m) lies "
            f"outside the capture's time window (paths {first:.3g} to {last:.3g} m); move the volume (scene.volume.depth, "
            f"within about {max(first, 0) / 2:.3g} to {last / 2:.3g} m) or the gate, or check the bin width "
            f"({capture.bin_width_ps:.3g} ps)"
        )
    return shortest, longest
