"""Wrong zero of the time axis."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect, Parameter
from nlos_lit.functional.surfel_paths import Paths


class TimeOffset(Effect):
    """All light is recorded later than the geometry says.

    ``L → L + offset``

    Parameters: ``offset`` (m of path), null 0.

    Signature: lines of equal delay are not the right ellipsoids: depths and curvature disagree between near
    and far spots.

    Degenerate with: the scene's depth: only the curvature over the wall tells them apart, so that little
    information is retained; ``clock_scale``.

    Source: W. Becker, *The bh TCSPC Handbook* (delay of cables and detector).
    """

    name = "time_offset"
    stage = "time"
    needs_paths = True

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        reach = 0.25 * scan.n_bins * scan.bin_length
        return (Parameter("offset", "m", 0.0, scan.bin_length, -reach, reach),)

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.value("offset")
