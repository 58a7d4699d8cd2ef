"""Show, name, extend, measure: the loop that finds out which physical effects a capture asks for (docs/criticism.md)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from nlos_lit.criticism.discrepancy import Discrepancy, discrepancies
from nlos_lit.criticism.refit import Comparison, compare, copy_effects, log_likelihood, refit_with
from nlos_lit.criticism.screen import FOLDS, Candidate, Projector, screen
from nlos_lit.criticism.sensitivity import Problem, build_problem
from nlos_lit.criticism.split import Split
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.base import Extension
from nlos_lit.effects.scan import Scan
from nlos_lit.surfel_fit import SurfelFit

log = logging.getLogger(__name__)
Tell = Callable[[str], None]
Rebuild = Callable[[Extension], SurfelFit]


@dataclass(frozen=True)
class CriticismSettings:
    """How hard an effect must be asked for before it is named.

    Args:
        spots: fitted spots that score tests look at (all, where there are fewer).
        level: largest p-value, Holm-adjusted over all effects.
        least_gain: nats that the score test must predict.
        rivals: effects that are refitted before one is chosen.
        similar: correlation of projected sensitivities from which on two effects are one group.
        steps: batches of a refit (and as many again at falling rate).
        most: effects that are accepted at most.
        explained: share of the structured misfit that named effects must explain; below it, the misfit is called unexplained.
        toys: simulated captures for the null distribution. processes: that work on them.
    """

    spots: int = 1024
    level: float = 1e-3
    least_gain: float = 8.0
    rivals: int = 5
    similar: float = 0.9
    steps: int = 60
    most: int = 5
    explained: float = 0.5
    toys: int = 0
    processes: int = 2


@dataclass(frozen=True)
class Trial:
    """One rival after its refit: its gain on the select spots over a control that was refitted without it."""

    candidate: Candidate
    fit: SurfelFit
    gain: Comparison
    likelihood: torch.Tensor

    @property
    def name(self) -> str:
        return self.candidate.effect.name


@dataclass(frozen=True)
class Turn:
    """One turn of the loop: the screening, the rivals, and who was accepted (None ends it)."""

    candidates: list[Candidate]
    discrepancies: list[Discrepancy]
    trials: list[Trial]
    accepted: Trial | None
    group: list[str]


def tested_problem(fit: SurfelFit, split: Split, most: int, seed: int) -> tuple[Problem, torch.Tensor]:
    """The weighted least-squares problem of (at most ``most``) fitted spots, and their folds."""
    rows = np.sort(np.random.default_rng(seed).permutation(len(split.fit))[:most])
    spots = torch.from_numpy(split.fit[rows])
    return build_problem(fit.model, fit.extension, spots, fit.counts[rows]), split.folds(spots, FOLDS)


def look(fit: SurfelFit, split: Split, scan: Scan, s: CriticismSettings, seed: int) -> tuple[list[Candidate], list[Discrepancy]]:
    """Screen all effects that the fit does not have yet, and the flexible discrepancies."""
    problem, folds = tested_problem(fit, split, s.spots, seed)
    have = {e.name for e in fit.extension.effects}
    projector = Projector(problem)
    candidates = screen(problem, projector, [e(scan) for e in EFFECTS if e.name not in have], folds)
    return candidates, discrepancies(problem, projector, scan)


def turn(fit: SurfelFit, split: Split, scan: Scan, s: CriticismSettings, seed: int, tell: Tell) -> Turn:
    """Screen, refit the rivals, choose."""
    tell("screening effects")
    candidates, rest = look(fit, split, scan, s, seed)
    wanted = significant(candidates, s)
    if not wanted:
        return Turn(candidates, rest, [], None, [])
    block = split.block[split.select]
    tell("refitting the control")
    control = refit_with(fit, [], s.steps, seed)
    reference = log_likelihood(control, split.select)
    trials = []
    for candidate in wanted[: s.rivals]:
        tell(f"refitting with {candidate.effect.name}")
        again = refit_with(fit, [candidate], s.steps, seed)
        likelihood = log_likelihood(again, split.select)
        trials.append(Trial(candidate, again, compare(reference, likelihood, block), likelihood))
    trials.sort(key=lambda t: -t.gain.nats)
    best = choose(trials, block)
    if best.gain.interval[0] <= 0:
        return Turn(candidates, rest, trials, None, [])
    return Turn(candidates, rest, trials, best, group_of(best, trials, block, s.similar))


def significant(candidates: list[Candidate], s: CriticismSettings) -> list[Candidate]:
    """Those whose Holm-adjusted p-value and predicted gain pass, the largest predicted gain first."""
    order = sorted(candidates, key=lambda c: c.p_value)
    passed, worst = set(), 0.0
    for rank, candidate in enumerate(order):
        worst = max(worst, candidate.p_value * (len(order) - rank))
        if worst > s.level:
            break
        passed.add(candidate.effect.name)
    return [c for c in candidates if c.effect.name in passed and c.gain > s.least_gain]


def choose(trials: list[Trial], block: np.ndarray) -> Trial:
    """The best rival, or the one with fewest parameters among those that cannot be told from it (one standard error)."""
    best = trials[0]

    def close(trial: Trial) -> bool:
        short = compare(trial.likelihood, best.likelihood, block)
        return short.nats < max(short.error, 0.02 * best.gain.nats)

    near = [t for t in trials if close(t)]
    return min(near, key=lambda t: (len(t.candidate.step) if not t.candidate.effect.per_spot else 2, -t.gain.nats))


def group_of(best: Trial, trials: list[Trial], block: np.ndarray, similar: float) -> list[str]:
    """Names that this capture cannot tell from the best: as good after the refit, or the same sensitivity and nearly as good."""
    names = []
    for other in trials:
        if other is best:
            continue
        short = compare(other.likelihood, best.likelihood, block)
        alike = abs(float(other.candidate.direction @ best.candidate.direction)) > similar
        if (alike and short.nats < 0.5 * best.gain.nats) or short.nats < max(2 * short.error, 0.02 * best.gain.nats):
            names.append(other.name)
    return names


@dataclass
class Findings:
    """What the loop leaves behind: the base, every turn, and the final extended fit."""

    base: SurfelFit
    final: SurfelFit
    turns: list[Turn]

    @property
    def accepted(self) -> list[Turn]:
        kept = {e.name for e in self.final.extension.effects}
        return [t for t in self.turns if t.accepted is not None and t.accepted.name in kept]

    @property
    def left(self) -> list[Discrepancy]:
        """Flexible discrepancies of the final fit."""
        return self.turns[-1].discrepancies


def criticise(
    base: SurfelFit, rebuild: Rebuild, split: Split, scan: Scan, s: CriticismSettings, seed: int, tell: Tell = log.debug
) -> Findings:
    """Find out, one after the other, which effects the capture asks for.

    Args:
        base: fitted to ``split.fit`` without effects.
        rebuild: a fit from new seeds with the given effects, begun at their present values: surfels that imitated an effect do not
            come back.
        tell: what is being done now.
    """
    fit, turns = base, []
    while True:
        turns.append(turn(fit, split, scan, s, seed, tell))
        best = turns[-1].accepted
        if best is None:
            break
        tell(f"rebuilding the scene with {best.name}")
        fit = better(rebuild(copy_effects(best.fit.extension, [])), best.fit, split)
        if len(fit.extension.effects) == s.most:
            candidates, rest = look(fit, split, scan, s, seed)
            turns.append(Turn(candidates, rest, [], None, []))
            break
    fit = drop_needless(fit, split, s, seed, tell)
    return Findings(base, fit, turns)


def better(first: SurfelFit, second: SurfelFit, split: Split) -> SurfelFit:
    """Whichever predicts the select spots better."""
    one, two = (float(log_likelihood(f, split.select).sum()) for f in (first, second))
    return first if one >= two else second


def drop_needless(fit: SurfelFit, split: Split, s: CriticismSettings, seed: int, tell: Tell) -> SurfelFit:
    """Backward: an effect accepted early may be explained by those that came later."""
    block = split.block[split.select]
    while len(fit.extension.effects) > 1:
        reference = log_likelihood(refit_with(fit, [], s.steps, seed), split.select)
        losses = []
        for effect in fit.extension.effects:
            tell(f"refitting without {effect.name}")
            fewer = fit.copy(Extension([e for e in copy_effects(fit.extension, []).effects if e.name != effect.name]), seed)
            fewer.run(1, steps=s.steps, settle=False)
            losses.append((compare(log_likelihood(fewer, split.select), reference, block), fewer))
        least, fewer = min(losses, key=lambda entry: entry[0].nats)
        if least.nats > 2 * least.error:
            break
        fit = fewer
    return fit
