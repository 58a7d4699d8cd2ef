"""Gate that does not open and close at once."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords


class GateEdges(Effect):
    """Sensitivity rises at the start of the gate and falls at its end.

    ``m'_t = m_t (1 - start e^{-(t - first)/w}) (1 - end e^{-(last - 1 - t)/w})`` for bins first ≤ t < last of
    the gate.

    Parameters: ``start``, ``end`` (1): share lost in the gate's first and last bin, null 0, at most 1.
    ``width`` w (bins), scanned.

    Signature: residual below 0 in the first or last bins of the gate, proportional to what is there, at every
    spot.

    Degenerate with: ``direct_leak`` (of the other sign at the start), ``background_slope`` for large widths.

    Source: gated SPADs: M. Buttafava et al., *Non-line-of-sight imaging using a time-gated single photon
    avalanche diode*, Opt. Express 23, 2015.
    """

    name = "gate_edges"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="a time gate with soft edges",
        cause="The detector is not fully sensitive right after the gate opens and before it closes.",
        remedy="Fit a narrower gate, or measure its shape with steady light.",
        headline="{start} lost at the first bin, {end} at the last",
    )
    split_by: ClassVar = {
        "direct_leak": "a capture with the gate opened later",
    }

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        span = float(scan.gate[1] - scan.gate[0])
        widths = tuple(w for w in (1.5, 4.0, 10.0, 25.0) if w < span / 2) or (1.5,)
        edges = tuple(Parameter(name, "1", 0.0, 0.1, 0.0, 1.0, kind="percent") for name in ("start", "end"))
        return (*edges, Parameter("width", "bins", None, 0.2, 0.5, max(span, 2.0), grid=widths, log=True))

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"start": 0.5, "end": 0.5}

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        first, last = self.scan.gate
        bins = torch.arange(expected.shape[1], dtype=expected.dtype, device=expected.device)
        opening, closing = (
            torch.exp(-k.clamp_min(0) / self.value("width")) for k in (bins - first, last - 1 - bins)
        )
        sensitivity = (1 - self.value("start") * opening) * (1 - self.value("end") * closing)
        return expected * torch.where(bins >= first, sensitivity, 1.0)
