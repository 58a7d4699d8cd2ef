"""Background that changes over the gate."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords


class BackgroundSlope(Effect):
    """The background rises or falls along time, the same way at every spot.

    ``background → background · e^{slope τ + bend (τ² - 1/3)}``, τ from -1 at the start of the gate to 1 at
    its end; constant before the gate.

    Parameters: ``slope``, ``bend`` (1, of the logarithm), null 0, at most 3 either way.

    Signature: residual that rises or falls smoothly along time at bins without scene.

    Degenerate with: ``direct_leak`` and ``irf_tail`` with long decays, ``pile_up`` (which bends the
    background down).

    Source: none needed, second order in time; light that decays slowly is the first.
    """

    name = "background_slope"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="a background that rises or falls over the time gate",
        cause="Slow light (fluorescence, the laser's pedestal) or a detector that recovers after the "
        "direct pulse.",
        remedy="Record once with the hidden scene covered, and subtract nothing but model that shape.",
        headline="{slope} from the middle of the gate to its end, bent by {bend}",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, "1", 0.0, 0.05, -3.0, 3.0, kind="percent") for name in ("slope", "bend"))

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"slope": 0.5}

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        first, last = self.scan.gate
        middles = torch.arange(last, dtype=background.dtype, device=background.device) + 0.5
        tau = (2 * (middles - first) / (last - first) - 1).clamp_min(-1)
        return background * torch.exp(self.value("slope") * tau + self.value("bend") * (tau.square() - 1 / 3))
