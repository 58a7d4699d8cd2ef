"""Flexible discrepancies: may say that something is wrong along an axis, never what (after Kennedy and
O'Hagan, 2001).

Each axis has its own columns: the expected counts within one band of the axis. Along wall and scan there is
one more set for every effect with one random number a spot that the counts ask for: that number, the same
within a band. So an object that moves during the scan shows as a delay that is smooth along it, and not as
jitter. All are tested like effects, projected off the base and all accepted effects, and cross-validated over
random spots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.inference.problem import Problem, weighted_columns
from nlos_lit.inference.screen import FOLDS, Projector

BANDS = {"time": 40, "wall": 8, "scan": 64, "rate": 10}
RETAINED = 1e-3  # share of a combination's information that the base must leave
# share of a per-spot effect's gain that neighbours have in common, from which on its numbers are not
# independent
SMOOTH = 0.5


@dataclass(frozen=True)
class Discrepancy:
    """What an axis says by itself.

    Args:
        axis: ``time``, ``wall``, ``scan``, ``rate`` or two of them.
        gain: nats, cross-validated.
        statistic: of the score test.
        degrees: columns of it.
        p_value: of the statistic.
        of: the per-spot effect smoothed, or "".
    """

    axis: str
    gain: float
    statistic: float
    degrees: int
    p_value: float
    of: str = ""


def discrepancies(
    problem: Problem, projector: Projector, scan: Scan, per_spot: Sequence[Effect] = ()
) -> list[Discrepancy]:
    """One discrepancy for each axis, and two for each per-spot effect; the largest gain first.

    Stretches of a raster are stripes of the wall: a map of the wall that holds nothing beyond the order of
    the scan is left out.

    Args:
        problem: of the tested spots.
        projector: takes off what the base can explain.
        scan: of the capture.
        per_spot: effects whose numbers may be smooth along wall or scan.

    Returns:
        what each says.
    """
    root = problem.expected.sqrt()
    asked = {"": (root, tuple(BANDS))}
    for effect in per_spot:
        asked[effect.name] = weighted_columns(problem, effect)[:, 0].view(root.shape), ("scan", "wall")
    found: list[Discrepancy] = []
    for of, (column, axes) in asked.items():
        tests = {axis: _test(column, problem, projector, (axis,), scan, of) for axis in axes}
        if tests["wall"].gain > tests["scan"].gain > SMOOTH * tests["wall"].gain:
            both = _test(column, problem, projector, ("scan", "wall"), scan, of)
            if both.gain <= tests["scan"].gain:
                del tests["wall"]
        found += tests.values()
    return sorted(found, key=lambda d: -d.gain)


def smooth(found: list[Discrepancy], name: str, gain: float) -> bool:
    """Whether neighbours share much of what a per-spot effect gains.

    Its numbers are then not independent.

    Args:
        found: discrepancies.
        name: of the effect.
        gain: of the effect by itself, nats.

    Returns:
        whether a smoothed one holds more than the share ``SMOOTH``.
    """
    return any(d.of == name and d.gain > SMOOTH * gain for d in found)


def counted(found: list[Discrepancy]) -> float:
    """Nats that a function of the count rate gains.

    Of an effect of the registry it never holds as much as the effect itself.
    """
    return next(d.gain for d in found if d.axis == "rate")


def bands(problem: Problem, axis: str, scan: Scan) -> Tensor:
    """The band of each spot or bin along an axis.

    Args:
        problem: of the tested spots.
        axis: ``time``, ``wall``, ``scan`` or ``rate``.
        scan: of the capture.

    Returns:
        ``[S]`` (wall, scan, rate) or ``[T]`` (time) numbers of bands.
    """
    number = BANDS[axis]
    if axis == "time":
        return torch.arange(problem.bins) * number // problem.bins
    if axis == "scan":
        return ((scan.rank[problem.spots] + 1) / 2 * number).long().clamp_max(number - 1)
    if axis == "wall":
        place = ((scan.places[-1][problem.spots] + 1) / 2 * number).long().clamp(0, number - 1)
        return place[:, 0] * number + place[:, 1]
    total = problem.expected.sum(1)
    return torch.argsort(torch.argsort(total)) * number // len(total)


def _test(
    column: Tensor, problem: Problem, projector: Projector, axes: Sequence[str], scan: Scan, of: str
) -> Discrepancy:
    """``column`` ``[S, T]``, with a coefficient of its own in every band of every axis."""
    parts = []
    for axis in axes:
        names, band = torch.unique(bands(problem, axis, scan), return_inverse=True)
        onehot = torch.nn.functional.one_hot(band, len(names)).float()
        parts.append(column[:, :, None] * (onehot[None] if axis == "time" else onehot[:, None]))
    return Discrepancy("+".join(axes), *flexible(torch.cat(parts, 2), problem, projector), of)


def flexible(columns: Tensor, problem: Problem, projector: Projector) -> tuple[float, float, int, float]:
    """Score test of weighted columns, cross-validated over random spots.

    Combinations that the base can imitate (``RETAINED``) are left out: their scores and information are
    rounding errors.

    Args:
        columns: ``[S, T, k]``, divided by √μ.
        problem: of the S spots.
        projector: takes off what the base can explain.

    Returns:
        gain (nats), statistic, degrees and p-value.
    """
    spots, bins, k = columns.shape
    raw = columns.reshape(-1, k)
    z = projector.off(raw).view(spots, bins, k)
    scale = raw.double().square().sum(0).clamp_min(1e-30).rsqrt()
    folds = torch.from_numpy(np.random.default_rng(1).permutation(spots) % FOLDS)
    score = torch.einsum("sbk,sb->sk", z, projector.residual.view(spots, bins)).double() * scale
    information = torch.einsum("sbk,sbl->skl", z, z).double() * scale[:, None] * scale
    values, vectors = torch.linalg.eigh(information.sum(0))
    kept = vectors[:, values > RETAINED]
    s = torch.zeros(FOLDS, k, dtype=torch.float64).index_add_(0, folds, score) @ kept
    f = kept.T @ torch.zeros(FOLDS, k, k, dtype=torch.float64).index_add_(0, folds, information) @ kept
    total = f.sum(0)
    floor = torch.diag(RETAINED * total.diagonal())
    gain = 0.0
    for b in range(FOLDS):
        step = torch.linalg.solve(total - f[b] + floor, s.sum(0) - s[b])
        gain += float(step @ s[b] - 0.5 * step @ f[b] @ step)
    statistic = float(s.sum(0) @ torch.linalg.solve(total, s.sum(0)))
    degrees = kept.shape[1]
    return gain, statistic, degrees, float(stats.chi2.sf(statistic, degrees))
