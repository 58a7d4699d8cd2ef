"""Sensor that looks beside the point that it is thought to look at."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths


class LaserSensorBaseline(Effect):
    """The sensor looks at ``sensor + (baseline_x, baseline_y, 0)``; the laser hits its stated point.

    ``d2 → |p - s - b|`` in length and throughput (d2⁻², both cosines), worked out at the surfels' centres.

    Parameters: ``baseline_x``, ``baseline_y`` (m), null 0.

    Signature: edges in time shifted by ``-b·(p - s)/d2``: one sign for scene on one side of a spot, the other
    for the other side.

    Degenerate with: a sideways shift of the scene by half the baseline, exactly so for confocal scans of far
    scenes; ``wall_tilt``.

    Source: geometry.
    """

    name = "laser_sensor_baseline"
    followed_by = ("free_wall_delay",)
    lasting = True
    words = EffectWords(
        phrase="laser and sensor spots that do not coincide",
        cause="The detector looks beside the point that the laser lights.",
        remedy="Realign the two beams on the wall, or give the sensor's true points.",
        headline="{baseline_x} along x, {baseline_y} along y",
    )

    sensor: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("sensor", scan.sensor.clone(), persistent=False)

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

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        stated, real = self.legs(paths, spots)
        facing = [(-(leg * paths.normal).sum(2)).clamp_min(1e-6) for leg in (stated, real)]
        squares = [leg.square().sum(2) for leg in (stated, real)]
        return contribution * (facing[1] / facing[0] * (squares[0] / squares[1]) ** 2)[..., None]

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        stated, real = self.legs(paths, spots)
        return length + (real.norm(dim=2) - stated.norm(dim=2))[..., None]

    def legs(self, paths: Paths, spots: Tensor) -> tuple[Tensor, Tensor]:
        """From the sensor's stated and its real point to the surfels' centres.

        Args:
            paths: for the centres.
            spots: ``[B]`` indices into the scan.

        Returns:
            Both ``[B, M, 3]`` m.
        """
        stated = paths.centre - self.sensor[spots][:, None]
        x, y = self.value("baseline_x"), self.value("baseline_y")
        return stated, stated - torch.stack([x, y, torch.zeros_like(x)])
