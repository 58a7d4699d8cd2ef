"""Rivals after their refits: which is chosen, and which this capture cannot tell from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from nlos_lit.criticism.refit import Comparison, compare
from nlos_lit.criticism.screen import Candidate
from nlos_lit.surfel_fit import SurfelFit

NEARLY = 0.8  # share of the best rival's predicted gain from which on fewer parameters count as a virtue


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


def best_of_each(trials: list[Trial]) -> list[Trial]:
    """The better of an effect's trials, the largest gain first."""
    found: dict[str, Trial] = {}
    for trial in sorted(trials, key=lambda t: -t.gain.nats):
        found.setdefault(trial.name, trial)
    return list(found.values())


def choose(trials: list[Trial], block: np.ndarray) -> Trial:
    """The best rival, or the one with fewest parameters among those that cannot be told from it.

    That is: within one standard error on the select spots, and with nearly the predicted gain of the best on the fitted ones.
    """
    best = trials[0]

    def close(trial: Trial) -> bool:
        short = compare(trial.likelihood, best.likelihood, block)
        predicted = trial.candidate.gain > NEARLY * best.candidate.gain
        return predicted and short.nats < max(short.error, 0.02 * best.gain.nats)

    near = [t for t in trials if t is best or close(t)]
    return min(near, key=lambda t: (t.candidate.degrees, -t.gain.nats))


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
