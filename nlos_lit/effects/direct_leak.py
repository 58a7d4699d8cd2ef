"""What is left of the direct pulse inside the gate."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.two_parts import quicker_part, share_left
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import geometric


class DirectLeak(Effect):
    """The tail of the first bounce reaches into the gate, the same at every spot.

    ``background → background + amplitude ((1 - q) e^{-(t - first)/τ} + q e^{-(t - first)/τ₂})``, t the bin
    number, first that of the gate; constant before the gate.

    Parameters: ``amplitude`` (counts/bin, in the gate's first bin), null 0. ``decay`` τ (m of path), scanned.
    ``quick`` q (1): share of the amplitude that decays more quickly, fitted along from 0 on. ``quick_decay``
    τ₂ (m of path).

    Signature: residual above 0 at the start of the gate, equal at all spots however far the scene is from
    them.

    Degenerate with: ``background_slope`` for long decays, ``gate_edges`` (which is proportional to what is
    there).

    Source: gating against the direct pulse: M. Buttafava et al., *Non-line-of-sight imaging using a
    time-gated single photon avalanche diode*, Opt. Express 23, 2015.
    """

    name = "direct_leak"
    followed_by = ("free_time",)
    with_power = ("amplitude",)
    words = EffectWords(
        phrase="direct light that leaks into the gate",
        cause="The end of the very bright first return is still there when the gate opens.",
        remedy="Open the gate later, or block the direct path between laser spot and detector.",
        headline="{amplitude} when the gate opens, τ = {decay}",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        bins, width = scan.bin_length, scan.gate[1] - scan.gate[0]
        most = 1e3 * (scan.mean_counts / scan.n_bins + scan.background)
        return (
            Parameter("amplitude", "counts/bin", 0.0, scan.background, 0.0, most),
            Parameter(
                "decay",
                "m",
                None,
                0.2,
                bins,
                bins * scan.n_bins * 2,
                grid=geometric(3 * bins, bins * width, 8),
                log=True,
            ),
            *quicker_part(scan),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"amplitude": 5 * scan.background}

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        first, last = self.scan.gate
        since = (torch.arange(last, dtype=background.dtype, device=background.device) - first).clamp_min(0)
        return background + self.value("amplitude") * share_left(self, since * self.scan.bin_length)
