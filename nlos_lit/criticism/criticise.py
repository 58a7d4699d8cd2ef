"""Show, name, extend, measure: the loop that finds out which physical effects a capture asks for (docs/criticism.md)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.criticism.discrepancy import Discrepancy, discrepancies
from nlos_lit.criticism.refit import Comparison, compare, log_likelihood, refit_with
from nlos_lit.criticism.screen import FOLDS, Candidate, Projector, screen
from nlos_lit.criticism.sensitivity import Problem, build_problem
from nlos_lit.criticism.split import Split
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.scan import Scan
from nlos_lit.surfel_fit import SurfelFit

log = logging.getLogger(__name__)
Tell = Callable[[str], None]


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
        toys: simulated captures for the null distribution.
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


@dataclass
class Step:
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
    candidates = screen(problem, [e(scan) for e in EFFECTS if e.name not in have], folds)
    return candidates, discrepancies(problem, Projector(problem), scan)


def turn(fit: SurfelFit, capture: Capture, split: Split, scan: Scan, s: CriticismSettings, seed: int, tell: Tell) -> Step:
    """Screen, refit the rivals, choose."""
    tell("screening effects")
    candidates, rest = look(fit, split, scan, s, seed)
    wanted = significant(candidates, s)
    if not wanted:
        return Step(candidates, rest, [], None, [])
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
        return Step(candidates, rest, trials, None, [])
    return Step(candidates, rest, trials, best, group_of(best, trials, candidates, block, s.similar))


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


def group_of(best: Trial, trials: list[Trial], candidates: list[Candidate], block: np.ndarray, similar: float) -> list[str]:
    """Names that this capture cannot tell from the best: same projected sensitivity, and as good after the refit (two errors)."""
    names = []
    for other in trials:
        if other is best:
            continue
        short = compare(other.likelihood, best.likelihood, block)
        alike = abs(float(other.candidate.direction @ best.candidate.direction)) > similar
        if (alike and short.nats < 0.5 * best.gain.nats) or short.nats < max(2 * short.error, 0.02 * best.gain.nats):
            names.append(other.name)
    return names
