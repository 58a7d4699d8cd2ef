"""Gloss: scene that sends more light along the mirror direction."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths


class SpecularLobe(Effect):
    """The diffuse reflectance gets a lobe about the mirror direction.

    ``K → K (1 + strength (p + 2)/2 · cos^p θh)``, θh between the normal and the half vector of the directions
    to the two wall points.

    Parameters: ``strength`` (1: as much light as the diffuse part), null 0. ``exponent`` p (1), scanned.

    Signature: bright patches on the wall, opposite to surfaces that face it; they move with the normal.

    Degenerate with: albedo of single surfels (a lobe seen from few spots), ``retroreflection``; in confocal
    scans with it alone.

    Source: J. F. Blinn, *Models of light reflection for computer synthesized pictures*, SIGGRAPH 1977.
    """

    name = "specular_lobe"
    followed_by = ("free_wall",)
    words = EffectWords(
        phrase="a glossy hidden surface",
        cause="Part of the light is reflected around the mirror direction, so spots that face the surface "
        "see it too bright.",
        remedy="Make the surface matt where you can; a non-confocal scan shows the lobe's direction.",
        headline="lobe strength {strength}",
    )

    apart: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("apart", (scan.laser - scan.sensor).square().sum(1), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (
            Parameter("strength", "1", 0.0, 0.1, 0.0, 5.0),
            Parameter("exponent", "1", None, 0.5, 1.0, 300.0, grid=(4.0, 16.0, 64.0), log=True),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"strength": 0.5}

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        one, two = paths.laser_leg, paths.sensor_leg
        # |l + s|² of the unit directions, by the law of cosines.
        square = 2 + (one**2 + two**2 - self.apart[spots][:, None, None]) / (one * two)
        half = (paths.laser_cosine + paths.sensor_cosine) / torch.sqrt(square.clamp_min(1e-6))
        exponent = self.value("exponent")
        lobe = (exponent + 2) / 2 * half.clamp(1e-4, 1.0) ** exponent
        return contribution * (1 + self.value("strength") * lobe)
