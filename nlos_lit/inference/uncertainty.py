"""Parameters of accepted effects with their uncertainties, from the curvature of the whole fit."""

from __future__ import annotations

import copy
import math

import numpy as np
import torch
from torch import Tensor

from nlos_lit.effects.effect import Effect
from nlos_lit.inference.evidence import Projector
from nlos_lit.inference.own import above_null
from nlos_lit.inference.problem import build_problem, weighted_columns
from nlos_lit.inference.result import Estimate
from nlos_lit.inference.split import Split
from nlos_lit.inference.tested import patches_for, tested_rows
from nlos_lit.surfels.fit import SurfelFit

REACH = 3.0  # standard errors over which quantities are displaced
# How much larger errors are than the fit says: no cause follows an effect's equation to the last digit. Of
# quantities in blind looks nine of ten lie within 3.6 of the fit's own errors (docs/blind.md).
UNLIKE = 2.0


class Uncertainty:
    """Joint covariance of all parameters of all effects, the base projected off.

    The larger of two: F⁻¹ (counts alone) and F⁻¹(Σ_b s_b s_bᵀ)F⁻¹ (scatter of the score between wall blocks,
    which also feels misfit; Huber's sandwich).

    Args:
        fit: with the effects.
        spots: ``[S]`` fitted spots that are looked at.
        counts: ``[S, T_gate]`` of them.
        block: ``[S]`` wall block of each.
        share: of all fitted spots that these are: the others have as much to say.
    """

    def __init__(
        self, fit: SurfelFit, spots: Tensor, counts: Tensor, block: Tensor, share: float = 1.0
    ) -> None:
        self.fitted = len(fit.train) / fit.capture.n_spots
        self.effects = [e for e in fit.extension.effects if not e.per_spot]
        if not self.effects:
            return
        problem = build_problem(
            fit.model, fit.extension, spots, counts, with_effects=False, patches=patches_for(counts.numel())
        )
        projector = Projector(problem)
        z = projector.off(torch.cat([weighted_columns(problem, e, shapes=True) for e in self.effects], 1))
        information = (z.T @ z).double() + torch.diag(
            torch.cat([e.precision() for e in self.effects]).double() * share
        )
        floor = 1e-9 * information.diagonal().mean() * torch.eye(len(information), dtype=torch.float64)
        inverse = torch.linalg.inv(information + floor)
        score = (z * projector.residual[:, None]).double()
        by_spot = score[: counts.numel()].view(len(spots), -1, z.shape[1]).sum(1)
        names, index = torch.unique(block, return_inverse=True)
        by_block = by_spot.new_zeros(len(names), z.shape[1]).index_add_(0, index, by_spot)
        by_block = torch.cat([by_block, score[counts.numel() :]])  # a prior's row is a block by itself
        robust = inverse @ (by_block.T @ by_block) @ inverse
        grow = (robust.diagonal() / inverse.diagonal()).clamp_min(1.0).sqrt()
        self.covariance = share * inverse * grow[:, None] * grow[None, :]

    def parameters(
        self, effect: Effect, again: Effect | None = None, misfit: float = 0.0
    ) -> dict[str, Estimate]:
        """Reported quantities and their errors.

        An error is a third of the change over three standard errors along each axis of the covariance, the
        larger of both ways, in quadrature: the delta method where a quantity is linear, and more where it
        bends, as the length of a vector does whose largest component is not settled. The width of per-spot
        effects: from the number of spots.

        Counts say nothing of what the scene cannot follow. The nats that a term needs for that before it is
        named are the same three standard errors, of how much of it there is: by so much all its amplitudes
        are displaced together, too. All this is reported ``UNLIKE`` times as large.

        Args:
            effect: one of the fit's.
            again: the same effect in a fit from new seeds; the difference is an error, too.
            misfit: nats that the scene's misfit may give the effect, at most.

        Returns:
            by name of the quantity.
        """
        if effect.per_spot:
            return _spread(effect, self.fitted)
        offset = sum(e_size(e) for e in self.effects[: self.effects.index(effect)])
        variance, axes = torch.linalg.eigh(
            self.covariance[offset : offset + e_size(effect), offset : offset + e_size(effect)]
        )
        steps = REACH * variance.clamp_min(0).sqrt() * axes
        moved = [[_displaced(effect, sign * step) for sign in (1, -1)] for step in steps.T.float()]
        part = slice(offset, offset + sum(p.size for p in effect.amplitudes))
        towards = _more_of(effect, self.covariance[part, part], misfit)
        moved.append([_displaced(effect, sign * towards) for sign in (1, -1)])
        elsewhere = {} if again is None else _values(again)
        found = {}
        for name, quantity in effect.quantities().items():
            value = float(quantity.value.detach())
            errors = [max(abs(side[name] - value) for side in both) / REACH for both in moved]
            errors.append(abs(elsewhere.get(name, value) - value))
            found[name] = Estimate(value, UNLIKE * math.hypot(*errors), quantity.unit)
        return found


def _displaced(effect: Effect, step: Tensor) -> dict[str, float]:
    """Quantities with all stored values moved by ``step``, as far as their bounds allow."""
    moved = copy.deepcopy(effect)
    moved.shift(step, shapes=True)
    moved.clamp()
    return _values(moved)


def _more_of(effect: Effect, covariance: Tensor, misfit: float) -> Tensor:
    """Step of all stored values by which there is so many nats more of an effect; twice as much, at most."""
    amplitudes = above_null(effect).double()
    variance, axes = torch.linalg.eigh(covariance)
    told = (axes.T @ amplitudes).square() / variance.clamp_min(1e-12 * float(variance[-1]) + 1e-30)
    share = min(1.0, math.sqrt(2 * misfit / max(float(told.sum()), 1e-30)))
    return torch.cat([share * amplitudes, torch.zeros(e_size(effect) - len(amplitudes))]).float()


def uncertainty_of(fit: SurfelFit, split: Split, most: int, seed: int) -> Uncertainty:
    """That of a fit's effects, from the spots that the pool is asked on.

    Args:
        fit: with the effects.
        split: of its spots.
        most: spots, at most.
        seed: of their choice.

    Returns:
        for all of the fitted spots.
    """
    rows = tested_rows(fit, split, most, seed)
    spots = split.fit[rows]
    block = torch.from_numpy(split.block[spots])
    return Uncertainty(fit, torch.from_numpy(spots), fit.counts[rows], block, len(rows) / len(split.fit))


def _values(effect: Effect) -> dict[str, float]:
    return {name: float(quantity.value.detach()) for name, quantity in effect.quantities().items()}


def e_size(effect: Effect) -> int:
    """Number of an effect's stored values."""
    return sum(p.size for p in effect.declared.values())


def _spread(effect: Effect, share: float) -> dict[str, Estimate]:
    """Of a per-spot effect, from the spots that have a number.

    ``share`` of all spots were fitted; numbers of spots are for all. Errors are those of the width of a
    normal distribution, or by leaving out each spot (the jackknife), where that is more: some numbers are far
    from normal.
    """
    without, left_out = copy.deepcopy(effect), []
    raw = getattr(without, f"raw_{effect.amplitudes[0].name}").data
    known = torch.nonzero(raw)[:, 0].tolist()
    for spot in known:
        number, raw[spot] = float(raw[spot]), 0.0
        left_out.append(_values(without))
        raw[spot] = number
    n = max(1, len(known))
    found = {}
    for name, quantity in effect.quantities().items():
        value, others = float(quantity.value.detach()), [values[name] for values in left_out]
        away = (n - 1) ** 0.5 * float(np.std(others)) if others else 0.0
        error = value**0.5 if quantity.spots else max(value / (2 * n) ** 0.5, away)
        scale = share if quantity.spots else 1.0
        found[name] = Estimate(value / scale, UNLIKE * error / scale, quantity.unit)
    return found
