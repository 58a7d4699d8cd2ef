"""Scan that is larger or smaller than the file says."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths


class WallScale(Effect):
    """The scanned side is wrong by a factor: all wall points are farther from the scan's centre, or nearer.

    ``x → c + (1 + scale)(x - c)`` for the laser's and the sensor's points x, c the scan's centre: ``d → |p -
    x|`` in the length and throughput (d⁻², both cosines) of both legs, worked out at the surfels' centres.

    Parameters: ``scale`` (1), null 0.

    Signature: the delay over the wall is curved more than the file's points allow, or less, about the point
    before each part of the scene; at the wall's edges most.

    Degenerate with: the scene's own size together with its depth; ``clock_scale`` and ``time_offset``, which
    change the depth that fits; ``vignetting``, as to the light by itself.

    Source: geometry.

    Examples:
        >>> from nlos_lit.effects.nominal import nominal_scan
        >>> scan = nominal_scan()
        >>> wall = WallScale(scan)
        >>> wall.set("scale", 0.1)
        >>> scan.laser[0].tolist(), wall.real(scan.laser)[0].detach().tolist()
        ([-0.5, -0.5, 0.0], [-0.550000011920929, -0.550000011920929, 0.0])
    """

    name = "wall_scale"
    followed_by = ("free_wall_delay",)
    lasting = True
    words = EffectWords(
        phrase="a scan that is larger or smaller than stated",
        cause="The side of the scanned square was measured wrongly, or the scanner's angles are not what "
        "they are taken for.",
        remedy="Measure the distance between two far corners of the scan on the wall and give the true "
        "points.",
        headline="sides {scale} longer than stated",
    )
    split_by: ClassVar = {
        "clock_scale": "the distance between two corners of the scan, measured on the wall",
    }

    laser: Tensor
    sensor: Tensor
    centre: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("laser", scan.laser.clone(), persistent=False)
        self.register_buffer("sensor", scan.sensor.clone(), persistent=False)
        self.register_buffer("centre", scan.centre.clone(), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("scale", "1", 0.0, 0.01, -0.3, 0.3, kind="percent"),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"scale": 0.05}

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        laser = self.brighter(self.laser[spots], paths)
        sensor = laser if self.scan.confocal else self.brighter(self.sensor[spots], paths)
        return contribution * (laser * sensor)

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        laser = self.longer(self.laser[spots], paths)
        sensor = laser if self.scan.confocal else self.longer(self.sensor[spots], paths)
        return length + (laser + sensor)

    def real(self, wall: Tensor) -> Tensor:
        """Where stated wall points really are.

        Args:
            wall: ``[B, 3]`` m, stated.

        Returns:
            ``[B, 3]`` m.
        """
        return wall + torch.nn.functional.pad(self.value("scale") * (wall[:, :2] - self.centre), (0, 1))

    def legs(self, wall: Tensor, paths: Paths) -> tuple[Tensor, Tensor]:
        """From stated and from real wall points to the surfels' centres.

        Args:
            wall: ``[B, 3]`` m, stated.
            paths: for the centres.

        Returns:
            Both ``[B, M, 3]`` m.
        """
        return paths.centre - wall[:, None], paths.centre - self.real(wall)[:, None]

    def longer(self, wall: Tensor, paths: Paths) -> Tensor:
        """By how much legs get longer.

        Args:
            wall: ``[B, 3]`` m, stated.
            paths: for the centres.

        Returns:
            ``[B, M, 1]`` m.
        """
        stated, real = self.legs(wall, paths)
        return (real.norm(dim=2) - stated.norm(dim=2))[..., None]

    def brighter(self, wall: Tensor, paths: Paths) -> Tensor:
        """What a leg's throughput is multiplied by.

        Args:
            wall: ``[B, 3]`` m, stated.
            paths: for centres and normals.

        Returns:
            ``[B, M, 1]``.
        """
        both = self.legs(wall, paths)
        stated, real = (-(leg * paths.normal).sum(2).clamp_max(-1e-6) for leg in both)
        near, far = (leg.square().sum(2) for leg in both)
        return (real / stated * (near / far) ** 2)[..., None]
