"""The scanned wall points as a regular lattice, and the volume that is imaged through them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nlos_lit.capture import Capture
from nlos_lit.errors import UserError
from nlos_lit.grid import VolumeGrid


@dataclass(frozen=True)
class ApertureLattice:
    """A planar, axis-aligned, equally spaced grid of wall points parallel to the xy plane.

    ``first`` is point [0, 0] (m), ``pitch`` the signed steps along x and y (m), ``shape`` the numbers (nx, ny).
    """

    first: tuple[float, float, float]
    pitch: tuple[float, float]
    shape: tuple[int, int]


def find_lattice(points: np.ndarray, shape: tuple[int, int], tolerance: float = 0.01) -> ApertureLattice | None:
    """The lattice of ``points`` ``[nx·ny, 3]``, or None where they stray from one by more than ``tolerance`` pitches."""
    nx, ny = shape
    grid = points.reshape(nx, ny, 3)
    if nx < 2 or ny < 2:
        return None
    dx = float((grid[-1, :, 0] - grid[0, :, 0]).mean() / (nx - 1))
    dy = float((grid[:, -1, 1] - grid[:, 0, 1]).mean() / (ny - 1))
    if dx == 0 or dy == 0:
        return None
    first = grid[0, 0]
    ideal = np.stack(
        np.broadcast_arrays(first[0] + dx * np.arange(nx)[:, None], first[1] + dy * np.arange(ny), first[2]), axis=-1
    )
    if np.abs(grid - ideal).max() > tolerance * min(abs(dx), abs(dy)):
        return None
    return ApertureLattice(tuple(float(v) for v in first), (dx, dy), shape)


@dataclass(frozen=True)
class ScanGeometry:
    """How a capture splits into scans over one lattice, for convolutional imaging.

    Args:
        lattice: the scanned aperture.
        fixed: ``[L, 3]`` the wall point that stays put in each of the L scans; None when confocal.
        rows: ``[L, nx·ny]`` capture rows (spots) of each scan.
    """

    lattice: ApertureLattice
    fixed: np.ndarray | None
    rows: np.ndarray


def scan_geometry(capture: Capture) -> ScanGeometry | None:
    """The capture's lattice scans, or None where the direct sum is needed (curved wall, irregular spots)."""
    if capture.scan_shape is None:
        return None
    spots = np.arange(capture.n_spots)
    if len(capture.scan_shape) == 4:
        lx, ly, sx, sy = capture.scan_shape
        rows = spots.reshape(lx * ly, sx * sy)
        lattice = find_lattice(capture.sensor[rows[0]], (sx, sy))
        same = all(np.allclose(capture.sensor[r], capture.sensor[rows[0]], atol=1e-6) for r in rows)
        return ScanGeometry(lattice, capture.laser[rows[:, 0]], rows) if lattice and same else None
    moving = capture.laser if capture.kind == "single_sensor" else capture.sensor
    lattice = find_lattice(moving, capture.scan_shape)
    if lattice is None or capture.kind not in ("confocal", "single_laser", "single_sensor"):
        return None
    still = {"confocal": None, "single_laser": capture.laser[:1], "single_sensor": capture.sensor[:1]}[capture.kind]
    return ScanGeometry(lattice, still, spots[None])


def spot_spacing(capture: Capture) -> float:
    """Distance between neighbouring scanned wall points, m."""
    geometry = scan_geometry(capture)
    if geometry is not None:
        return float(np.abs(geometry.lattice.pitch).max())
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
    nz = max(2, int(math.floor((far - near) / pitch_z + 1e-6)) + 1)
    geometry = scan_geometry(capture)
    if geometry is not None:
        lattice = geometry.lattice
        first, steps, counts = lattice.first, lattice.pitch, lattice.shape
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
    _check_window(capture, grid)
    return grid


def voxel_path_range(capture: Capture, grid: VolumeGrid) -> tuple[float, float]:
    """Shortest and longest laser-voxel-sensor path over all spots and voxels, m (bounds, not attained in general)."""
    low = np.array([grid.x.min(), grid.y.min(), grid.z.min()])
    high = np.array([grid.x.max(), grid.y.max(), grid.z.max()])

    def reach(points: np.ndarray) -> tuple[float, float]:
        nearest = np.linalg.norm(points - np.clip(points, low, high), axis=1).min()
        farthest = np.linalg.norm(np.maximum(np.abs(points - low), np.abs(points - high)), axis=1).max()
        return float(nearest), float(farthest)

    (near_l, far_l), (near_s, far_s) = reach(capture.laser), reach(capture.sensor)
    return near_l + near_s, far_l + far_s


def _check_window(capture: Capture, grid: VolumeGrid) -> None:
    start, end = capture.path_gate
    near, far = voxel_path_range(capture, grid)
    if near >= end or far <= start:
        raise UserError(
            f"the volume (depth {grid.z[0]:.3g} to {grid.z[-1]:.3g} m, light paths {near:.3g} to {far:.3g} m) lies outside the "
            f"capture's time window (paths {start:.3g} to {end:.3g} m); set scene.volume.depth within about "
            f"{max(start, 0) / 2:.3g} to {end / 2:.3g} m, or check the bin width ({capture.bin_width_ps:.3g} ps)"
        )
