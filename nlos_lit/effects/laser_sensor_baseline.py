"""Sensor that looks beside the point that it is thought to look at."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Walls


class LaserSensorBaseline(Effect):
    """The sensor looks at ``sensor + (baseline_x, baseline_y, 0)``; the laser hits its stated point.

    ``s → s + b`` for the point that paths end at; a confocal scan is none any more.

    Parameters: ``baseline_x``, ``baseline_y`` (m), null 0.

    Signature: edges in time shifted by ``-b·(p - s)/d2``: one sign for scene on one side of a spot, the other
    for the other side.

    Degenerate with: a sideways shift of the scene by half the baseline, exactly so for confocal scans of far
    scenes; ``wall_tilt``.

    Source: geometry.
    """

    name = "laser_sensor_baseline"
    imitated = ("geometry",)
    followed_by = ("free_wall_delay",)
    lasting = True
    words = EffectWords(
        phrase="laser and sensor spots that do not coincide",
        cause="The detector looks beside the point that the laser lights.",
        remedy="Realign the two beams on the wall, or give the sensor's true points.",
        headline="{baseline_x} along x, {baseline_y} along y",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        reach = 0.25 * scan.half
        return tuple(
            Parameter(name, "m", 0.0, scan.bin_length, -reach, reach, kind="length")
            for name in ("baseline_x", "baseline_y")
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"baseline_x": 0.05 * scan.half, "baseline_y": 0.0}

    def walls(self, walls: Walls, spots: Tensor) -> Walls:
        baseline = torch.stack([self.value("baseline_x"), self.value("baseline_y")])
        moved = walls.sensor + torch.nn.functional.pad(baseline, (0, 1))
        return walls._replace(sensor=moved, confocal=False)
