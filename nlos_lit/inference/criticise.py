"""Show, name, extend, measure: the loop that finds out what a capture asks for (docs/criticism.md).

A turn asks the pool beside a parsimonious scene, lets the fit go on with the leaders, and takes the simplest
of those that may be the best by spots that were not fitted; none at all is the simplest. It is kept if it is
still asked for once the scene is as fine as the counts ask for, and if that scene predicts better than one
that grew without it.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE_NAMES
from nlos_lit.inference.heldout import Comparison, compare, log_likelihood, score, weights
from nlos_lit.inference.per_spot import solve
from nlos_lit.inference.pool import Candidate, ask, own_evidence
from nlos_lit.inference.problem import acting_order
from nlos_lit.inference.split import Split
from nlos_lit.runtime.steps import Steps
from nlos_lit.surfels.fit import SurfelFit

log = logging.getLogger(__name__)
Rebuild = Callable[[Extension, int], SurfelFit]
Grow = Callable[[SurfelFit, int], SurfelFit]
LENGTHS = (1.0, 0.3, 0.1)  # of the pool's step, that a term may begin with
PREDICTED = 0.25  # of what select spots leave unexplained without a term: who explains that much is believed
WARM = 120  # batches, and as many again at falling rate


@dataclass(frozen=True)
class CriticismSettings:
    """How hard a term must be asked for before the model is extended with it.

    Args:
        spots: fitted spots that the pool is asked on at most.
        level: chance of a false name that is borne where the base is right: a term needs ln(terms in the
            pool/level) nats of evidence.
        share: of the misfit that a fine scene leaves, nats; a term needs so much on top, as far as it acts
            where the scene's light falls. What is wrong for unknown reasons may look a little like anything.
        rivals: effects with which the fit goes on in a turn, besides the best free term and the best with a
            number for each spot.
        open_share: weight above which the capture leaves something open: that nothing is to be named, in the
            turn or beside a fine scene; or that an effect's rival is meant.
        most_of: share of the best gain from which on a simpler term goes before that with the best …
        odds: … as it does if its weight is this much of the best's.
        most: terms that are accepted at most.
        toys: simulated captures for the null distribution.
        processes: that work on them; rebuilds that go on side by side.
    """

    spots: int = 1024
    level: float = 0.01
    share: float = 0.1
    rivals: int = 6
    open_share: float = 0.05
    most_of: float = 0.9
    odds: float = 0.25
    most: int = 5
    toys: int = 0
    processes: int = 2


@dataclass(frozen=True)
class Trial:
    """A fit gone on with one more term, or with none.

    Args:
        candidate: the term; None for none.
        fit: the scene with it.
        likelihood: ``[S]`` of the select spots, nats.
        gain: over going on with none.
        weight: how far the capture leaves open that this is the best of its turn.
    """

    candidate: Candidate | None
    fit: SurfelFit
    likelihood: Tensor = field(repr=False)
    gain: Comparison
    weight: float = 0.0

    @property
    def name(self) -> str:
        return "none" if self.candidate is None else self.candidate.name


Job = tuple[str, Candidate | None, Callable[[], SurfelFit]]  # what is said, term, what makes the fit


@dataclass(frozen=True)
class Confirmed:
    """What is left of a term once the scene is fine.

    Args:
        evidence: nats, of the term beside all else.
        needed: nats.
        gain: of the select spots over the scene that grew without it.
        weight: how far the capture leaves open that it predicts better than that one.
        explained: share of what the select spots leave unexplained without it; asked in company only.
    """

    evidence: float
    needed: float
    gain: Comparison
    weight: float
    explained: float = 0.0


@dataclass(frozen=True)
class Turn:
    """One turn of the loop.

    Args:
        candidates: the pool, most evidence first.
        needed: nats, of a term that a misfit may look like.
        asked: names of those that have the evidence that they need.
        trials: fits gone on with its leaders and with none, the largest gain first.
        best: the simplest of those that gain most; None where nothing is asked for.
        group: it and what the capture cannot tell from it, by name, with weights. A free term is none for an
            effect.
        confirmed: what a fine scene left of it; None where there was none.
        accepted: it is in the model from here on.
        refused: by name, those that were chosen before it and of which a fine scene left too little.
    """

    candidates: list[Candidate]
    needed: float
    asked: frozenset[str] = frozenset()
    trials: list[Trial] = field(default_factory=list)
    best: Trial | None = None
    group: dict[str, float] = field(default_factory=dict)
    confirmed: Confirmed | None = None
    accepted: bool = False
    refused: dict[str, Confirmed] = field(default_factory=dict)


@dataclass
class Findings:
    """What the loop leaves behind.

    Args:
        base: the fine fit without effects.
        final: the fine fit with all terms that were kept.
        turns: of the loop.
        losses: what each kept term's absence costs on the select spots, beside the final scene.
        again: the fit with these terms before the scene was refined; None where there is none.
    """

    base: SurfelFit
    final: SurfelFit
    turns: list[Turn]
    losses: dict[str, Comparison] = field(default_factory=dict)
    again: SurfelFit | None = None

    @property
    def accepted(self) -> list[Turn]:
        """Turns whose term was kept."""
        kept = {e.name for e in self.final.extension.effects}
        return [t for t in self.turns if t.accepted and t.best is not None and t.best.name in kept]


def needed(candidates: list[Candidate], s: CriticismSettings, misfit: float, lit: float = 1.0) -> float:
    """Nats that a term of this pool needs.

    Args:
        candidates: the pool.
        s: settings.
        misfit: nats, see :func:`misfit_of`.
        lit: how far a misfit of the scene may look like the term, see
            :class:`~nlos_lit.inference.pool.Candidate`.

    Returns:
        ln(terms/level) and, as far as it may be the scene's, the settings' share of the misfit.
    """
    return math.log(len(candidates) / s.level) + s.share * lit * misfit


def misfit_of(fit: SurfelFit, spots: np.ndarray, number: int) -> float:
    """How much likelier than by the fit some counts would be if all but counting noise were explained.

    Args:
        fit: that is judged.
        spots: ``[S]`` rows of the capture.
        number: of spots that it is said for.

    Returns:
        nats, half the deviance above the noise's; below 0 where surfels have taken up noise.
    """
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

    Args:
        fit: that goes on, in place.

    Returns:
        the same fit.
    """
    solve_spots(fit)
    fit.run(1, steps=WARM, settle=False)
    return solve_spots(fit)


class Loop:
    """All turns of one capture.

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

    def turn(self, fit: SurfelFit, fine: SurfelFit | None) -> Turn:
        """Ask the pool, go on with its leaders, choose.

        Args:
            fit: with the terms accepted so far.
            fine: the fine scene with these terms, a share of whose misfit leaders must exceed; None asks for
                no share.

        Returns:
            the turn, not confirmed yet; its ``best`` is None where nothing is asked for.
        """
        s, self.number = self.settings, self.number + 1
        self.steps.plan(screen=1, fit=s.rivals + 5)
        asking = partial(ask, fit, self.split, self.scan, s.spots, self.seed)
        candidates = self.steps(
            "screen", f"asking the pool, turn {self.number}", f"turn{self.number}_pool", asking
        )
        # Before it is in the model, a term is part of the misfit of other spots itself.
        misfit = 0.0 if fine is None else self._misfit(fine, self.split.fit)
        bars = {c.name: needed(candidates, s, misfit, c.lit) for c in candidates}
        asked = frozenset(c.name for c in candidates if c.evidence > bars[c.name])
        turn = Turn(candidates, needed(candidates, s, misfit), asked)
        rivals = leaders([c for c in candidates if c.loud > bars[c.name]], s.rivals)
        if not rivals:
            return turn
        jobs: list[Job] = [("going on without another term", None, partial(self._warm, fit, []))]
        jobs += [(f"going on with {c.name}", c, partial(self._warm, fit, [c])) for c in rivals]
        trials = weighed(self._trials(jobs), self.block)
        return self.among(replace(turn, trials=trials), trials)

    def next_best(self, turn: Turn) -> Turn | None:
        """The turn with what is chosen in place of a term of which a fine scene left too little.

        It is one of those that the pool itself asks for.

        Args:
            turn: with a best term that was not accepted.

        Returns:
            the turn, not confirmed yet; None where nothing else is asked for.
        """
        assert turn.best is not None
        assert turn.confirmed is not None
        refused = {**turn.refused, turn.best.name: turn.confirmed}
        left = [
            t for t in turn.trials if t.candidate is None or (t.name in turn.asked and t.name not in refused)
        ]
        if len(left) == 1:
            return None
        bare = replace(turn, best=None, group={}, confirmed=None)
        other = self.among(bare, weighed(left, self.block))
        if other.best is None:
            return None
        self.steps.plan(screen=1, fit=2)
        return replace(other, refused=refused)

    def among(self, turn: Turn, trials: list[Trial]) -> Turn:
        """The turn with what is chosen among some of its trials.

        Args:
            turn: without a best term.
            trials: with weights, the largest gain first; that with none is one of them.

        Returns:
            the turn; its ``best`` is None where nothing is chosen.
        """
        best = chosen(trials, self.settings)
        if best is None:
            return turn
        return replace(turn, best=best, group=group_of(best, trials, self.block, self.settings.open_share))

    def own(self, turn: Turn, fine: SurfelFit) -> tuple[float, float]:
        """How much the turn's best term is asked for beside a fine scene.

        Args:
            turn: with a best term.
            fine: the fine scene with it.

        Returns:
            its own evidence and what it needs, nats.
        """
        assert turn.best is not None
        tried = "" if turn.confirmed is None else "_again"
        return self._own(turn, fine, f"turn{self.number}_own_{turn.best.name}{tried}")

    def _own(self, turn: Turn, fine: SurfelFit, kept: str) -> tuple[float, float]:
        assert turn.best is not None
        s, name = self.settings, turn.best.name
        own = partial(own_evidence, fine, self.split, s.spots, self.seed, name)
        nats, lit = self.steps("screen", f"asking for {name} again", kept, own)
        misfit = self._misfit(fine, self.split.fit, self.split.select)
        return nats, needed(turn.candidates, s, misfit, lit)

    def confirm(self, turn: Turn, own: tuple[float, float], fine: SurfelFit, without: SurfelFit) -> Turn:
        """Is the turn's best term still asked for beside a fine scene?

        Args:
            turn: with a best term.
            own: its evidence there, and what it needs.
            fine: the fine scene with it.
            without: the fine scene without it.

        Returns:
            the turn, accepted or not.
        """
        before, after = (log_likelihood(f, self.split.select) for f in (without, fine))
        found = self._confirmed(own, before, after)
        yes = found.evidence > found.needed and found.weight > 1 - self.settings.open_share
        return replace(turn, confirmed=found, accepted=yes)

    def _confirmed(self, own: tuple[float, float], before: Tensor, after: Tensor) -> Confirmed:
        gain, weight = compare(before, after, self.block), weights([before, after], self.block)[1]
        return Confirmed(*own, gain, weight)

    def held(self, turns: list[Turn], scene: SurfelFit) -> list[tuple[Turn, SurfelFit]]:
        """Is each of several terms asked for beside all others?

        By its own evidence, or by the share that it explains of what the select spots leave unexplained
        without it; and they must be predicted better with it.

        Args:
            turns: with a best term each.
            scene: with all of them.

        Returns:
            the turns, accepted or not, each with the scene gone on without its term.
        """
        select, names = self.split.select, [turn.best.name for turn in turns if turn.best is not None]
        kept = f"company{self.number}_{'_'.join(names)}"
        whole, *fewer = self.absences(scene, names, kept)
        value, found = log_likelihood(whole, select), []
        for turn, name, fit in zip(turns, names, fewer, strict=True):
            own = self._own(turn, scene, f"{kept}_own_{name}")
            alone = self._confirmed(own, log_likelihood(fit, select), value)
            nats = alone.gain.nats
            explained = nats / max(misfit_of(fit, select, len(select)), nats, 1e-9)
            asked = alone.evidence > alone.needed or explained > PREDICTED
            yes = asked and alone.weight > 1 - self.settings.open_share
            confirmed = replace(alone, explained=explained)
            found.append((replace(turn, confirmed=confirmed, accepted=yes), fit))
        return found

    def asked_again(self, turn: Turn, fine: SurfelFit) -> tuple[Turn, SurfelFit, SurfelFit]:
        """Is the turn's best term still asked for beside a fine scene, in one of two ways?

        Args:
            turn: with a best term.
            fine: the fine scene without it.

        Returns:
            the turn, accepted or not; the parsimonious and the fine scene with the term.
        """
        assert turn.best is not None
        again = self.again(turn.best)
        refined = self.fine(again, f"with_{turn.best.name}_{self.number}")
        own = self.own(turn, refined)
        if own[0] <= own[1]:
            return self.confirm(turn, own, refined, fine), again, refined
        turn = self.confirm(turn, own, refined, self.fair(turn, again, fine))
        if not turn.accepted:
            refined, without = self.beside(turn, refined, fine)
            turn = self.confirm(turn, self.own(turn, refined), refined, without)
        return turn, again, refined

    def beside(self, turn: Turn, with_it: SurfelFit, fine: SurfelFit) -> tuple[SurfelFit, SurfelFit]:
        """The fine scene without a turn's best term goes on with it, and without: whatever seeds do to a
        scene they do to both. A scene that has taken up the term gains nothing so: this is asked second.

        Args:
            turn: with a best term.
            with_it: a fine scene with it.
            fine: the fine scene without it.

        Returns:
            with it and without.
        """
        assert turn.best is not None
        name = turn.best.name
        effect = next(e for e in with_it.extension.effects if e.name == name)
        found = [
            self.steps("fit", f"going on beside the fine scene, {text}", f"turn{self.number}_{text}", make)
            for text, make in (
                (
                    f"with {name}",
                    lambda: go_on(fine.copy(copy_effects(fine.extension, [effect]), self.seed)),
                ),
                (f"without {name}", lambda: self._warm(fine, [])),
            )
        ]
        return found[0], found[1]

    def fine(self, fit: SurfelFit, name: str) -> SurfelFit:
        """The scene as fine as the counts ask for, with the fit's terms.

        Args:
            fit: that goes on.
            name: of the step.

        Returns:
            another fit.
        """
        text = f"refining the scene {name.replace('_', ' ')}"
        return self.steps("fit", text, f"fine_{name}", lambda: solve_spots(self.grow(fit, self.seed)))

    def again(self, trial: Trial) -> SurfelFit:
        """The parsimonious scene built anew with a trial's terms, where that predicts better: surfels that
        imitated a term do not come back.
        """
        name = trial.name
        make = partial(_rebuilt, self.rebuild, trial.fit.extension, self.seed)
        other = self.steps("fit", f"rebuilding the scene with {name}", f"turn{self.number}_new_{name}", make)
        if other is None:
            return trial.fit
        value = log_likelihood(other, self.split.select)
        return other if float(value.sum()) > float(trial.likelihood.sum()) else trial.fit

    def fair(self, turn: Turn, with_it: SurfelFit, fine: SurfelFit) -> SurfelFit:
        """The fine scene without a turn's best term, with the chance that the term had: other seeds alone may
        find a better one.

        Args:
            turn: with a best term.
            with_it: the scene that was chosen for it.
            fine: the fine scene without it.

        Returns:
            the better of two where the term's was built anew, else ``fine``.
        """
        assert turn.best is not None
        if with_it is turn.best.fit:
            return fine
        none = next(t for t in turn.trials if t.candidate is None)
        scene = self.again(none)
        if scene is none.fit:
            return fine
        other = self.fine(scene, f"without_{turn.best.name}_{self.number}")
        before, after = (log_likelihood(f, self.split.select).sum() for f in (fine, other))
        return other if after > before else fine

    def _misfit(self, fit: SurfelFit, *parts: np.ndarray) -> float:
        """In the mean of some parts of the spots, for as many as the pool is asked on.

        What surfels take up of the noise of fitted spots they add to that of the others: the mean of both
        holds neither.
        """
        number = min(len(self.split.fit), self.settings.spots)
        return max(0.0, sum(misfit_of(fit, spots, number) for spots in parts) / len(parts))

    def _warm(self, fit: SurfelFit, extra: list[Candidate]) -> SurfelFit:
        """The same scene, gone on with more terms."""
        return go_on(fit.copy(begun_with(fit, extra), self.seed))

    def without(self, fit: SurfelFit, name: str) -> SurfelFit:
        """The same scene, gone on without a term.

        Args:
            fit: that is copied.
            name: of the term.

        Returns:
            another fit.
        """
        fewer = [e for e in copy_effects(fit.extension, []).effects if e.name != name]
        return go_on(fit.copy(Extension(fewer), self.seed))

    def _trials(self, jobs: list[Job]) -> list[Trial]:
        named = [(text, f"turn{self.number}_{text.replace(' ', '_')}", make) for text, _, make in jobs]
        fits = self.steps.several("fit", named, self.settings.processes)
        values = [log_likelihood(f, self.split.select) for f in fits]
        return [
            Trial(c, f, v, compare(values[0], v, self.block))
            for (_, c, _), f, v in zip(jobs, fits, values, strict=True)
        ]

    def losses(self, fit: SurfelFit) -> dict[str, Comparison]:
        """What each term's absence costs on the select spots, where the same scene goes on without it.

        Args:
            fit: the final one.

        Returns:
            by name.
        """
        names = [e.name for e in fit.extension.effects]
        if not names:
            return {}
        whole, *fewer = [log_likelihood(f, self.split.select) for f in self.absences(fit, names, "all")]
        return {n: compare(v, whole, self.block) for n, v in zip(names, fewer, strict=True)}

    def absences(self, fit: SurfelFit, names: list[str], kept: str) -> list[SurfelFit]:
        """The same scene gone on with all terms, and without each of some.

        Args:
            fit: with the terms.
            names: of those that are left out, one at a time.
            kept: name of the steps.

        Returns:
            one more than names.
        """
        jobs = [("going on with all", kept, partial(self._warm, fit, []))]
        jobs += [(f"going on without {n}", f"{kept}_but_{n}", partial(self.without, fit, n)) for n in names]
        self.steps.plan(fit=len(jobs))
        return self.steps.several("fit", jobs, self.settings.processes)


def weighed(trials: list[Trial], block: np.ndarray) -> list[Trial]:
    """Trials with their weights, the largest gain first.

    Args:
        trials: of one turn.
        block: ``[S]`` wall block of each select spot.

    Returns:
        the same trials.
    """
    shares = weights([t.likelihood for t in trials], block)
    found = [replace(t, weight=w) for t, w in zip(trials, shares, strict=True)]
    return sorted(found, key=lambda t: -t.gain.nats)


def is_law(candidate: Candidate | None) -> bool:
    """A term that is an effect, and not one with a number for each spot."""
    return candidate is not None and candidate.name not in FREE_NAMES and not candidate.effect.per_spot


def per_spot(turn: Turn) -> bool:
    """The turn's best term has a number for each spot."""
    return turn.best is not None and turn.best.candidate is not None and turn.best.candidate.effect.per_spot


def leaders(candidates: list[Candidate], number: int) -> list[Candidate]:
    """Which terms are tried.

    Half of the effects have the most evidence; the others would have, were their scatter their own: one
    linear step towards a strong effect leaves an error that scatters like a misfit.

    Args:
        candidates: that have what they need, if all of the scatter is theirs; most evidence first.
        number: of effects that are the same law at all spots; the best free term and the best with a number
            for each spot come on top.

    Returns:
        those, most evidence first.
    """
    laws = [c for c in candidates if is_law(c)]
    tried = laws[: number // 2]
    rest = [c for c in laws if c not in tried]
    tried += sorted(rest, key=lambda c: -c.loud)[: number - len(tried)]
    tried += [c for c in candidates if c.name in FREE_NAMES and not c.effect.per_spot][:1]
    tried += [c for c in candidates if c.effect.per_spot][:1]
    return sorted(tried, key=lambda c: -c.evidence)


def chosen(trials: list[Trial], s: CriticismSettings) -> Trial | None:
    """The simplest of those that gain most.

    Args:
        trials: of one turn, with weights, the largest gain first.
        s: settings.

    Returns:
        None where going on with none is open. Else, of all terms with most of the best one's gain or much of
        its weight, an effect before a free term and few coefficients before many; what it leaves is asked for
        in the next turn.
    """
    first, *others = [t for t in trials if t.candidate is not None]
    if any(t.candidate is None and t.weight > s.open_share for t in trials):
        return None
    near = [
        t for t in others if t.gain.nats >= s.most_of * first.gain.nats or t.weight >= s.odds * first.weight
    ]
    return min([first, *near], key=cost)


def cost(trial: Trial) -> tuple[bool, int, float]:
    """Sort key of a term: an effect before a free term, fewer coefficients before more, more gain first."""
    assert trial.candidate is not None
    return trial.name in FREE_NAMES, len(trial.candidate.step), -trial.gain.nats


def group_of(best: Trial, trials: list[Trial], block: np.ndarray, least: float) -> dict[str, float]:
    """What the capture cannot tell from the best, among those of its kind: effects, or free terms.

    Args:
        best: of the turn.
        trials: of the turn.
        block: ``[S]`` wall block of each select spot.
        least: weight above which it cannot.

    Returns:
        weights by name, the best's first.
    """
    kind = [t for t in trials if t.candidate and (t.name in FREE_NAMES) == (best.name in FREE_NAMES)]
    shares = dict(zip([t.name for t in kind], weights([t.likelihood for t in kind], block), strict=True))
    left = {best.name: shares[best.name]} | {n: w for n, w in shares.items() if w > least}
    return {name: weight / sum(left.values()) for name, weight in left.items()}
