"""Effects with one random number a spot: nothing can be predicted for a spot that was not measured, but its
scatter can.

A spot's coefficient δ is drawn from N(0, σ²), with probability π where it is sparse and positive (half
normal), else always. With the spot's own score s and information F the marginal likelihood over δ is, up to
what does not depend on σ (Laplace; exact for Gaussian counts),

    ln[(1 - π) + π exp(½ σ²s²/(1 + σ²F)) / √(1 + σ²F)]

(half normal: the second term times 2Φ of the posterior's mean in its standard deviations).

So spots that no fit saw still say whether the width is right.

Where coefficients are independent of each other, what a spot shares with its neighbours on the wall is none
of its own, but the scene's, or another term's. It is taken off first, :func:`own_part`.
"""

from __future__ import annotations

import math

import torch
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.problem import FEWEST, expected_and_columns
from nlos_lit.surfels.model import SurfelModel

SHARES = (0.003, 0.01, 0.03, 0.1, 0.3)
NEIGHBOURS = 8  # of a spot on the wall: over their mean stands what is its own


def sparse(effect: Effect) -> bool:
    """Its coefficients are positive and rare."""
    return effect.amplitudes[0].lower == effect.amplitudes[0].null


def neighbours(scan: SurfelModel | Capture, spots: Tensor) -> Tensor:
    """Which spots are nearest to each on the wall.

    Args:
        scan: what knows their laser and sensor points.
        spots: ``[S]`` rows of the capture.

    Returns:
        ``[S, K]`` places in ``spots``, of ``NEIGHBOURS`` others or of all there are.
    """
    points = [torch.as_tensor(p, device="cpu")[spots] for p in (scan.laser, scan.sensor)]
    places = torch.cat(points, 1).numpy()
    number = min(NEIGHBOURS, len(spots) - 1)
    near = torch.from_numpy(cKDTree(places).query(places, number + 1)[1]).view(len(spots), -1)
    itself = near == torch.arange(len(spots))[:, None]
    return near.gather(1, itself.int().argsort(stable=True, dim=1))[:, :number]


def own_part(
    score: Tensor, information: Tensor, near: Tensor, own: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Score and information of what a spot's coefficient has over the mean of its neighbours'.

    Args:
        score: ``[S]`` of the whole coefficients at 0.
        information: ``[S]`` of them.
        near: ``[S, K]`` from :func:`neighbours`.
        own: ``[S]`` what is known of the neighbours' own parts; without it their scatter counts for the
            spot's, which makes a width by √(1 + 1/K) too large.

    Returns:
        both, ``[S]``; those of spots without neighbours as they are.

    Examples:
        Three spots of 5, 5 and 8, each measured to ±1: the last has 3 of its own, to ±√1.5.

        >>> near = torch.tensor([[1, 2], [0, 2], [0, 1]])
        >>> score, information = own_part(torch.tensor([5.0, 5.0, 8.0]), torch.ones(3), near)
        >>> (score / information).tolist(), round(float(information[2]), 3)
        ([-1.5, -1.5, 3.0], 0.667)
    """
    if near.shape[1] == 0:
        return score, information
    left = score if own is None else score - information * own
    around = information[near].sum(1)
    its = 1 / (1 / information + 1 / around)
    return its * (score / information - left[near].sum(1) / around), its


def factors(
    score: Tensor, information: Tensor, width: float | Tensor, share: float, positive: bool
) -> Tensor:
    """Log marginal likelihood ratio of each spot against no effect, see the module's equation.

    Args:
        score: ``[S]`` of the spot's own coefficient at 0.
        information: ``[S]`` of it, > 0.
        width: σ of the coefficients, or ``[W, 1]`` of them.
        share: π of the spots that have one.
        positive: coefficients are half normal and sparse.

    Returns:
        ``[S]`` nats, or ``[W, S]``.

    Examples:
        >>> factors(torch.tensor([0.0, 4.0]), torch.tensor([1.0, 1.0]), 1.0, 1.0, False)
        tensor([-0.3466,  3.6534])
        >>> factors(torch.tensor([4.0]), torch.tensor([1.0]), 0.0, 1.0, True)
        tensor([0.])
    """
    return _mixed(_whole(score, information, width, positive), share if positive else 1.0)


def _whole(score: Tensor, information: Tensor, width: float | Tensor, positive: bool) -> Tensor:
    """:func:`factors` where every spot has a coefficient: share 1."""
    grown = 1 + width**2 * information
    factor = 0.5 * width**2 * score**2 / grown - 0.5 * grown.log()
    if not positive:
        return factor
    return factor + math.log(2) + torch.special.log_ndtr(width * score * grown.rsqrt())


def _mixed(whole: Tensor, share: float) -> Tensor:
    """:func:`factors` where a share of the spots has a coefficient, from what they are where all have."""
    if share == 1.0:
        return whole
    return torch.logaddexp(whole.new_tensor(1 - share).log(), whole + math.log(share))


def best_width(score: Tensor, information: Tensor, positive: bool) -> tuple[float, float, float]:
    """The distribution of coefficients that maximises the marginal likelihood.

    Args:
        score: ``[S]`` see :func:`factors`.
        information: ``[S]``.
        positive: coefficients are half normal and sparse.

    Returns:
        gain (nats), width and share; gain 0 where nothing does better than none.
    """
    typical = float(information.median().clamp_min(1e-30).rsqrt())
    best = (0.0, 0.0, 1.0)
    widths = typical * 2.0 ** torch.arange(-6, 13, 0.5, dtype=score.dtype)
    whole = _whole(score, information, widths[:, None], positive)
    for share in SHARES if positive else (1.0,):
        gains = _mixed(whole, share).sum(1)
        k = int(gains.argmax())
        best = max(best, (float(gains[k]), float(widths[k]), share))
    if best[0] == 0.0:
        return best

    def loss(octaves: float) -> float:
        return -float(factors(score, information, 2.0**octaves, best[2], positive).sum())

    middle = math.log2(best[1])
    found = minimize_scalar(
        loss, bounds=(middle - 0.5, middle + 0.5), method="bounded", options={"xatol": 1e-3}
    )
    return max(best, (-float(found.fun), 2.0 ** float(found.x), best[2]))


def coefficients(score: Tensor, information: Tensor, width: float, positive: bool) -> Tensor:
    """Each spot's coefficient.

    Args:
        score: ``[S]`` see :func:`factors`.
        information: ``[S]``.
        width: σ of the coefficients.
        positive: they are sparse: only those count that stand out by 3.5 standard deviations.

    Returns:
        ``[S]`` posterior means.

    Examples:
        >>> coefficients(torch.tensor([2.0, 6.0]), torch.tensor([1.0, 1.0]), 1.0, False)
        tensor([1., 3.])
        >>> coefficients(torch.tensor([2.0, 6.0]), torch.tensor([1.0, 1.0]), 1.0, True)
        tensor([0., 6.])
    """
    if positive:
        return torch.where(
            score > 3.5 * information.sqrt(), score / information.clamp_min(1e-30), torch.zeros_like(score)
        )
    return width**2 * score / (1 + width**2 * information)


@torch.no_grad()
def spot_scores(
    model: SurfelModel,
    extension: Extension,
    effect: Effect,
    spots: Tensor,
    counts: Tensor,
    transients: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Score and information of each spot's own coefficient at its present value.

    Args:
        model: of the counts.
        extension: present effects.
        effect: a per-spot effect, of the extension or beside it.
        spots: ``[S]`` rows of the capture.
        counts: ``[S, T]`` of them.
        transients: ``[S, T]`` light that arrives, where it is known already.

    Returns:
        score ``[S]``, information ``[S]``, and expected counts ``[S, T]``.
    """
    found, columns = expected_and_columns(model, extension, spots, effect, transients=transients)
    expected, column = found.double().clamp_min(FEWEST), columns.view(found.shape).double()
    return (column * (counts / expected - 1)).sum(1), (column**2 / expected).sum(1).clamp_min(1e-30), expected


@torch.no_grad()
def solve(
    model: SurfelModel, extension: Extension, effect: Effect, spots: Tensor, counts: Tensor, rounds: int = 4
) -> None:
    """Set a per-spot effect's coefficients to their posterior means by Newton steps.

    The width is estimated anew from their scatter.

    Args:
        model: of the counts.
        extension: present effects.
        effect: one of them; in place.
        spots: ``[S]`` rows of the capture.
        counts: ``[S, T]`` of them.
        rounds: Newton steps.
    """
    p = effect.amplitudes[0]
    raw = getattr(effect, f"raw_{p.name}")
    near, light = None if effect.in_runs else neighbours(model, spots), None
    if not effect.needs_paths:  # what it cannot change
        light = torch.cat([model.arrived(part, extension) for part in spots.split(model.batch)])
    for _ in range(rounds):
        score, information, _ = spot_scores(model, extension, effect, spots, counts, light)
        own = raw[spots].double()
        score = score + information * own  # that a start at 0 would have had
        if near is not None:
            score, information = own_part(score, information, near, own)
        _, effect.width, effect.share = best_width(score, information, sparse(effect))
        raw[spots] = coefficients(score, information, effect.width, sparse(effect)).float()
        effect.clamp()
