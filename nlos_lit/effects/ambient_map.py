"""Ambient light that is not the same all over the wall."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.smooth import SmoothEffect, over_wall
from nlos_lit.effects.words import EffectWords


class AmbientMap(SmoothEffect):
    """The constant background varies smoothly over the wall, as with a lamp on one side.

    ``background → background · e^{f(x, y)}``, f a 5×5 tensor product of cubic splines without its constant;
    of both points, added, where both laser and sensor move.

    Parameters: ``level_map`` (1, logarithm), at most 24 coefficients, null 0. Quantity ``rms`` (1) of the
    logarithm.

    Signature: the level before the first return forms a smooth map over the wall.

    Degenerate with: nothing where the gate holds bins without scene; else ``irf_tail`` with
    ``wall_reflectance``.

    Source: splines: C. de Boor, *A Practical Guide to Splines*, 1978.
    """

    name = "ambient_map"
    followed_by = ("free_wall_background",)
    words = EffectWords(
        phrase="a background that differs over the wall",
        cause="Lamps, windows or screens light parts of the wall.",
        remedy="Shield the wall or use a narrower filter; keep the map where you cannot.",
        headline="{rms} rms over the wall",
    )
    coefficients = "level_map"
    imitated = ("light",)

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        return over_wall(scan, 5)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return cls.coefficient(scan, "1", 0.1, 1.5, 0.7, kind="percent")

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"rms": 0.3}

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        return background * torch.exp(self.field(spots))[:, None]
