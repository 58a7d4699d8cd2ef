"""Refits of the whole model together with effects, and what they bring on spots that were not fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nlos_lit.inference.joint_step import best_start
from nlos_lit.inference.per_spot import factors, solve, sparse, spot_scores
from nlos_lit.inference.screen import Candidate
from nlos_lit.metrics.transients import Scores
from nlos_lit.surfels.fit import SurfelFit
from nlos_lit.surfels.refine import score_spots

BOOTSTRAP = 400


@dataclass(frozen=True)
class Comparison:
    """Gain of one model over another, nats, with the standard error and 95 % interval by bootstrap over wall
    blocks.
    """

    nats: float
    error: float
    interval: tuple[float, float]


def refit_with(
    fit: SurfelFit, candidates: list[Candidate], steps: int, seed: int, beside: Tensor | None = None
) -> SurfelFit:
    """Warm-started joint refit with more effects (none: the control), begun at their one-step estimates.

    ``beside`` ``[P]``: what the base does at the same time; None takes that of a single candidate, and
    nothing for several.
    """
    if beside is None and len(candidates) == 1:
        beside = candidates[0].beside
    again = best_start(fit, [c.effect for c in candidates], [c.step for c in candidates], beside, seed)
    random = [e for e in again.extension.effects if e.per_spot]
    for effect in random:  # solved spot by spot: random batches would visit each number a few times only
        effect.requires_grad_(False)
        solve(again.model, again.extension, effect, again.train, again.counts)
    again.run(1, steps=steps, settle=False)
    for effect in random:
        solve(again.model, again.extension, effect, again.train, again.counts)
    return again


def log_likelihood(fit: SurfelFit, spots: np.ndarray) -> Tensor:
    """``[S]`` Poisson log-likelihood of each spot that was not fitted (without ln k!), marginal over per-spot
    effects.
    """
    index = torch.from_numpy(spots)
    first, last = fit.capture.gate
    counts = torch.from_numpy(fit.capture.counts[spots, first:last].astype(np.float64))
    expected = fit.model.expected(index, fit.extension).double().clamp_min(1e-9)
    value = (torch.xlogy(counts, expected) - expected).sum(1)
    for effect in fit.extension.effects:
        if effect.per_spot:
            score, information, _ = spot_scores(fit.model, fit.extension, effect, index, counts)
            value += factors(score, information, effect.width, effect.share, sparse(effect))
    return value


def compare(before: Tensor, after: Tensor, block: np.ndarray, seed: int = 0) -> Comparison:
    """Paired comparison of log-likelihoods ``[S]`` of the same spots in wall blocks ``block`` ``[S]``."""
    names, index = np.unique(block, return_inverse=True)
    gain = np.zeros(len(names))
    np.add.at(gain, index, (after - before).numpy())
    draws = np.random.default_rng(seed).integers(len(names), size=(BOOTSTRAP, len(names)))
    sums = gain[draws].sum(1)
    low, high = np.quantile(sums, (0.025, 0.975))
    return Comparison(float(gain.sum()), float(sums.std(ddof=1)), (float(low), float(high)))


def score(fit: SurfelFit, spots: np.ndarray) -> Scores:
    """Deviance and NMSE of spots, with their noise levels."""
    return score_spots(fit.model, fit.capture, torch.from_numpy(spots), fit.extension)
