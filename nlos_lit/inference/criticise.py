"""Show, name, extend, measure: the loop that finds out what a capture asks for (docs/criticism.md).

What the counts ask for together, beside a parsimonious scene, goes into the model together. Then each term
must hold: the same scene goes on without it, and whoever is not missed by spots that were not fitted leaves.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.heldout import Comparison, compare, log_likelihood, score, weights
from nlos_lit.inference.members import (
    EVEN,
    SURE,
    Confirmed,
    Findings,
    Member,
    Trial,
    chosen,
    group_of,
    unknown_beside,
    weighed,
)
from nlos_lit.inference.per_spot import solve
from nlos_lit.inference.pool import Candidate, Pool, ahead_of, ask, each_once, free_along, lost, own_evidence
from nlos_lit.inference.problem import acting_order
from nlos_lit.inference.split import Split
from nlos_lit.runtime.steps import Steps
from nlos_lit.surfels.fit import SurfelFit

log = logging.getLogger(__name__)
Rebuild = Callable[[Extension, int], SurfelFit]
Grow = Callable[[SurfelFit, int], SurfelFit]
Built = tuple[SurfelFit, SurfelFit | None]  # a parsimonious scene, and the fine one, where it was made
LENGTHS = (1.0, 0.3, 0.1)  # of the pool's step, that a term may begin with
WARM = 240  # batches, at falling rates
HALF = 0.5  # of the misfit: one effect predicts less of what a scene lacks for unknown reasons
OF_SPOTS = frozenset(cls.name for cls in [*EFFECTS, *FREE] if cls.per_spot)
IMITATED = [
    frozenset(cls.name for cls in EFFECTS if cls.imitated == kind) for kind in ("light", "geometry", "echoes")
]


@dataclass(frozen=True)
class CriticismSettings:
    """How hard a term must be asked for before the model is extended with it.

    Args:
        spots: fitted spots that the pool is asked on at most.
        level: chance of a false name that is borne where the base is right: a term needs ln(terms in the
            pool/level) nats of evidence.
        share: of the misfit that a fine scene leaves, nats; a term needs so much on top, as far as it acts
            where the scene's light falls. What is wrong for unknown reasons may look a little like anything.
        form: of what other terms take from a term, nats; it needs so much on top. No cause follows an
            equation to the last digit, and what a strong one leaves looks like its look-alikes.
        most: terms that are tried together at most.
        rivals: look-alikes that are tried in the place of each term that holds, at most.
        open_share: weight above which the capture leaves open that a rival is meant.
        odds: share of the best one's weight from which on a simpler rival goes before it, and effects before
            something unknown by itself.
        toys: simulated captures for the null distribution.
        processes: that work on them; fits that go on side by side.
    """

    spots: int = 1024
    level: float = 0.01
    share: float = 0.1
    form: float = 0.25
    most: int = 8
    rivals: int = 2
    open_share: float = 0.05
    odds: float = 0.25
    toys: int = 0
    processes: int = 2


def misfit_of(fit: SurfelFit, spots: np.ndarray, number: int) -> float:
    """How much likelier than by the fit some counts would be if all but counting noise were explained.

    Numbers of single spots are solved for: no fit can know those of spots that it has not seen.

    Args:
        fit: that is judged.
        spots: ``[S]`` rows of the capture.
        number: of spots that it is said for.

    Returns:
        nats, half the deviance above the noise's; below 0 where surfels have taken up noise.
    """
    if any(e.per_spot for e in fit.extension.effects):
        fit = copy.copy(fit)
        fit.extension, fit.train = copy_effects(fit.extension, []), torch.from_numpy(spots)
        fit.counts = torch.from_numpy(fit.capture.gated_counts()[spots])
        solve_spots(fit)
    found = score(fit, spots)
    return 0.5 * (found.deviance_per_bin - found.deviance_noise) * number * fit.counts.shape[1]


def begun_with(fit: SurfelFit, extra: list[Candidate]) -> Extension:
    """A copy of the fit's extension with more terms, begun where the pool saw them.

    A step of the linear problem may be far too long where a term bends the light, and is shortened until the
    counts are likelier; numbers of single spots are solved for and not moved by an optimiser.

    Args:
        fit: whose extension it is.
        extra: the terms.

    Returns:
        a new extension.
    """

    def begun(length: float) -> Extension:
        added = []
        for candidate in extra:
            effect = copy.deepcopy(candidate.effect)
            effect.shift(length * candidate.step)
            effect.clamp()
            added.append(effect.requires_grad_(not effect.per_spot))
        return copy_effects(fit.extension, added)

    def likelihood(extension: Extension) -> float:
        counts = fit.counts[fit.tested]
        expected = fit.model.expected(fit.train[fit.tested], extension).clamp_min(1e-9)
        return float((torch.xlogy(counts, expected) - expected).double().sum())

    return max((begun(length) for length in LENGTHS), key=likelihood) if extra else begun(0.0)


def copy_effects(extension: Extension, extra: list[Effect]) -> Extension:
    """A copy of the extension with more effects at their present values, in order of application.

    Args:
        extension: that is copied.
        extra: effects, copied too.

    Returns:
        a new extension.
    """
    return Extension(sorted((copy.deepcopy(e) for e in [*extension.effects, *extra]), key=acting_order))


def _rebuilt(rebuild: Rebuild, extension: Extension, seed: int) -> SurfelFit | None:
    """None: with these effects no surfel survives, so that they are not the ones."""
    try:
        fit = rebuild(copy_effects(extension, []), seed)
    except UserError as error:
        log.info("a rebuild leaves nothing: %s", error)
        return None
    return solve_spots(fit)


def solve_spots(fit: SurfelFit) -> SurfelFit:
    """The fit, with numbers of single spots solved for: random batches would visit each a few times only."""
    for effect in fit.extension.effects:
        if effect.per_spot:
            solve(fit.model, fit.extension, effect, fit.train, fit.counts)
    return fit


def go_on(fit: SurfelFit) -> SurfelFit:
    """Some more batches, at falling rates.

    Numbers of single spots stay until the scene has got used to the terms that came or left: they would take
    up whatever it lacks at first, and the scene could not get it back.

    Args:
        fit: that goes on, in place.

    Returns:
        the same fit.
    """
    fit.go_on(WARM)
    return solve_spots(fit)


class Held(NamedTuple):
    """Terms that hold, the scene with them, and the parsimonious one."""

    members: list[Member]
    scene: SurfelFit
    coarse: SurfelFit


class Standing(NamedTuple):
    """Where a search stands for those that hold."""

    staying: list[Member]
    gone: dict[str, Member]  # by name
    scene: SurfelFit
    coarse: SurfelFit | None  # as Loop.hold takes it
    asked: bool = False  # all who stay have been, beside scenes that were built without them, too


class Loop:
    """All that is tried on one capture.

    Args:
        rebuild: a parsimonious fit from new seeds with given effects, begun at their present values, and
            random seed.
        grow: the same scene gone on with until surfels are as many and as fine as the counts ask for.
        split: of the spots.
        scan: of the capture.
        settings: of the criticism.
        seed: of everything random.
        steps: says and keeps what is done.
    """

    def __init__(
        self,
        rebuild: Rebuild,
        grow: Grow,
        split: Split,
        scan: Scan,
        settings: CriticismSettings,
        seed: int,
        steps: Steps,
    ) -> None:
        self.rebuild, self.grow = rebuild, grow
        self.split, self.scan, self.settings = split, scan, settings
        self.seed, self.steps, self.number = seed, steps, 0
        self.block = split.block[split.select]
        self.least = math.log((len(EFFECTS) + len(FREE)) / settings.level)

    def ask(self, fit: SurfelFit, room: int, effects: bool = True, of_spots: bool = False) -> Pool:
        """What the counts ask for beside a fit.

        Args:
            fit: that is criticised.
            room: for so many terms that are taken together.
            effects: such may be taken; free terms may where none is.
            of_spots: only terms with a number for each spot are asked.

        Returns:
            the pool.
        """
        self.number += 1
        s, only = self.settings, OF_SPOTS if of_spots else None
        asking = partial(ask, fit, self.split, self.scan, s.spots, self.seed, self.least, room, effects, only)
        text = "asking single spots" if of_spots else "asking the pool"
        return self.steps("screen", f"{text}, {self.number}", f"pool{self.number}", asking)

    def begun(self, base: SurfelFit, fine: SurfelFit, pool: Pool) -> Held:
        """What the search begins with.

        Beside a scene that has imitated a strong effect the counts do not ask for that any more. So scenes
        are also built with all effects of each kind that scenes imitate, from the first surfel on. The best
        is taken where it surely predicts better than the base, and, when it has become as fine, than the fine
        scene without any. Where there are no such effects they are a burden, or the scene is a luckier one:
        where it is as good without them, it is the base. They may also do a little of what is there; so,
        where they are taken, a scene with what the counts ask for together is built in the same way.

        Args:
            base: without effects, parsimonious.
            fine: the same scene as fine as the counts ask for.
            pool: what the counts ask for beside the base.

        Returns:
            The effects that are there, if any, and the scenes with them; nobody was asked whether they hold.
        """
        found = [Held([], fine, base)]
        asked = [Member(t.candidate, t.rivals) for t in pool.together if not t.candidate.free]
        known = any({m.name for m in asked} <= kind for kind in IMITATED)  # or nothing is asked for
        kinds = [[Member(c) for c in pool.candidates if c.name in kind] for kind in IMITATED]
        built = self._built_at_first(base, {k: members for k, members in enumerate(kinds) if members})
        for kind, members in enumerate([*kinds, asked]):
            if members is asked and not known and len(found) > 1:
                built |= self._built_at_first(base, {kind: asked})
            fit = built.get(kind, base)
            if not fit.extension.effects or not self.predicts(fit, base, SURE):
                continue
            names = [m.name for m in members]
            bare = self._parted(fit, names, f"begun{kind}_bare")
            if not self.predicts(fit, bare, SURE):
                members, fit = [], bare
            grown = self.grown(fit, f"begun_with_{'_'.join(names)}")
            if self.predicts(grown, fine, SURE):
                found.append(Held(members, grown, fit))
        best = self.better(*(one.coarse for one in found))
        return next(one for one in found if one.coarse is best)

    def _built_at_first(self, base: SurfelFit, kinds: dict[int, list[Member]]) -> dict[int, SurfelFit]:
        """Scenes built with the terms of each kind, or the base where no surfel survives with them."""
        jobs = []
        for kind, members in kinds.items():
            extension = copy_effects(Extension([]), [self._at_first(m.candidate, base) for m in members])
            text = f"building a scene with {', '.join(e.name for e in extension.effects)}"
            jobs.append((text, f"begun{kind}", partial(self._built_or, base, extension)))
        self.steps.plan(fit=len(jobs))
        return dict(zip(kinds, self.steps.several("fit", jobs, self.settings.processes), strict=True))

    def _at_first(self, candidate: Candidate, base: SurfelFit) -> Effect:
        """What a scene is built with: the effect as it begins, with the shapes that the pool asks for."""
        effect = copy.deepcopy(candidate.effect)
        effect.begin(base.counts)
        if candidate.evidence > self.least:
            effect.set_all({p.name: candidate.effect.value(p.name) for p in effect.shapes})
        return effect.requires_grad_(True)

    def _built_or(self, other: SurfelFit, extension: Extension) -> SurfelFit:
        """A scene built with the effects, or the other, where no surfel survives with them."""
        fit = _rebuilt(self.rebuild, extension, self.seed)
        return other if fit is None else fit

    def next(self, pool: Pool, free: bool) -> list[Member]:
        """Who comes into the parsimonious scene.

        Args:
            pool: what the counts ask for beside it.
            free: free terms, else effects.

        Returns:
            An effect with a number for each spot by itself, where the counts ask for nothing more than for
            it: other terms would be taken for what it does. Else those that are asked for together.
        """
        lead = [c for c in pool.candidates[:1] if c.effect.per_spot and c.evidence > self.least]
        if lead and not free and not lead[0].free:
            return [Member(lead[0])]
        return [Member(t.candidate, t.rivals) for t in pool.together if t.candidate.free == free]

    def joined(self, fit: SurfelFit, new: list[Candidate]) -> SurfelFit:
        """A parsimonious scene with more terms.

        The present one goes on with them, and is built anew, where that predicts better: surfels that
        imitated the terms do not come back.

        Args:
            fit: parsimonious.
            new: terms that come to it.

        Returns:
            another fit.
        """
        names = "_".join(c.name for c in new)
        self.steps.plan(fit=3)
        warm = self.gone_on(fit, new)
        text = f"rebuilding the scene with {', '.join(e.name for e in warm.extension.effects)}"
        return self.steps("fit", text, f"new{self.number}_{names}", partial(self._or_anew, warm))

    def _or_anew(self, fit: SurfelFit) -> SurfelFit:
        """A parsimonious scene, or one built anew with its terms, whichever predicts better."""
        other = _rebuilt(self.rebuild, fit.extension, self.seed)
        return fit if other is None else self.better(other, fit)

    def better(self, *fits: SurfelFit) -> SurfelFit:
        """The one that predicts the select spots best."""
        return max(fits, key=lambda fit: float(log_likelihood(fit, self.split.select).sum()))

    def gone_on(self, fit: SurfelFit, new: list[Candidate]) -> SurfelFit:
        """The same scene, gone on with more terms.

        Args:
            fit: that is copied.
            new: the terms.

        Returns:
            another fit.
        """
        names = ", ".join(c.name for c in new)
        name = f"on{self.number}_{'_'.join(c.name for c in new)}"
        return self.steps("fit", f"going on with {names}", name, partial(self._warm, fit, new))

    def fine(self, fit: SurfelFit, name: str) -> SurfelFit:
        """The scene as fine as the counts ask for, with the fit's terms.

        Args:
            fit: that goes on.
            name: of the step.

        Returns:
            another fit.
        """
        return self.steps("fit", *self._refining(fit, name))

    def _refining(self, fit: SurfelFit, name: str) -> tuple[str, str, Callable[[], SurfelFit]]:
        """What :meth:`fine` says, keeps and does."""
        text, kept = f"refining the scene {name.replace('_', ' ')}", f"fine{self.number}_{name}"
        return text, kept, lambda: solve_spots(self.grow(fit, self.seed))

    def grown(self, coarse: SurfelFit, name: str) -> SurfelFit:
        """The scene as fine as the counts ask for, or the parsimonious one, whichever predicts better.

        Args:
            coarse: the parsimonious one.
            name: of the step.

        Returns:
            one of them.
        """
        return self.better(self.fine(coarse, name), coarse)

    def hold(
        self,
        members: list[Member],
        scene: SurfelFit,
        coarse: SurfelFit | None = None,
        before: Held | None = None,
    ) -> tuple[list[Member], SurfelFit, SurfelFit | None]:
        """Which of some terms hold, beside each other.

        Of two that stand for each other neither is missed. So those without the evidence that they need leave
        one after the other, each asked when those before it are gone, and free terms beside the effects that
        are left; else the one that is missed least leaves. The scene has bent itself to those that left: it
        is built anew with all that stay, who are asked again. Those that hold so are asked once more, beside
        parsimonious scenes. Effects with which other spots are surely predicted better stay in the scene,
        however little they are asked for: what they explain would stand against all others as misfit. But
        where one lacks only what others take, those that are missed least leave, one after the other, as they
        may share what one of them does. If fewer hold then than before, they stay, or if no more do and other
        spots are surely predicted better with them.

        Args:
            members: whose terms the scene has.
            scene: with all of them.
            coarse: the parsimonious scene with all of them, where it is to be asked.
            before: what held before these came, where ``coarse`` is given. It is not asked again, and where
                none of these holds all is as it was.

        Returns:
            The same members, accepted or not, with none and itself as trials where they are, and both scenes
            with those that stay.
        """
        start = Standing(list(members), {}, scene, coarse)
        end, whole = self._left(start, before, apart=True)
        if whole is not None and self._in_vain(end, whole):
            together = whole if whole.asked else self._left(whole, before, apart=False)[0]
            end = together if self._in_vain(end, together) else end
        now = {m.name: m for m in end.staying} | end.gone
        return [now[m.name] for m in members], end.scene, end.coarse

    def _in_vain(self, apart: Standing, together: Standing) -> bool:
        """Look-alikes left in vain: fewer hold, or no more, and others are surely predicted worse."""
        more = _named(apart.staying) - _named(together.staying)
        return more < 0 or (more == 0 and self.predicts(together.scene, apart.scene, SURE))

    def _left(self, now: Standing, before: Held | None, apart: bool) -> tuple[Standing, Standing | None]:
        """Who is left when nobody has to leave any more.

        Args:
            now: who is there.
            before: as for :meth:`hold`.
            apart: look-alikes leave, too.

        Returns:
            That, and how it stood when the first look-alike left, if one did.
        """
        (staying, away, scene, coarse, _), whole = now, None

        def leaving(anew: bool) -> list[Member]:
            nonlocal whole
            gone = _leaving(staying, enough)
            if not gone and apart and (gone := _sharing(staying)):
                whole = whole or Standing(staying, away, scene, coarse, anew)
            return gone

        while staying:
            without = dict[str, Built]()
            asked, enough = self._asked(staying, scene)
            staying = [member for member, _ in asked]
            gone = leaving(anew=coarse is None)
            if not gone and coarse is not None:
                staying, without = self._anew(staying, coarse, scene)
                gone = leaving(anew=True)
            if not gone:
                break
            away = away | {m.name: replace(m, gone=True) for m in gone}
            staying = [m for m in staying if m not in gone]
            if coarse is None or before is None:
                scene = self._bare(scene, gone, asked)
            elif not staying:
                scene, coarse = before.scene, before.coarse
            else:
                names = [m.name for m in [*before.members, *staying]]
                known = without.get(gone[0].name) if len(gone) == 1 else None
                coarse, fine = known or (self.built_with(coarse, names), None)
                scene = self.better(fine or self.fine(coarse, f"with_{'_'.join(names)}"), coarse)
        return Standing(staying, away, scene, coarse), whole

    def whole(self, coarse: SurfelFit) -> SurfelFit:
        """A parsimonious scene whose terms do all that they stand for.

        A scene that has taken up the first of some echoes leaves every second one to be found, and no step
        leads from there to the first.

        Args:
            coarse: the scene.

        Returns:
            It, or one built anew from what its terms may be a part of, for as long as that predicts better.
        """
        turn = 0
        while parts := {e.name: more for e in coarse.extension.effects if (more := e.part_of())}:
            extension = copy_effects(coarse.extension, [])
            for effect in extension.effects:
                effect.set_all(parts.get(effect.name, {}))
            text, kept = f"building a scene with more of {', '.join(parts)}", f"whole{self.number}_{turn}"
            self.steps.plan(fit=1)
            fit = self.steps("fit", text, kept, partial(self._built_or, coarse, extension))
            if self.better(coarse, fit) is coarse:
                break
            coarse, turn = fit, turn + 1
        return coarse

    def built_with(self, coarse: SurfelFit, names: Sequence[str]) -> SurfelFit:
        """A parsimonious scene with some of its terms: gone on with, or built anew.

        Args:
            coarse: with these terms, and others.
            names: of those that stay.

        Returns:
            The one that predicts the select spots better.
        """
        text, kept = f"rebuilding the scene with {', '.join(names)}", f"built{self.number}_{'_'.join(names)}"
        return self.steps("fit", text, kept, partial(self._or_anew, self.only(coarse, names)))

    def but_outdone(self, effects: Held, start: Held, asked: Sequence[Member]) -> Held | None:
        """What is left without effects that are not surely asked for more than something unknown beside them.

        Args:
            effects: that hold.
            start: what held before they came.
            asked: all that was tried, free terms beside the effects.

        Returns:
            Those that are left, and scenes with them alone; None where that is all.
        """
        before = {m.name for m in start.members}
        unknown = unknown_beside([m for m in asked if m.name not in before])
        if not unknown:
            return None
        least = unknown + self.least
        named = [m for m in effects.members if m.accepted and m.name not in before]
        more = [m for m in named if m.confirmed is not None and m.confirmed.evidence > least]
        if len(more) == len(named):
            return None
        if not more:
            return start
        staying = start.members + more
        coarse = self.built_with(effects.coarse, [m.name for m in staying])
        return Held(staying, self.grown(coarse, "with_those_that_do_more"), coarse)

    def unsaid(self, pool: Pool, held: Held) -> Candidate | None:
        """What an unknown by itself would have to be, to be held against the effects that hold.

        Effects that look alike may do together what none of them does alone. So what holds is held against a
        scene that never had any of it, and was built with the free term that may be asked for most.

        Args:
            pool: what the counts ask for beside the parsimonious scene without any term.
            held: what holds.

        Returns:
            Of the free terms that do what no effect that holds can, the one with most evidence where its
            scatter is its own; None where no effect holds, one of them has a number for each spot, of which
            others know nothing, or no free term is asked for.
        """
        effects = [m for m in held.members if m.accepted and not m.candidate.free]
        if not effects or any(m.candidate.effect.per_spot for m in effects):
            return None
        does = {m.name for m in held.members}.union(*(m.candidate.effect.followed_by for m in effects))
        asked = [c for c in free_along(pool.candidates, does) if c.evidence > self.least]
        return max(asked, key=lambda c: c.loud, default=None)

    def _bare(self, scene: SurfelFit, gone: list[Member], asked: list[tuple[Member, SurfelFit]]) -> SurfelFit:
        """The scene without members that leave."""
        names = [m.name for m in gone]
        if len(gone) == 1:
            return next(fit for member, fit in asked if member.name == names[0])
        return self._parted(scene, names, f"left{self.number}_{'_'.join(names)}")

    def _anew(
        self, members: list[Member], coarse: SurfelFit, scene: SurfelFit
    ) -> tuple[list[Member], dict[str, Built]]:
        """Members that hold, asked against parsimonious scenes that were built without them.

        A scene that has bent itself to a term cannot go on without it as well as one that never had it. And
        terms must be asked for as much as they need beside such a scene when it has become fine, but for free
        ones that hold by what they predict, and numbers of single spots. Not those that account for most of
        the misfit which this leaves: beside a scene that imitates a strong one, or fails without it, the
        counts ask for it no more.

        Args:
            members: those that hold are asked.
            coarse: the parsimonious scene with all of them.
            scene: the one that they hold beside.

        Returns:
            The same members, and by name the scenes that were built without them: parsimonious, and fine
            where it was asked.
        """
        names, value = [m.name for m in members], log_likelihood(coarse, self.split.select)
        kept, asked = f"anew{self.number}_{'_'.join(names)}_but_", [m for m in members if m.accepted]
        self.steps.plan(fit=len(asked))
        jobs = [
            (
                f"rebuilding the scene without {m.name}",
                kept + m.name,
                partial(self._without_it, coarse, m.name),
            )
            for m in asked
        ]
        fits = self.steps.several("fit", jobs, self.settings.processes)
        built: dict[str, Built] = {m.name: (fit, None) for m, fit in zip(asked, fits, strict=True)}
        now = {m.name: self._missed(m, fit, value) for m, fit in zip(asked, fits, strict=True)}
        finer = [
            m.name
            for m in asked
            if now[m.name].holds(m.candidate)
            and not m.candidate.effect.per_spot
            and not (m.candidate.free and now[m.name].much)
        ]
        self.steps.plan(fit=len(finer), screen=len(finer))
        refining = [self._refining(built[n][0], f"with_all_of_{'_'.join(names)}_but_{n}") for n in finer]
        for name, fine in zip(
            finer, self.steps.several("fit", refining, self.settings.processes), strict=True
        ):
            built[name] = built[name][0], fine
            if not self._accounts(now[name].evidence, scene, fine):
                evidence = self._beside(fine, name, kept + name)
                now[name] = replace(now[name], evidence=min(evidence, now[name].evidence))
        found = [
            replace(m, confirmed=now[m.name], accepted=now[m.name].holds(m.candidate)) if m.name in now else m
            for m in members
        ]
        return found, built

    def _missed(self, member: Member, fit: SurfelFit, value: Tensor) -> Confirmed:
        """What a member is worth over a scene that went on without it, or was built so: the lesser.

        ``value`` ``[S]`` nats is that of the parsimonious scene with it.
        """
        gain, weight, explained = self._gained(fit, log_likelihood(fit, self.split.select), value)
        old = member.confirmed
        assert old is not None
        least = gain if gain.nats < old.gain.nats else old.gain
        return replace(
            old, gain=least, weight=min(weight, old.weight), explained=min(explained, old.explained)
        )

    def _accounts(self, evidence: float, scene: SurfelFit, fine: SurfelFit) -> bool:
        """A term of a scene accounts for most of the misfit of a fine one without it.

        Other spots are predicted better with it, which cells that are too wide do not bring about, but for
        the chance of a false name: by half of that misfit, or its own evidence is more than all of it. What
        is missing for unknown reasons looks less like one term than that.
        """
        before, value = (log_likelihood(fit, self.split.select) for fit in (fine, scene))
        _, weight, explained = self._gained(fine, before, value)
        sure = weight > 1 - self.settings.level
        return sure and (explained > HALF or evidence > self._misfit(fine))

    def _beside(self, fine: SurfelFit, name: str, kept: str) -> float:
        """Nats that a term has beside a fine scene without it: cells too wide for a scene ask for terms that
        it does not need.
        """
        given = (self.split, self.scan, self.settings.spots, self.seed, self.least, 0, True, {name})
        asking = partial(ask, fine, *given)
        (found,) = self.steps("screen", f"asking for {name}", f"{kept}_asked", asking).candidates
        return found.evidence

    def _without_it(self, scene: SurfelFit, name: str) -> SurfelFit:
        """A parsimonious scene without a term: gone on with, or built anew, whichever predicts better."""
        return self._or_anew(self.without(scene, [name]))

    def _gained(self, without: SurfelFit, before: Tensor, value: Tensor) -> tuple[Comparison, float, float]:
        """What select spots gain over a scene without a term, its weight, and the share that it explains.

        ``before`` and ``value``, ``[S]`` nats, are without the term and with it.
        """
        select, gain = self.split.select, compare(before, value, self.block)
        explained = gain.nats / max(misfit_of(without, select, len(select)), abs(gain.nats), 1e-9)
        return gain, weights([before, value], self.block)[1], explained

    def _asked(
        self, members: list[Member], scene: SurfelFit
    ) -> tuple[list[tuple[Member, SurfelFit]], list[str]]:
        """Each of some terms, asked beside the others, and the scene gone on without it; who is left when all
        who have too little evidence are gone.
        """
        s, select, names = self.settings, self.split.select, [m.name for m in members]
        kept = f"hold{self.number}_{'_'.join(names)}"
        self.steps.plan(fit=1 + len(names), screen=1)
        jobs = [("going on with all", kept, partial(self._warm, scene, []))]
        jobs += [
            (f"going on without {n}", f"{kept}_but_{n}", partial(self.without, scene, [n])) for n in names
        ]
        whole, *fewer = self.steps.several("fit", jobs, s.processes)
        own, enough = self._own(scene, names, kept)
        value, found = log_likelihood(whole, select), []
        for member, fit in zip(members, fewer, strict=True):
            before = log_likelihood(fit, select)
            gain, weight, explained = self._gained(fit, before, value)
            evidence, needed, shared = own[member.name]
            confirmed = Confirmed(evidence, needed, gain, weight, explained, shared, self.least)
            none = Trial(None, fit, before, compare(before, before, self.block))
            trials = [Trial(member.candidate, whole, value, gain), none]
            holds = confirmed.holds(member.candidate)
            asked = replace(member, confirmed=confirmed, accepted=holds, trials=trials)
            found.append((asked, fit))
        unknown = unknown_beside([m for m, _ in found if m.accepted or not m.candidate.free])
        return [(self._outdone(member, unknown), fit) for member, fit in found], enough

    def _outdone(self, member: Member, unknown: float) -> Member:
        """A member that was asked, where something unknown holds with so many nats: an effect needs more."""
        old = member.confirmed
        if member.candidate.free or old is None or not unknown:
            return member
        now = replace(old, needed=max(old.needed, unknown + self.least))
        return replace(member, confirmed=now, accepted=now.holds(member.candidate))

    def _own(
        self, scene: SurfelFit, names: list[str], kept: str
    ) -> tuple[dict[str, tuple[float, float, float]], list[str]]:
        """Own evidence of some terms of a scene with what they need there, and who is left when all who have
        less are gone.
        """
        bar = partial(self._bar, self._misfit(scene))
        asking = partial(own_evidence, scene, self.split, self.settings.spots, self.seed, names, bar)
        return self.steps("screen", f"asking for {', '.join(names)} again", f"{kept}_own", asking)

    def single_spots(self, members: list[Member], scene: SurfelFit) -> tuple[list[Member], SurfelFit]:
        """Terms with a number for each spot, which are asked last: with them nothing is predicted for others.

        What has come with such a term may not hold beside it.

        Args:
            members: that were tried.
            scene: with those that hold.

        Returns:
            The members, such terms among them, and the scene with those that hold.
        """
        while True:
            tried = {m.name for m in members}
            pool = self.ask(scene, 0, of_spots=True)
            new = [c for c in pool.candidates if c.evidence > self.least and c.name not in tried]
            if not new:
                return members, scene
            staying = [m for m in members if m.accepted] + [Member(new[0])]
            with_it = self.better(self._solved(scene, new[0]), self.gone_on(scene, new[:1]))
            staying, with_it, _ = self.hold(staying, with_it)
            if not staying[-1].stays:
                return [*members, staying[-1]], scene
            now = {m.name: m for m in staying}
            members, scene = [now.get(m.name, m) for m in members] + staying[-1:], with_it

    def _solved(self, fit: SurfelFit, new: Candidate) -> SurfelFit:
        """The same scene with a term of single spots, and nothing moved: batches may make it worse."""
        text, kept = f"solving for {new.name}", f"solved{self.number}_{new.name}"
        return self.steps("fit", text, kept, lambda: solve_spots(fit.copy(begun_with(fit, [new]), self.seed)))

    def predicts(self, scene: SurfelFit, other: SurfelFit, least: float = EVEN) -> bool:
        """Which of two scenes predicts the select spots better.

        Args:
            scene: one.
            other: another.
            least: weight from which on it counts.

        Returns:
            Whether it is the first.
        """
        values = [log_likelihood(fit, self.split.select) for fit in (other, scene)]
        return weights(values, self.block)[1] > least

    def named(self, members: list[Member], scene: SurfelFit) -> tuple[list[Member], SurfelFit]:
        """The terms that hold, each held against its rivals.

        Args:
            members: that were tried.
            scene: with those that hold.

        Returns:
            The members, and the scene with what each is now. Where that has come since and holds, the member
            leaves.
        """
        have = {m.name for m in members if m.accepted}
        settled, gone, came = list[Member](), list[str](), list[Member]()
        for member in members:
            now = self.settled(member) if member.accepted else member
            if now.name != member.name:
                gone.append(member.name)
                if now.name in have:
                    now = replace(member, accepted=False, gone=True)
                else:
                    came.append(now)
                    have.add(now.name)
            settled.append(now)
        if not gone:
            return settled, scene
        scene = self._parted(scene, gone, f"bare{self.number}_{'_'.join(gone)}")
        if not came:
            return settled, scene
        return settled, self.gone_on(scene, [m.candidate for m in came])

    def only(self, fit: SurfelFit, names: Sequence[str]) -> SurfelFit:
        """The same scene, gone on without all other terms.

        Args:
            fit: that is copied.
            names: of the terms that stay.

        Returns:
            another fit, or the same where it has no others.
        """
        others = [e.name for e in fit.extension.effects if e.name not in names]
        if not others:
            return fit
        return self._parted(fit, others, f"only{self.number}_{'_'.join(names)}")

    def _parted(self, fit: SurfelFit, names: list[str], kept: str) -> SurfelFit:
        """:meth:`without` as a step of its own, kept as ``kept``."""
        return self.steps(
            "fit", f"going on without {', '.join(names)}", kept, partial(self.without, fit, names)
        )

    def needed(self, fit: SurfelFit) -> float:
        """Nats of own evidence that a term needs beside a fine scene, if it acts where its light falls."""
        return self._bar(self._misfit(fit), 1.0)

    def _bar(self, misfit: float, lit: float, lost: float = 0.0) -> float:
        """Nats that a term needs, of whose information ``lit`` lies where the scene's light falls.

        Without the others it would have ``lost`` more. What these do follows their equations as nearly as a
        real cause does, and what is left of it looks like the term.
        """
        s = self.settings
        return self.least + s.share * lit * misfit + s.form * lost

    def settled(self, member: Member) -> Member:
        """A member with what its rivals are worth in its place.

        Args:
            member: that holds.

        Returns:
            The member, with the simplest of those that gain most as its term; a rival must hold as well.
        """
        s = self.settings
        itself, none = member.trials
        have = {e.name for e in none.fit.extension.effects}  # those that came since and hold beside it
        rivals = [c for c in member.rivals if c.name not in have][: s.rivals]
        jobs = [
            (
                f"going on with {c.name} for {member.name}",
                f"rival{self.number}_{member.name}_{c.name}",
                partial(self._warm, none.fit, [c]),
            )
            for c in rivals
        ]
        self.steps.plan(fit=len(jobs))
        trials = [itself, none]
        for c, fit in zip(rivals, self.steps.several("fit", jobs, s.processes), strict=True):
            value = log_likelihood(fit, self.split.select)
            trials.append(Trial(c, fit, value, compare(none.likelihood, value, self.block)))
        trials = weighed(trials, self.block)
        left, confirmed = trials, member.confirmed
        while (best := chosen(left, s.odds, self.least)).name != member.name:
            confirmed = self._in_its_place(best, none, member.name)
            assert best.candidate is not None
            if confirmed.holds(best.candidate):
                break
            left, confirmed = [t for t in left if t is not best], member.confirmed
        assert best.candidate is not None
        group = group_of(best, trials, self.block, s.open_share, self.least)
        return replace(member, candidate=best.candidate, confirmed=confirmed, trials=trials, group=group)

    def _in_its_place(self, trial: Trial, none: Trial, name: str) -> Confirmed:
        """What a rival is worth in the place of the term ``name``, over none there."""
        names = [e.name for e in trial.fit.extension.effects]
        own, _ = self._own(trial.fit, names, f"rival{self.number}_{name}_{trial.name}")
        evidence, needed, shared = own[trial.name]
        gained = self._gained(none.fit, none.likelihood, trial.likelihood)
        return Confirmed(evidence, needed, *gained, shared, self.least)

    def _misfit(self, fit: SurfelFit) -> float:
        """In the mean of fitted and select spots, for as many as the pool is asked on.

        What surfels take up of the noise of fitted spots they add to that of the others: the mean of both
        holds neither.
        """
        number = min(len(self.split.fit), self.settings.spots)
        parts = (self.split.fit, self.split.select)
        return max(0.0, sum(misfit_of(fit, spots, number) for spots in parts) / len(parts))

    def _warm(self, fit: SurfelFit, extra: list[Candidate]) -> SurfelFit:
        """The same scene, gone on with more terms."""
        return go_on(fit.copy(begun_with(fit, extra), self.seed))

    def without(self, fit: SurfelFit, names: Sequence[str]) -> SurfelFit:
        """The same scene, gone on without some terms.

        Args:
            fit: that is copied.
            names: of the terms.

        Returns:
            another fit.
        """
        fewer = [e for e in copy_effects(fit.extension, []).effects if e.name not in names]
        return go_on(fit.copy(Extension(fewer), self.seed))


# Fine fit without effects, present one, terms so far.
Told = Callable[[SurfelFit, SurfelFit, list[Member]], None]


def criticise(
    base: SurfelFit,
    rebuild: Rebuild,
    grow: Grow,
    split: Split,
    scan: Scan,
    s: CriticismSettings,
    seed: int,
    steps: Steps | None = None,
    told: Told = lambda base, present, members: None,
) -> Findings:
    """Find out what the capture asks for.

    Args:
        base: fitted to ``split.fit`` without effects, coarse.
        rebuild, grow: see :class:`Loop`.
        split: of the spots.
        scan: of the capture.
        s: settings.
        seed: of everything random.
        steps: says and keeps what is done.
        told: called before anything is asked, when terms came, and when it is known which hold.

    Returns:
        base, terms and final fit.
    """
    loop = Loop(rebuild, grow, split, scan, s, seed, steps or Steps())
    first = loop.fine(base, "without_effects")
    found, coarse = Findings(first, first, loop.needed(first)), base
    held = begun = Held([], first, base)
    told(first, first, [])

    def asked(effects: bool) -> Pool:
        found.pools.append(loop.ask(coarse, max(0, s.most - len(coarse.extension.effects)), effects))
        return found.pools[-1]

    pool = asked(effects=True)

    def joined_by(new: list[Member], free: bool) -> list[Member]:
        """Those that came, and effects or free terms that are asked for beside them, which come too."""
        nonlocal coarse, pool
        while come := loop.next(pool, free):
            coarse = loop.joined(coarse, [m.candidate for m in come])
            again = {m.name for m in come}
            new, found.members = new + come, [m for m in found.members if m.name not in again] + come
            told(first, coarse, found.members)
            pool = asked(effects=not free)
        return new

    def with_those(new: list[Member], beside: Held) -> Held:
        """What holds of those that came, beside what is held."""
        nonlocal coarse
        if not new:
            return beside
        coarse = loop.whole(coarse)
        grown = begun.scene if coarse is begun.coarse else loop.grown(coarse, "with_all")
        tried, scene, left = loop.hold(new, grown, coarse, beside)
        now = {m.name: m for m in tried}
        found.members = [now.get(m.name, m) for m in found.members]
        return Held(beside.members + [m for m in tried if m.stays], scene, left or coarse)

    def with_free(beside: Held) -> Held:
        """What holds when free terms are asked for, too."""
        nonlocal coarse, pool
        if beside.coarse is not coarse:
            coarse = beside.coarse
            pool = asked(effects=False)
        return with_those(joined_by([], free=True), beside)

    def led_by(leads: Candidate, before: Pool) -> Held:
        """What holds where a free term goes before all effects, beside the scene that was built with it."""
        nonlocal pool
        found.members = [Member(leads)]
        told(first, coarse, found.members)
        pool = asked(effects=True)
        rivals = [c for c in lost(before.candidates, pool.candidates, loop.least) if c.free]
        return with_those([Member(leads, rivals)], Held([], first, base))

    def beside(start: Held, new: list[Member]) -> Held:
        """What holds when effects and free terms have come to what holds, and ``new`` have already."""
        effects = with_those(joined_by(new, free=False), start)
        fewer: Held | None = start  # what they do may be what something unknown does
        held = effects
        if len(effects.members) <= len(start.members) or loop.predicts(effects.scene, start.scene):
            held = with_free(effects)
            fewer = loop.but_outdone(effects, start, found.members)
        if fewer is None:
            return held
        known = found.members
        other = with_free(fewer)
        if len(other.members) <= len(fewer.members):
            found.members = known
            return held
        less = {m.name for m in effects.members} - {m.name for m in fewer.members}
        gone = [replace(m, accepted=False, gone=True) if m.name in less else m for m in found.members]
        found.members = gone
        return other

    first_pool = pool
    if (leads := pool.foreign) is not None:
        coarse = loop.joined(base, [leads])
        held = led_by(leads, pool)
        if not held.members:
            held, coarse, pool, found.members = begun, base, first_pool, []
    start, new = held, list[Member]()
    if not start.members:
        begun = loop.begun(base, first, pool)
        coarse, new = begun.coarse, begun.members
        if coarse is not base and not new:
            start, first, base = begun, begun.scene, coarse
            found = Findings(first, first, loop.needed(first))
            told(first, first, [])
            first_pool = pool = asked(effects=True)
    if new:
        before, pool = pool, asked(effects=True)
        rivals = lost(before.candidates, pool.candidates, loop.least)
        alike = [c for c in rivals if not c.free]
        new = [replace(m, rivals=each_once(*m.rivals, *ahead_of(m.candidate, rivals), *alike)) for m in new]
        found.members = found.members + new
        told(first, coarse, found.members)
    held = beside(start, new)
    instead = None if start.members else loop.unsaid(first_pool, held)
    if instead is not None:
        known, pools, coarse = found.members, list(found.pools), loop.joined(base, [instead])
        if loop.predicts(coarse, held.coarse, 1 / (1 + s.odds)):
            other = led_by(instead, first_pool)
            if other.members:
                held = beside(other, [])
            else:
                found.members, found.pools = known, pools
    found.members, scene = loop.named(*loop.single_spots(found.members, held.scene))
    if found.accepted and loop.predicts(scene, first):
        found.final = scene
        found.again = loop.only(held.coarse, [m.name for m in found.present])
    else:
        found.members = [replace(m, accepted=False) for m in found.members]
    told(first, found.final, found.members)
    return found


def _leaving(members: list[Member], enough: list[str]) -> list[Member]:
    """Who of some members that were asked leaves; ``enough`` would have enough without the others."""
    failing = [m for m in members if not m.stays]
    return [m for m in failing if m.name not in enough] or sorted(failing, key=_gain)[:1]


def _sharing(members: list[Member]) -> list[Member]:
    """Who of some members that all stay leaves, where one lacks only what others take."""
    unnamed = [m for m in members if not m.accepted]
    return sorted(unnamed, key=_gain)[:1] if any(m.stands_in for m in unnamed) else []


def _named(members: list[Member]) -> int:
    return sum(m.accepted for m in members)


def _gain(member: Member) -> float:
    assert member.confirmed is not None
    return member.confirmed.gain.nats
