"""Time axis that jumps from spot to spot."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.smooth import length as euclidean
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths


class TimingJitter(Effect):
    """Every spot's record starts a little early or late, as when the trigger is set anew at each.

    ``L → L + δ_s``, ``δ_s ~ N(0, σ²)``, independent

    Parameters: ``offset`` δ (m of path), one for each spot, null 0. Quantity ``sigma`` (m): the width of
    their distribution where it was fitted, else the root mean square of those that are not exactly 0.

    Signature: residuals of both signs at edges in time, all of one spot with the same sign, neighbouring
    spots unrelated.

    Degenerate with: nothing smooth; a wide response (``sigma_ls``) when spots are summed.

    Source: W. Becker, *The bh TCSPC Handbook* (jitter of the synchronisation).
    """

    name = "timing_jitter"
    words = EffectWords(
        phrase="a time zero that jumps from spot to spot",
        cause="Each spot's histogram starts at a slightly different time: trigger, scanner settling, or "
        "per-spot alignment.",
        remedy="Check the synchronisation between scanner and timing electronics; align every spot to its "
        "own direct pulse.",
        headline="σ = {sigma}",
    )
    witness = "delay"
    per_spot = True

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        reach = 0.1 * scan.n_bins * scan.bin_length
        return (Parameter("offset", "m", 0.0, scan.bin_length, -reach, reach, size=scan.n_spots),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"sigma": scan.bin_length}

    def settable(self) -> dict[str, str]:
        return {"sigma": "m"}

    def draw(self, values: Mapping[str, float], rng: np.random.Generator) -> None:
        """Normal deviates of the width given, one for each spot.

        Args:
            values: ``sigma``, m of path.
            rng: for the deviates.

        Raises:
            UserError: it is negative or too large.
        """
        sigma = self.given_size(values, "sigma")
        drawn = torch.from_numpy(sigma * rng.standard_normal(self.scan.n_spots))
        self.set_given("offset", drawn, "sigma")

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.value("offset").reshape(-1)[spots][:, None, None]

    def quantities(self) -> dict[str, Quantity]:
        offset, scale = self.value("offset").reshape(-1), self.declared["offset"].scale
        if self.width:
            return {"sigma": Quantity(offset.new_tensor(self.width * scale), "m")}
        spots = (offset != 0).sum().clamp_min(1)  # those of other spots stay at 0
        return {"sigma": Quantity(euclidean(offset / spots**0.5, scale), "m")}
