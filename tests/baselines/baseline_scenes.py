"""Captures of point scatterers by the textbook formula, for the tests of the classical baselines alone."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid


def lattice(nx: int, ny: int, dx: float, dy: float, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """``[nx·ny, 3]`` wall points, spot ``i·ny + j`` at ``x_i, y_j``."""
    x = centre[0] + dx * (np.arange(nx) - (nx - 1) / 2)
    y = centre[1] + dy * (np.arange(ny) - (ny - 1) / 2)
    return np.stack([np.repeat(x, ny), np.tile(y, nx), np.zeros(nx * ny)], axis=1)


def transients(
    laser: np.ndarray,
    sensor: np.ndarray,
    points: list[tuple[float, float, float]],
    bins: int,
    bin_length: float,
    t_start: float = 0.0,
    power: float = 2.0,
    width: float = 0.8,
) -> np.ndarray:
    """``[S, bins]`` Gaussian pulses, ``width`` bins wide, at ``|p-l| + |p-s|``, with energy
    ``1/(|p-l|·|p-s|)^power``.
    """
    edges = t_start + bin_length * np.arange(bins + 1)
    total = np.zeros((len(laser), bins))
    for point in points:
        dl = np.sqrt(((laser - np.array(point)) ** 2).sum(1))
        ds = np.sqrt(((sensor - np.array(point)) ** 2).sum(1))
        cumulative = ndtr((edges[None] - (dl + ds)[:, None]) / (width * bin_length))
        total += np.diff(cumulative, axis=1) / (dl * ds)[:, None] ** power
    return total


def capture_of(
    laser: np.ndarray,
    sensor: np.ndarray,
    points: list[tuple[float, float, float]],
    bins: int,
    bin_length: float,
    t_start: float = 0.0,
    power: float = 2.0,
    scan_shape: tuple[int, ...] | None = None,
    gate: tuple[int, int] | None = None,
) -> Capture:
    counts = transients(laser, sensor, points, bins, bin_length, t_start, power).astype(np.float32)
    normals = np.tile([0.0, 0.0, 1.0], (len(laser), 1))
    return Capture(
        counts,
        laser,
        sensor,
        normals,
        normals,
        bin_length,
        t_start,
        gate=gate,
        scan_shape=scan_shape,
        is_counts=False,
    )


def box(x: tuple[float, float, int], y: tuple[float, float, int], z: tuple[float, float, int]) -> VolumeGrid:
    """A grid from ``(first centre, last centre, count)`` per axis."""
    pitch = tuple((last - first) / (count - 1) for first, last, count in (x, y, z))
    return VolumeGrid((x[0], y[0], z[0]), pitch, (z[2], x[2], y[2]))


def peak(volume, grid: VolumeGrid) -> np.ndarray:
    """Position ``(x, y, z)`` of the maximum."""
    k, i, j = np.unravel_index(int(volume.argmax()), volume.shape)
    return np.array([grid.x[i], grid.y[j], grid.z[k]])


def off_by(volume, grid: VolumeGrid, point: tuple[float, float, float]) -> float:
    """Distance of the maximum from ``point`` in voxels, along the worst axis."""
    return float(np.abs((peak(volume, grid) - np.array(point)) / np.array(grid.pitch)).max())
