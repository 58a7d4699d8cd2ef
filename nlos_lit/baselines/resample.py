"""Linear resampling of a volume from the lattice a method works on to the grid that was asked for."""

from __future__ import annotations

import numpy as np
import torch


def linear_weights(start: float, pitch: float, count: int, centres: np.ndarray, width: float) -> torch.Tensor:
    """Matrix that interpolates evenly spaced samples linearly and averages over voxels, along one axis.

    A voxel narrower than the sample pitch takes the interpolated value at its centre; a wider one takes the
    mean over ``width``, so that no sample is skipped. Voxels whose centre lies more than half a pitch outside
    the samples get zero. Where the two lattices coincide the matrix is the identity.

    Args:
        start: place of sample 0.
        pitch: spacing of the samples, positive; all in one unit.
        count: M, number of samples.
        centres: ``[N]`` centres of voxels.
        width: of a voxel; its sign does not matter.

    Returns:
        ``[N, M]`` float32.

    Examples:
        >>> import numpy as np
        >>> linear_weights(0.0, 1.0, 3, np.array([0.25, 2.0, 9.0]), 0.5)
        tensor([[0.7500, 0.2500, 0.0000],
                [0.0000, 0.0000, 1.0000],
                [0.0000, 0.0000, 0.0000]])
    """
    parts = max(1, int(np.ceil(abs(width) / pitch - 1e-6)))
    offsets = ((np.arange(parts) + 0.5) / parts - 0.5) * abs(width)
    position = (centres[:, None] + offsets - start) / pitch
    inside = (position > -0.5 - 1e-6) & (position < count - 0.5 + 1e-6)
    nearest = np.rint(position)
    position = np.clip(np.where(np.abs(position - nearest) < 1e-6, nearest, position), 0, count - 1)
    low = np.minimum(position.astype(int), max(count - 2, 0))
    high = np.minimum(low + 1, count - 1)
    share = position - low
    weights = np.zeros((len(centres), count))
    rows = np.broadcast_to(np.arange(len(centres))[:, None], low.shape)
    np.add.at(weights, (rows, low), inside * (1 - share) / parts)
    np.add.at(weights, (rows, high), inside * share / parts)
    return torch.from_numpy(weights).float()


def apply_weights(
    volume: torch.Tensor, along_z: torch.Tensor, along_x: torch.Tensor, along_y: torch.Tensor
) -> torch.Tensor:
    """Resample a volume by one matrix per axis; identities along x and y are skipped.

    Args:
        volume: ``[mz, mx, my]``.
        along_z: ``[nz, mz]``.
        along_x: ``[nx, mx]``.
        along_y: ``[ny, my]``.

    Returns:
        ``[nz, nx, ny]``, contiguous.
    """
    volume = torch.tensordot(along_z, volume, dims=1)
    if not _identity(along_x):
        volume = torch.einsum("ix,zxy->ziy", along_x, volume)
    if not _identity(along_y):
        volume = volume @ along_y.T
    return volume.contiguous()


def _identity(weights: torch.Tensor) -> bool:
    rows, columns = weights.shape
    return rows == columns and bool(torch.equal(weights, torch.eye(rows)))
