"""Scan that is larger or smaller than the file says."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Walls


class WallScale(Effect):
    """The scanned sides are wrong by a factor each: wall points are farther from the scan's centre, or
    nearer.

    ``x → c_x + (1 + scale_x)(x - c_x)``, y alike, for the laser's and the sensor's points, c the scan's
    centre; all paths start and end there.

    Parameters: ``scale_x``, ``scale_y`` (1), null 0: each mirror of a scanner has a gain of its own.

    Signature: the delay over the wall is curved more than the file's points allow, or less, about the point
    before each part of the scene; at the wall's edges most.

    Degenerate with: the scene's own size together with its depth; ``clock_scale`` and ``time_offset``, which
    change the depth that fits; ``vignetting``, as to the light by itself.

    Source: geometry.

    Examples:
        >>> from nlos_lit.effects.nominal import nominal_scan
        >>> scan = nominal_scan()
        >>> wall = WallScale(scan)
        >>> wall.set("scale_x", 0.1)
        >>> scan.laser[0].tolist(), wall.real(scan.laser)[0].detach().tolist()
        ([-0.5, -0.5, 0.0], [-0.550000011920929, -0.5, 0.0])
    """

    name = "wall_scale"
    imitated = ("geometry",)
    followed_by = ("free_wall_delay",)
    lasting = True
    words = EffectWords(
        phrase="a scan that is larger or smaller than stated",
        cause="The sides of the scanned square were measured wrongly, or the scanner's angles are not what "
        "they are taken for.",
        remedy="Measure the distance between two far corners of the scan on the wall and give the true "
        "points.",
        headline="{scale_x} longer along x than stated, {scale_y} along y",
    )
    split_by: ClassVar = {
        "clock_scale": "the distance between two corners of the scan, measured on the wall",
    }

    centre: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("centre", scan.centre.clone(), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        names = ("scale_x", "scale_y")
        return tuple(Parameter(name, "1", 0.0, 0.01, -0.3, 0.3, kind="percent") for name in names)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"scale_x": 0.05, "scale_y": 0.03}

    def walls(self, walls: Walls, spots: Tensor) -> Walls:
        return walls._replace(laser=self.real(walls.laser), sensor=self.real(walls.sensor))

    def real(self, wall: Tensor) -> Tensor:
        """Where stated wall points really are.

        Args:
            wall: ``[B, 3]`` m, stated.

        Returns:
            ``[B, 3]`` m.
        """
        longer = torch.stack([self.value("scale_x"), self.value("scale_y")])
        return wall + torch.nn.functional.pad(longer * (wall[:, :2] - self.centre), (0, 1))
