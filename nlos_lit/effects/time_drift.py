"""Time axis that wanders while the wall is scanned."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.smooth import SmoothEffect, fast, over_scan
from nlos_lit.effects.timing_jitter import TimingJitter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths


class TimeDrift(SmoothEffect):
    """The delay between laser and detector drifts, as with temperature.

    ``L → L + f(u)``, u the order of acquisition from -1 to 1, f a cubic spline without its constant, of 128
    functions (of one for every four spots where they are few), likely a random walk: its coefficients fall
    with the frequency.

    Parameters: ``drift`` (m of path), at most 127 coefficients, null 0. Quantities ``rms`` and
    ``peak_to_peak`` (m).

    Signature: residuals of both signs at every edge in time, their sign changing along the scan. A delay that
    swings more than 12 times during the scan, in the mean of its squares, is no drift.

    Degenerate with: ``wall_tilt`` in a raster scan (slow axis = scan order); a serpentine scan or columns
    split nothing more.

    Source: W. Becker, *The bh TCSPC Handbook* (timing drift of detector and trigger).
    """

    name = "time_drift"
    followed_by = ("free_scan_delay",)
    words = EffectWords(
        phrase="a time zero that drifts during the scan",
        cause="Laser trigger and timing electronics wander as they warm up.",
        remedy="Let the rig warm up, scan faster, or align every spot to its own direct pulse.",
        headline="{peak_to_peak} from end to end of its range",
    )
    split_by: ClassVar = {
        "wall_tilt": "a second scan in another order (serpentine or column by column)",
        "time_offset": "a second scan in another order",
    }
    coefficients = "drift"
    falling: ClassVar[float] = 1.0
    ends: ClassVar[bool] = True
    slow: ClassVar[bool] = True

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        return over_scan(scan, fast(scan))

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return cls.coefficient(
            scan, "m", scan.bin_length, 0.1 * scan.n_bins * scan.bin_length, 4 * scan.bin_length
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"rms": 1.5 * scan.bin_length}

    def factors(self, spots: Tensor) -> Tensor:
        return self.functions[spots]

    def alone(self) -> Effect:
        return TimingJitter(self.scan)

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.field(spots)[:, None, None]
