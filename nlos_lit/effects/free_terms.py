"""Free terms: what is wrong along an axis, whatever causes it (after Kennedy and O'Hagan, 2001).

A free term is an effect without a name: its coefficients may take any values along one axis or a pair of
axes, each with the same prior deviation, or, along the scan, with the same for each octave of frequencies. It
stands in the same contest as the effects of the registry, can be fitted, shown and measured like them, and
says where to look when no equation fits.

    f = Σ_k c_k b_k,    counts → counts · e^f,    light → light · e^f,    background → background · e^f
                 or     L → L + f
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.scan_pieces import bands, stretches
from nlos_lit.effects.smooth import SeveralWidths, falling_prior, fast, length, over_scan, over_wall
from nlos_lit.effects.timing_jitter import TimingJitter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import filtered
from nlos_lit.functional.surfel_paths import Paths

TAILS = (4.0, 12.0, 36.0)  # bins
MOST_BANDS = 256  # of the gate: columns for each bin of a long one would not fit into memory
RATES = (-2.0, 2.0)  # natural logarithm of a spot's counts over the scan's mean


def _words(where: str, what: str) -> EffectWords:
    return EffectWords(
        phrase=f"something unknown {where}",
        cause=f"{what} No equation of the registry has this form.",
        remedy="Look at its shape in the residual; if it follows a formula, that is a new effect file.",
        headline="{rms} rms",
    )


class Free(Effect):
    """Any free term.

    Attributes:
        axis: ``time``, ``wall``, ``scan``, ``rate``, ``spot`` or two of them with ``×``.
    """

    axis: ClassVar[str]

    def values(self) -> Tensor:
        """f at every spot ``[S]``, in every bin ``[T]``, at every knot of the rate, or ``[S, T]``."""
        raise NotImplementedError


class FreeTerm(Free):
    """Coefficients along an axis; subclasses give the functions and one hook."""

    functions: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("functions", self.basis(scan), persistent=False)

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        """``[n, K]`` functions of the spot, or of the bin."""
        raise NotImplementedError

    @classmethod
    def size(cls, scan: Scan) -> int:
        """How many coefficients there are."""
        return cls.basis(scan).shape[1]

    @classmethod
    def likely(cls, scan: Scan, largest: float) -> tuple[float, ...]:
        """Prior deviations of the coefficients.

        Args:
            scan: of the capture.
            largest: of them, in their unit.

        Returns:
            one for each.
        """
        return (largest,) * cls.size(scan)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        prior = cls.likely(scan, 0.5)
        return (Parameter("field", "1", 0.0, 0.05, -3.0, 3.0, size=len(prior), prior=prior, kind="percent"),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"field": 0.2}

    def values(self) -> Tensor:
        return self.functions @ self.value("field").reshape(-1)

    def at(self, spots: Tensor) -> Tensor:
        """``[B, 1]`` f at spots, where the functions are those of the spot."""
        return (self.functions[spots] @ self.value("field").reshape(-1))[:, None]

    def quantities(self) -> dict[str, Quantity]:
        p, field = self.declared["field"], self.values()
        return {"rms": Quantity(length(field / field.numel() ** 0.5, p.scale), p.unit, kind=p.kind)}


class AlongScan(SeveralWidths, FreeTerm):
    """Splines over the scan; each octave of frequencies is as likely, and may then have a width of its own.

    Fitted spots leave gaps, of a line or so. What swings must be followed through them, and what does not
    must not swing there.
    """

    axis = "scan"

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        share = over_scan(scan, self.splines(scan))[1]
        self.give_widths((-0.5 * share.log2()).floor().long())

    @classmethod
    def splines(cls, scan: Scan) -> int:
        """128, or one for every four spots."""
        return fast(scan)

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        return over_scan(scan, cls.splines(scan))[0]

    @classmethod
    def likely(cls, scan: Scan, largest: float) -> tuple[float, ...]:
        # An octave has as many more functions as it has higher frequencies: variances fall as much.
        return falling_prior(over_scan(scan, cls.splines(scan))[1], largest, 0.5)


class _FreeCounts(FreeTerm):
    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        return expected * torch.exp(self.at(spots))


class _FreeBackground(FreeTerm):
    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        return background * torch.exp(self.at(spots))


class FreeTime(FreeTerm):
    """``m_t → m_t e^{f(t)}``, f any value in each bin of the gate, or in every two, three, … of many bins."""

    name, axis = "free_time", "time"
    words = _words("along the time axis", "All spots count too much or too little in the same bins.")

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        return time_bands(scan, MOST_BANDS)

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        return expected * torch.exp(self.values())


class FreeWall(_FreeCounts):
    """``m → m e^{f(x, y)}``, f any combination of 8×8 splines over the wall."""

    name, axis = "free_wall", "wall"
    words = _words("across the wall", "Spots of one region count too much or too little.")

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        return over_wall(scan, 8)[0]


class FreeLines(FreeTerm):
    """``signal → signal e^{f(x) + g(y)}``, f and g constant within each of 24 stripes of the wall.

    No effect changes the scene's light so. On counts it would change the background with it, and an effect of
    the background would be asked for to put that right.
    """

    name, axis = "free_lines", "wall"
    words = _words(
        "along rows or columns of the wall",
        "Whole rows or columns get too much of the scene's light, or too little.",
    )

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        place = scan.places[-1]
        return torch.cat([bands((place[:, k] + 1) / 2, 24) for k in (0, 1)], 1)

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        return signal * torch.exp(self.at(spots))


class FreeScan(AlongScan, _FreeCounts):
    """``m → m e^{f(u)}``, f any combination of 128 splines over the scan, or of one for every four spots."""

    name = "free_scan"
    words = _words(
        "over the course of the scan", "Spots of one stretch of time count too much or too little."
    )


class FreeRate(FreeTerm):
    """``m → m e^{f(ln n)}``, n the spot's expected counts, f linear between 10 knots."""

    name, axis = "free_rate", "rate"
    words = _words(
        "with the count rate", "Bright spots count too much or too little, whatever makes them so."
    )
    KNOTS = 10

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        return torch.eye(cls.KNOTS)

    def tents(self, expected: Tensor) -> Tensor:
        """``[B, KNOTS]`` weight of each knot at spots of ``expected`` ``[B, T]`` counts."""
        rate = (expected.sum(1) / self.scan.mean_counts).clamp_min(1e-6).log()
        place = (rate - RATES[0]) / (RATES[1] - RATES[0]) * (self.KNOTS - 1)
        knots = torch.arange(self.KNOTS, device=expected.device)
        return (1 - (place.clamp(0, self.KNOTS - 1)[:, None] - knots).abs()).clamp_min(0)

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        return expected * torch.exp(self.tents(expected) @ self.value("field").reshape(-1))[:, None]


class FreeScanBackground(AlongScan, _FreeBackground):
    """``background → background e^{f(u)}``, f as of ``free_scan``."""

    name = "free_scan_background"
    words = _words(
        "in the background over the course of the scan", "Light that is not the scene's comes and goes."
    )


class FreeWallBackground(_FreeBackground):
    """``background → background e^{f(x, y)}``, f any combination of 8×8 splines over the wall."""

    name, axis = "free_wall_background", "wall"
    words = _words(
        "in the background across the wall", "Light that is not the scene's depends on the wall point."
    )

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        return over_wall(scan, 8)[0]


class _FreeDelay(FreeTerm):
    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        step = scan.bin_length
        prior = cls.likely(scan, step)
        return (Parameter("field", "m", 0.0, step, -20 * step, 20 * step, size=len(prior), prior=prior),)

    def factors(self, spots: Tensor) -> Tensor:
        return self.functions[spots]

    def alone(self) -> Effect:
        return TimingJitter(self.scan)

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.at(spots)[:, None]


class FreeScanDelay(AlongScan, _FreeDelay):
    """``L → L + f(u)``, f as of ``free_scan``."""

    name = "free_scan_delay"
    words = _words(
        "in the delay over the course of the scan", "Light comes early or late in one stretch of time."
    )


class FreeWallDelay(_FreeDelay):
    """``L → L + f(x, y)``, f any combination of 6×6 splines over the wall."""

    name, axis = "free_wall_delay", "wall"
    words = _words("in the delay across the wall", "Light comes early or late at one region of the wall.")

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        return over_wall(scan, 6)[0]


class _OfResponse(FreeTerm):
    """What becomes of all light at a spot, by functions of the spot."""

    def factors(self, spots: Tensor) -> Tensor | None:
        """At the null only: changes of a changed response do not add up."""
        return None if bool(self.value("field").any()) else self.functions[spots]


class _Equally(_OfResponse):
    """The same at all spots."""

    axis = "time"

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        return torch.ones(scan.n_spots, 1)

    def factors(self, spots: Tensor) -> None:
        return None


class _OverWall(_OfResponse):
    """The 8 smoothest functions of the wall point without a constant."""

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        return over_wall(scan, 5)[0][:, :8]


class _FreeResponse(_OfResponse):
    """``signal → signal + Σ_ij c_ij b_j(spot) K_i signal``: what response and spot do together.

    K_1 … K_3 move light into tails that decay over 4, 12 and 36 bins and keep the energy. A scene changes
    what arrives at a spot in any way it likes, but never smears all of it.
    """

    kernels: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("kernels", tails_of(scan.n_bins), persistent=False)

    @classmethod
    def size(cls, scan: Scan) -> int:
        return len(TAILS) * cls.basis(scan).shape[1]

    def alone(self) -> Effect:
        return _EqualResponse(self.scan)

    def weights(self, spots: Tensor | slice = slice(None)) -> Tensor:
        """``[B, 3]`` of the changes at spots."""
        return self.functions[spots] @ self.value("field").reshape(self.functions.shape[1], -1)

    def values(self) -> Tensor:
        """``[S, T]`` what becomes of light that arrives when the gate opens."""
        return self.weights() @ self.kernels[:, :, self.scan.gate[0]]

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        weights = self.weights(spots)
        changed = torch.einsum("ktu,bu->bkt", self.kernels, signal)
        return (signal + torch.einsum("bk,bkt->bt", weights, changed)).clamp_min(0)


class _EqualResponse(_Equally, _FreeResponse):
    """The response changes everywhere alike."""

    name = "equal_response"


class FreeResponseScan(_FreeResponse):
    """The response changes over the scan: b_j 16 stretches of it, each less its mean over the spots.

    What is the same at all spots is no change: a tail that no single equation follows would pass for one.
    """

    name, axis = "free_response_scan", "time×scan"
    words = _words("along time that changes over the scan", "The response drifts, or comes and goes.")

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        found = stretches(scan, 16)
        return found - found.mean(0)


class FreeResponseWall(_OverWall, _FreeResponse):
    """The response depends on the wall point: b_j the 8 smoothest functions of it without a constant."""

    name, axis = "free_response_wall", "time×wall"
    words = _words("along time that depends on the wall point", "The response is not the same everywhere.")


class _FreeWidth(_OfResponse):
    """Light spreads over time by a variance f, in squared bins, which is not the same at all spots.

    A spectrum is multiplied by ``e^{-f (1 - cos ω)}``, and by ``1 - f (1 - cos ω)`` where f is negative: the
    energy is kept. Beside the tails of :class:`_FreeResponse` it has a prior of its own, as they do far more
    to the light by each unit.
    """

    def alone(self) -> Effect:
        return _EqualWidth(self.scan)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        prior = cls.likely(scan, 4.0)
        return (Parameter("field", "bins²", 0.0, 0.5, -100.0, 100.0, size=len(prior), prior=prior),)

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        def blur(wave: Tensor) -> Tensor:
            spread = self.at(spots) * (1 - wave.cos())
            return torch.where(spread > 0, torch.exp(-spread.clamp_min(0)), 1 - spread)

        return filtered(signal, blur).clamp_min(0)


class _EqualWidth(_Equally, _FreeWidth):
    """Light spreads everywhere alike."""

    name = "equal_width"


class FreeWidthScan(AlongScan, _FreeWidth):
    """f any combination of 16 splines over the scan; each octave of frequencies is as likely."""

    name = "free_width_scan"
    words = _words(
        "in the width of the response over the course of the scan",
        "The pulse or the detector's response grows wider or narrower.",
    )

    @classmethod
    def splines(cls, scan: Scan) -> int:
        return 16


class FreeWidthWall(_OverWall, _FreeWidth):
    """f any combination of the 8 smoothest functions of the wall point without a constant."""

    name, axis = "free_width_wall", "wall"
    words = _words(
        "in the width of the response across the wall",
        "The response is wider at one region of the wall.",
    )


class FreeSpotGain(Free):
    """``m → m e^{δ_s}``, ``δ_s ~ N(0, σ²)``, independent."""

    name, axis = "free_spot_gain", "spot"
    words = _words(
        "in the gain of single spots", "Each spot counts too much or too little, unlike its neighbours."
    )
    per_spot = True

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("field", "1", 0.0, 0.05, -3.0, 3.0, size=scan.n_spots, kind="percent"),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"field": 0.1}

    def values(self) -> Tensor:
        return self.value("field").reshape(-1)

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        return expected * torch.exp(self.values()[spots])[:, None]

    def quantities(self) -> dict[str, Quantity]:
        p = self.declared["field"]
        return {"rms": Quantity(self.value("field").new_tensor(self.width * p.scale), p.unit, kind=p.kind)}


def tails_of(n_bins: int) -> Tensor:
    """``[3, T, T]`` what tails that decay over ``TAILS`` bins add to light, and take from it.

    Examples:
        Of light of one bin a part comes later, and the energy is kept:

        >>> tails_of(5)[0, :, 2].round(decimals=3)
        tensor([ 0.0000,  0.0000, -0.7790,  0.1720,  0.1340])
    """
    late = (torch.arange(n_bins)[:, None] - torch.arange(n_bins)).float()
    changes = [
        torch.exp(-late.clamp_min(0) / tail) * (late >= 0) * (1 - torch.exp(torch.tensor(-1 / tail)))
        - (late == 0).float()
        for tail in TAILS
    ]
    return torch.stack(changes).to(torch.get_default_dtype())


def time_bands(scan: Scan, most: int) -> Tensor:
    """Indicators of bands of the gate, each of as many bins.

    Args:
        scan: of the capture.
        most: bands.

    Returns:
        ``[T, K ≤ most]``, nothing before the gate.
    """
    first, last = scan.gate
    width = math.ceil((last - first) / most)
    index = (torch.arange(scan.n_bins) - first).div(width, rounding_mode="floor")
    return (index[:, None] == torch.arange(math.ceil((last - first) / width))).float()


FREE: tuple[type[Free], ...] = (
    FreeScanDelay, FreeWallDelay, FreeScanBackground, FreeWallBackground, FreeTime, FreeWall, FreeLines,
    FreeScan, FreeRate, FreeResponseScan, FreeResponseWall, FreeWidthScan, FreeWidthWall, FreeSpotGain,
)  # fmt: skip
FREE_NAMES = frozenset(term.name for term in FREE)
