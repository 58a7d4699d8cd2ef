"""Backprojection and filtered backprojection: any wall, any spots, any pairing of laser and sensor.

Velten et al., Nature Communications 3, 745 (2012): every voxel collects, from every spot's transient, the bin whose ellipsoid of
equal path runs through it; a Laplacian then removes the blur that the overlap of the ellipsoids leaves.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from nlos_lit.baselines.scan import gated_transients, path_range
from nlos_lit.capture import Capture
from nlos_lit.errors import UserError
from nlos_lit.grid import VolumeGrid

_BLOCK = 1 << 19  # (spot, voxel) pairs at a time: six float32 arrays of this size fit the caches and bound the memory
_TABLE = 1 << 23  # distances (wall point, voxel) kept at a time


def bp(capture: Capture, grid: VolumeGrid, *, falloff: float = 0.0) -> torch.Tensor:
    """Backprojection ``I(v) = Σ_s H_s(|v - l_s| + |v - d_s|)``, linear between bin centres, zero outside the gate.

    Args:
        capture: of any kind; the spots need no order and no plane.
        grid: where to reconstruct.
        falloff: power of half the path length that multiplies the counts first; 0 leaves them as they are.

    Returns:
        ``[nz, nx, ny]`` float32, in counts (times m^falloff).

    Raises:
        CaptureError: the volume lies outside the gate.
    """
    _, longest = path_range(capture, grid)
    transients, start = gated_transients(capture, longest, falloff)
    lasers, laser_of = np.unique(capture.laser, axis=0, return_inverse=True)
    sensors, sensor_of = np.unique(capture.sensor, axis=0, return_inverse=True)
    confocal = capture.confocal
    # grid_sample wants positions in [-1, 1] between the outer bin edges
    scale = 2 / (transients.shape[1] * capture.bin_length)
    shift = -start * scale - 1
    nz, nx, ny = grid.shape
    voxels = _block_voxels(grid, len(sensors) + (0 if confocal else len(lasers)))
    spots = max(1, _BLOCK // voxels)
    where = torch.zeros(min(spots, capture.n_spots), 1, voxels, 2)
    volume = torch.empty(grid.n_voxels)
    laser_of, sensor_of = (torch.from_numpy(index.reshape(-1)) for index in (laser_of, sensor_of))
    for begin in range(0, grid.n_voxels, voxels):
        flat = np.arange(begin, min(begin + voxels, grid.n_voxels))
        centres = np.stack([grid.x[flat // ny % nx], grid.y[flat % ny], grid.z[flat // (nx * ny)]])
        to_sensor = _distances(sensors, centres).mul_(2 * scale if confocal else scale).add_(shift)
        to_laser = None if confocal else _distances(lasers, centres).mul_(scale)
        total = torch.zeros(len(flat))
        for s in range(0, capture.n_spots, spots):
            chunk = slice(s, min(s + spots, capture.n_spots))
            position = where[: chunk.stop - s, :, : len(flat)]
            path = to_sensor[sensor_of[chunk]]
            if to_laser is not None:
                path += to_laser[laser_of[chunk]]
            position[:, 0, :, 0] = path
            total += F.grid_sample(transients[chunk, None, None], position, padding_mode="zeros", align_corners=False).sum((0, 1, 2))
        volume[begin : begin + len(flat)] = total
    return volume.view(nz, nx, ny)


def fbp(capture: Capture, grid: VolumeGrid, *, filter: str = "log", sigma: float = 1.0, falloff: float = 0.0) -> torch.Tensor:
    """Filtered backprojection: ``max(0, -σ²·L I)`` of the backprojection ``I``.

    Args:
        capture: of any kind.
        grid: where to reconstruct.
        filter: ``log``, Laplacian of Gaussian over the three axes, or ``second_derivative``, of a Gaussian along z alone.
        sigma: standard deviation of the Gaussian in voxels (derivatives are per voxel as well).
        falloff: as for :func:`bp`.

    Returns:
        ``[nz, nx, ny]`` float32, nonnegative.

    Raises:
        UserError: unknown ``filter``, or ``sigma`` not positive.
        CaptureError: the volume lies outside the gate.
    """
    if filter not in ("log", "second_derivative"):
        raise UserError(f"fbp has the filters 'log' and 'second_derivative'; found {filter!r}")
    if not sigma > 0:
        raise UserError(f"fbp needs a positive sigma in voxels; found {sigma}")
    volume = bp(capture, grid, falloff=falloff)
    if filter == "second_derivative":
        return _along(volume, 0, sigma, derivative=True).mul_(-(sigma**2)).clamp_(min=0)
    smooth_z = _along(volume, 0, sigma, derivative=False)
    smooth_zx = _along(smooth_z, 1, sigma, derivative=False)
    result = _along(smooth_zx, 2, sigma, derivative=True)
    result += _along(_along(smooth_z, 1, sigma, derivative=True), 2, sigma, derivative=False)
    del smooth_z, smooth_zx
    curved = _along(_along(volume, 0, sigma, derivative=True), 1, sigma, derivative=False)
    result += _along(curved, 2, sigma, derivative=False)
    return result.mul_(-(sigma**2)).clamp_(min=0)


def bp_bytes(capture: Capture, grid: VolumeGrid) -> int:
    """Bytes that :func:`bp` allocates: transients, volume, and one block of positions and distances."""
    points = len(np.unique(capture.sensor, axis=0))
    points += 0 if capture.confocal else len(np.unique(capture.laser, axis=0))
    voxels = _block_voxels(grid, points)
    pairs = max(1, min(_BLOCK // voxels, capture.n_spots)) * voxels
    transients = capture.n_spots * (capture.gate[1] - capture.gate[0])
    return 4 * (transients + grid.n_voxels + 6 * pairs + 2 * points * voxels)


def fbp_bytes(capture: Capture, grid: VolumeGrid) -> int:
    """Bytes that :func:`fbp` allocates: the larger of the backprojection and five volumes for its filter."""
    return max(bp_bytes(capture, grid), 4 * 6 * grid.n_voxels)


def _block_voxels(grid: VolumeGrid, points: int) -> int:
    return max(1, min(grid.n_voxels, max(256, min(_TABLE // points, 1 << 15))))


def _distances(points: np.ndarray, centres: np.ndarray) -> torch.Tensor:
    """``[P, V]`` distances from wall ``points [P, 3]`` to voxel ``centres [3, V]``."""
    wall, voxel = torch.from_numpy(points).float(), torch.from_numpy(centres).float()
    squared = (wall[:, :1] - voxel[0]).square_()
    squared += (wall[:, 1:2] - voxel[1]).square_()
    squared += (wall[:, 2:] - voxel[2]).square_()
    return squared.sqrt_()


def _along(volume: torch.Tensor, axis: int, sigma: float, *, derivative: bool) -> torch.Tensor:
    """The volume convolved along one axis with a Gaussian or its second derivative; edge values continue outside."""
    radius = int(np.ceil(4 * sigma))
    t = np.arange(-radius, radius + 1)
    kernel = np.exp(-0.5 * (t / sigma) ** 2)
    kernel /= kernel.sum()
    if derivative:
        kernel *= (t**2 - sigma**2) / sigma**4
        kernel -= kernel.mean()
        kernel *= 2 / (kernel * t**2).sum()
    padding = [0, 0, 0, 0, 0, 0]
    padding[2 * (2 - axis)] = padding[2 * (2 - axis) + 1] = radius
    padded = F.pad(volume[None], padding, mode="replicate")[0]
    size = volume.shape[axis]
    result = torch.zeros_like(volume)
    for k, weight in enumerate(kernel.tolist()):
        result.add_(padded.narrow(axis, k, size), alpha=weight)
    return result
