"""Second, weak laser pulse."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import whole_record


class GhostPulse(Effect):
    """A copy of the response follows, from a reflection in the optics, in a cable or in the laser.

    ``Ψ'(t) = Ψ(t) + fraction · Ψ(t - delay)``; between whole bins Ψ is interpolated linearly.

    Parameters: ``fraction`` (1), null 0. ``delay`` (m of path), scanned from 4 bins to 0.6 of the record.

    Signature: the whole record again, weaker and later, at every spot by the same delay.

    Degenerate with: weak surfels behind the surface, where the delay is short; ``irf_tail`` for delays within
    the tail.

    Source: W. Becker, *The bh TCSPC Handbook* (optical and electrical reflections in the instrument
    response).
    """

    name = "ghost_pulse"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="a second, delayed pulse",
        cause="A reflection in the optics or a cable, or a post-pulse of the laser, repeats every return "
        "later.",
        remedy="Look for the repeat in the direct pulse; tilt filters and windows, terminate cables, or "
        "move it out of the gate.",
        headline="{fraction} of the main pulse, {delay} later",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        delay, delays = 4.0, []
        while delay <= max(0.6 * scan.n_bins, 4.0):
            delays.append(delay * scan.bin_length)
            delay = delay + 3 if delay < 40 else 1.06 * delay
        longest = max(scan.n_bins, 5) * scan.bin_length
        return (
            Parameter("fraction", "1", 0.0, 0.05, 0.0, 1.0, kind="percent"),
            Parameter("delay", "m", None, scan.bin_length, scan.bin_length, longest, grid=tuple(delays)),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"fraction": 0.1}

    def response(self, kernel: Tensor, lead: int) -> Tensor:
        kernel = whole_record(kernel, lead, self.scan.n_bins)
        delay = self.value("delay") / self.scan.bin_length
        whole = int(delay.detach())
        part = delay - whole
        late, later = (torch.nn.functional.pad(kernel, (n, 0))[: len(kernel)] for n in (whole, whole + 1))
        return kernel + self.value("fraction") * ((1 - part) * late + part * later)
