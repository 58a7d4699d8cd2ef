"""A few spots whose gate opens late."""

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

LATE = 0.25  # of the largest share lost: from there on a spot's gate counts as late
MOST_STARTS = 200


class SpotGate(Effect):
    """Some spots have a gate of their own, which opens later: they record little or nothing before.

    ``m'_t = m_t (1 - lost_s before_t)``, the background included, before_t the part of bin t that lies before
    ``start``; lost ≥ 0 and 0 at most spots.

    Parameters: ``lost`` (1): share of the counts before the start, one for each spot, null 0, at most 1.
    ``start`` (bins, from the record's first on), scanned at up to 200 bins of the gate. Quantities ``share``
    (1, mean of the late spots' lost) and ``number`` (1): spots that lose at least a quarter of what the
    worst one loses.

    Signature: single spots, or a run of them in the order of acquisition, with a residual below 0 in every
    bin up to the same one and none from there on.

    Degenerate with: ``gate_edges`` with a wide start (which all spots share, and which has no sharp end);
    ``occlusion`` where a spot's light ends before the start.

    Source: none needed, a step. Gated detectors: M. Buttafava et al., *Non-line-of-sight imaging using a
    time-gated single photon avalanche diode*, Opt. Express 23, 2015.

    Examples:
        >>> from nlos_lit.effects.nominal import nominal_scan
        >>> gate = SpotGate(nominal_scan())
        >>> gate.set_all({"lost": 0.8, "start": 60.25})
        >>> gate.counting(torch.full((1, 200), 10.0), torch.tensor([0]))[0, 59:62].detach().round(decimals=3)
        tensor([ 2.,  8., 10.])
    """

    name = "spot_gate"
    words = EffectWords(
        phrase="a few spots whose gate opens late",
        cause="At some spots the gate's delay was another one, or an earlier part of the record was lost.",
        remedy="Open the gate at the same delay everywhere, or leave these spots' early bins out as not "
        "recorded.",
        headline="{number} spots that lose {share} before bin {start}",
    )
    split_by: ClassVar = {
        "gate_edges": "steady light on the wall: it shows every spot's own gate",
    }
    per_spot = True
    in_runs = True

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        first, last = scan.gate
        count = max(1, min(MOST_STARTS, last - first - 1))
        starts = tuple(first + (last - first) * (k + 1) / (count + 1) for k in range(count))
        return (
            Parameter("lost", "1", 0.0, 0.2, 0.0, 1.0, size=scan.n_spots, kind="percent"),
            Parameter("start", "bins", None, 1.0, float(first), float(last), grid=starts),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"share": 1.0, "number": max(1, round(0.01 * scan.n_spots))}

    def settable(self) -> dict[str, str]:
        return {"share": "1", "number": "1", "start": "bins"}

    def draw(self, values: Mapping[str, float], rng: np.random.Generator) -> None:
        """Spots at random, all with the same share.

        Args:
            values: ``share`` lost, ``number`` of spots, and ``start``; what is not given is typical, the
                start the present one.
            rng: for the spots.

        Raises:
            UserError: the share or the start is out of bounds, or the number is not one of spots.
        """
        values, spots = {**self.typical(self.scan), **values}, self.scan.n_spots
        number = values["number"]
        if number != int(number) or not 1 <= number <= spots:
            raise UserError(
                f"spot_gate.number must be a whole number from 1 to the scan's {spots} spots;"
                f" found {number:g}"
            )
        self.set_given("lost", torch.tensor(self.given_size(values, "share"), dtype=torch.float64), "share")
        lost = torch.zeros(spots)
        lost[torch.from_numpy(rng.permutation(spots)[: int(number)])] = values["share"]
        self.set("lost", lost)
        if "start" in values:
            self.set_given("start", torch.tensor(values["start"], dtype=torch.float64), "start")

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        bins = torch.arange(expected.shape[1], dtype=expected.dtype, device=expected.device)
        before = (self.value("start") - bins).clamp(0, 1)
        return expected * (1 - self.value("lost").reshape(-1)[spots][:, None] * before)

    def quantities(self) -> dict[str, Quantity]:
        lost = self.value("lost").reshape(-1)
        late = ((lost > 0) & (lost >= LATE * lost.max())).detach().to(lost.dtype)
        number = late.sum()
        return {
            "share": Quantity((lost * late).sum() / number.clamp_min(1), "1", kind="percent"),
            "number": Quantity(number, "1", spots=True),
            "start": Quantity(self.value("start"), "bins"),
        }
