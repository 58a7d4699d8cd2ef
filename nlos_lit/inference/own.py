"""The evidence of terms that a model has, beside all else that it may do."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE_NAMES
from nlos_lit.inference.evidence import Projector
from nlos_lit.inference.per_spot import best_width, sparse
from nlos_lit.inference.problem import FEWEST, Problem, expected_and_columns, weighted_columns
from nlos_lit.inference.screening import freed_of, lit_of, scores, term_evidence
from nlos_lit.inference.split import Split
from nlos_lit.inference.tested import problem_of
from nlos_lit.surfels.fit import SurfelFit


def own_evidence(
    fit: SurfelFit, split: Split, most: int, seed: int, names: list[str], bar: Callable[[float, float], float]
) -> tuple[dict[str, tuple[float, float, float]], list[str]]:
    """How much the counts ask for each of several terms that a fit has, beside all else that it may do.

    Then who has less than it needs is taken out of the linear problem, one after the other, the one that
    comes least near to it first; what it did is asked of the others. Effects are asked without any free term,
    free terms beside the effects that are left.

    Args:
        fit: with the terms at their fitted values.
        split: of its spots.
        most: fitted spots that are looked at.
        seed: of their choice.
        names: of the terms.
        bar: nats that a term needs, from how far a misfit may look like it, see :class:`Candidate`, and from
            the nats that it would have more if the others were not there.

    Returns:
        nats that each has, those that it needs, and of these those for what the others take, by name; and who
        is left. Where such a one has too little beside all others, it is told what it has when those who
        leave are gone.
    """
    problem, block = problem_of(fit, split, most, seed, with_effects=False)
    whole = Projector(problem)
    effects = {e.name: e for e in fit.extension.effects}
    laws = {n: e for n, e in effects.items() if not e.per_spot}
    columns = {n: weighted_columns(problem, e, shapes=True) for n, e in laws.items()}
    freed = freed_of(whole, columns)
    above = {n: above_null(e) for n, e in laws.items()}
    does = {n: freed[n][:, : len(above[n])] @ above[n] for n in laws}

    @cache
    def one(name: str, gone: tuple[str, ...]) -> tuple[float, float, float]:
        """Nats, ``lit``, and nats if all of the scatter were the term's own."""
        effect, others = effects[name], [n for n in laws if n != name and n not in gone]
        many = math.log(len(effect.shape_grid()))
        residual = whole.left[:, 0] + sum((does[n] for n in gone if n in does), torch.zeros(()))
        z = torch.cat([whole.left[:, :0], *(freed[n] for n in others)], 1)
        precision = torch.cat([whole.left.new_zeros(0), *(effects[n].precision() for n in others)])
        if effect.per_spot:
            column, residual = _without(problem, effect, whole.beside(z, precision, residual))
            score, information, _ = scores(problem, effect, column, residual)
            nats = best_width(score, information, sparse(effect))[0] - many
            return nats, lit_of(problem, effect, column), nats
        beside, number = whole.beside(z, precision, residual + does[name]), len(above[name])
        own = (columns[name][:, :number], beside.freed(freed[name][:, :number]))
        found = term_evidence(problem, beside, effect, *own, block)
        return found.nats - many, found.lit, found.loud - many

    @cache
    def judged(name: str, gone: tuple[str, ...]) -> tuple[float, float, float]:
        (nats, lit, _), others = one(name, gone), tuple(n for n in laws if n != name and n in names)
        # What the others do scatters like a misfit where a look-alike has to stand for it.
        needed = bar(lit, max(0.0, one(name, others)[2] - nats) if others else 0.0)
        return nats, needed, needed - bar(lit, 0.0)

    found = dict[str, tuple[float, float, float]]()

    def left(asked: list[str], gone: tuple[str, ...]) -> list[str]:
        now = {n: judged(n, gone) for n in asked}
        while short := [n for n, (nats, needed, _) in now.items() if nats <= needed]:
            worst = min(short, key=lambda n: now[n][0] / now[n][1])
            found[worst] = now.pop(worst)
            gone = (*gone, worst)
            now |= {n: judged(n, gone) for n in short if n in now}
        found.update(now)
        return list(now)

    free = [n for n in names if n in FREE_NAMES]
    enough = left([n for n in names if n not in free], tuple(free))
    enough += left(free, tuple(n for n in names if n not in free and n not in enough))
    for name in names:
        beside = judged(name, ())
        if name not in enough or beside[0] > beside[1]:
            found[name] = beside
    return found, enough


def above_null(effect: Effect) -> Tensor:
    """How far an effect's stored amplitudes lie from their nulls.

    Args:
        effect: of any strength.

    Returns:
        ``[k]``.
    """
    return _amplitudes(effect) - _amplitudes(null_of(effect))


def null_of(effect: Effect) -> Effect:
    """A copy that does nothing.

    Args:
        effect: of any strength.

    Returns:
        another effect, of the same shape.
    """
    null = copy.deepcopy(effect)
    for p in null.amplitudes:
        null.set(p.name, 0.0 if p.null is None else p.null)
    return null


def _without(problem: Problem, effect: Effect, projector: Projector) -> tuple[Tensor, Tensor]:
    """Columns and residual ``[S, bins]`` of a term with a number for each spot, in the model without it.

    A spot that loses all its light counts nothing by the model, and one count there would weigh without end.
    """
    others = Extension([e for e in problem.extension.effects if e is not effect])
    given = (problem.model, others, problem.spots, null_of(effect))
    expected, column = expected_and_columns(*given, transients=problem.transients)
    expected, present = expected.clamp_min(FEWEST), problem.expected
    left = projector.residual[: present.numel()].view_as(present) * present.sqrt()
    return column.view_as(present) * expected.rsqrt(), (left + present - expected) * expected.rsqrt()


def _amplitudes(effect: Effect) -> Tensor:
    return torch.cat([getattr(effect, f"raw_{p.name}").detach() for p in effect.amplitudes])
