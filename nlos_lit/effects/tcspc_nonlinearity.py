"""Time bins of unequal width."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.smooth import length
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.log_factor import log_factor

WAVES = 8  # of a pattern: any of up to 16 widths
MOST_PERIODS = 2000
LIKELY = 8  # periods that are worth a test
MOST = 0.9  # of the largest worth: a shorter period with so much goes before longer ones


class TcspcNonlinearity(Effect):
    """Bin widths repeat along the record: differential non-linearity of the time-to-digital converter.

    ``m'_t = m_t (1 + Σ_k (s_k sin(2πkt/P) + c_k cos(2πkt/P)))``, t the bin number, k from 1 to 8 where half a
    period of the k-th wave is a bin or more.

    Parameters: ``sine`` s_1, ``cosine`` c_1 (1), null 0. ``overtones`` s_2, c_2, … s_8, c_8 (1), null 0: each
    octave is as likely as the first wave. ``period`` P (bins), scanned from 40 (or half the gate) to 2.2, so
    densely that no wave is off by more than a sixth of its period at either end of the gate, but at most 2000
    values. Quantities ``rms`` of the widths (1) and ``period`` (bins).

    Signature: the same pattern in time at all spots, in phase with the bin number and not with the arrival;
    also in the background.

    Degenerate with: ``background_slope`` for periods beyond the gate; with nothing else.

    Source: D. V. O'Connor, D. Phillips, *Time-correlated Single Photon Counting*, 1984 (differential
    non-linearity). Widths of single codes that repeat with the interpolator: J. Kalisz, *Review of methods
    for time interval measurements with picosecond resolution*, Metrologia 41, 2004.
    """

    name = "tcspc_nonlinearity"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="time bins of unequal width",
        cause="The timing electronics' bins are not equally wide; the pattern repeats with the "
        "interpolator's period.",
        remedy="Record a flat histogram with steady light and divide by it.",
        headline="{rms} rms with a period of {period}",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        width = scan.gate[1] - scan.gate[0]
        high = 1 / 2.2
        low = min(max(1 / 40, 2 / width), high / 2)
        frequencies = [low]
        while frequencies[-1] < high:
            highest = min(WAVES, max(1.0, 0.5 / frequencies[-1]))
            frequencies.append(frequencies[-1] + 1 / (1.5 * width * highest))
        n = min(MOST_PERIODS, len(frequencies))
        places = np.linspace(0, len(frequencies) - 1, n)
        even = np.interp(places, np.arange(len(frequencies)), [*frequencies[:-1], high])
        waves = tuple(
            Parameter(name, "1", 0.0, 0.02, -0.7, 0.7, kind="percent") for name in ("sine", "cosine")
        )
        falling = tuple(0.02 / k**0.5 for k in range(2, WAVES + 1) for _ in range(2))
        overtones = Parameter(
            "overtones", "1", 0.0, 0.02, -0.3, 0.3, size=len(falling), prior=falling, kind="percent"
        )
        periods = tuple((1 / even).tolist())
        return (*waves, overtones, Parameter("period", "bins", None, 0.01, 2.0, 50.0, grid=periods, log=True))

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"sine": 0.05, "cosine": 0.0}

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        bins = torch.arange(expected.shape[1], dtype=expected.dtype, device=expected.device)
        return expected * (1 + self.pattern(bins)).clamp_min(0)

    def pattern(self, bins: Tensor) -> Tensor:
        """``[T]`` how much wider bins are than the mean, at their numbers ``[T]``."""
        first = torch.stack([self.value("sine"), self.value("cosine")])
        return waves_at(bins, self.value("period")) @ torch.cat([first, self.value("overtones")])

    def likely_in_time(self, excess: Tensor, light: Tensor) -> list[dict[str, float]]:
        """Those that beat both their neighbours, by what single waves alone would be worth.

        What repeats does so after twice its period, too, and a longer one can take up more that is wrong.
        """
        first, last = self.scan.gate
        bins = torch.arange(first, last, dtype=torch.float64)
        excess, light = excess.double().cpu(), light.double().cpu()
        deviation = torch.cat([torch.full((2,), 0.02), torch.tensor(self.declared["overtones"].prior)])
        variance, tried = deviation.double().square(), torch.logspace(-3, 3, 13, dtype=torch.float64)

        def worth(periods: Tensor) -> Tensor:
            found = list[Tensor]()
            for some in periods.split(64):
                waves = waves_at(bins, some[:, None])
                score = torch.einsum("ptk,t->pk", waves, excess)
                told = torch.einsum("ptk,t->pk", waves.square(), light)
                nats = log_factor(variance * told, variance * score.square(), tried).amax(1)
                found.append(nats.clamp_min(0.0))  # a width of 0 is worth nothing, and no less
            return torch.cat(found)

        grid = np.array(self.declared["period"].grid)
        nats = torch.nn.functional.pad(worth(torch.from_numpy(grid)), (1, 1), value=-math.inf)
        peaks = ((nats[1:-1] >= nats[:-2]) & (nats[1:-1] > nats[2:])).nonzero()[:, 0]
        most = peaks[nats[1:-1][peaks].argsort(descending=True)][: 4 * LIKELY].numpy()
        # What one loses on the grid and another does not would decide between them.
        beside = most[:, None] + np.linspace(-1, 1, 9)
        periods = torch.from_numpy(1 / np.interp(beside, np.arange(len(grid)), 1 / grid))
        peak, place = worth(periods.flatten()).view(periods.shape).max(1)
        period = periods.gather(1, place[:, None])[:, 0]
        shortest = period[peak >= MOST * peak.max()].min()
        best = peak.argsort(descending=True)
        return [{"period": float(period[k])} for k in best if period[k] <= shortest][:LIKELY]

    def settable(self) -> dict[str, str]:
        return {name: unit for name, unit in super().settable().items() if name != "overtones"}

    def quantities(self) -> dict[str, Quantity]:
        first, last = self.scan.gate
        pattern = self.pattern(
            torch.arange(first, last, dtype=torch.float32, device=self.value("period").device)
        )
        return {
            "rms": Quantity(length(pattern / (last - first) ** 0.5, 0.02), "1", kind="percent"),
            "period": Quantity(self.value("period"), "bins"),
        }


def waves_at(bins: Tensor, period: Tensor) -> Tensor:
    """Waves of a pattern that repeats.

    Those are left out that bins do not tell from others: half a period of theirs is shorter than a bin, by
    more than a period between two whole numbers may need.

    Args:
        bins: ``[T]`` numbers.
        period: ``[…, 1]`` or a scalar, bins.

    Returns:
        ``[…, T, 16]`` sine and cosine of each.

    Examples:
        >>> waves_at(torch.arange(4.0), torch.tensor(4.0))[:, :5].abs().round().int().tolist()
        [[0, 1, 0, 1, 0], [1, 0, 0, 1, 0], [0, 1, 0, 1, 0], [1, 0, 0, 1, 0]]
    """
    k = torch.arange(1, WAVES + 1, dtype=bins.dtype, device=bins.device)
    phase = 2 * math.pi * (bins / period)[..., None] * k
    told = (k <= period[..., None] / 2 + 0.25).to(bins.dtype)
    return torch.stack([torch.sin(phase) * told, torch.cos(phase) * told], -1).flatten(-2)
