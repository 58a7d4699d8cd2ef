"""What fits are worth on spots that took part in none of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.wall_blocks import by_block
from nlos_lit.inference.per_spot import factors, neighbours, own_part, sparse, spot_scores
from nlos_lit.metrics.transients import Scores
from nlos_lit.surfels.fit import SurfelFit, score_spots

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
            if not effect.in_runs:
                score, information = own_part(score, information, neighbours(fit.model, index))
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
    gain = by_block(after - before, block)
    draws = np.random.default_rng(seed).integers(len(gain), size=(BOOTSTRAP, len(gain)))
    sums = gain[draws].sum(1)
    low, high = np.quantile(sums, (0.025, 0.975))
    return Comparison(float(gain.sum()), float(sums.std(ddof=1)), (float(low), float(high)))


def weights(likelihoods: Sequence[Tensor], block: np.ndarray, seed: int = 0) -> list[float]:
    """How far the wall blocks leave open which of several models predicts best.

    Pseudo-Bayesian model averaging over Dirichlet weights of the blocks (Y. Yao, A. Vehtari, D. Simpson,
    A. Gelman, *Bayesian Analysis* 13, 2018): the mean posterior share of each, had other blocks been drawn.

    Args:
        likelihoods: ``[S]`` nats of the same spots, one for each model.
        block: ``[S]`` wall block of each spot.
        seed: of the draws.

    Returns:
        one weight a model; they sum to 1.

    Examples:
        >>> same = torch.tensor([1.0, 1.0, 2.0, 2.0])
        >>> [round(w, 2) for w in weights([same, same - 9], np.array([0, 0, 1, 1]))]
        [1.0, 0.0]
    """
    table = by_block(torch.stack(list(likelihoods), 1), block)
    drawn = len(table) * np.random.default_rng(seed).dirichlet(np.ones(len(table)), BOOTSTRAP) @ table
    shares = np.exp(drawn - drawn.max(1, keepdims=True))
    return (shares / shares.sum(1, keepdims=True)).mean(0).tolist()


def score(fit: SurfelFit, spots: np.ndarray) -> Scores:
    """Deviance and NMSE of spots, with their noise levels.

    Args:
        fit: that is judged.
        spots: ``[S]`` rows of the capture.

    Returns:
        means over the spots' gated bins.
    """
    return score_spots(fit.model, fit.capture, torch.from_numpy(spots), fit.extension)
