"""Time zero that jumps between the lines of a scan."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.scan_pieces import lines
from nlos_lit.effects.smooth import SmoothEffect
from nlos_lit.effects.timing_jitter import TimingJitter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths


class LineDelay(SmoothEffect):
    """Each line of the scan begins a little early or late, and drifts until it ends.

    ``L → L + a_l + b_l v``, l the line of the spot, v its place in the line from -1 (first) to 1 (last); a, b
    independent of one line to the next, their sum zero on average over the spots.

    Parameters: ``delay`` (m of path), two coefficients a line (a, then b of all lines), null 0. Quantities
    ``rms`` and ``peak_to_peak`` (m).

    Signature: residuals of both signs at edges in time, all of one line with the same sign, neighbouring
    lines unrelated.

    Degenerate with: ``time_drift`` where it is smooth over many lines; ``scene_motion``.

    Source: W. Becker, *The bh TCSPC Handbook* (synchronisation with a scanner's line clock).
    """

    name = "line_delay"
    followed_by = ("free_scan_delay", "free_wall_delay")
    words = EffectWords(
        phrase="a time zero that jumps from line to line of the scan",
        cause="Timing starts anew with each line: the trigger, the scanner's line clock, or the way each "
        "line's records were aligned.",
        remedy="Check what is reset at the end of a line; align every line to its own direct pulse.",
        headline="{rms} rms",
    )
    split_by: ClassVar = {
        "time_drift": "a second scan with lines in the other direction",
    }
    coefficients = "delay"
    ends: ClassVar[bool] = True

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        number, place = lines(scan)
        whole = torch.nn.functional.one_hot(number).float()
        functions = torch.cat([whole, whole * place[:, None]], 1)
        return functions - functions.mean(0), torch.ones(functions.shape[1])

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        reach = 0.1 * scan.n_bins * scan.bin_length
        return cls.coefficient(scan, "m", scan.bin_length, reach, scan.bin_length)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"rms": scan.bin_length}

    def factors(self, spots: Tensor) -> Tensor:
        return self.functions[spots]

    def alone(self) -> Effect:
        return TimingJitter(self.scan)

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.field(spots)[:, None, None]
