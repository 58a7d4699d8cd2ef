"""Time bins that are not as wide as the file says."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths


class ClockScale(Effect):
    """The recorded time axis is stretched about the middle of the gate.

    ``L → L0 + (1 + scale)(L - L0)``, L0 the path length at the middle of the gate.

    Parameters: ``scale`` (1), null 0.

    Signature: early returns too early and late ones too late, or the reverse, the more so the farther from
    the gate's middle.

    Degenerate with: the scene's depth and curvature, ``time_offset``; a deep scene splits them.

    Source: D. V. O'Connor, D. Phillips, *Time-correlated Single Photon Counting*, 1984 (calibration of the
    time axis).
    """

    name = "clock_scale"
    imitated = ("geometry",)
    followed_by = ("free_wall_delay",)
    words = EffectWords(
        phrase="a time axis that is stretched",
        cause="The true width of a time bin is not the nominal one.",
        remedy="Calibrate the bin width with a known delay or with the laser's repetition period.",
        headline="bins {scale} wider than stated",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("scale", "1", 0.0, 0.01, -0.3, 0.3, kind="percent"),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"scale": 0.02}

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.value("scale") * (length - self.scan.middle)
