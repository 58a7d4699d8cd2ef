"""Does what an effect explains have the effect's own form?

An effect's equation says that one strength holds everywhere. Once it is in the model, its change Δμ of the expected counts is cut
into bands of the time axis that weigh the same, and each may ask for a strength of its own. A ripple that was accepted for a gap in
the time codes wants four times the strength at the gap, and none elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from nlos_lit.criticism.discrepancy import flexible
from nlos_lit.criticism.joint_step import null_of
from nlos_lit.criticism.screen import Projector
from nlos_lit.criticism.sensitivity import Problem
from nlos_lit.effects.base import Effect, Extension

BANDS = 8
OWN = 0.5  # share of what the effect itself changes


@dataclass(frozen=True)
class Form:
    """What strengths of its own in every band would bring an accepted effect.

    ``gain``: nats beyond the common strength, cross-validated over random spots. ``own``: nats that the effect's own change is
    worth, ½‖Δμ/√μ‖². Their ratio is the relative mean square by which the strength varies, where the base leaves Δμ alone.
    """

    name: str
    gain: float
    own: float
    statistic: float
    p_value: float
    axis: str = "time"

    @property
    def wrong(self) -> bool:
        """The strength varies by more than 70 % (root mean square) of itself."""
        return self.p_value < 1e-6 and self.gain > OWN * self.own


def form_of(problem: Problem, projector: Projector, effect: Effect) -> Form | None:
    """Test an effect of the problem's extension; None for a per-spot effect, which has no common strength."""
    if effect.per_spot:
        return None
    without = Extension([null_of(e) if e is effect else e for e in problem.extension.effects])
    with torch.no_grad():
        change = (problem.expected - problem.model.expected(problem.spots, without)) * problem.expected.rsqrt()
    weight = change.square().sum(0).cumsum(0)
    band = (weight / weight[-1].clamp_min(1e-30) * BANDS).long().clamp_max(BANDS - 1)
    columns = change[:, :, None] * torch.nn.functional.one_hot(band, BANDS)
    gain, statistic, p = flexible(columns[..., band.unique()], problem, projector)
    return Form(effect.name, gain, float(change.square().sum()) / 2, statistic, p)
