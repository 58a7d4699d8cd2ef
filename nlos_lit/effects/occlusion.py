"""Something black between wall and scene."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths

EDGE = 0.12  # width of the soft edge, in radii


class Occlusion(Effect):
    """An unseen black disc, parallel to the wall, blocks legs that cross it.

    ``K → K T_laser T_sensor``, ``T = 1 - opacity σ((radius - ρ)/w) σ((z_surfel - z)/w)``, ρ the distance from
    the disc's axis at which the leg crosses the plane z, w = 0.12 radius; a leg is taken as the line to the
    surfel's centre.

    Parameters: ``opacity`` (1), null 0, at most 1. ``x``, ``y``, ``z``, ``radius`` (m), scanned.

    Signature: light missing at spots and depths that lie on lines through one region.

    Degenerate with: albedo and normals of surfels that few spots see; ``wall_reflectance`` when the disc is
    near the wall.

    Source: F. Heide et al., *Non-line-of-sight imaging with partial occluders and surface normals*, ACM
    Trans. Graph. 38, 2019.
    """

    name = "occlusion"
    words = EffectWords(
        phrase="something opaque between the wall and the scene",
        cause="An object that returns no light itself shadows part of the scene for part of the wall.",
        remedy="Look for a dark object at the place given and remove it, or scan a wider part of the wall "
        "to see around it.",
        headline="{opacity} of the light, at depth {z}, radius {radius}",
    )

    laser: Tensor
    sensor: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("laser", scan.laser.clone(), persistent=False)
        self.register_buffer("sensor", scan.sensor.clone(), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        x, y = scan.centre.tolist()
        first, last = (scan.t_start + k * scan.bin_length for k in scan.gate)
        nearest, farthest = max(first, last / 8) / 2, last / 2
        half = scan.half
        steps = (-0.5 * half, 0.0, 0.5 * half)
        radius = 0.3 * half

        def across(name: str, middle: float) -> Parameter:
            low, high = middle - 2 * half, middle + 2 * half
            grid = tuple(middle + a for a in steps)
            return Parameter(name, "m", None, 0.1 * half, low, high, grid=grid, kind="length")

        def beyond(name: str, low: float, high: float, start: float) -> Parameter:
            return Parameter(name, "m", None, 0.2, low, high, grid=(start,), log=True, kind="length")

        return (
            Parameter("opacity", "1", 0.0, 0.2, 0.0, 1.0, kind="percent"),
            across("x", x),
            across("y", y),
            beyond("z", nearest / 10, farthest, nearest / 2),
            beyond("radius", radius / 20, 2 * half, radius),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"opacity": 1.0}

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        laser = self.transmission(self.laser[spots], paths.centre)
        sensor = laser if self.scan.confocal else self.transmission(self.sensor[spots], paths.centre)
        return contribution * (laser * sensor)[..., None]

    def transmission(self, wall: Tensor, centre: Tensor) -> Tensor:
        """Light that lines from the wall to the surfels keep.

        Args:
            wall: ``[B, 3]`` m, points of it.
            centre: ``[M, 3]`` m, of the surfels.

        Returns:
            ``[B, M]``, 1 where nothing is in the way.
        """
        z, radius = self.value("z"), self.value("radius")
        away = centre - wall[:, None]
        crossing = (
            wall[:, None, :2]
            + away[..., :2] * ((z - wall[:, 2, None]) / away[..., 2].clamp_min(1e-3))[..., None]
        )
        off = torch.sqrt(
            (crossing[..., 0] - self.value("x")) ** 2 + (crossing[..., 1] - self.value("y")) ** 2 + 1e-12
        )
        width = EDGE * radius
        return 1 - self.value("opacity") * torch.sigmoid((radius - off) / width) * torch.sigmoid(
            (centre[:, 2] - z) / width
        )
