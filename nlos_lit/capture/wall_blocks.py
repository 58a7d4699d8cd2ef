"""Contiguous patches of the scanned wall."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from nlos_lit.capture.capture import Capture


def wall_blocks(capture: Capture, number: int) -> np.ndarray:
    """Which patch of the wall every spot lies in.

    What is scanned are the sensor's points where they move, else the laser's.

    Args:
        capture: whose wall points are divided.
        number: patches along each side, of equal extent.

    Returns:
        ``[S]`` patches, from 0, row after row: ``divmod`` by ``number`` gives row and column.
    """
    points = [p for p in (capture.laser, capture.sensor) if np.ptp(p, axis=0).max() > 0]
    xy = points[-1][:, :2] if points else capture.laser[:, :2]
    low, extent = xy.min(0), np.maximum(np.ptp(xy, axis=0), 1e-9)
    place = np.minimum((xy - low) / extent * number, number - 1e-6).astype(int)
    return place[:, 0] * number + place[:, 1]


def by_block(values: Tensor, block: np.ndarray) -> np.ndarray:
    """Sums over wall blocks.

    Args:
        values: ``[S, …]`` of spots.
        block: ``[S]`` wall block of each.

    Returns:
        ``[B, …]`` in double precision, by rising block.

    Examples:
        >>> import torch
        >>> by_block(torch.tensor([1.0, 2.0, 4.0]), np.array([7, 3, 7])).tolist()
        [2.0, 5.0]
    """
    names, index = np.unique(block, return_inverse=True)
    total = np.zeros((len(names), *values.shape[1:]))
    np.add.at(total, index, values.numpy())
    return total
