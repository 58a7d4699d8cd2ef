"""Which terms hold, beside each other and against their rivals."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

from torch import Tensor

from nlos_lit.inference.asking import Asking
from nlos_lit.inference.heldout import Comparison, compare, weights
from nlos_lit.inference.members import (
    SURE,
    Confirmed,
    Held,
    Member,
    Trial,
    chosen,
    group_of,
    unknown_beside,
    weighed,
)
from nlos_lit.surfels.fit import SurfelFit

Built = tuple[SurfelFit, SurfelFit | None]  # a parsimonious scene, and the fine one, where it was made


class Standing(NamedTuple):
    """Where a search stands for those that hold."""

    staying: list[Member]
    gone: dict[str, Member]  # by name
    scene: SurfelFit
    coarse: SurfelFit | None  # as Holding.hold takes it
    asked: bool = False  # all who stay have been, beside scenes that were built without them, too


class Holding:
    """Asks whether terms of a scene hold.

    Args:
        asking: of the counts of a capture, beside its scenes.
    """

    def __init__(self, asking: Asking) -> None:
        self.asking, self.scenes, self.settings = asking, asking.scenes, asking.settings

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
        return more < 0 or (more == 0 and self.scenes.predicts(together.scene, apart.scene, SURE))

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
                coarse, fine = known or (self.scenes.built_with(coarse, names), None)
                scene = self.scenes.better(
                    fine or self.scenes.fine(coarse, f"with_{'_'.join(names)}"), coarse
                )
        return Standing(staying, away, scene, coarse), whole

    def _bare(self, scene: SurfelFit, gone: list[Member], asked: list[tuple[Member, SurfelFit]]) -> SurfelFit:
        """The scene without members that leave."""
        names = [m.name for m in gone]
        if len(gone) == 1:
            return next(fit for member, fit in asked if member.name == names[0])
        return self.scenes.parted(scene, names, f"left{self.scenes.turn}_{'_'.join(names)}")

    def _anew(
        self, members: list[Member], coarse: SurfelFit, scene: SurfelFit
    ) -> tuple[list[Member], dict[str, Built]]:
        """Members that hold, asked against parsimonious scenes that were built without them.

        A scene that has bent itself to a term cannot go on without it as well as one that never had it. And
        terms must be asked for as much as they need beside such a scene when it has become fine, but for free
        ones that hold by what they predict, and numbers of single spots. Not effects with which others are
        predicted better than by this fine scene, but for the chance of a false name: it imitates the term, or
        fails without it, and then nothing is left of it to be asked for there.

        Args:
            members: those that hold are asked.
            coarse: the parsimonious scene with all of them.
            scene: the one that they hold beside.

        Returns:
            The same members, and by name the scenes that were built without them: parsimonious, and fine
            where it was asked.
        """
        names, value = [m.name for m in members], self.scenes.value(coarse)
        kept, asked = f"anew{self.scenes.turn}_{'_'.join(names)}_but_", [m for m in members if m.accepted]
        jobs = [
            (
                f"rebuilding the scene without {m.name}",
                kept + m.name,
                partial(self.scenes.built_without, coarse, m.name),
            )
            for m in asked
        ]
        fits = self.scenes.several(jobs)
        built: dict[str, Built] = {m.name: (fit, None) for m, fit in zip(asked, fits, strict=True)}
        now = {m.name: self._missed(m, fit, value) for m, fit in zip(asked, fits, strict=True)}
        finer = [
            m
            for m in asked
            if now[m.name].holds(m.candidate)
            and not m.candidate.effect.per_spot
            and not (m.candidate.free and now[m.name].much)
        ]
        refining = [
            self.scenes.refining(built[m.name][0], f"with_all_of_{'_'.join(names)}_but_{m.name}")
            for m in finer
        ]
        for m, fine in zip(finer, self.scenes.several(refining, screen=len(finer)), strict=True):
            built[m.name] = built[m.name][0], fine
            if m.candidate.free or not self.scenes.predicts(scene, fine, 1 - self.settings.level):
                evidence = self.asking.beside(fine, m.name, f"{kept}{m.name}_asked")
                now[m.name] = replace(now[m.name], evidence=min(evidence, now[m.name].evidence))
        found = [
            replace(m, confirmed=now[m.name], accepted=now[m.name].holds(m.candidate)) if m.name in now else m
            for m in members
        ]
        return found, built

    def _missed(self, member: Member, fit: SurfelFit, value: Tensor) -> Confirmed:
        """What a member is worth over a scene that went on without it, or was built so: the lesser.

        ``value`` ``[S]`` nats is that of the parsimonious scene with it.
        """
        gain, weight, explained = self._gained(fit, self.scenes.value(fit), value)
        old = member.confirmed
        assert old is not None
        least = gain if gain.nats < old.gain.nats else old.gain
        return replace(
            old, gain=least, weight=min(weight, old.weight), explained=min(explained, old.explained)
        )

    def _gained(self, without: SurfelFit, before: Tensor, value: Tensor) -> tuple[Comparison, float, float]:
        """What select spots gain over a scene without a term, its weight, and the share that it explains.

        ``before`` and ``value``, ``[S]`` nats, are without the term and with it.
        """
        gain = compare(before, value, self.scenes.block)
        explained = gain.nats / max(self.asking.left(without), abs(gain.nats), 1e-9)
        return gain, weights([before, value], self.scenes.block)[1], explained

    def _asked(
        self, members: list[Member], scene: SurfelFit
    ) -> tuple[list[tuple[Member, SurfelFit]], list[str]]:
        """Each of some terms, asked beside the others, and the scene gone on without it; who is left when all
        who have too little evidence are gone.
        """
        names = [m.name for m in members]
        kept = f"hold{self.scenes.turn}_{'_'.join(names)}"
        jobs = [("going on with all", kept, partial(self.scenes.warm, scene, []))]
        for n in names:
            job = partial(self.scenes.without, scene, [n])
            jobs.append((f"going on without {n}", f"{kept}_but_{n}", job))
        whole, *fewer = self.scenes.several(jobs, screen=1)
        own, enough = self.asking.own(scene, names, f"{kept}_own")
        value, found = self.scenes.value(whole), []
        for member, fit in zip(members, fewer, strict=True):
            before = self.scenes.value(fit)
            gain, weight, explained = self._gained(fit, before, value)
            evidence, needed, shared = own[member.name]
            confirmed = Confirmed(evidence, needed, gain, weight, explained, shared, self.asking.least)
            none = Trial(None, fit, before, compare(before, before, self.scenes.block))
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
        now = replace(old, needed=max(old.needed, unknown + self.asking.least))
        return replace(member, confirmed=now, accepted=now.holds(member.candidate))

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
            pool = self.asking.ask(scene, 0, of_spots=True)
            new = [c for c in pool.candidates if c.evidence > self.asking.least and c.name not in tried]
            if not new:
                return members, scene
            staying = [m for m in members if m.accepted] + [Member(new[0])]
            with_it = self.scenes.better(
                self.scenes.solved(scene, new[0]), self.scenes.gone_on(scene, new[:1])
            )
            staying, with_it, _ = self.hold(staying, with_it)
            if not staying[-1].stays:
                return [*members, staying[-1]], scene
            now = {m.name: m for m in staying}
            members, scene = [now.get(m.name, m) for m in members] + staying[-1:], with_it

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
        scene = self.scenes.parted(scene, gone, f"bare{self.scenes.turn}_{'_'.join(gone)}")
        if not came:
            return settled, scene
        return settled, self.scenes.gone_on(scene, [m.candidate for m in came])

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
                f"rival{self.scenes.turn}_{member.name}_{c.name}",
                partial(self.scenes.warm, none.fit, [c]),
            )
            for c in rivals
        ]
        trials = [itself, none]
        for c, fit in zip(rivals, self.scenes.several(jobs), strict=True):
            value = self.scenes.value(fit)
            trials.append(Trial(c, fit, value, compare(none.likelihood, value, self.scenes.block)))
        trials = weighed(trials, self.scenes.block)
        left, confirmed = trials, member.confirmed
        while (best := chosen(left, s.odds, self.asking.least)).name != member.name:
            confirmed = self._in_its_place(best, none, member.name)
            assert best.candidate is not None
            if confirmed.holds(best.candidate):
                break
            left, confirmed = [t for t in left if t is not best], member.confirmed
        assert best.candidate is not None
        group = group_of(best, trials, self.scenes.block, s.open_share, self.asking.least)
        return replace(member, candidate=best.candidate, confirmed=confirmed, trials=trials, group=group)

    def _in_its_place(self, trial: Trial, none: Trial, name: str) -> Confirmed:
        """What a rival is worth in the place of the term ``name``, over none there."""
        names = [e.name for e in trial.fit.extension.effects]
        own, _ = self.asking.own(trial.fit, names, f"rival{self.scenes.turn}_{name}_{trial.name}_own")
        evidence, needed, shared = own[trial.name]
        gained = self._gained(none.fit, none.likelihood, trial.likelihood)
        return Confirmed(evidence, needed, *gained, shared, self.asking.least)


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
