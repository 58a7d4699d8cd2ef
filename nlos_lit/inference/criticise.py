"""Show, name, extend, measure: the loop that finds out what a capture asks for (docs/criticism.md).

A turn asks the pool, rebuilds the scene with its leaders, and decides on spots that were not fitted. More
scene stands in the same contest: the same model with finer and more surfels. What gains most is taken.
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
from nlos_lit.inference.heldout import Comparison, compare, log_likelihood, weights
from nlos_lit.inference.per_spot import solve
from nlos_lit.inference.pool import Candidate, ask
from nlos_lit.inference.problem import acting_order
from nlos_lit.inference.split import Split
from nlos_lit.runtime.steps import Steps
from nlos_lit.surfels.fit import SurfelFit

log = logging.getLogger(__name__)
Rebuild = Callable[[Extension, int, bool], SurfelFit]
Grow = Callable[[SurfelFit, int], SurfelFit]
LENGTHS = (1.0, 0.3, 0.1)  # of the pool's step, that a term may begin with
WARM = 120  # batches, and as many again at falling rate
HOPELESS = 0.05  # of the best evidence: a rebuild does not turn such odds


@dataclass(frozen=True)
class CriticismSettings:
    """How hard a term must be asked for before the model is extended with it.

    Args:
        spots: fitted spots that the pool is asked on at most.
        level: chance of a false name that is borne: a term needs ln(terms in the pool/level) nats of
            evidence.
        errors: standard errors by which predictions of other spots must differ to count as different.
        sure: standard errors that a term's absence must cost, beside a fine scene, for the term to be kept.
        rivals: terms with which the fit goes on in a turn. finalists: of them, with which the scene is
            rebuilt from new seeds, too; the one with the most evidence is always among them.
        open_share: weight above which a rival is one that the capture leaves open: the simplest of these is
            taken, the others are its group.
        most: terms that are accepted at most.
        toys: simulated captures for the null distribution. processes: that work on them; rebuilds that go on
            side by side.
    """

    spots: int = 1024
    level: float = 0.01
    errors: float = 2.0
    sure: float = 3.0
    rivals: int = 4
    finalists: int = 2
    open_share: float = 0.05
    most: int = 5
    toys: int = 0
    processes: int = 2


@dataclass(frozen=True)
class Trial:
    """The scene rebuilt with one more term, or with none but finer.

    Args:
        candidate: the term; None for more scene.
        fit: the rebuilt scene.
        likelihood: ``[S]`` of the select spots, nats.
        gain: over the fit that the turn began with.
        weight: how far the capture leaves open that this is the best of its turn.
    """

    candidate: Candidate | None
    fit: SurfelFit
    likelihood: Tensor = field(repr=False)
    gain: Comparison
    weight: float = 0.0

    @property
    def name(self) -> str:
        return "more scene" if self.candidate is None else self.candidate.name


Job = tuple[str, Candidate | None, Callable[[], SurfelFit | None]]  # what is said, term, what makes the fit


@dataclass(frozen=True)
class Turn:
    """One turn of the loop.

    Args:
        candidates: the pool, most evidence first.
        trials: rebuilt scenes, the largest gain first.
        accepted: one of them; None ends the loop.
        group: names that the capture cannot tell from the accepted one.
        grown: the base was fine already.
    """

    candidates: list[Candidate]
    trials: list[Trial] = field(default_factory=list)
    accepted: Trial | None = None
    group: list[str] = field(default_factory=list)
    grown: bool = False


@dataclass
class Findings:
    """What the loop leaves behind.

    Args:
        base: the fit without effects, as fine as the final one.
        final: the fit with all terms that were kept.
        turns: of the loop.
        losses: what each kept term's absence costs on the select spots, beside a fine scene.
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
        return [t for t in self.turns if t.accepted is not None and t.accepted.name in kept]


def needed(candidates: list[Candidate], s: CriticismSettings) -> float:
    """Nats that a term of this pool needs.

    Args:
        candidates: the pool.
        s: settings.

    Returns:
        ln(terms/level).
    """
    return math.log(len(candidates) / s.level)


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


def _rebuilt(rebuild: Rebuild, extension: Extension, seed: int, fine: bool) -> SurfelFit | None:
    """None: with these effects no surfel survives, so that they are not the ones."""
    try:
        fit = rebuild(copy_effects(extension, []), seed, fine)
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


class Loop:
    """All turns of one capture.

    Args:
        rebuild: a fit from new seeds with given effects, begun at their present values, random seed, and
            whether surfels may be divided as finely as the counts ask for.
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

    def turn(self, fit: SurfelFit, grown: bool) -> Turn:
        """Ask the pool, rebuild the scene with its leaders and finer, choose.

        Args:
            fit: with the terms accepted so far.
            grown: it is as fine as it gets.

        Returns:
            the turn; its ``accepted`` is None where nothing is asked for.
        """
        s, self.number = self.settings, self.number + 1
        self.steps.plan(screen=1, fit=s.rivals + s.finalists + 2)
        asking = partial(ask, fit, self.split, self.scan, s.spots, self.seed)
        candidates = self.steps(
            "screen", f"asking the pool, turn {self.number}", f"turn{self.number}_pool", asking
        )
        wanted = [c for c in candidates if c.evidence > needed(candidates, s)]
        rivals = leaders(wanted, s.rivals)
        if not rivals:
            return Turn(candidates, grown=grown)
        jobs: list[Job] = [("going on without another term", None, partial(self._warm, fit, []))]
        for c in rivals:
            jobs.append((f"going on with {c.name}", c, partial(self._warm, fit, [c])))
        before = log_likelihood(fit, self.split.select)
        warm, *tried = self._trials(before, jobs)
        last = [] if grown else finalists(tried, s.finalists)
        self.steps.plan(fit=len(last) + 1)
        tried += self._trials(
            before,
            [
                (
                    f"rebuilding the scene with {t.name}",
                    t.candidate,
                    partial(_rebuilt, self.rebuild, t.fit.extension, self.seed, False),
                )
                for t in last
            ],
        )
        asked = best_of_each(tried)
        sure = [t for t in asked if self._beats(t, warm) and t.gain.nats > s.errors * t.gain.error]
        best = choose(weighed(sure, self.block), s.open_share) if sure else None
        if grown and best is None:
            return Turn(candidates, asked, grown=grown)
        other = partial(_rebuilt, self.rebuild, fit.extension, self.seed + 1, True)
        more: Job = ("rebuilding the scene by other seeds", None, other)
        if not grown:
            more = ("refining the scene", None, partial(self.grow, fit, self.seed + 1))
        controls = self._trials(before, [more])
        trials = weighed([*asked, *controls], self.block)
        if best is not None and not any(self._beats(control, best) for control in controls):
            best = next(t for t in trials if t.candidate is best.candidate)
            group = [t.name for t in trials if t.candidate and t is not best and t.weight > s.open_share]
            return Turn(candidates, trials, best, group, grown)
        if not grown and controls and controls[0].gain.nats > 0:
            return Turn(candidates, trials, controls[0], grown=grown)
        return Turn(candidates, trials, grown=grown)

    def _warm(self, fit: SurfelFit, extra: list[Candidate]) -> SurfelFit:
        """The same scene, gone on with more terms."""
        return self._go_on(fit.copy(begun_with(fit, extra), self.seed))

    def _without(self, fit: SurfelFit, name: str) -> SurfelFit:
        """The same scene, gone on without a term."""
        fewer = [e for e in copy_effects(fit.extension, []).effects if e.name != name]
        return self._go_on(fit.copy(Extension(fewer), self.seed))

    @staticmethod
    def _go_on(fit: SurfelFit) -> SurfelFit:
        solve_spots(fit)
        fit.run(1, steps=WARM, settle=False)
        return solve_spots(fit)

    def _beats(self, one: Trial, other: Trial) -> bool:
        """It predicts better than the other, by more than the difference's error."""
        gain = compare(other.likelihood, one.likelihood, self.block)
        return gain.nats > self.settings.errors * gain.error

    def _trials(self, before: Tensor, jobs: list[Job]) -> list[Trial]:
        named = [(text, f"turn{self.number}_{text.replace(' ', '_')}", make) for text, _, make in jobs]
        fits = self.steps.several("fit", named, self.settings.processes)
        trials = []
        for (_, c, _), again in zip(jobs, fits, strict=True):
            if again is not None:
                value = log_likelihood(again, self.split.select)
                trials.append(Trial(c, again, value, compare(before, value, self.block)))
        return trials

    def refined(self, fit: SurfelFit, without: str = "") -> SurfelFit:
        """The scene gone on with without one of its terms, then as fine as the counts ask for.

        Args:
            fit: with all terms.
            without: name of the one; empty leaves all.

        Returns:
            another fit.
        """
        return solve_spots(self.grow(self._without(fit, without) if without else fit, self.seed))

    def drop_needless(self, fit: SurfelFit) -> tuple[SurfelFit, dict[str, Comparison]]:
        """Backward: without which terms does a fine scene predict as well?

        A parsimonious scene lets effects be seen, and lets them stand for what it lacks. So each has to be
        missed once the scene is as fine as the counts ask for, with it and without it.

        Args:
            fit: with all accepted terms.

        Returns:
            the fine fit without needless terms, and what each other one's absence costs.
        """
        while True:
            names = [e.name for e in fit.extension.effects]
            if not names:
                return fit, {}
            jobs: list[tuple[str, str, Callable[[], SurfelFit]]] = [
                ("refining the scene", f"fine_{len(names)}", partial(self.refined, fit))
            ]
            for name in names:
                key = f"without_{name}_of_{len(names)}"
                jobs.append((f"refining the scene without {name}", key, partial(self.refined, fit, name)))
            self.steps.plan(fit=len(jobs))
            fine, *fewer = self.steps.several("fit", jobs, self.settings.processes)
            value = log_likelihood(fine, self.split.select)
            losses = {
                name: compare(log_likelihood(other, self.split.select), value, self.block)
                for name, other in zip(names, fewer, strict=True)
            }
            needless = [n for n, loss in losses.items() if loss.nats <= self.settings.sure * loss.error]
            if not needless:
                return fine, losses
            least = min(needless, key=lambda n: losses[n].nats)
            fit = fewer[0] if len(names) == 1 else self._without(fit, least)


def best_of_each(trials: list[Trial]) -> list[Trial]:
    """The better of a term's trials, the largest gain first."""
    found: dict[str, Trial] = {}
    for trial in sorted(trials, key=lambda t: -t.gain.nats):
        found.setdefault(trial.name, trial)
    return list(found.values())


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


def finalists(trials: list[Trial], number: int) -> list[Trial]:
    """With which terms the scene is built anew: those that gain most, and those with the most evidence.

    Args:
        trials: warm ones, the most evidence first.
        number: of those that gain most.

    Returns:
        at most two more: the first, and the first effect that is the same law at all spots. Numbers of single
        spots take up what is wrong there at once; a law has to drive the scene out first.
    """
    most = sorted(trials, key=lambda t: -t.gain.nats)[:number] + trials[:1]
    most += [t for t in trials if is_law(t.candidate)][:1]
    return [t for t in trials if any(t is m for m in most)]


def is_law(candidate: Candidate | None) -> bool:
    """A term that is an effect, and not one with a number for each spot."""
    return candidate is not None and candidate.name not in FREE_NAMES and not candidate.effect.per_spot


def leaders(wanted: list[Candidate], number: int) -> list[Candidate]:
    """Which terms are tried: the best free one, the best with a number for each spot, the best effects.

    Args:
        wanted: most evidence first; below ``HOPELESS`` of the best there are no leaders.
        number: of leaders.

    Returns:
        at most so many, most evidence first.
    """
    wanted = [c for c in wanted if c.evidence > HOPELESS * wanted[0].evidence]
    laws = [c for c in wanted if is_law(c)]
    others = [c for c in wanted if c.name in FREE_NAMES and not c.effect.per_spot][:1]
    others += [c for c in wanted if c.effect.per_spot][:1]
    return sorted(others + laws[: number - len(others)], key=lambda c: -c.evidence)


def choose(trials: list[Trial], least: float) -> Trial:
    """The simplest of those that the wall patches leave open.

    An effect is simpler than a free term, and fewer coefficients are simpler than more.

    Args:
        trials: with a candidate and a weight each.
        least: weight above which a trial is open.

    Returns:
        one of them; that of the largest weight where none is above.
    """

    def cost(t: Trial) -> tuple[bool, int, float]:
        assert t.candidate is not None
        return t.name in FREE_NAMES, len(t.candidate.step), -t.weight

    heaviest = max(trials, key=lambda t: t.weight)
    return min((t for t in trials if t.weight > least or t is heaviest), key=cost)


def criticise(
    base: SurfelFit,
    rebuild: Rebuild,
    grow: Grow,
    split: Split,
    scan: Scan,
    s: CriticismSettings,
    seed: int,
    steps: Steps | None = None,
) -> Findings:
    """Find out, one after the other, what the capture asks for.

    Args:
        base: fitted to ``split.fit`` without effects, coarse.
        rebuild, grow: see :class:`Loop`.
        split: of the spots.
        scan: of the capture.
        s: settings.
        seed: of everything random.
        steps: says and keeps what is done.

    Returns:
        base, turns and final fit.
    """
    loop = Loop(rebuild, grow, split, scan, s, seed, steps or Steps())
    fit, turns, grown, fine_base = base, [], False, False
    while len(fit.extension.effects) < s.most:
        turns.append(loop.turn(fit, grown))
        taken = turns[-1].accepted
        if taken is None:
            break
        fit = taken.fit
        if taken.candidate is None:
            grown = True
            if not fit.extension.effects:
                base, fine_base = fit, True
    final, losses = loop.drop_needless(fit)
    if fit.extension.effects and not fine_base:
        refine = partial(loop.refined, base)
        base = loop.steps("fit", "refining the scene without any effect", "fine_base", refine)
    return Findings(base, final, turns, losses, fit if losses else None)
