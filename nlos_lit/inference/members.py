"""Terms that are tried on a capture, and what is found of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from torch import Tensor

from nlos_lit.effects.free_terms import FREE_NAMES
from nlos_lit.inference.candidates import MOST, Candidate, Pool
from nlos_lit.inference.heldout import Comparison, weights
from nlos_lit.surfels.fit import SurfelFit

# Of what select spots leave unexplained without a term. A free term that explains more, with this weight,
# holds, since it claims no cause; an effect is told of.
MUCH, SURE = 0.25, 0.95
EVEN = 0.5  # weight from which on a scene predicts better rather than worse than another


@dataclass(frozen=True)
class Trial:
    """The scene with one term in a place, or with none there.

    Args:
        candidate: the term; None for none.
        fit: the scene with it.
        likelihood: ``[S]`` of the select spots, nats.
        gain: over none.
        weight: how far the capture leaves open that this is the best in that place.
    """

    candidate: Candidate | None
    fit: SurfelFit
    likelihood: Tensor = field(repr=False)
    gain: Comparison
    weight: float = 0.0

    @property
    def name(self) -> str:
        return "none" if self.candidate is None else self.candidate.name


@dataclass(frozen=True)
class Confirmed:
    """What a term is worth beside all others.

    Args:
        evidence: its own, nats.
        needed: nats.
        gain: of the select spots over the scene without it: gone on with, or built anew, whichever leaves it
            less.
        weight: how far the capture leaves open that it predicts better than that one.
        explained: share of what the select spots leave unexplained without it.
        shared: of what is needed, nats for what other terms take from it.
        chance: of what is needed, nats that one of all terms has where nothing is wrong.
    """

    evidence: float
    needed: float
    gain: Comparison
    weight: float
    explained: float = 0.0
    shared: float = 0.0
    chance: float = 0.0

    @property
    def misfit(self) -> float:
        """Of what is needed, nats that what the scene cannot follow may give the term."""
        return max(0.0, self.needed - self.shared - self.chance)

    @property
    def much(self) -> bool:
        """Spots that were not fitted are predicted much better with it, and not a few of them alone: by a
        standard error less, too.
        """
        least = self.gain.nats - self.gain.error
        return self.explained * least > MUCH * self.gain.nats > 0 and self.weight > SURE

    def holds(self, candidate: Candidate) -> bool:
        """By its own evidence, which other spots do not contradict.

        Args:
            candidate: the term. An effect must predict others better than no effect. A free term is no name,
                and a number for each spot says next to nothing of others: with those others must not surely
                be predicted worse, and what a free term predicts is enough.
        """
        law = not candidate.free and not candidate.effect.per_spot
        enough = self.evidence > self.needed or (candidate.free and self.much)
        return enough and self.weight > (EVEN if law else 1 - SURE)


@dataclass(frozen=True)
class Member:
    """A term that was tried together with others.

    Args:
        candidate: as the pool saw it.
        rivals: that might be meant, as the pool saw them.
        confirmed: what was found when it was last asked whether it holds.
        accepted: it held.
        trials: what was tried in its place once it held, the largest gain first: itself, rivals, none.
        group: it and what the capture cannot tell from it, by name, with weights. A free term is none for an
            effect.
        gone: it has left the scene.
    """

    candidate: Candidate
    rivals: Sequence[Candidate] = ()
    confirmed: Confirmed | None = None
    accepted: bool = False
    trials: list[Trial] = field(default_factory=list)
    group: dict[str, float] = field(default_factory=dict)
    gone: bool = False

    @property
    def name(self) -> str:
        return self.candidate.name

    @property
    def likely(self) -> bool:
        """It does not hold, although it is asked for by more than chance, and spots that were not fitted are
        predicted much better with it: what a scene has bent itself to is missed by these, too.
        """
        known, c = not self.accepted and not self.gone, self.confirmed
        return known and c is not None and c.much and c.evidence > c.chance

    @property
    def stands_in(self) -> bool:
        """Its evidence is less than it needs by no more than what it needs because of other terms."""
        c = self.confirmed
        return c is not None and c.needed - c.shared < c.evidence <= c.needed

    @property
    def stays(self) -> bool:
        """The scene keeps its term: it holds, or is an effect that others are surely predicted better with.

        That is no name, but what it explains would stand against all others as misfit.
        """
        if self.accepted or self.gone or self.confirmed is None:
            return self.accepted
        unnamed = not self.candidate.free and not self.candidate.effect.per_spot
        return unnamed and self.confirmed.weight > SURE

    @property
    def trial(self) -> Trial:
        """With its term, once it held."""
        return next(t for t in self.trials if t.name == self.name)


class Held(NamedTuple):
    """Terms that hold, the scene with them, and the parsimonious one."""

    members: list[Member]
    scene: SurfelFit
    coarse: SurfelFit


@dataclass
class Findings:
    """What the search leaves behind.

    Args:
        base: the fine fit without effects.
        final: the fit with all terms that hold.
        pools: what was asked for, beside the base and whenever terms had come to it.
        members: terms that were tried, in the order in which they came.
        needed: nats of own evidence that a term needs beside the base, if it acts where the scene's light
            falls.
        again: the parsimonious fit with the terms that hold; None where there is none.
    """

    base: SurfelFit
    final: SurfelFit
    needed: float
    pools: list[Pool] = field(default_factory=list)
    members: list[Member] = field(default_factory=list)
    again: SurfelFit | None = None

    @property
    def accepted(self) -> list[Member]:
        """Terms that hold."""
        return [m for m in self.members if m.accepted]

    @property
    def present(self) -> list[Member]:
        """Terms that hold, and effects that the scenes keep besides."""
        return [m for m in self.members if m.stays]


def unknown_beside(members: Sequence[Member]) -> float:
    """How much is asked for that no effect does.

    Args:
        members: that were asked, effects without free terms, and free terms beside the effects.

    Returns:
        nats of the free term that has most, of those that have what they need; 0 where there is none. Those
        are left out that go on with what a stronger effect does that holds: no cause follows an equation to
        the last digit.
    """
    known = [(m, m.confirmed) for m in members if m.confirmed is not None]
    effects = [(m.candidate.effect.followed_by, c.evidence) for m, c in known if m.accepted]
    unknown = [
        c.evidence
        for m, c in known
        if m.candidate.free
        and c.evidence > c.needed
        and not any(m.name in does and nats > c.evidence for does, nats in effects)
    ]
    return max(unknown, default=0.0)


def weighed(trials: list[Trial], block: np.ndarray) -> list[Trial]:
    """Trials with their weights, the largest gain first.

    Args:
        trials: in one place.
        block: ``[S]`` wall block of each select spot.

    Returns:
        the same trials.
    """
    shares = weights([t.likelihood for t in trials], block)
    found = [replace(t, weight=w) for t, w in zip(trials, shares, strict=True)]
    return sorted(found, key=lambda t: -t.gain.nats)


def chosen(trials: list[Trial], odds: float, least: float) -> Trial:
    """The simplest of those that gain most.

    Args:
        trials: in one place, with weights, the largest gain first; none is not chosen.
        odds: share of the best one's weight from which on a simpler one goes before it, as it does from
            ``MOST`` of its gain and of its evidence on; but no effect before a free term that predicts better
            by so much weight …
        least: … or that, doing what the effect cannot, is asked for by so many nats more.

    Returns:
        an effect before a free term, few coefficients before many.
    """
    first, *others = [t for t in trials if t.candidate is not None]

    def near(trial: Trial) -> bool:
        one, other = first.candidate, trial.candidate
        assert one is not None
        assert other is not None
        unknown = one.free and not other.free
        if unknown and one.name not in other.effect.followed_by and one.evidence > other.evidence + least:
            return False
        gains = trial.gain.nats >= MOST * first.gain.nats and other.evidence >= MOST * one.evidence
        return (gains and not unknown) or trial.weight >= odds * first.weight

    return min([first, *filter(near, others)], key=cost)


def cost(trial: Trial) -> tuple[bool, int, float]:
    """Sort key of a term: an effect before a free term, fewer coefficients before more, more gain first."""
    assert trial.candidate is not None
    return trial.name in FREE_NAMES, len(trial.candidate.step), -trial.gain.nats


def group_of(
    best: Trial, trials: list[Trial], block: np.ndarray, share: float, least: float
) -> dict[str, float]:
    """What the capture cannot tell from the best, among those of its kind: effects, or free terms.

    Select spots weigh them. Fitted spots have half a say where they ask for one more surely than for the best
    that select spots do not gain much less with.

    Args:
        best: in its place.
        trials: there.
        block: ``[S]`` wall block of each select spot.
        share: weight above which it cannot.
        least: nats by which fitted spots ask for one more surely.

    Returns:
        weights by name, the best's first.
    """
    kind = [t for t in trials if t.candidate and (t.name in FREE_NAMES) == (best.name in FREE_NAMES)]
    shares = dict(zip([t.name for t in kind], weights([t.likelihood for t in kind], block), strict=True))
    near = [t for t in kind if t.gain.nats >= MOST * best.gain.nats]
    asked = max([best, *near], key=evidence_of)
    if evidence_of(asked) > evidence_of(best) + least:
        shares = {name: (weight + (name == asked.name)) / 2 for name, weight in shares.items()}
    left = {best.name: shares[best.name]} | {n: w for n, w in shares.items() if w > share}
    return {name: weight / sum(left.values()) for name, weight in left.items()}


def evidence_of(trial: Trial) -> float:
    """Nats of the pool for a trial's term; 0 for none."""
    return 0.0 if trial.candidate is None else trial.candidate.evidence
