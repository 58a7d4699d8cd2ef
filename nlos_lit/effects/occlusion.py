"""Something black between wall and scene."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Asked, Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths

EDGE = 0.12  # width of the soft edge, in radii
DEPTHS = (0.2, 0.3, 0.45, 0.7, 1.0)  # of the nearest light's, at which a disc is looked for …
RADII = (0.12, 0.2, 0.33, 0.55)  # … of half the wall, that it is tried with
LEAST = 0.05  # of the most light that a disc may hide: it must hide so much
FINE = 2  # cells a smallest radius, of the picture of what the planes hide


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
    followed_by = ("free_wall",)
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

        def across(name: str, middle: float) -> Parameter:
            low, high = middle - 2 * half, middle + 2 * half
            return Parameter(name, "m", None, 0.1 * half, low, high, grid=(middle,), kind="length")

        def beyond(name: str, low: float, high: float, *grid: float) -> Parameter:
            return Parameter(name, "m", None, 0.2, low, high, grid=grid, log=True, kind="length")

        return (
            Parameter("opacity", "1", 0.0, 0.2, 0.0, 1.0, kind="percent"),
            across("x", x),
            across("y", y),
            beyond("z", nearest / 10, farthest, *(share * nearest for share in DEPTHS)),
            beyond("radius", 0.015 * half, 2 * half, *(share * half for share in RADII)),
        )

    def shape_grid(self) -> list[dict[str, float]]:
        """Discs a radius apart in each plane, as far as the wall reaches."""
        x, y = self.scan.centre.tolist()
        found = []
        for shape in super().shape_grid():
            steps = math.ceil(self.scan.half / shape["radius"])
            along = [k / steps * self.scan.half for k in range(-steps, steps + 1)]
            found += [shape | {"x": x + a, "y": y + b} for a in along for b in along]
        return found

    def likely_shapes(self, asked: Asked) -> list[dict[str, float]]:
        """In each plane and of each radius the disc that would hide what there is too much of.

        Where legs cross a plane, less light is asked for, or more; a disc hides what crosses it. So one
        picture of the plane, smoothed by the disc, tells of all its places.

        Args:
            asked: of each path.

        Returns:
            one shape a plane and radius.
        """
        depths, radii = (self.declared[name].grid for name in ("z", "radius"))
        cell, device = min(radii) / FINE, asked.excess.device
        reach = math.ceil(self.scan.half / cell)
        side = 2 * reach + 1
        corner = self.scan.centre.to(device) - (reach + 0.5) * cell
        found = []
        for z in depths:
            picture = torch.zeros(2, side * side, device=device)
            for wall in self._walls():
                place = ((_crossing(wall[asked.spots], asked.centre, z) - corner) / cell).floor().long()
                inside = ((place >= 0) & (place < side)).all(2) & (asked.centre[:, 2] > z)
                where = (place[..., 0] * side + place[..., 1])[inside]
                for row, values in zip(picture, (asked.excess, asked.light), strict=True):
                    row.index_add_(0, where, values[inside])
            for radius in radii:
                line = torch.arange(-(n := math.ceil(radius / cell)), n + 1, device=device) * cell
                off = torch.sqrt(line[:, None] ** 2 + line**2)
                disc = torch.sigmoid((radius - off) / (EDGE * radius))[None, None]
                excess, light = torch.nn.functional.conv2d(
                    picture.view(2, 1, side, side), disc, padding=n
                ).flatten(1)
                worth = excess.clamp_min(0) ** 2 / light.clamp_min(LEAST * float(light.max()) + 1e-30)
                best = int(worth.argmax())
                x, y = (float(corner[k]) + (at + 0.5) * cell for k, at in enumerate(divmod(best, side)))
                found.append({"x": x, "y": y, "z": z, "radius": radius})
        return found

    def _walls(self) -> tuple[Tensor, ...]:
        """``[S, 3]`` m, where legs begin."""
        return (self.laser,) if self.scan.confocal else (self.laser, self.sensor)

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
        crossing = _crossing(wall, centre, z)
        off = torch.sqrt(
            (crossing[..., 0] - self.value("x")) ** 2 + (crossing[..., 1] - self.value("y")) ** 2 + 1e-12
        )
        width = EDGE * radius
        return 1 - self.value("opacity") * torch.sigmoid((radius - off) / width) * torch.sigmoid(
            (centre[:, 2] - z) / width
        )


def _crossing(wall: Tensor, centre: Tensor, z: Tensor | float) -> Tensor:
    """``[B, M, 2]`` where lines from wall points ``[B, 3]`` to surfels ``[M, 3]`` cross the plane z, m."""
    away = centre - wall[:, None]
    share = (z - wall[:, 2, None]) / away[..., 2].clamp_min(1e-3)
    return wall[:, None, :2] + away[..., :2] * share[..., None]
