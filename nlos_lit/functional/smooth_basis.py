"""Smooth functions of one or two coordinates: combinations of cubic B-splines, the smoothest first."""

from __future__ import annotations

import torch
from torch import Tensor

# slopes along the second axis weigh more: otherwise equal pairs of a square would mix at the eigensolver's
# whim
UNEVEN = 1.1


def spline_basis(u: Tensor, n: int) -> Tensor:
    """Uniform cubic B-splines over [-1, 1]; they sum to one everywhere.

    Args:
        u: ``[S]`` places in [-1, 1].
        n: number of splines, at least 4.

    Returns:
        ``[S, n]`` values.

    Source: C. de Boor, *A Practical Guide to Splines*, 1978.

    Examples:
        >>> spline_basis(torch.tensor([-1.0, 1.0]), 4).round(decimals=4)
        tensor([[0.1667, 0.6667, 0.1667, 0.0000],
                [0.0000, 0.1667, 0.6667, 0.1667]])
    """
    pieces = n - 3
    place = ((u + 1) / 2 * pieces).clamp(0, pieces - 1e-5)
    first = place.floor().long()
    f = place - first
    g = 1 - f
    weights = torch.stack([g**3, 3 * f**3 - 6 * f**2 + 4, 3 * g**3 - 6 * g**2 + 4, f**3], 1) / 6
    columns = first[:, None] + torch.arange(4, device=u.device)
    return torch.zeros(len(u), n, dtype=u.dtype, device=u.device).scatter_add_(1, columns, weights)


def smooth_basis(u: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Smooth functions of one coordinate.

    Over the S points they average to zero with mean square 1; over the interval their slopes are orthogonal.

    Args:
        u: ``[S]`` places in [-1, 1].
        n: number of splines that they combine, at least 4.

    Returns:
        ``[S, K ≤ n - 1]`` functions, the smoothest first, and their shares ``[K]``: (first's mean squared
        slope)/(its own), the inverse square of its frequency.

    Examples:
        >>> functions, share = smooth_basis(torch.linspace(-1, 1, 50), 6)
        >>> functions.shape, [round(s, 2) for s in share.tolist()[:3]]
        (torch.Size([50, 5]), [1.0, 0.25, 0.11])
        >>> torch.allclose(functions.T @ functions / 50, torch.eye(5), atol=1e-4)
        True
    """
    mass, stiffness = _line_products(n)
    return _by_smoothness(spline_basis(u.double(), n), stiffness, mass, u.dtype)


def smooth_map_basis(place: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Smooth functions of a place on the wall, as :func:`smooth_basis` has them along a line.

    Args:
        place: ``[S, 2]`` in [-1, 1]².
        n: number of splines along either side, at least 4.

    Returns:
        ``[S, K ≤ n² - 1]`` functions, the smoothest first, and their shares ``[K]``.
    """
    x, y = spline_basis(place[:, 0].double(), n), spline_basis(place[:, 1].double(), n)
    mass, line = _line_products(n)
    stiffness = torch.kron(line, mass) + UNEVEN * torch.kron(mass, line)
    return _by_smoothness(
        (x[:, :, None] * y[:, None, :]).flatten(1), stiffness, torch.kron(mass, mass), place.dtype
    )


def _line_products(n: int, points: int = 2001) -> tuple[Tensor, Tensor]:
    """``[n, n]`` integrals over [-1, 1] of products of the splines, and of their slopes."""
    values = spline_basis(torch.linspace(-1, 1, points, dtype=torch.float64), n)
    step = 2 / (points - 1)
    middle, slope = (values[1:] + values[:-1]) / 2, values.diff(dim=0) / step
    return step * middle.T @ middle, step * slope.T @ slope


def _by_smoothness(
    basis: Tensor, stiffness: Tensor, mass: Tensor, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Combinations of the columns, centred, orthogonal over the points and in slope; empty ones dropped."""
    centred = basis - basis.mean(0)
    values, vectors = torch.linalg.eigh(stiffness + 1e-6 * mass)
    whiten = vectors * values.rsqrt()
    share, mixed = torch.linalg.eigh(whiten.T @ (centred.T @ centred) @ whiten)
    functions = centred @ (whiten @ mixed)
    kept = share.flip(0) > 1e-5 * share[-1].clamp_min(1e-12 * len(basis))
    functions, share = functions.flip(1)[:, kept], share.flip(0)[kept]
    functions = functions * (len(basis) / share).sqrt()
    # Signs are the eigensolver's whim; stored coefficients must mean the same everywhere.
    ramp = torch.linspace(0, 1, len(basis), dtype=torch.float64).exp() @ functions
    functions = functions * torch.where(ramp < 0, -1.0, 1.0)
    return functions.to(dtype), (share / share[:1]).to(dtype)
