"""Optics that lose light away from their axis."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords


class Vignetting(Effect):
    """Spots away from the axis of the optics are darker.

    ``signal → signal · (1 + strength |x - c|²/2)^{-2}``, the cos⁴ of the angle to the axis; x is the spot's
    place and c where the axis meets the wall, both in half sides of the scan; the product of laser's and
    sensor's where both move.

    Parameters: ``strength`` (1), null 0: about how much of the logarithm is lost half a side from the axis.
    ``x``, ``y`` (m): where the axis meets the wall, in the scan; begun at its middle.

    Signature: spot totals fall off radially from a point of the wall; the shape in time is right.

    Degenerate with: ``wall_reflectance`` (any smooth map), ``retroreflection`` of a shallow scene before the
    axis, normals.

    Source: the cos⁴ law of lenses: B. K. P. Horn, *Robot Vision*, 1986, ch. 10.
    """

    name = "vignetting"
    followed_by = ("free_wall",)
    words = EffectWords(
        phrase="a brightness that falls off around the axis of the optics",
        cause="Lens, mirrors or an aperture pass less light at the edge of the field.",
        remedy="Open the aperture, re-centre the optics, or measure a flat field.",
        headline="about {strength} darker half a side of the scan from the axis, which is at {x}, {y}",
    )
    split_by: ClassVar = {
        "wall_reflectance": "a capture with the optics shifted against the wall",
        "retroreflection": "a target of known reflectance, or a non-confocal scan",
    }
    witness = "energy"

    places: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.middle = scan.centre.tolist()
        self.register_buffer("places", torch.stack(scan.places), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        half = scan.half
        axis = (
            Parameter(name, "m", None, 0.1 * half, at - half, at + half, grid=(at,), kind="length")
            for name, at in zip("xy", scan.centre.tolist(), strict=True)
        )
        return (Parameter("strength", "1", 0.0, 0.05, 0.0, 2.0, kind="percent"), *axis)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"strength": 0.4}

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        x, y = ((self.value(n) - at) / self.scan.half for n, at in zip("xy", self.middle, strict=True))
        square = (self.places[:, spots] - torch.stack([x, y])).square().sum(2)
        lost = torch.log1p(0.5 * self.value("strength") * square).sum(0)
        return signal * torch.exp(-2 * lost)[:, None]
