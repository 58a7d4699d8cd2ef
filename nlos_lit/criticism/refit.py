"""Refits of the whole model together with effects, and what they bring on spots that were not fitted."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nlos_lit.criticism.per_spot import factors, solve, sparse, spot_scores
from nlos_lit.criticism.result import Scores
from nlos_lit.criticism.screen import Candidate
from nlos_lit.criticism.sensitivity import acting_order
from nlos_lit.effects.base import Effect, Extension
from nlos_lit.refine import score_spots
from nlos_lit.surfel_fit import SurfelFit

BOOTSTRAP = 400


@dataclass(frozen=True)
class Comparison:
    """Gain of one model over another, nats, with the standard error and 95 % interval by bootstrap over wall blocks."""

    nats: float
    error: float
    interval: tuple[float, float]


def copy_effects(extension: Extension, extra: list[Effect]) -> Extension:
    """A copy of the extension with more effects at their present values, in order of application."""
    return Extension(sorted((copy.deepcopy(e) for e in [*extension.effects, *extra]), key=acting_order))


def set_step(effect: Effect, step: Tensor) -> None:
    """Move an effect's stored amplitudes by ``step`` ``[k]`` (all amplitudes in order), within bounds."""
    with torch.no_grad():
        start = 0
        for p in effect.amplitudes:
            getattr(effect, f"raw_{p.name}").add_(step[start : start + p.size])
            start += p.size
    effect.clamp()


def refit_with(fit: SurfelFit, candidates: list[Candidate], steps: int, seed: int, rounds: int = 1) -> SurfelFit:
    """Warm-started joint refit with more effects (none: the control), begun at their one-step estimates.

    ``rounds`` above 1 let surfels die and grow first.
    """
    extra = []
    for candidate in candidates:
        effect = copy.deepcopy(candidate.effect)
        set_step(effect, candidate.step)
        extra.append(effect)
    again = fit.copy(copy_effects(fit.extension, extra), seed)
    random = [e for e in again.extension.effects if e.per_spot]
    for effect in random:  # solved spot by spot: random batches would visit each number a few times only
        effect.requires_grad_(False)
        solve(again.model, again.extension, effect, again.train, again.counts)
    again.run(rounds, steps=steps, settle=False, grow_first=rounds > 1)
    for effect in random:
        solve(again.model, again.extension, effect, again.train, again.counts)
    return again


def log_likelihood(fit: SurfelFit, spots: np.ndarray) -> Tensor:
    """``[S]`` Poisson log-likelihood of each spot that was not fitted (without ln k!), marginal over per-spot effects."""
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
    found = score_spots(fit.model, fit.capture, torch.from_numpy(spots), fit.extension)
    return Scores(found.deviance_per_bin, found.deviance_noise, found.nmse, found.nmse_noise_floor)
