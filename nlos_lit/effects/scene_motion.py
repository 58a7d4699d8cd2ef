"""Hidden scene that moves while the wall is scanned."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.smooth import SeveralWidths, SmoothEffect, fast, over_scan
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Walls

AXES = ("x", "y", "z")
SPLINES = 80  # over the scan at most: each has three coefficients


class SceneMotion(SeveralWidths, SmoothEffect):
    """The whole scene moves against the wall, without turning.

    ``p → p + d(u)`` for the scene's points, u the order of acquisition from -1 to 1, d along x, y and z a
    cubic spline each without its constant, of 80 functions (of one for every four spots where they are few),
    likely a random walk, along each axis as wide as the counts ask for. Paths are exact: the wall's points
    move the other way instead.

    Parameters: ``motion`` (m), at most 79 coefficients along each axis, null 0. Quantities ``rms`` of d's
    length, and ``range_x``, ``range_y`` and ``range_z`` from one end to the other (m).

    Signature: edges in time early or late in one stretch of the scan, the more the more the scene is seen
    along the way that it moved. A motion that swings more than 12 times during the scan is none.

    Degenerate with: ``time_drift``, from which a motion towards the wall differs only where parts of the
    scene are seen at other angles; ``line_delay``, where it moves from line to line; a scene that lies
    turned, where a steady motion goes along with the slow axis of a raster: of that, ranges say too little.

    Source: geometry.
    """

    name = "scene_motion"
    followed_by = ("free_scan_delay",)
    words = EffectWords(
        phrase="a hidden scene that moves during the scan",
        cause="What is hidden has moved between spots, or the rig and its wall have moved before it.",
        remedy="Keep scene and rig still, scan faster, or cut the scan where it moved.",
        headline="{range_z} along z, {range_x} along x, {range_y} along y",
    )
    split_by: ClassVar = dict.fromkeys(
        ("time_drift", "line_delay"),
        "the direct pulse of each spot: a time zero that drifts moves it, a scene that moves does not",
    )
    coefficients = "motion"
    components = len(AXES)
    falling: ClassVar[float] = 1.0
    slow: ClassVar[bool] = True

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.give_widths(torch.arange(len(AXES)).repeat(self.functions.shape[1]))

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        return over_scan(scan, min(SPLINES, fast(scan)))

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        step = scan.bin_length / 2
        return cls.coefficient(scan, "m", step, 0.1 * scan.n_bins * step, 4 * step, "length")

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"rms": 1.5 * scan.bin_length}

    def factors(self, spots: Tensor) -> Tensor:
        return self.functions[spots]

    def alone(self) -> Effect:
        return _Moved(self.scan)

    def walls(self, walls: Walls, spots: Tensor) -> Walls:
        return away(walls, self.field(spots))

    def quantities(self) -> dict[str, Quantity]:
        field = self.field()
        ranges = field.amax(0) - field.amin(0)
        along = {
            f"range_{axis}": Quantity(moved, "m", kind="length")
            for axis, moved in zip(AXES, ranges, strict=True)
        }
        return super().quantities() | along


class _Moved(Effect):
    """The scene lies elsewhere, at all spots alike."""

    name = "moved"

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("by", "m", 0.0, scan.bin_length / 2, -1.0, 1.0, size=len(AXES)),)

    def walls(self, walls: Walls, spots: Tensor) -> Walls:
        return away(walls, self.value("by"))


def away(walls: Walls, moved: Tensor) -> Walls:
    """Walls as a scene sees them that has moved.

    Args:
        walls: of B spots.
        moved: ``[3]`` or ``[B, 3]`` m, of the scene.

    Returns:
        walls that have moved the other way.
    """
    return walls._replace(laser=walls.laser - moved, sensor=walls.sensor - moved)
