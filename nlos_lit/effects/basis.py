"""Smooth functions of one or two coordinates in [-1, 1]: uniform cubic B-splines without their constant."""

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
    columns = first[:, None] + torch.arange(4, device=u.device)
    return torch.zeros(len(u), n, dtype=u.dtype, device=u.device).scatter_add_(1, columns, weights)


def smooth_basis(u: Tensor, n: int) -> Tensor:
    """``[S, ≤ n - 1]`` orthonormal (over the S points, mean square 1) smooth functions that average to zero."""
    return _without_constant(spline_basis(u.double(), n)).to(u.dtype)


def smooth_map_basis(place: Tensor, n: int) -> Tensor:
    """``[S, ≤ n² - 1]`` the same over the wall, from ``place`` ``[S, 2]``."""
    x, y = spline_basis(place[:, 0].double(), n), spline_basis(place[:, 1].double(), n)
    return _without_constant((x[:, :, None] * y[:, None, :]).flatten(1)).to(place.dtype)


def _without_constant(basis: Tensor) -> Tensor:
    """Gram-Schmidt of the centred columns in their order, twice for accuracy; columns that add nothing are dropped.

    Not an SVD: on a square scan its singular values come in equal pairs whose vectors depend on the linear-algebra library, and
    stored coefficients would mean something else on another machine.
    """
    columns = (basis - basis.mean(0)).unbind(1)
    least = 1e-3 * max((float(c.norm()) for c in columns), default=0.0)
    kept = basis[:, :0]
    for column in columns:
        for _ in range(2):
            column = column - kept @ (kept.T @ column)
        if float(column.norm()) > least:
            kept = torch.cat([kept, (column / column.norm())[:, None]], 1)
    return kept * len(basis) ** 0.5
