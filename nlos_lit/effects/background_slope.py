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

    ``background → background · (1 + slope τ)``, τ from -1 at the start of the gate to 1 at its end; constant
    before the gate.

    Parameters: ``slope`` (1), null 0, at most 0.95 either way.

    Signature: residual that is linear in time at bins without scene.

    Degenerate with: ``direct_leak`` and ``irf_tail`` with long decays, ``pile_up`` (which bends the
    background down).

    Source: none needed, first order in time.
    """

    name = "background_slope"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="a background that rises or falls over the time gate",
        cause="Slow light (fluorescence, the laser's pedestal) or a detector that recovers after the "
        "direct pulse.",
        remedy="Record once with the hidden scene covered, and subtract nothing but model that shape.",
        headline="{slope} from the middle of the gate to its end",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("slope", "1", 0.0, 0.05, -0.95, 0.95, kind="percent"),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"slope": 0.5}

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        first, last = self.scan.gate
        middles = torch.arange(last, dtype=background.dtype, device=background.device) + 0.5
        tau = (2 * (middles - first) / (last - first) - 1).clamp_min(-1)
        return background * (1 + self.value("slope") * tau)
