"""Smooth functions of one or two coordinates in [-1, 1]: uniform clamped cubic B-splines without their constant."""

from __future__ import annotations

import torch
from torch import Tensor


def spline_basis(u: Tensor, n: int) -> Tensor:
    """``[S, n]`` values of n ≥ 4 uniform cubic B-splines at ``u`` ``[S]`` in [-1, 1]; they sum to one everywhere."""
    pieces = n - 3
    place = ((u + 1) / 2 * pieces).clamp(0, pieces - 1e-5)
    first = place.floor().long()
    f = place - first
    g = 1 - f
    weights = torch.stack([g**3, 3 * f**3 - 6 * f**2 + 4, 3 * g**3 - 6 * g**2 + 4, f**3], 1) / 6
    return torch.zeros(len(u), n, dtype=u.dtype, device=u.device).scatter_add_(1, first[:, None] + torch.arange(4), weights)


def smooth_basis(u: Tensor, n: int) -> Tensor:
    """``[S, n - 1]`` orthonormal (over the S points, mean square 1) smooth functions that average to zero."""
    return _without_constant(spline_basis(u, n))


def smooth_map_basis(place: Tensor, n: int) -> Tensor:
    """``[S, n² - 1]`` the same over the wall, from ``place`` ``[S, 2]``."""
    x, y = spline_basis(place[:, 0], n), spline_basis(place[:, 1], n)
    return _without_constant((x[:, :, None] * y[:, None, :]).flatten(1))


def _without_constant(basis: Tensor) -> Tensor:
    centred = (basis - basis.mean(0)).double()
    u, s, _ = torch.linalg.svd(centred, full_matrices=False)
    keep = s > 1e-3 * s[0]
    return (u[:, keep] * len(basis) ** 0.5).to(basis.dtype)
