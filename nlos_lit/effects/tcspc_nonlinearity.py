"""Time bins of unequal width."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.smooth import length
from nlos_lit.effects.words import EffectWords

MOST_PERIODS = 200


class TcspcNonlinearity(Effect):
    """Bin widths ripple along the record: differential non-linearity of the time-to-digital converter.

    ``m'_t = m_t (1 + sine · sin(2πt/P) + cosine · cos(2πt/P))``, t the bin number.

    Parameters: ``sine``, ``cosine`` (1), null 0. ``period`` P (bins), scanned uniformly in 1/P from 1/40 (or
    two periods in the gate) to 1/2.2, with steps of 1/(1.5 gate) but at most 200 values. Quantities
    ``amplitude`` (1, the root of both squares) and ``period`` (bins).

    Signature: a ripple in time at all spots, in phase with the bin number and not with the arrival; also in
    the background.

    Degenerate with: ``background_slope`` for periods beyond the gate; with nothing else.

    Source: D. V. O'Connor, D. Phillips, *Time-correlated Single Photon Counting*, 1984 (differential
    non-linearity).
    """

    name = "tcspc_nonlinearity"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="time bins of unequal width",
        cause="The timing electronics' bins are not equally wide; the pattern repeats with the "
        "interpolator's period.",
        remedy="Record a flat histogram with steady light and divide by it.",
        headline="{amplitude} with a period of {period}",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        width = scan.gate[1] - scan.gate[0]
        high = 1 / 2.2
        low = min(max(1 / 40, 2 / width), high / 2)
        n = min(MOST_PERIODS, math.ceil((high - low) * 1.5 * width) + 1)
        periods = tuple(1 / (low + (high - low) * k / (n - 1)) for k in range(n))
        waves = tuple(
            Parameter(name, "1", 0.0, 0.02, -0.7, 0.7, kind="percent") for name in ("sine", "cosine")
        )
        return (*waves, Parameter("period", "bins", None, 0.01, 2.0, 50.0, grid=periods, log=True))

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"sine": 0.05, "cosine": 0.0}

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        bins = torch.arange(expected.shape[1], dtype=expected.dtype, device=expected.device)
        phase = 2 * math.pi * bins / self.value("period")
        return expected * (
            1 + self.value("sine") * torch.sin(phase) + self.value("cosine") * torch.cos(phase)
        )

    def quantities(self) -> dict[str, Quantity]:
        waves = torch.stack([self.value("sine"), self.value("cosine")])
        return {
            "amplitude": Quantity(length(waves, 0.02), "1", kind="percent"),
            "period": Quantity(self.value("period"), "bins"),
        }
