"""Flexible discrepancies: may say that something is wrong along an axis, never what (after Kennedy and O'Hagan, 2001).

Each axis has its own columns: the expected counts (time, rate) or the signal (wall, scan) within one band of the axis. They are
tested like effects, projected off the base and all accepted effects, and cross-validated over random spots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from nlos_lit.criticism.screen import FOLDS, Projector
from nlos_lit.criticism.sensitivity import Problem
from nlos_lit.effects.scan import Scan

BANDS = {"time": 40, "wall": 8, "scan": 64, "rate": 10}


@dataclass(frozen=True)
class Discrepancy:
    """``gain`` nats (cross-validated); ``statistic`` of ``degrees`` columns."""

    axis: str
    gain: float
    statistic: float
    degrees: int
    p_value: float


def discrepancies(problem: Problem, projector: Projector, scan: Scan) -> list[Discrepancy]:
    """One for each axis, the largest gain first."""
    return sorted((_test(problem, projector, axis, scan) for axis in BANDS), key=lambda d: -d.gain)


def bands(problem: Problem, axis: str, scan: Scan) -> Tensor:
    """``[S]`` (wall, scan, rate) or ``[T]`` (time) band of each spot or bin."""
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


def _test(problem: Problem, projector: Projector, axis: str, scan: Scan) -> Discrepancy:
    band = bands(problem, axis, scan)
    names, band = torch.unique(band, return_inverse=True)
    k = len(names)
    spots, bins = problem.expected.shape
    onehot = torch.nn.functional.one_hot(band, k).float()
    root = problem.expected.sqrt()
    columns = root[:, :, None] * (onehot[None] if axis == "time" else onehot[:, None])
    z = projector.off(columns.reshape(-1, k)).view(spots, bins, k)
    folds = torch.from_numpy(np.random.default_rng(1).permutation(spots) % FOLDS)
    score = torch.einsum("sbk,sb->sk", z, projector.residual.view(spots, bins)).double()
    s = torch.zeros(FOLDS, k, dtype=torch.float64).index_add_(0, folds, score)
    f = torch.stack([z[folds == b].reshape(-1, k).T @ z[folds == b].reshape(-1, k) for b in range(FOLDS)]).double()
    total = f.sum(0)
    floor = torch.diag(1e-6 * total.diagonal().mean() * torch.ones(k, dtype=torch.float64))
    gain = 0.0
    for b in range(FOLDS):
        step = torch.linalg.solve(total - f[b] + floor, s.sum(0) - s[b])
        gain += float(step @ s[b] - 0.5 * step @ f[b] @ step)
    statistic = float(s.sum(0) @ torch.linalg.solve(total + floor, s.sum(0)))
    return Discrepancy(axis, gain, statistic, k, float(stats.chi2.sf(statistic, k)))
