"""Something black between wall and scene."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect, Parameter
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
    stage = "path"
    needs_paths = True

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
        across = (-0.5 * half, 0.0, 0.5 * half)
        radius = 0.3 * half
        return (
            Parameter("opacity", "1", 0.0, 0.2, 0.0, 1.0),
            Parameter(
                "x", "m", None, 0.1 * half, x - 2 * half, x + 2 * half, grid=tuple(x + a for a in across)
            ),
            Parameter(
                "y", "m", None, 0.1 * half, y - 2 * half, y + 2 * half, grid=tuple(y + a for a in across)
            ),
            Parameter("z", "m", None, 0.2, nearest / 10, farthest, grid=(nearest / 2,), log=True),
            Parameter("radius", "m", None, 0.2, radius / 20, 2 * half, grid=(radius,), log=True),
        )

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        laser = self.transmission(self.laser[spots], paths.centre)
        sensor = laser if self.scan.confocal else self.transmission(self.sensor[spots], paths.centre)
        return contribution * (laser * sensor)[..., None]

    def transmission(self, wall: Tensor, centre: Tensor) -> Tensor:
        """``[B, M]`` of the lines from ``wall`` ``[B, 3]`` to ``centre`` ``[M, 3]``."""
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
