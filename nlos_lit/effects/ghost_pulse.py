"""Echoes of the pulse: a reflection, and its own reflections."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import convolve, whole_record

SHORTEST = 4  # bins; what comes again earlier belongs to the pulse
SOONEST = 8  # bins; what comes again earlier cannot be told from how the light of a spot rises and falls
PART = 1024  # spots whose spectra are held at once


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
    imitated = ("echoes",)
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
        delay, delays = float(SHORTEST), []
        while delay <= max(0.6 * scan.n_bins, SHORTEST):
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

    def begin(self, counts: Tensor) -> None:
        """A weak echo, where it shows: at 0 nothing moves its delay, and surfels would take its place."""
        self.reset()
        self.set("fraction", self.declared["fraction"].scale)
        self.set("delay", repeats_after(counts) * self.scan.bin_length)

    def part_of(self) -> dict[str, float]:
        """Echoes at half the delay, of which these are every second one."""
        fraction, delay, again = (float(self.value(p).detach()) for p in ("fraction", "delay", "again"))
        if min(fraction, again) <= 0 or delay < 2 * SHORTEST * self.scan.bin_length:
            return {}
        return {"fraction": fraction / again**0.5, "delay": delay / 2, "again": again**0.5}

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


def repeats_after(counts: Tensor) -> int:
    """After how many bins the same rises and falls come again, at all spots.

    An echo is a narrow peak of the autocorrelation of what each bin has over the one before, in the mean of
    spots. What a scene does there is wide. So each lag is compared with those 3 to 5 bins to both sides.

    Args:
        counts: ``[S, T]``.

    Returns:
        from ``SOONEST`` to 0.6 T.
    """
    lags = torch.zeros(())
    for part in counts.float().split(PART):
        steps = part.diff(dim=1)
        power = torch.fft.rfft(steps, n=2 * counts.shape[1] + SOONEST).abs().square().sum(0)
        lags = lags.to(power) + torch.fft.irfft(power)
    asked = torch.arange(SOONEST, max(SOONEST + 1, int(0.6 * counts.shape[1])), device=lags.device)
    over = lags[asked] - sum(lags[asked + d] for d in (-5, -4, -3, 3, 4, 5)) / 6
    return int(asked[over.argmax()])
