"""Show, name, extend, measure: the search that finds out what a capture asks for (docs/criticism.md).

What the counts ask for together, beside a parsimonious scene, goes into the model together. Then each term
must hold: the same scene goes on without it, and whoever is not missed by spots that were not fitted leaves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from nlos_lit.capture.scan import Scan
from nlos_lit.inference.asking import Asking
from nlos_lit.inference.beginning import begun
from nlos_lit.inference.candidates import Candidate, Pool, ahead_of, each_once, free_along, lost
from nlos_lit.inference.holding import Holding
from nlos_lit.inference.members import Findings, Held, Member, unknown_beside
from nlos_lit.inference.scenes import Scenes
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.surfels.fit import SurfelFit

# Fine fit without effects, present one, terms so far.
Told = Callable[[SurfelFit, SurfelFit, list[Member]], None]


def criticise(
    base: SurfelFit,
    scenes: Scenes,
    scan: Scan,
    s: CriticismSettings,
    told: Told = lambda base, present, members: None,
) -> Findings:
    """Find out what the capture asks for.

    Args:
        base: fitted without effects, coarse.
        scenes: makes others of the capture.
        scan: of the capture.
        s: settings.
        told: called before anything is asked, when terms came, and when it is known which hold.

    Returns:
        base, terms and final fit.
    """
    return Search(base, scenes, scan, s, told).findings()


class Search:
    """What is asked when, and how a diagnosis stands. Arguments are those of :func:`criticise`.

    Attributes:
        base: without effects, parsimonious. first: the same scene, fine.
        coarse: the parsimonious scene with all that has come. pool: what the counts ask for beside it.
        begun: what the search began with.
        found: terms that were tried, and all that is left behind.
    """

    def __init__(self, base: SurfelFit, scenes: Scenes, scan: Scan, s: CriticismSettings, told: Told) -> None:
        self.scenes, self.settings, self.told = scenes, s, told
        self.asking = Asking(scenes, scan, s)
        self.holding = Holding(self.asking)
        self.least = self.asking.least
        self._begin_with(base, scenes.fine(base, "without_effects"))

    def _begin_with(self, base: SurfelFit, first: SurfelFit) -> None:
        """Begin anew, with this parsimonious scene without effects and this fine one."""
        self.base, self.first, self.coarse = base, first, base
        self.begun = Held([], first, base)
        self.found = Findings(first, first, self.asking.needed(first))
        self.told(first, first, [])
        self.pool = self._ask(effects=True)

    def findings(self) -> Findings:
        """All that is asked, in its order."""
        held = self._held_at_first()
        if held.members:
            held = self._beside(held, [])
        else:
            start, new = self._beginning()
            pool = self.found.pools[0]  # without any term
            held = self._or_unsaid(pool, self._beside(start, new))
        found = self.found
        found.members, scene = self.holding.named(*self.holding.single_spots(found.members, held.scene))
        if found.accepted and self.scenes.predicts(scene, self.first):
            found.final = scene
            found.again = self.scenes.only(held.coarse, [m.name for m in found.present])
        else:
            found.members = [replace(m, accepted=False) for m in found.members]
        self.told(self.first, found.final, found.members)
        return found

    def _ask(self, effects: bool) -> Pool:
        """What the counts ask for beside the parsimonious scene: effects, or free terms alone."""
        room = max(0, self.settings.most - len(self.coarse.extension.effects))
        self.found.pools.append(self.asking.ask(self.coarse, room, effects))
        return self.found.pools[-1]

    def _held_at_first(self) -> Held:
        """What holds where a free term goes before all effects that are asked for; else nothing."""
        leads, before = self.pool.foreign, self.pool
        if leads is None:
            return self.begun
        self.coarse = self.scenes.joined(self.base, [leads])
        held = self._led_by(leads, before)
        if not held.members:
            held, self.coarse, self.pool, self.found.members = self.begun, self.base, before, []
        return held

    def _led_by(self, leads: Candidate, before: Pool) -> Held:
        """What holds of a free term, beside the scene that was built with it."""
        self.found.members = [Member(leads)]
        self.told(self.first, self.coarse, self.found.members)
        self.pool = self._ask(effects=True)
        rivals = [c for c in lost(before.candidates, self.pool.candidates, self.least) if c.free]
        return self._with_those([Member(leads, rivals)], Held([], self.first, self.base))

    def _beginning(self) -> tuple[Held, list[Member]]:
        """What is held when effects are asked for, and those that scenes were built with."""
        start = self.begun
        odds = self.settings.odds
        self.begun = begun(self.scenes, self.base, self.first, self.pool, self.least, odds)
        self.coarse, new = self.begun.coarse, self.begun.members
        if new:
            before, self.pool = self.pool, self._ask(effects=True)
            rivals = lost(before.candidates, self.pool.candidates, self.least)
            alike = [c for c in rivals if not c.free]
            new = [
                replace(m, rivals=each_once(*m.rivals, *ahead_of(m.candidate, rivals), *alike)) for m in new
            ]
            self.found.members = self.found.members + new
            self.told(self.first, self.coarse, self.found.members)
        elif self.coarse is not self.base:
            self._begin_with(self.coarse, self.begun.scene)
            start = self.begun
        return start, new

    def _beside(self, start: Held, new: list[Member]) -> Held:
        """What holds when effects and free terms have come to what holds, and ``new`` have already."""
        effects = self._with_those(self._joined_by(new, free=False), start)
        fewer: Held | None = start  # what they do may be what something unknown does
        held = effects
        if len(effects.members) <= len(start.members) or self.scenes.predicts(effects.scene, start.scene):
            held = self._with_free(effects)
            fewer = self._but_outdone(effects, start)
        if fewer is None:
            return held
        known = self.found.members
        other = self._with_free(fewer)
        if len(other.members) <= len(fewer.members):
            self.found.members = known
            return held
        less = {m.name for m in effects.members} - {m.name for m in fewer.members}
        self.found.members = [
            replace(m, accepted=False, gone=True) if m.name in less else m for m in self.found.members
        ]
        return other

    def _or_unsaid(self, pool: Pool, held: Held) -> Held:
        """What holds, or, where a scene that was built with something unknown alone stands against it and
        that holds, what holds beside that.

        Args:
            pool: what the counts ask for beside the parsimonious scene without any term.
            held: what holds.
        """
        instead = unsaid(pool, held, self.least)
        if instead is None:
            return held
        known, pools = self.found.members, list(self.found.pools)
        self.coarse = self.scenes.joined(self.base, [instead])
        if self.scenes.predicts(self.coarse, held.coarse, 1 / (1 + self.settings.odds)):
            other = self._led_by(instead, pool)
            if other.members:
                return self._beside(other, [])
            self.found.members, self.found.pools = known, pools
        return held

    def _joined_by(self, new: list[Member], free: bool) -> list[Member]:
        """Those that came, and effects or free terms that are asked for beside them, which come too."""
        while come := coming(self.pool, free, self.least):
            self.coarse = self.scenes.joined(self.coarse, [m.candidate for m in come])
            again = {m.name for m in come}
            new = new + come
            self.found.members = [m for m in self.found.members if m.name not in again] + come
            self.told(self.first, self.coarse, self.found.members)
            self.pool = self._ask(effects=not free)
        return new

    def _with_those(self, new: list[Member], beside: Held) -> Held:
        """What holds of those that came, beside what is held."""
        if not new:
            return beside
        self.coarse = self.scenes.whole(self.coarse)
        known = self.coarse is self.begun.coarse
        grown = self.begun.scene if known else self.scenes.grown(self.coarse, "with_all")
        tried, scene, left = self.holding.hold(new, grown, self.coarse, beside)
        now = {m.name: m for m in tried}
        self.found.members = [now.get(m.name, m) for m in self.found.members]
        return Held(beside.members + [m for m in tried if m.stays], scene, left or self.coarse)

    def _with_free(self, beside: Held) -> Held:
        """What holds when free terms are asked for, too."""
        if beside.coarse is not self.coarse:
            self.coarse = beside.coarse
            self.pool = self._ask(effects=False)
        return self._with_those(self._joined_by([], free=True), beside)

    def _but_outdone(self, effects: Held, start: Held) -> Held | None:
        """What is left without effects that are not surely asked for more than something unknown beside them.

        Args:
            effects: that hold.
            start: what held before they came.

        Returns:
            Those that are left, and scenes with them alone; None where that is all.
        """
        before = {m.name for m in start.members}
        unknown = unknown_beside([m for m in self.found.members if m.name not in before])
        if not unknown:
            return None
        named = [m for m in effects.members if m.accepted and m.name not in before]
        more = [m for m in named if m.confirmed and m.confirmed.evidence > unknown + self.least]
        if len(more) == len(named):
            return None
        if not more:
            return start
        staying = start.members + more
        coarse = self.scenes.built_with(effects.coarse, [m.name for m in staying])
        return Held(staying, self.scenes.grown(coarse, "with_those_that_do_more"), coarse)


def coming(pool: Pool, free: bool, least: float) -> list[Member]:
    """Who comes into the parsimonious scene.

    Args:
        pool: what the counts ask for beside it.
        free: free terms, else effects.
        least: nats that a term needs.

    Returns:
        An effect with a number for each spot by itself, where the counts ask for nothing more than for it:
        other terms would be taken for what it does. Else those that are asked for together.
    """
    lead = [c for c in pool.candidates[:1] if c.effect.per_spot and c.evidence > least]
    if lead and not free and not lead[0].free:
        return [Member(lead[0])]
    return [Member(t.candidate, t.rivals) for t in pool.together if t.candidate.free == free]


def unsaid(pool: Pool, held: Held, least: float) -> Candidate | None:
    """What an unknown by itself would have to be, to be held against the effects that hold.

    Effects that look alike may do together what none of them does alone. So what holds is held against a
    scene that never had any of it, and was built with the free term that may be asked for most.

    Args:
        pool: what the counts ask for beside the parsimonious scene without any term.
        held: what holds.
        least: nats that a term needs.

    Returns:
        Of the free terms that do what no effect that holds can, the one with most evidence where its scatter
        is its own; None where no effect holds, one of them has a number for each spot, of which others know
        nothing, or no free term is asked for.
    """
    effects = [m for m in held.members if m.accepted and not m.candidate.free]
    if not effects or any(m.candidate.effect.per_spot for m in effects):
        return None
    does = {m.name for m in held.members}.union(*(m.candidate.effect.followed_by for m in effects))
    asked = [c for c in free_along(pool.candidates, does) if c.evidence > least]
    return max(asked, key=lambda c: c.loud, default=None)
