"""A few spots with light of their own."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect, Parameter, Quantity

HOT = 0.25  # of the hottest spot: from there on a spot counts as hot


class HotSpots(Effect):
    """Some spots have a constant background of their own: hot pixels, a bright reflection, interference
    during their exposure.

    ``background → background + extra_s``, extra ≥ 0 and 0 at most spots

    Parameters: ``extra`` (counts/bin), one for each spot, null 0. Quantities ``level`` (counts/bin, mean of
    the hot spots) and ``number`` (1): spots of at least a quarter of the hottest one's extra.

    Signature: single spots with a residual above 0 in all bins alike.

    Degenerate with: nothing that is smooth over the wall; ``ambient_map`` takes part of a cluster of hot
    spots.

    Source: none needed, a constant per spot.
    """

    name = "hot_spots"
    stage = "spot"
    per_spot = True

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        typical = scan.mean_counts / scan.n_bins + scan.background
        return (
            Parameter("extra", "counts/bin", 0.0, scan.background, 0.0, 1e3 * typical, size=scan.n_spots),
        )

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        return background + self.value("extra").reshape(-1)[spots][:, None]

    def quantities(self) -> dict[str, Quantity]:
        extra = self.value("extra").reshape(-1)
        hot = ((extra > 0) & (extra >= HOT * extra.max())).detach().to(extra.dtype)
        number = hot.sum()
        return {
            "level": Quantity((extra * hot).sum() / number.clamp_min(1), "counts/bin"),
            "number": Quantity(number, "1", spots=True),
        }
