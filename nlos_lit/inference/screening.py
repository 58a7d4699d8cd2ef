"""The evidence of terms that a model does not have, each at its best shape."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.smooth import SeveralWidths
from nlos_lit.inference.candidates import Candidate, Shape
from nlos_lit.inference.evidence import (
    SEGMENTS,
    Evidence,
    Freed,
    Projector,
    best_evidence,
    lit_share,
    prior_deviations,
)
from nlos_lit.inference.per_spot import best_width, coefficients, neighbours, own_part, sparse
from nlos_lit.inference.problem import Problem, columns_at, weighted_columns
from nlos_lit.surfels.effect_start import likely

KEPT = 16  # shapes of one effect that are tested in full; the others are worth nothing beside them
CLOSER = 5.0  # nats, from which on a grid that keeps four fifths of what a shape has may cost one
HALVINGS = 3  # of the grid's step, about the best shape of so much
TOGETHER = 128  # columns from which on no more are projected along
Of = TypeVar("Of")  # whose columns they are


def screen(
    problem: Problem, effects: list[Effect], block: Tensor, projector: Projector | None = None
) -> list[Candidate]:
    """Evidence of several terms.

    Args:
        problem: of the tested spots.
        effects: at their nulls; they stay there.
        block: ``[S]`` number of each spot's wall block.
        projector: of the problem; None makes one.

    Returns:
        one candidate an effect, most evidence first.
    """
    projector = projector or Projector(problem)
    effects = [copy.deepcopy(e) for e in effects]
    found = [_per_spot(problem, projector, e) for e in effects if e.per_spot]
    others = [e for e in effects if not e.per_spot]
    tried: dict[str, list[tuple[Shape, Evidence]]] = {e.name: [] for e in others}
    each = (((e, shape), columns) for e in others for shape, columns in _worthwhile(problem, projector, e))
    for (effect, shape), columns, part in parted(projector, each):
        tried[effect.name].append((shape, term_evidence(problem, projector, effect, columns, part, block)))
    _look_closer(problem, projector, others, tried, block)
    found += [_candidate(e, tried[e.name]) for e in others]
    return sorted(found, key=lambda c: -c.evidence)


def _look_closer(
    problem: Problem,
    projector: Projector,
    effects: list[Effect],
    tried: dict[str, list[tuple[Shape, Evidence]]],
    block: Tensor,
) -> None:
    """Put better ones in the place of the best shapes of the grids, where effects are strong enough to tell.

    What a strong effect leaves at a shape that is off by a part of the grid's step looks like a misfit.
    """

    best = dict[str, int]()  # of those tried
    for effect in effects:
        place = max(range(len(tried[effect.name])), key=lambda k: _worth(tried[effect.name][k]))
        strong = tried[effect.name][place][1].loud - math.log(len(effect.shape_grid())) > CLOSER
        if strong and not effect.needs_paths:
            best[effect.name] = place
    for halving in range(1, HALVINGS + 1):
        for k in range(max(len(e.shapes) for e in effects) if best else 0):
            asked = list[tuple[Effect, Shape]]()
            for effect in (e for e in effects if e.name in best and k < len(e.shapes)):
                p, (shape, _) = effect.shapes[k], tried[effect.name][best[effect.name]]
                asked += [(effect, {**shape, p.name: v}) for v in beside_it(p, shape[p.name], halving)]
            for (effect, shape), columns, part in parted(projector, _at(problem, asked)):
                now = shape, term_evidence(problem, projector, effect, columns, part, block)
                old = tried[effect.name][best[effect.name]]
                tried[effect.name][best[effect.name]] = max(old, now, key=_worth)


def _at(problem: Problem, asked: list[tuple[Effect, Shape]]) -> Iterator[tuple[tuple[Effect, Shape], Tensor]]:
    """Effects and shapes with their columns."""
    for effect, shape in asked:
        effect.set_all(shape)
        yield (effect, shape), weighted_columns(problem, effect)


def beside_it(shape: Parameter, value: float, halving: int) -> list[float]:
    """Values on both sides of one, within the grid.

    Args:
        shape: that is scanned.
        value: between the ends of its grid.
        halving: how often the grid's step is halved to come to theirs.

    Returns:
        two values, or one where ``value`` is an end, or none where the grid has no steps.

    Examples:
        >>> decay = Parameter("decay", "m", None, 0.2, 0.01, 2.0, grid=(0.1, 0.4, 1.6), log=True)
        >>> [round(v, 3) for v in beside_it(decay, 0.4, 1)], [round(v, 3) for v in beside_it(decay, 0.1, 1)]
        ([0.2, 0.8], [0.2])
    """
    grid = np.sort(np.log(shape.grid) if shape.log else shape.grid)
    steps = np.arange(len(grid))
    place = np.interp(math.log(value) if shape.log else value, grid, steps)
    near = np.array([place - 0.5**halving, place + 0.5**halving])
    found = np.interp(near[(near >= 0) & (near <= steps[-1])], steps, grid)
    return (np.exp(found) if shape.log else found).tolist()


def _worth(tried: tuple[Shape, Evidence]) -> tuple[float, float]:
    return tried[1].nats, tried[1].loud


def term_evidence(
    problem: Problem, projector: Projector, effect: Effect, columns: Tensor, freed: Freed, block: Tensor
) -> Evidence:
    """Evidence of a term at its present shape.

    Args:
        problem: of the tested spots.
        projector: of it.
        effect: the term.
        columns: ``[S·bins, k]`` of it.
        freed: what the base leaves of them.
        block: ``[S]`` number of each spot's wall block.

    Returns:
        none where the step would be what the effect does not mean.
    """
    raw = columns.reshape(*problem.expected.shape, -1)
    prior = prior_deviations(effect), effect.step_bounds(), effect.width_of
    found = best_evidence(projector, raw, freed, block, *prior)
    return found if effect.is_meant(found.step) else replace(found, nats=0.0, loud=0.0)


def _candidate(effect: Effect, tried: list[tuple[Shape, Evidence]]) -> Candidate:
    """The best shape; the evidence is the mean of the Bayes factors of all that could have been."""
    shape, best = max(tried, key=_worth)
    mean = mean_factor([e.nats for _, e in tried], len(effect.shape_grid()))
    effect.set_all(shape)
    told = (mean, best.retained, best.scatter, shape, best.step, best.error, max(mean, best.loud), best.lit)
    return Candidate(with_scale(effect, best), *told, best.scale)


def with_scale(effect: Effect, found: Evidence) -> Effect:
    """The effect, its prior as wide as the counts ask for.

    Args:
        effect: that is set, in place.
        found: of it.

    Returns:
        the same effect.
    """
    if bool(effect.precision().any()) and found.scale:
        effect.prior_scale = found.scale
    if isinstance(effect, SeveralWidths) and found.relative is not None:
        effect.relative.copy_(found.relative)
    return effect


def mean_factor(nats: list[float], number: int) -> float:
    """Logarithm of the mean of Bayes factors.

    Args:
        nats: their logarithms; the others are nothing beside them.
        number: of all.

    Returns:
        nats.

    Examples:
        >>> round(mean_factor([10.0, 10.0], 4), 2)
        9.31
    """
    return float(torch.logsumexp(torch.tensor(nats, dtype=torch.float64), 0)) - math.log(number)


def parted(projector: Projector, terms: Iterable[tuple[Of, Tensor]]) -> Iterator[tuple[Of, Tensor, Freed]]:
    """What the base leaves of columns; so many are projected together as allowed.

    A projection passes over all nuisance columns, however few it projects.

    Args:
        projector: of the base.
        terms: whose columns, and these.

    Yields:
        Whose, the columns, and what is left of them.
    """
    for group, together, sizes in _grouped(terms):
        parts = zip(*(each.split(sizes, 1) for each in projector.freed(together)), strict=True)
        for (of, columns), part in zip(group, parts, strict=True):
            yield of, columns, Freed(*part)


def freed_of(projector: Projector, terms: dict[str, Tensor]) -> dict[str, Tensor]:
    """Columns of several terms after the projector's first step; so many at once as allowed.

    Args:
        projector: of the base.
        terms: columns by name.

    Returns:
        by name.
    """
    found = dict[str, Tensor]()
    for group, together, sizes in _grouped(terms.items()):
        found |= dict(zip((name for name, _ in group), projector.free(together).split(sizes, 1), strict=True))
    return found


def _grouped(
    terms: Iterable[tuple[Of, Tensor]],
) -> Iterator[tuple[list[tuple[Of, Tensor]], Tensor, list[int]]]:
    """Terms with their columns, about ``TOGETHER`` of them at a time; those together, how many of each."""
    group, sizes = list[tuple[Of, Tensor]](), list[int]()
    for term in terms:
        group.append(term)
        sizes.append(term[1].shape[1])
        if sum(sizes) >= TOGETHER:
            yield group, torch.cat([columns for _, columns in group], 1), sizes
            group, sizes = [], []
    if group:
        yield group, torch.cat([columns for _, columns in group], 1), sizes


def _worthwhile(problem: Problem, projector: Projector, effect: Effect) -> list[tuple[Shape, Tensor]]:
    """The ``KEPT`` most promising shapes with their columns.

    Zᵀr⊥ is the score already; only the information needs the projection, whose passes over all of X are what
    costs. So shapes are ranked by the score over the unprojected information.
    """
    shapes, kept = _shapes(problem, projector, effect), list[tuple[float, Shape, Tensor]]()
    for shape, z in zip(shapes, columns_at(problem, effect, shapes), strict=True):
        worth = 0.0
        if len(shapes) > 1:
            score, information = (z.T @ projector.residual[: len(z)]).double(), (z.T @ z).double()
            floor = 1e-9 * information.diagonal().mean() + 1e-30
            worth = float(score @ torch.linalg.solve(information + floor * torch.eye(len(score)), score))
        kept = sorted([*kept, (worth, shape, z)], key=lambda entry: -entry[0])[:KEPT]
    return [(shape, z) for _, shape, z in kept]


def _shapes(problem: Problem, projector: Projector, effect: Effect) -> list[Shape]:
    """Those that the effect itself thinks likely."""
    if not effect.shapes:
        return effect.shape_grid()
    over = projector.residual[: problem.expected.numel()].view_as(problem.expected) * problem.expected.sqrt()
    return likely(problem.model, problem.extension, problem.spots, effect, over, problem.expected)


def _per_spot(problem: Problem, projector: Projector, effect: Effect) -> Candidate:
    """One random coefficient a spot: do the spots' own scores scatter more than counts alone let them?"""
    shapes, best = effect.shape_grid(), None
    residual = projector.residual[: problem.expected.numel()].view_as(problem.expected)
    nats = []
    for shape, columns in zip(shapes, columns_at(problem, effect, shapes), strict=True):
        column = columns[:, 0].view(problem.expected.shape)
        score, information, scatter = scores(problem, effect, column, residual)
        gain, width, share = best_width(score, information, sparse(effect))
        nats.append(gain)
        if best is None or gain > best[0]:
            best = gain, width, share, shape, score, information, scatter, column
    assert best is not None
    _, effect.width, effect.share, shape, score, information, scatter, column = best
    effect.set_all(shape)
    full = torch.zeros(len(problem.model.laser))
    full[problem.spots] = coefficients(score, information, effect.width, sparse(effect)).float()
    error = torch.full_like(full, float("nan"))
    error[problem.spots] = information.rsqrt().float()
    nats_of_all = mean_factor(nats, len(shapes))
    lit = lit_of(problem, effect, column)
    return Candidate(effect, nats_of_all, 1.0, scatter, shape, full, error, nats_of_all, lit)


def scores(
    problem: Problem, effect: Effect, column: Tensor, residual: Tensor
) -> tuple[Tensor, Tensor, float]:
    """Scores of a term with a number for each spot.

    Args:
        problem: of the tested spots.
        effect: the term.
        column: ``[S, T]`` of each spot's own coefficient.
        residual: ``[S, T]``.

    Returns:
        Score and information of each spot's own coefficient ``[S]``, discounted by their scatter, and that.
    """
    information = column.square().sum(1).double().clamp_min(1e-30)
    score = (column * residual).sum(1).double()
    scatter = spot_scatter(column, residual)
    if not effect.in_runs:
        score, information = own_part(score, information, neighbours(problem.model, problem.spots))
    return score / scatter, information / scatter, scatter


def spot_scatter(column: Tensor, residual: Tensor) -> float:
    """How much more the scores of a spot's own coefficient differ along time than counts alone let them.

    Args:
        column: ``[S, T]`` of each spot's own coefficient.
        residual: ``[S, T]``.

    Returns:
        φ, at least 1.
    """
    told = column.square().double()
    passed = (told.cumsum(1) - told / 2) / told.sum(1, keepdim=True).clamp_min(1e-30)
    parts = (passed * SEGMENTS).long().clamp_max(SEGMENTS - 1)
    f = told.new_zeros(len(column), SEGMENTS).scatter_add_(1, parts, told)
    s = told.new_zeros(len(column), SEGMENTS).scatter_add_(1, parts, (column * residual).double())
    mean = s.sum(1, keepdim=True) / f.sum(1, keepdim=True).clamp_min(1e-30)
    left = (s - f * mean).square() / f.clamp_min(1e-30)
    return max(1.0, float(left.sum() / max(1, int((f > 0).sum()) - len(column))))


def lit_of(problem: Problem, effect: Effect, column: Tensor) -> float:
    """How far a misfit of the scene may look like a term with a number for each spot.

    Args:
        problem: of the tested spots.
        effect: the term.
        column: ``[S, T]`` of each spot's own coefficient.

    Returns:
        see :class:`~nlos_lit.inference.candidates.Candidate`.
    """
    return lit_share(column.reshape(-1, 1), problem.lit) if sparse(effect) else 0.0
