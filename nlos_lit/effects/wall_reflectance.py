"""Wall that is not equally white everywhere."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.smooth import SmoothEffect, over_wall
from nlos_lit.effects.words import EffectWords


class WallReflectance(SmoothEffect):
    """The wall's reflectance, or the efficiency of laser and sensor optics, varies smoothly over the wall.

    ``signal → signal · e^{f(x, y)}``, f a 12×12 tensor product of cubic splines without its constant;
    ``e^{f(laser) + f(sensor)}`` where both points move, with one f for both.

    Parameters: ``gain_map`` (1, logarithm), at most 143 coefficients, null 0. Quantity ``rms`` (1) of the
    logarithm.

    Signature: spot totals form a smooth map over the wall; the shape in time is right.

    Degenerate with: ``vignetting`` (one such map), ``power_drift`` in a raster scan, normals of a small
    scene, ``retroreflection`` of a shallow one.

    Source: splines: C. de Boor, *A Practical Guide to Splines*, 1978.
    """

    name = "wall_reflectance"
    followed_by = ("free_wall",)
    lasting = True
    words = EffectWords(
        phrase="a relay wall that is brighter in some places than in others",
        cause="Paint, stains or texture change how much light each wall point passes on.",
        remedy="Repaint the wall, or measure its gain with the direct pulse and divide by it.",
        headline="{rms} rms over the wall",
    )
    witness = "energy"
    coefficients = "gain_map"
    imitated = ("light",)

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        return over_wall(scan, 12)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return cls.coefficient(scan, "1", 0.05, 1.0, 0.5, kind="percent")

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"rms": 0.2}

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        return signal * torch.exp(self.field(spots))[:, None]
