"""One pool: every effect of the registry and every free term, and what is asked for together."""

from __future__ import annotations

import copy
import math
from collections.abc import Container
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.candidates import MOST, Candidate, Pool, Taken, ahead_of, each_once, foreign, lost
from nlos_lit.inference.evidence import Evidence, Projector, prior_deviations
from nlos_lit.inference.problem import Problem, weighted_columns
from nlos_lit.inference.screening import freed_of, parted, screen, term_evidence, with_scale
from nlos_lit.inference.split import Split
from nlos_lit.inference.tested import problem_of
from nlos_lit.surfels.fit import SurfelFit


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
    problem, block = problem_of(fit, split, most, seed)
    projector = Projector(problem)
    have = {e.name for e in fit.extension.effects}
    terms = [e for e in [*(EFFECTS if effects else ()), *FREE] if only is None or e.name in only]
    new = [e(scan) for e in terms if e.name not in have]
    if only is None:
        new = [e for e in new if not any(map(e.twin_of, fit.extension.effects))]
    found = screen(problem, new, block, projector)
    taken = together(problem, projector, block, found, least, room, effects)
    return Pool(found, taken, foreign(found, least) if effects and room else None)


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
        again = parted(other, ((c, freed[c.name]) for c in left))
        return [
            _seen_again(c, term_evidence(problem, other, c.effect, raw[c.name], part, block))
            for c, _, part in again
        ]

    for free in (False, True) if effects else (True,):
        asked = [] if taken else [c for c in loud if c.free == free]
        raw = {c.name: weighted_columns(problem, c.effect) for c in asked}
        freed = freed_of(projector, raw)
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


def _seen_again(candidate: Candidate, found: Evidence) -> Candidate:
    """The same term beside others; another shape of it may be the best, but that is asked once others are in
    the model.
    """
    nats = found.nats - math.log(len(candidate.effect.shape_grid()))
    loud = max(nats, found.loud - math.log(len(candidate.effect.shape_grid())))
    effect = with_scale(copy.deepcopy(candidate.effect), found)
    seen = replace(candidate, effect=effect, evidence=nats, loud=loud, scale=found.scale)
    return replace(seen, step=found.step, error=found.error, retained=found.retained, scatter=found.scatter)
