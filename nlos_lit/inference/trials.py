"""Rivals after their refits: which is chosen, and which this capture cannot tell from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from nlos_lit.inference.refit import Comparison, compare
from nlos_lit.inference.screen import Candidate
from nlos_lit.surfels.fit import SurfelFit


@dataclass(frozen=True)
class Trial:
    """One rival after its refit.

    Both gains are of spots that had no part in the parameters, so that they add up to one piece of evidence.

    Args:
        candidate: as the screening saw it.
        fit: with the effect.
        gain: on the select spots, over a control that was refitted without it.
        likelihood: ``[S]`` of the select spots, nats.
        predicted: nats that the screening predicts, cross-validated, for the fitted spots.
    """

    candidate: Candidate
    fit: SurfelFit
    gain: Comparison
    likelihood: torch.Tensor
    predicted: float = 0.0

    @property
    def name(self) -> str:
        return self.candidate.effect.name

    @property
    def evidence(self) -> float:
        """Nats, on select and fitted spots."""
        return self.gain.nats + self.predicted


def best_of_each(trials: list[Trial]) -> list[Trial]:
    """The better of an effect's trials, the most evidence first."""
    found: dict[str, Trial] = {}
    for trial in sorted(trials, key=lambda t: -t.evidence):
        found.setdefault(trial.name, trial)
    return list(found.values())


def choose(trials: list[Trial], block: np.ndarray) -> Trial:
    """The best rival, or a simpler one that cannot be told from it (one standard error).

    Args:
        trials: the most evidence first.
        block: ``[S]`` wall block of each select spot.

    Returns:
        the one with fewest parameters, then the most evidence.
    """
    best = trials[0]
    near = [t for t in trials if t is best or _short(t, best, block, errors=1)]
    return min(near, key=lambda t: (t.candidate.degrees, -t.evidence))


def group_of(best: Trial, trials: list[Trial], block: np.ndarray, similar: float) -> list[str]:
    """Names that this capture cannot tell from the best.

    Args:
        best: the chosen one.
        trials: all of them.
        block: ``[S]`` wall block of each select spot.
        similar: correlation of projected sensitivities from which on two effects are alike.

    Returns:
        those with as much evidence, or the same sensitivity and nearly as much.
    """
    names = []
    for other in trials:
        if other is best:
            continue
        alike = abs(float(other.candidate.direction @ best.candidate.direction)) > similar
        if (alike and other.evidence > 0.5 * best.evidence) or _short(other, best, block, errors=2):
            names.append(other.name)
    return names


def _short(trial: Trial, best: Trial, block: np.ndarray, errors: float) -> bool:
    """Whether a trial falls short of the best by few errors (of the select spots), or by next to nothing."""
    short = compare(trial.likelihood, best.likelihood, block)
    return short.nats + best.predicted - trial.predicted < max(errors * short.error, 0.02 * best.evidence)
