"""Echoes of the pulse: a reflection, and its own reflections."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import convolve, whole_record


class GhostPulse(Effect):
    """Copies of the response follow, from a reflection in the optics, in a cable or in the laser.

    ``Ψ'(t) = Ψ(t) + fraction · Σ_{k≥1} again^{k-1} Ψ(t - k delay)``; what goes to and fro between two ends
    loses the same share each time. Between whole bins Ψ is interpolated linearly.

    Parameters: ``fraction`` (1) of the first echo, null 0. ``delay`` (m of path), scanned from 4 bins to 0.6
    of the record. ``again`` (1) of each echo over the one before; 0 is a single echo.

    Signature: the whole record again, weaker and later, at every spot by the same delay.

    Degenerate with: weak surfels behind the surface, where the delay is short; ``irf_tail`` for delays within
    the tail.

    Source: W. Becker, *The bh TCSPC Handbook* (optical and electrical reflections in the instrument
    response); the series is that of any two partly reflecting ends (M. Born, E. Wolf, *Principles of Optics*,
    §7.6).
    """

    name = "ghost_pulse"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="a second, delayed pulse",
        cause="A reflection in the optics or a cable, or a post-pulse of the laser, repeats every return "
        "later, and may come again.",
        remedy="Look for the repeat in the direct pulse; tilt filters and windows, terminate cables, or "
        "move it out of the gate.",
        headline="{fraction} of the main pulse, {delay} later, and {again} of each echo again",
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
            Parameter("again", "1", None, 0.1, 0.0, 0.9, grid=(0.2,), kind="percent"),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"fraction": 0.1}

    def response(self, kernel: Tensor, lead: int) -> Tensor:
        kernel = whole_record(kernel, lead, self.scan.n_bins)
        delay = self.value("delay") / self.scan.bin_length
        echoes = int(len(kernel) / delay.detach())
        number = torch.arange(1, 1 + echoes, dtype=delay.dtype, device=delay.device)
        at, size = number * delay, self.value("again").reshape(1) ** (number - 1)
        whole = at.detach().long()
        later = size * (at - whole.to(at))
        train = torch.zeros_like(later[:1]).expand(len(kernel) + 2)
        train = train.index_add(0, whole, size - later).index_add(0, whole + 1, later)
        return kernel + self.value("fraction") * convolve(kernel, train[: len(kernel)])
