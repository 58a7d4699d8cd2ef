"""Terms of a pool with their evidence, and what they are to each other."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, field

from torch import Tensor

from nlos_lit.effects.effect import Effect
from nlos_lit.effects.free_terms import FREE_NAMES

MOST = 0.9  # of the largest evidence or gain: a simpler term with so much goes before that with the largest
Shape = dict[str, float]


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
        together: terms that are asked for beside each other, see :func:`~nlos_lit.inference.pool.together`.
        foreign: the free term that is surely asked for more than any effect and does what none of those can
            that are asked for most; None where there is none. It stands for something unknown, and they for
            what they share with that.
    """

    candidates: list[Candidate]
    together: list[Taken]
    foreign: Candidate | None = None


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
