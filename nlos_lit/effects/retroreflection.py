"""Scene that sends light back to where it came from."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths

STEEPEST = 3.0  # tan² of the angle (60°) beyond which the loss stays: its derivative is to stay finite


class Retroreflection(Effect):
    """Brightness falls more slowly with distance than from diffuse surfaces, and otherwise with the tilt.

    ``d1⁻² d2⁻² cosθ2 cosθ3 → (d1 d2)^{-falloff/2} d0^{falloff-4} (cosθ2 cosθ3)^cosine e^{-entrance tan⁴θ}``,
    d0 half the path at the middle of the gate, ``cos²θ = cosθ2 cosθ3``.

    Parameters: ``falloff`` (1), null 4; 2 for a confocal retroreflector that sends all light back to the
    spot, more where it returns in a wider cone. It may pass the null by a little only: brighter near than a
    diffuse surface nothing is. ``cosine`` (1), null 1; 0 for one without foreshortening. ``entrance`` (1),
    null 0: beads and prisms of sheeting send back less of what enters at an angle. White sheeting keeps
    at 30° at least 43 % (type I), 60 % (III) of what it sends back at 4°; a diffuse surface keeps 75 %.

    Signature: with a large wall, a smooth map over wall positions and depths: far spots are too bright.

    Degenerate with: ``vignetting`` and ``wall_reflectance`` when the scene is shallow (one distance per
    spot), ``specular_lobe``.

    Source: M. O'Toole, D. B. Lindell, G. Wetzstein, *Confocal non-line-of-sight imaging based on the
    light-cone transform*, Nature 555, 2018: r⁻⁴ for diffuse, r⁻² for retroreflective scenes.
    ASTM D4956-01, *Standard specification for retroreflective sheeting for traffic control*: least
    coefficients of retroreflection at entrance angles of -4° and 30°.
    """

    name = "retroreflection"
    followed_by = ("free_wall",)
    words = EffectWords(
        phrase="a retroreflecting hidden surface",
        cause="The surface sends light back to where it came from (tape, signs, safety vests): brightness "
        "falls more slowly with distance, and otherwise with the angle.",
        remedy="Cover the retroreflective parts, or keep the fitted exponents; a non-confocal scan is far "
        "less sensitive to it.",
        headline="falloff exponent {falloff} instead of 4, cosine exponent {cosine} instead of 1, "
        "a loss of {entrance} tan⁴ of the angle",
    )
    split_by: ClassVar = {
        "wall_reflectance": "the direct pulse's energy over the wall, or a non-confocal scan",
    }
    imitated = ("light",)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (
            Parameter("falloff", "1", 4.0, 0.2, 1.5, 4.2),
            Parameter("cosine", "1", 1.0, 0.2, -0.2, 3.0),
            Parameter("entrance", "1", 0.0, 0.2, 0.0, 8.0),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"falloff": 2.0, "cosine": 0.0}

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        distance = paths.laser_leg * paths.sensor_leg / (self.scan.middle / 2) ** 2
        # Grazing surfels carry no light; the clamp keeps a power below 0 finite for them.
        cosines = (paths.laser_cosine * paths.sensor_cosine).clamp_min(1e-6)
        exponent = (4 - self.value("falloff")) / 2
        steepness = (1 / cosines - 1).clamp(0.0, STEEPEST) ** 2
        return contribution * torch.exp(
            exponent * torch.log(distance)
            + (self.value("cosine") - 1) * torch.log(cosines)
            - self.value("entrance") * steepness
        )
