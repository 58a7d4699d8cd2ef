"""Wrong zero of the time axis."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
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
    imitated = ("geometry",)
    followed_by = ("free_wall_delay",)
    lasting = True
    words = EffectWords(
        phrase="a wrong time zero",
        cause="Cables, trigger or a re-zeroed histogram shift all arrival times by the same amount.",
        remedy="Measure the arrival of the direct pulse at a known distance and correct the start of the "
        "time axis.",
        headline="{offset} late everywhere",
    )

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        reach = 0.25 * scan.n_bins * scan.bin_length
        return (Parameter("offset", "m", 0.0, scan.bin_length, -reach, reach),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"offset": 4 * scan.bin_length}

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.value("offset")
