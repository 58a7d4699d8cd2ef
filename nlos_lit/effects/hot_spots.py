"""A few spots with light of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.words import EffectWords

HOT = 3.0  # standard errors of its background, by which a spot must exceed the others to count as hot


class HotSpots(Effect):
    """Some spots have a background of their own: hot pixels, a bright reflection, interference.

    ``background → background + extra_s``, extra ≥ 0 and 0 at most spots

    Parameters: ``extra`` (counts/bin), one for each spot, null 0. Quantities ``level`` (counts/bin, mean of
    the hot spots) and ``number`` (1): spots whose light exceeds what most have by three
    standard errors of counting it.

    Signature: single spots with a residual above 0 in all bins alike.

    Degenerate with: nothing that is smooth over the wall; ``ambient_map`` takes part of a cluster of hot
    spots.

    Source: none needed, a constant per spot.
    """

    name = "hot_spots"
    words = EffectWords(
        phrase="a few spots with far too much background",
        cause="Single spots look at a reflection, a status lamp, or were recorded while someone opened a "
        "door.",
        remedy="Look at these spots on the wall; mask or record them again.",
        headline="{number} spots with {level} more",
    )
    split_by: ClassVar = {
        "ambient_map": "a capture with the laser off",
    }
    per_spot = True

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        most = 1e3 * (scan.mean_counts / scan.n_bins + scan.background)
        return (Parameter("extra", "counts/bin", 0.0, scan.background, 0.0, most, size=scan.n_spots),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"level": 5 * scan.background, "number": max(1, round(0.01 * scan.n_spots))}

    def settable(self) -> dict[str, str]:
        return {"level": "counts/bin", "number": "1"}

    def draw(self, values: Mapping[str, float], rng: np.random.Generator) -> None:
        """Spots at random, each with 0.5 to 1.5 of the level.

        Args:
            values: ``level``, counts/bin on average over the hot spots, and their ``number``; what is not
                given is typical.
            rng: for the spots and their shares of the level.

        Raises:
            UserError: the level is negative or too large, or the number is not one of a few spots.
        """
        values, spots = {**self.typical(self.scan), **values}, self.scan.n_spots
        level, number = self.given_size(values, "level"), values["number"]
        if number != int(number) or not 1 <= number <= spots // 2:
            raise UserError(
                f"hot_spots.number must be a whole number from 1 to {spots // 2}, half of the scan's spots; "
                f"found {number:g}"
            )
        extra = torch.zeros(spots)
        share = rng.uniform(0.5, 1.5, int(number))
        hot = torch.from_numpy(rng.permutation(spots)[: int(number)])
        extra[hot] = torch.from_numpy(level * share / share.mean()).float()
        self.set_given("extra", extra, "level")

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        return background + self.value("extra").reshape(-1)[spots][:, None]

    def quantities(self) -> dict[str, Quantity]:
        extra = self.value("extra").reshape(-1)
        usual = extra.detach().median()  # a fit may give a part of the background to all spots
        error = ((self.scan.background + usual) / self.scan.n_bins).sqrt()
        above = extra - usual
        hot = (above > HOT * error).detach().to(extra.dtype)
        number = hot.sum()
        return {
            "level": Quantity((above * hot).sum() / number.clamp_min(1), "counts/bin"),
            "number": Quantity(number, "1", spots=True),
        }
