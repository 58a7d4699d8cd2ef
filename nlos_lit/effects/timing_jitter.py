"""Time axis that jumps from spot to spot."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect, Parameter, Quantity
from nlos_lit.effects.smooth import length as euclidean
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
    stage = "time"
    needs_paths = True
    per_spot = True

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        reach = 0.1 * scan.n_bins * scan.bin_length
        return (Parameter("offset", "m", 0.0, scan.bin_length, -reach, reach, size=scan.n_spots),)

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.value("offset").reshape(-1)[spots][:, None, None]

    def quantities(self) -> dict[str, Quantity]:
        offset, scale = self.value("offset").reshape(-1), self.declared["offset"].scale
        if self.width:
            return {"sigma": Quantity(offset.new_tensor(self.width * scale), "m")}
        spots = (offset != 0).sum().clamp_min(1)  # those of other spots stay at 0
        return {"sigma": Quantity(euclidean(offset / spots**0.5, scale), "m")}
