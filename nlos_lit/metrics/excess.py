"""Along which axes counts depart from a model by more than counting noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nlos_lit.metrics.transients import expected_deviance, poisson_deviance

DEGREES = 5  # Legendre polynomials along each side of the wall: what varies slower is smooth
CLASSES = 12  # of bins by their rate
SIGNIFICANT = 3.0  # standard deviations of noise that structure must exceed


@dataclass(frozen=True)
class Excess:
    """Deviance above that of counting noise, and where it lies.

    Args:
        per_bin: mean Poisson deviance of a bin, less that of pure noise.
        ratio: mean Poisson deviance of a bin over that of pure noise; 1 is perfect.
        error: standard error of that ratio, from how much the bins' deviances scatter.
        along: ``level``, ``time``, ``wall``, ``scan``, ``rate`` → share of the whole excess that is
            structured along it, from 0 (nothing beyond noise) to 1. Axes overlap: shares need not add up
            to 1.
    """

    per_bin: float
    ratio: float
    error: float
    along: dict[str, float]


def excess_by_axis(
    counts: Tensor,
    expected: Tensor,
    places: Sequence[Tensor],
    runs: Tensor,
    observed: Tensor | None = None,
) -> Excess:
    """How much more than counting noise a model leaves, and along which axes it is structured.

    Residuals ``R = Σ(k - μ)`` are pooled along an axis, and their chi-square ``Σ R²/Σμ``, less the number of
    pools, which is its mean under noise, is compared with the deviance above noise. *level*: everything.
    *time*: each bin, over all spots. *rate*: twelve classes of bins by μ, with as many expected counts each.
    *wall*: Legendre polynomials of the place instead of pools (the score test of a smooth gain). *scan*: runs
    of spots, beyond what is smooth over the wall. Time, wall and rate are taken beyond the level.

    Args:
        counts: k, ``[S, T]`` photon counts.
        expected: μ, ``[S, T]``, positive where ``counts`` are.
        places: one or more ``[S, 2]`` lateral coordinates of wall points, from -1 to 1.
        runs: ``[S]`` integers, in which stretch of the scan each spot was taken.
        observed: ``[S, T]`` bool, the bins that were recorded; the others are left out. None: all.

    Returns:
        The excess and its shares; those within three standard deviations of noise are 0.

    Examples:
        Four spots over eight bins, twice as bright as expected on one half of the wall, dark on the other:

        >>> gain = torch.tensor([0.0, 0.0, 2.0, 2.0])[:, None]
        >>> expected = torch.full((4, 8), 50.0)
        >>> places = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
        >>> found = excess_by_axis(gain * expected, expected, [places], torch.tensor([0, 1, 0, 1]))
        >>> [name for name, share in found.along.items() if share > 0]
        ['wall']
    """
    counts, expected = counts.double(), expected.double()
    seen = torch.ones_like(counts, dtype=torch.bool) if observed is None else observed
    deviances, noise = poisson_deviance(counts[seen], expected[seen]), expected_deviance(expected[seen])
    deviance = deviances.mean()
    variance = expected * seen
    residual = (counts - expected) * seen
    per_spot = residual.sum(1), variance.sum(1)
    time = torch.arange(counts.shape[1], device=counts.device).expand_as(counts)
    smooth = torch.cat([_smooth(place.double()) for place in places], dim=1)
    run = torch.nn.functional.one_hot(torch.unique(runs, return_inverse=True)[1]).double()
    level = _pooled(residual, variance, torch.zeros_like(time))
    wall = _projected(*per_spot, smooth)
    found = {
        "level": level,
        "time": _beyond(_pooled(residual, variance, time), level),
        "wall": _beyond(wall, level),
        "scan": _beyond(_projected(*per_spot, torch.cat([smooth, run], dim=1)), wall),
        "rate": _beyond(_pooled(residual, variance, _classes(variance)), level),
    }
    whole = float((deviance - noise) * seen.sum())
    return Excess(
        per_bin=float(deviance - noise),
        ratio=float(deviance / noise),
        error=float(deviances.std() / len(deviances) ** 0.5 / noise),
        along={name: _share(*value, whole) for name, value in found.items()},
    )


def _pooled(residual: Tensor, variance: Tensor, group: Tensor) -> tuple[float, int]:
    """Chi-square of residuals summed over groups, and how many groups hold anything."""
    size, flat = int(group.max()) + 1, group.reshape(-1)
    totals = [v.new_zeros(size).index_add_(0, flat, v.reshape(-1)) for v in (residual, variance)]
    kept = totals[1] > 0
    return float((totals[0][kept] ** 2 / totals[1][kept]).sum()), int(kept.sum())


def _projected(residual: Tensor, variance: Tensor, basis: Tensor) -> tuple[float, int]:
    """Chi-square of residuals ``[S]`` that gains out of a basis ``[S, P]`` take up, and its rank.

    A gain ``1 + Bc`` changes what is expected by ``vBc``; the best c takes up ``g·H⁻¹g`` with ``g = Bᵀr`` and
    ``H = Bᵀ diag(v) B``. For a basis of indicators that is :func:`_pooled`.
    """
    kept = variance > 0
    scale = variance[kept].sqrt()
    left, size, _ = torch.linalg.svd(basis[kept] * scale[:, None], full_matrices=False)
    inside = left[:, size > 1e-9 * size.max()]
    return float(((inside.T @ (residual[kept] / scale)) ** 2).sum()), inside.shape[1]


def _beyond(value: tuple[float, int], base: tuple[float, int]) -> tuple[float, int]:
    return value[0] - base[0], value[1] - base[1]


def _share(chi_square: float, number: int, whole: float) -> float:
    """Structure beyond noise over the whole excess; one that noise can make counts as none."""
    structured = chi_square - number
    if structured <= SIGNIFICANT * (2 * max(1, number)) ** 0.5:
        return 0.0
    return structured / max(whole, structured)


def _smooth(place: Tensor) -> Tensor:
    """``[S, 25]`` products of Legendre polynomials of both coordinates."""
    columns = [torch.ones_like(place), place]
    for n in range(1, DEGREES - 1):
        columns.append(((2 * n + 1) * place * columns[-1] - n * columns[-2]) / (n + 1))
    u, v = torch.stack(columns, dim=2).unbind(1)
    return (u[:, :, None] * v[:, None, :]).flatten(1)


def _classes(expected: Tensor) -> Tensor:
    """Class of each element by its size, equal ones in one; all classes sum to about the same."""
    value = expected.reshape(-1).sort().values
    reached = value.cumsum(0)
    parts = torch.arange(1, CLASSES, device=value.device) / CLASSES * reached[-1]
    return torch.bucketize(expected, value[torch.searchsorted(reached, parts)])
