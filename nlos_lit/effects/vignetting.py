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
    """Spots away from the middle of the scanned wall are darker (or, with the other sign, brighter).

    ``signal → signal · e^{-strength |x|²}``, x the spot's place in [-1, 1]²; |x|² of laser and sensor added
    where both move.

    Parameters: ``strength`` (1), null 0, of either sign.

    Signature: spot totals fall off radially from the wall's centre; the shape in time is right.

    Degenerate with: ``wall_reflectance`` (any smooth map), ``retroreflection`` of a shallow scene before the
    wall's centre, normals.

    Source: to second order the cos⁴ law of lenses: B. K. P. Horn, *Robot Vision*, 1986, ch. 10.
    """

    name = "vignetting"
    followed_by = ("free_wall",)
    words = EffectWords(
        phrase="a brightness that changes from the middle of the scan to its edge",
        cause="Lens, mirrors or an aperture pass less light at the edge of the field.",
        remedy="Open the aperture, re-centre the optics, or measure a flat field.",
        headline="{strength} darker at the edge (log gain)",
    )
    split_by: ClassVar = {
        "wall_reflectance": "a capture with the optics shifted against the wall",
        "retroreflection": "a target of known reflectance, or a non-confocal scan",
    }
    witness = "energy"

    square: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        squares = [place.square().sum(1) for place in scan.places]
        self.register_buffer("square", sum(squares[1:], squares[0]), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("strength", "1", 0.0, 0.05, -2.0, 2.0, kind="percent"),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"strength": 0.4}

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        return signal * torch.exp(-self.value("strength") * self.square[spots])[:, None]
