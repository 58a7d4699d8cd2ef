"""Laser power that wanders while the wall is scanned."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.smooth import SmoothEffect, fast, over_scan
from nlos_lit.effects.words import EffectWords


class PowerDrift(SmoothEffect):
    """The laser gets stronger or weaker, or the detector's efficiency drifts.

    ``signal → signal · e^{f(u)}``, u the order of acquisition from -1 to 1, f a cubic spline without its
    constant, of 128 functions (of one for every four spots where they are few), likely a random walk: its
    coefficients fall with the frequency.

    Parameters: ``drift`` (1, logarithm of the gain), at most 127 coefficients, null 0. Quantities ``rms`` and
    ``peak_to_peak`` (1).

    Signature: spot totals follow the order of acquisition; the shape in time is right. A power that swings
    more than 12 times during the scan, in the mean of its squares, is no drift.

    Degenerate with: ``wall_reflectance`` in a raster scan, which can be any smooth function of the slow axis;
    normals of a small scene.

    Source: none needed, a smooth gain.
    """

    name = "power_drift"
    followed_by = ("free_scan",)
    words = EffectWords(
        phrase="a laser power that drifts during the scan",
        cause="Laser output or detector efficiency changes with temperature while the scan runs.",
        remedy="Warm up the laser, record a power monitor, or divide each spot by its direct pulse.",
        headline="{peak_to_peak} from end to end of its range",
    )
    split_by: ClassVar = {
        "wall_reflectance": "a second scan in another order",
        "vignetting": "a second scan in another order",
    }
    witness = "energy"
    coefficients = "drift"
    falling: ClassVar[float] = 1.0
    ends: ClassVar[bool] = True
    slow: ClassVar[bool] = True

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        return over_scan(scan, fast(scan))

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return cls.coefficient(scan, "1", 0.05, 1.5, 0.5, kind="percent")

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"rms": 0.2}

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        return signal * torch.exp(self.field(spots))[:, None]
