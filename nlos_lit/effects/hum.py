"""Background that oscillates while the wall is scanned."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.smooth import length
from nlos_lit.effects.words import EffectWords

FEWEST, MOST = 2.0, 64.0  # periods in the scan


class Hum(Effect):
    """The level of foreign light swings along the order of acquisition, many times in a scan.

    ``background → background · max(0, 1 + Σ_k (c_k cos(2πkfu) + s_k sin(2πkfu)))``, k = 1, 2, 3, u the order
    of acquisition from 0 to 1.

    Parameters: ``cosine`` c_1, ``sine`` s_1 (1), null 0. ``overtones`` c_2, s_2, c_3, s_3 (1), null 0: a lamp
    at the mains does not swing like a sine. ``frequency`` f (1): periods in the scan, scanned from 2 to 64
    (fewer where spots are too few for it) in steps of half a period, so that a frequency between two values
    keeps at least 81 % of its power. Quantities ``amplitude`` (1, the root of both squares of the first wave)
    and ``frequency``.

    Signature: bands in the level before the first return, of a few rows or columns in a raster scan, which
    follow the order of acquisition and leave the scene's light alone.

    Degenerate with: ``ambient_map`` where a raster scan has only a few periods; ``power_drift`` in a gate
    that holds no bin without scene.

    Source: none needed, a sine. Bands of this kind: lamps and supplies that beat with the scan.

    Examples:
        Nine spots, two periods: the fifth spot is a whole one after the first.

        >>> import dataclasses
        >>> from nlos_lit.effects.nominal import nominal_scan
        >>> hum = Hum(dataclasses.replace(nominal_scan(), rank=torch.linspace(-1, 1, 9)))
        >>> hum.set_all({"cosine": 0.5, "frequency": 2.0})
        >>> hum.background(torch.tensor(2.0), torch.arange(5))[:, 0].detach().round(decimals=3)
        tensor([3., 2., 1., 2., 3.])
    """

    name = "hum"
    followed_by = ("free_scan_background",)
    words = EffectWords(
        phrase="a background that oscillates during the scan",
        cause="Lamps, screens or a power supply flicker; beaten with the time per spot they give bands.",
        remedy="Switch lamps and screens off one by one and look at the level before the first return; let "
        "the time per spot be whole periods of the mains.",
        headline="{amplitude} with {frequency} periods in the scan",
    )
    split_by: ClassVar = {
        "ambient_map": "a second scan in another order",
        "power_drift": "a capture with the laser off",
    }

    rank: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("rank", scan.rank.clone(), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        # Two spots a period are the fewest that tell it from a slower one.
        highest = min(MOST, math.floor(2 * scan.n_spots / 2.2) / 2)
        steps = max(0, round(2 * (highest - FEWEST)))
        waves = tuple(
            Parameter(name, "1", 0.0, 0.05, -0.7, 0.7, kind="percent") for name in ("cosine", "sine")
        )
        overtones = Parameter("overtones", "1", 0.0, 0.05, -0.3, 0.3, size=4, kind="percent")
        frequencies = tuple(FEWEST + k / 2 for k in range(steps + 1))
        return (*waves, overtones, Parameter("frequency", "1", None, 0.1, 1.0, 2 * MOST, grid=frequencies))

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"cosine": 0.3, "sine": 0.0}

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        phase = math.pi * self.value("frequency") * (self.rank[spots] + 1)
        waves = torch.stack([f(k * phase) for k in (1, 2, 3) for f in (torch.cos, torch.sin)], -1)
        first = torch.stack([self.value("cosine"), self.value("sine")])
        swing = waves @ torch.cat([first, self.value("overtones")])
        return background * (1 + swing[:, None]).clamp_min(0)

    def settable(self) -> dict[str, str]:
        return {name: unit for name, unit in super().settable().items() if name != "overtones"}

    def quantities(self) -> dict[str, Quantity]:
        waves = torch.stack([self.value("cosine"), self.value("sine")])
        return {
            "amplitude": Quantity(length(waves, 0.05), "1", kind="percent"),
            "frequency": Quantity(self.value("frequency"), "1"),
        }
