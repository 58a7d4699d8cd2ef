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
from nlos_lit.surfels.fitted import score_spots

BOOTSTRAP = 400


@dataclass(frozen=True)
class Comparison:
    """Gain of one model over another.

    Args:
        nats: the gain.
        error: its standard error by bootstrap over wall blocks.
        interval: of 95 %, likewise.
    """

    nats: float
    error: float
    interval: tuple[float, float]


def refit_with(
    fit: SurfelFit, candidates: list[Candidate], steps: int, seed: int, beside: Tensor | None = None
) -> SurfelFit:
    """Warm-started joint refit with more effects (none: the control), begun at their one-step estimates.

    Args:
        fit: that is copied.
        candidates: whose effects are added.
        steps: batches (and as many again at falling rate).
        seed: of the batches.
        beside: ``[P]`` what the base does at the same time; None takes that of a single candidate, and
            nothing for several.

    Returns:
        the refitted copy.
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
    """Poisson log-likelihood of spots that were not fitted (without ln k!), marginal over per-spot effects.

    Args:
        fit: that is judged.
        spots: ``[S]`` rows of the capture.

    Returns:
        ``[S]`` nats.
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
    """Paired comparison of log-likelihoods of the same spots.

    Args:
        before: ``[S]`` nats.
        after: ``[S]`` nats.
        block: ``[S]`` wall block of each spot.
        seed: of the bootstrap.

    Returns:
        the gain of ``after`` over ``before``.

    Examples:
        >>> found = compare(torch.zeros(4), torch.tensor([1.0, 2.0, 1.0, 2.0]), np.array([0, 0, 1, 1]))
        >>> found.nats, found.error
        (6.0, 0.0)
    """
    names, index = np.unique(block, return_inverse=True)
    gain = np.zeros(len(names))
    np.add.at(gain, index, (after - before).numpy())
    draws = np.random.default_rng(seed).integers(len(names), size=(BOOTSTRAP, len(names)))
    sums = gain[draws].sum(1)
    low, high = np.quantile(sums, (0.025, 0.975))
    return Comparison(float(gain.sum()), float(sums.std(ddof=1)), (float(low), float(high)))


def score(fit: SurfelFit, spots: np.ndarray) -> Scores:
    """Deviance and NMSE of spots, with their noise levels.

    Args:
        fit: that is judged.
        spots: ``[S]`` rows of the capture.

    Returns:
        means over the spots' gated bins.
    """
    return score_spots(fit.model, fit.capture, torch.from_numpy(spots), fit.extension)
