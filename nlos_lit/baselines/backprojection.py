"""Backprojection and filtered backprojection: any wall, any spots, any pairing of laser and sensor.

Velten et al., Nature Communications 3, 745 (2012): every voxel collects, from every spot's transient, the bin
whose ellipsoid of equal path runs through it; a Laplacian then removes the blur that the overlap of the
ellipsoids leaves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from nlos_lit.baselines.inputs import gated_transients
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid, path_range

_BLOCK = 1 << 19  # (spot, voxel) pairs at a time: they bound the memory, and few calls are made
_SCRATCH = 64 << 20  # bytes that the allocator and the libraries were seen to keep besides
_TABLE = 1 << 22  # distances from wall points to voxels kept at a time


def bp(capture: Capture, grid: VolumeGrid, *, falloff: float = 0.0) -> torch.Tensor:
    """Backprojection ``I(v) = Σ_s H_s(|v - l_s| + |v - d_s|)``.

    Transients are linear between bin centres and zero outside the gate.

    Args:
        capture: of any kind; the spots need no order and no plane.
        grid: where to reconstruct.
        falloff: power of half the path length that multiplies the counts first; 0 leaves them as they are.

    Returns:
        ``[nz, nx, ny]`` float32, in counts (times m^falloff).

    Raises:
        CaptureError: the volume lies outside the gate.

    Examples:
        One spot, one voxel 0.5 m ahead: the bin with path 1 m.

        >>> import numpy as np
        >>> spot, up = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
        >>> counts = np.zeros((1, 20))
        >>> counts[0, 10] = 7
        >>> capture = Capture(counts, spot, spot, up, up, bin_length=0.1, t_start=-0.05)
        >>> bp(capture, VolumeGrid((0.0, 0.0, 0.5), (0.1, 0.1, 0.1), (2, 1, 1)))[:, 0, 0].round()
        tensor([7., 0.])
    """
    _, longest = path_range(capture, grid)
    transients, start = gated_transients(capture, longest, falloff)
    # grid_sample takes positions in [-1, 1] between the outer edges of the bins
    scale = 2 / (transients.shape[1] * capture.bin_length)
    shift = -start * scale - 1
    ends = _path_ends(capture)
    nz, nx, ny = grid.shape
    lateral = np.stack([np.repeat(grid.x, ny), np.tile(grid.y, nx)], axis=1)
    columns = _block_columns(grid, ends)
    spots = min(capture.n_spots, max(1, _BLOCK // columns))
    position = torch.zeros(spots, 1, columns, 2)
    volume = torch.zeros(nz, nx * ny)
    for begin in range(0, nx * ny, columns):
        block = slice(begin, min(begin + columns, nx * ny))
        width = block.stop - block.start
        squares = [_squared_distances(end.points[:, :2], lateral[block], end.passes * scale) for end in ends]
        paths = [torch.empty_like(square) for square in squares]
        for k, z in enumerate(grid.z):
            for end, square, path in zip(ends, squares, paths, strict=True):
                torch.add(
                    square,
                    _squared_distances(end.points[:, 2:], np.array([[z]]), end.passes * scale),
                    out=path,
                ).sqrt_()
            paths[0] += shift
            for s in range(0, capture.n_spots, spots):
                chunk = slice(s, min(s + spots, capture.n_spots))
                where = position[: chunk.stop - s, :, :width]
                where[:, 0, :, 0] = paths[0][ends[0].of_spot[chunk]]
                if len(ends) > 1:
                    where[:, 0, :, 0] += paths[1][ends[1].of_spot[chunk]]
                found = F.grid_sample(
                    transients[chunk, None, None], where, padding_mode="zeros", align_corners=False
                )
                volume[k, block] += found.view(-1, width).sum(0)
    return volume.view(nz, nx, ny)


def fbp(
    capture: Capture, grid: VolumeGrid, *, filter: str = "log", sigma: float = 1.0, falloff: float = 0.0
) -> torch.Tensor:
    """Filtered backprojection: ``max(0, -σ²·L I)`` of the backprojection ``I``.

    Args:
        capture: of any kind.
        grid: where to reconstruct.
        filter: ``log``, Laplacian of Gaussian over the three axes, or ``second_derivative``, of a Gaussian
            along z alone.
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
    """Bytes that :func:`bp` allocates: transients, volume, and one block of positions and distances.

    Args:
        capture: of any kind.
        grid: where to reconstruct.

    Returns:
        Bytes, beyond the capture's counts.
    """
    ends = _path_ends(capture)
    columns = _block_columns(grid, ends)
    pairs = max(1, min(_BLOCK // columns, capture.n_spots)) * columns
    transients = capture.n_spots * (capture.gate[1] - capture.gate[0])
    return _SCRATCH + 4 * (
        transients + grid.n_voxels + 5 * pairs + 3 * sum(len(end.points) for end in ends) * columns
    )


def fbp_bytes(capture: Capture, grid: VolumeGrid) -> int:
    """Bytes that :func:`fbp` allocates: those of the backprojection or of the six volumes of its filter.

    Args:
        capture: of any kind.
        grid: where to reconstruct.

    Returns:
        Bytes, beyond the capture's counts: the larger of the two.
    """
    return max(bp_bytes(capture, grid), _SCRATCH + 4 * 6 * grid.n_voxels)


@dataclass(frozen=True)
class _PathEnd:
    """Distinct wall points at one end of the paths."""

    points: np.ndarray  # [P, 3] m
    of_spot: torch.Tensor  # [S] which of them each spot uses
    passes: float  # how often the path runs to them


def _path_ends(capture: Capture) -> list[_PathEnd]:
    ends = []
    for points in (capture.sensor,) if capture.confocal else (capture.laser, capture.sensor):
        distinct, of_spot = np.unique(points, axis=0, return_inverse=True)
        ends.append(
            _PathEnd(distinct, torch.from_numpy(of_spot.reshape(-1)), 2.0 if capture.confocal else 1.0)
        )
    return ends


def _block_columns(grid: VolumeGrid, ends: list[_PathEnd]) -> int:
    """Voxels of one slice to work on at a time."""
    return min(grid.shape[1] * grid.shape[2], max(64, _TABLE // sum(len(end.points) for end in ends)))


def _squared_distances(points: np.ndarray, centres: np.ndarray, scale: float) -> torch.Tensor:
    """``[P, V]`` squared distances between ``points [P, d]`` and ``centres [V, d]``, in units ``1/scale``."""
    a, b = torch.from_numpy(points * scale).float(), torch.from_numpy(centres * scale).float()
    total = torch.zeros(len(a), len(b))
    for axis in range(a.shape[1]):
        step = a[:, axis, None] - b[:, axis]
        total.addcmul_(step, step)
    return total


def _along(volume: torch.Tensor, axis: int, sigma: float, *, derivative: bool) -> torch.Tensor:
    """The volume convolved along one axis with a Gaussian or its second derivative.

    Edge values continue outside.
    """
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
