"""One pool: every effect of the registry and every free term, each with its evidence."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE, FREE_NAMES
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.smooth import SeveralWidths
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
from nlos_lit.inference.problem import (
    FEWEST,
    Problem,
    build_problem,
    columns_at,
    expected_and_columns,
    weighted_columns,
)
from nlos_lit.inference.split import Split
from nlos_lit.surfels.effect_start import likely
from nlos_lit.surfels.fit import SurfelFit

MOST = 0.9  # of the largest evidence or gain: a simpler term with so much goes before that with the largest
KEPT = 16  # shapes of one effect that are tested in full; the others are worth nothing beside them
CLOSER = 5.0  # nats, from which on a grid that keeps four fifths of what a shape has may cost one
HALVINGS = 3  # of the grid's step, about the best shape of so much
TOGETHER = 128  # columns from which on no more are projected along
WORK = 5e10  # multiplications of the nuisance columns with each other, some 1 s of one core
Shape = dict[str, float]
Of = TypeVar("Of")  # whose columns they are


@dataclass(frozen=True)
class Candidate:
    """One term of the pool, as the linear problem sees it.

    Args:
        effect: at its best shape and null amplitudes; its prior deviation is set.
        evidence: nats, log Bayes factor against no such term.
        retained: share of its information that the base cannot imitate.
        scatter: how much more its scores scatter between wall blocks than counts do.
        shape: scanned parameters.
        step: ``[k]`` change of the stored amplitudes that the counts ask for. error: of each,
            where the others stay as they are.
        loud: nats if all of the scatter were the term's own, as it is of a strong one: one linear step leaves
            an error that scatters like a misfit.
        lit: how far a misfit of the scene may look like it: the share of its information that lies where the
            scene's light falls; 0 of what single spots have over their neighbours, since a scene is seen
            alike from neighbouring points.
        scale: τ, of the coefficients' deviations.
    """

    effect: Effect
    evidence: float
    retained: float
    scatter: float
    shape: Shape
    step: Tensor = field(repr=False)
    error: Tensor = field(repr=False)
    loud: float
    lit: float = 1.0
    scale: float = 0.0

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def free(self) -> bool:
        """It is a free term."""
        return self.name in FREE_NAMES


@dataclass(frozen=True)
class Taken:
    """A term of those that are asked for beside each other.

    Args:
        candidate: as the linear problem sees it beside those that were taken before it.
        rivals: terms of its kind that were asked for until it was taken, and have less than half of their
            evidence beside it; most evidence first. Before them, where it is an effect and the first that is
            taken, the free term with most evidence, if it has more.
    """

    candidate: Candidate
    rivals: list[Candidate]


@dataclass(frozen=True)
class Pool:
    """What the counts ask for beside a fit.

    Args:
        candidates: every term that the fit does not have yet, most evidence first.
        together: terms that are asked for beside each other, see :func:`together`.
        foreign: the free term that is surely asked for more than any effect and does what none of those can
            that are asked for most; None where there is none. It stands for something unknown, and they for
            what they share with that.
    """

    candidates: list[Candidate]
    together: list[Taken]
    foreign: Candidate | None = None


def tested_rows(fit: SurfelFit, split: Split, most: int, seed: int) -> np.ndarray:
    """Which fitted spots the pool is asked on.

    Args:
        fit: that is criticised.
        split: of its spots.
        most: spots, at most.
        seed: of the choice.

    Returns:
        sorted rows of ``split.fit`` (and of the fit's counts).
    """
    return np.sort(np.random.default_rng(seed).permutation(len(split.fit))[:most])


def lit_by(fit: SurfelFit, scan: Scan) -> Scan:
    """The scan with a fit's expected light in place of the counts.

    Counts hold whatever a model lacks, and neighbours lack the same.

    Args:
        fit: of the base.
        scan: of the capture.

    Returns:
        another scan.
    """
    expected = fit.model.expected(torch.arange(scan.n_spots), fit.extension).numpy()
    return replace(scan, light=np.pad(expected, ((0, 0), (scan.gate[0], 0))))


def patches_for(rows: int) -> int:
    """How many groups of surfels the work allows, see ``WORK``.

    Args:
        rows: of the problem, spots times bins.

    Examples:
        >>> patches_for(320_000), patches_for(72_000)
        (197, 416)
    """
    return int((WORK / rows) ** 0.5 / 2)


def ask(
    fit: SurfelFit,
    split: Split,
    scan: Scan,
    most: int,
    seed: int,
    least: float = math.inf,
    room: int = 0,
    effects: bool = True,
    only: Container[str] | None = None,
) -> Pool:
    """Every term that the fit does not have yet.

    Args:
        fit: that is criticised.
        split: of its spots.
        scan: of the capture.
        most: fitted spots that are looked at.
        seed: of their choice.
        least: nats that a term needs to be taken.
        room: for terms that are taken together.
        effects: such are asked, too, and may be taken.
        only: names of those that are asked; None asks all but what the fit has by another name.

    Returns:
        candidates with a copy of each effect at its best shape, and those that are asked for together.
    """
    problem, block = _problem(fit, split, most, seed)
    projector = Projector(problem)
    have = {e.name for e in fit.extension.effects}
    terms = [e for e in [*(EFFECTS if effects else ()), *FREE] if only is None or e.name in only]
    new = [e(scan) for e in terms if e.name not in have]
    if only is None:
        new = [e for e in new if not any(map(e.twin_of, fit.extension.effects))]
    found = screen(problem, new, block, projector)
    taken = together(problem, projector, block, found, least, room, effects)
    return Pool(found, taken, foreign(found, least) if effects and room else None)


def foreign(candidates: list[Candidate], least: float) -> Candidate | None:
    """The free term that goes before all effects, see :class:`Pool`.

    Args:
        candidates: the pool.
        least: nats that a term needs, and by which the free term must be asked for more than any effect.

    Returns:
        it, or None.
    """
    effects = [c for c in candidates if not c.free]
    best = max((c.evidence for c in effects), default=0.0)
    if best <= least:
        return None  # free terms are asked for where no effect is
    does = {name for c in effects if c.evidence > MOST * best for name in c.effect.followed_by}
    return next((c for c in free_along(candidates, does) if c.evidence > best + least), None)


def free_along(candidates: list[Candidate], but: Container[str] = ()) -> list[Candidate]:
    """Free terms that say something of spots that were not fitted.

    Args:
        candidates: of a pool.
        but: names of others that are left out.

    Returns:
        those without a number for each spot, in the same order.
    """
    return [c for c in candidates if c.free and not c.effect.per_spot and c.name not in but]


def together(
    problem: Problem,
    projector: Projector,
    block: Tensor,
    candidates: list[Candidate],
    least: float,
    room: int,
    effects: bool = True,
) -> list[Taken]:
    """Terms that are asked for beside each other: each beside all that were taken before it.

    Strong faults hide one another, and the same trace may be that of several terms. So the one that is asked
    for most is taken, its columns go to what the base can do by itself, and all others are asked again. Who
    loses more than half of its evidence by that is a look-alike, and waits, as does what is the same in such
    a scan: what is left of it may be what one linear step of the first gets wrong. Of those that have most of
    the largest evidence the simplest is taken. Free terms are taken only where no effect is: a scene that was
    fitted with one has less need of the effect that it stands for.

    Args:
        problem: of the tested spots.
        projector: of it.
        block: ``[S]`` number of each spot's wall block.
        candidates: the pool; terms with a number for each spot are not taken.
        least: nats that a term needs.
        room: for so many.
        effects: such may be taken.

    Returns:
        in the order in which they were taken.
    """
    loud = [c for c in candidates if c.loud > least and not c.effect.per_spot] if room else []
    taken: list[Taken] = []
    raw, freed = dict[str, Tensor](), dict[str, Tensor]()
    known: list[tuple[Tensor, Tensor]] = []  # columns without what the base can do, and their precision

    def beside(left: list[Candidate]) -> list[Candidate]:
        """The same terms, asked again beside those that were taken."""
        columns, precision = (torch.cat(parts, -1) for parts in zip(*known, strict=True))
        other = projector.beside(columns, precision)
        parted = _parted(other, ((c, freed[c.name]) for c in left))
        return [
            _seen_again(c, _evidence(problem, other, c.effect, raw[c.name], part, block))
            for c, _, part in parted
        ]

    for free in (False, True) if effects else (True,):
        asked = [] if taken else [c for c in loud if c.free == free]
        raw = {c.name: weighted_columns(problem, c.effect) for c in asked}
        freed = _freed(projector, raw)
        while len(taken) < room:
            best = max((c.evidence for c in asked), default=0.0)
            near = [c for c in asked if c.evidence > max(least, MOST * best)]
            if not near:
                break
            first = min(near, key=lambda c: (len(c.step), -c.evidence))
            deviation = prior_deviations(first.effect)
            known.append((freed[first.name], (first.scale * deviation).pow(-2).float()))
            before = [c for c in asked if c is not first]
            asked = beside(before)
            same = [c for c in before if c.effect.twin_of(first.effect)]
            rivals = each_once(*same, *lost(before, asked, least))
            taken.append(Taken(first, rivals if free or taken else ahead_of(first, candidates) + rivals))
            waiting = {c.name for c in rivals}
            asked = [c for c in asked if c.loud > least and c.name not in waiting]
    return taken


def lost(before: list[Candidate], now: list[Candidate], least: float) -> list[Candidate]:
    """Terms that were asked for, and have lost more than half of their evidence since: they may be meant.

    Args:
        before: what was found without some terms.
        now: what is found beside them.
        least: nats from which on a term is asked for.

    Returns:
        those of ``before``, most evidence first; none with a number for each spot.
    """
    left = {c.name: c.evidence for c in now}
    known = [c for c in before if c.name in left and not c.effect.per_spot]
    found = [c for c in known if c.evidence > max(least, 2 * left[c.name])]
    return sorted(found, key=lambda c: -c.evidence)


def each_once(*candidates: Candidate) -> list[Candidate]:
    """Each once, as they first come."""
    found = dict[str, Candidate]()
    for candidate in candidates:
        found.setdefault(candidate.name, candidate)
    return list(found.values())


def ahead_of(effect: Candidate, candidates: list[Candidate]) -> list[Candidate]:
    """The free term that is asked for most, where that is more than an effect is asked for.

    Args:
        effect: of the registry.
        candidates: by falling evidence.

    Returns:
        One term, or none.
    """
    return [c for c in free_along(candidates)[:1] if c.evidence > effect.evidence]


def _seen_again(candidate: Candidate, found: Evidence) -> Candidate:
    """The same term beside others; another shape of it may be the best, but that is asked once others are in
    the model.
    """
    nats = found.nats - math.log(len(candidate.effect.shape_grid()))
    loud = max(nats, found.loud - math.log(len(candidate.effect.shape_grid())))
    effect = _with_scale(copy.deepcopy(candidate.effect), found)
    seen = replace(candidate, effect=effect, evidence=nats, loud=loud, scale=found.scale)
    return replace(seen, step=found.step, error=found.error, retained=found.retained, scatter=found.scatter)


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
    problem, block = _problem(fit, split, most, seed, with_effects=False)
    whole = Projector(problem)
    effects = {e.name: e for e in fit.extension.effects}
    laws = {n: e for n, e in effects.items() if not e.per_spot}
    columns = {n: weighted_columns(problem, e, shapes=True) for n, e in laws.items()}
    freed = _freed(whole, columns)
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
            score, information, _ = _scores(problem, effect, column, residual)
            nats = best_width(score, information, sparse(effect))[0] - many
            return nats, _lit(problem, effect, column), nats
        beside, number = whole.beside(z, precision, residual + does[name]), len(above[name])
        own = (columns[name][:, :number], beside.freed(freed[name][:, :number]))
        found = _evidence(problem, beside, effect, *own, block)
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


def _lit(problem: Problem, effect: Effect, column: Tensor) -> float:
    """Of a term with a number for each spot, whose columns ``[S, T]`` these are."""
    return lit_share(column.reshape(-1, 1), problem.lit) if sparse(effect) else 0.0


def _amplitudes(effect: Effect) -> Tensor:
    return torch.cat([getattr(effect, f"raw_{p.name}").detach() for p in effect.amplitudes])


def _problem(
    fit: SurfelFit, split: Split, most: int, seed: int, with_effects: bool = True
) -> tuple[Problem, Tensor]:
    """The linear problem of a fit's tested spots, and the number of each one's wall block."""
    rows = tested_rows(fit, split, most, seed)
    spots = torch.from_numpy(split.fit[rows])
    patches = patches_for(len(rows) * fit.counts.shape[1])
    problem = build_problem(
        fit.model, fit.extension, spots, fit.counts[rows], with_effects=with_effects, patches=patches
    )
    return problem, torch.from_numpy(np.unique(split.block[split.fit[rows]], return_inverse=True)[1])


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
    for (effect, shape), columns, part in _parted(projector, each):
        tried[effect.name].append((shape, _evidence(problem, projector, effect, columns, part, block)))
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
            for (effect, shape), columns, part in _parted(projector, _at(problem, asked)):
                now = shape, _evidence(problem, projector, effect, columns, part, block)
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


def _evidence(
    problem: Problem, projector: Projector, effect: Effect, columns: Tensor, freed: Freed, block: Tensor
) -> Evidence:
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
    return Candidate(_with_scale(effect, best), *told, best.scale)


def _with_scale(effect: Effect, found: Evidence) -> Effect:
    """The effect, its prior as wide as the counts ask for."""
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


def _parted(projector: Projector, terms: Iterable[tuple[Of, Tensor]]) -> Iterator[tuple[Of, Tensor, Freed]]:
    """Whose columns, these, and what the base leaves of them; so many are projected together as allowed.

    A projection passes over all nuisance columns, however few it projects.
    """
    for group, together, sizes in _grouped(terms):
        parts = zip(*(each.split(sizes, 1) for each in projector.freed(together)), strict=True)
        for (of, columns), part in zip(group, parts, strict=True):
            yield of, columns, Freed(*part)


def _freed(projector: Projector, terms: dict[str, Tensor]) -> dict[str, Tensor]:
    """Columns of several terms, by name, after the projector's first step; as many at once."""
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
        score, information, scatter = _scores(problem, effect, column, residual)
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
    lit = _lit(problem, effect, column)
    return Candidate(effect, nats_of_all, 1.0, scatter, shape, full, error, nats_of_all, lit)


def _scores(
    problem: Problem, effect: Effect, column: Tensor, residual: Tensor
) -> tuple[Tensor, Tensor, float]:
    """Score and information of each spot's own coefficient ``[S]``, discounted by their scatter, and that."""
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
