"""Ambient light that changes while the wall is scanned."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.scan_pieces import stretches
from nlos_lit.effects.smooth import SmoothEffect
from nlos_lit.effects.words import EffectWords

SPOTS = 12  # of a stretch, in small scans
MOST = 128  # stretches


class AmbientDrift(SmoothEffect):
    """The constant background changes during the scan, also at once, as when a lamp or a screen is switched.

    ``background → background · e^{f(u)}``, u the order of acquisition, f constant within each of many equal
    stretches (one for every 12 spots, 128 at most) and zero on average over the spots.

    Parameters: ``level`` (1, logarithm), one coefficient a stretch, null 0. Quantities ``rms`` and
    ``peak_to_peak`` (1) of the logarithm.

    Signature: the level before the first return has steps or waves along the order of acquisition.

    Degenerate with: ``hum``, which is periodic; ``ambient_map`` where it varies along the slow axis alone.

    Source: none needed, a level that changes.
    """

    name = "ambient_drift"
    followed_by = ("free_scan_background",)
    words = EffectWords(
        phrase="an ambient light that changes during the scan",
        cause="Lamps, screens or daylight changed while the wall was scanned.",
        remedy="Scan in the dark or behind a narrower filter; else keep the level of each stretch in the "
        "model.",
        headline="{peak_to_peak} between its extremes, {rms} rms",
    )
    split_by: ClassVar = {
        "ambient_map": "a second scan in another order",
        "hum": "a second scan: mains hum keeps its period, other light does not",
    }
    coefficients = "level"
    ends: ClassVar[bool] = True

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        number = min(MOST, max(2, scan.n_spots // SPOTS))
        found = stretches(scan, number)
        return found - found.mean(0), torch.ones(number)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return cls.coefficient(scan, "1", 0.1, 3.0, 0.5, kind="percent")

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"rms": 0.3}

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        return background * torch.exp(self.field(spots))[:, None]
