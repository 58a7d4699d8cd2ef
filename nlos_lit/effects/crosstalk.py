"""Light of a spot in the record of a later one."""

from __future__ import annotations

import copy
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords

FARTHEST = 8  # spots


class Crosstalk(Effect):
    """A share of what a spot records comes again in the record of the spot that is taken ``lag`` spots later.

    ``m'_s = m_s + leak · light_{s - lag}``, s in the order of acquisition, nothing before the first spot;
    between whole lags light is interpolated linearly.

    ``light`` is what is known of all spots beforehand (:attr:`Scan.light`): the capture's own counts with
    their noise, unless :meth:`settle` or the scan puts a model's expected counts in their place. Counts also
    hold whatever a model lacks; as neighbours lack the same, they then ask for crosstalk where there is none.

    Parameters: ``leak`` (1), null 0. ``lag`` (1): spots, scanned from 1 to 8.

    Signature: a dim second scene, moved along the scan by lag spots; at the start of every row of a raster
    scan it is that of the end of the row before.

    Degenerate with: a second, dim scene and, for a smooth one, a shift of the whole along the scan
    (``laser_sensor_baseline``), but for the starts of rows; where ``light`` is the capture's own counts,
    with anything the model lacks that neighbouring spots share.

    Source: none needed, linear in the light.

    Examples:
        Spots that record 1, 2, 4 and 8 in every bin, one after the other:

        >>> import dataclasses
        >>> from nlos_lit.effects.nominal import nominal_scan
        >>> talk = Crosstalk(dataclasses.replace(nominal_scan(), rank=torch.linspace(-1, 1, 4)))
        >>> talk.settle(torch.tensor([1.0, 2.0, 4.0, 8.0])[:, None].expand(4, 200))
        >>> talk.set_all({"leak": 0.5, "lag": 2.0})
        >>> talk.counting(talk.light, torch.arange(4))[:, 0].detach()
        tensor([1.0000, 2.0000, 4.5000, 9.0000])
    """

    name = "crosstalk"
    followed_by = ("free_response_scan",)
    words = EffectWords(
        phrase="light of an earlier spot in a spot's record",
        cause="The mirrors still move, or the counter still holds what it counted, when a spot's record "
        "begins.",
        remedy="Wait between spots until the mirrors rest and the counter is cleared; scan in another order "
        "and compare.",
        headline="{leak} of the light of the spot {lag} before",
    )
    split_by: ClassVar = {
        "laser_sensor_baseline": "a second scan in another order",
    }

    light: Tensor
    place: Tensor
    sequence: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        light = np.zeros((scan.n_spots, scan.n_bins)) if scan.light is None else scan.light
        self.register_buffer(
            "light", torch.from_numpy(light[:, : scan.n_bins].astype(np.float32)), persistent=False
        )
        sequence = scan.rank.argsort()
        self.register_buffer("sequence", sequence, persistent=False)
        self.register_buffer("place", sequence.argsort(), persistent=False)

    def __deepcopy__(self, memo: dict[int, Any]) -> Crosstalk:
        # Nothing writes into the light of all spots, which is large: copies share it.
        memo[id(self.light)] = self.light
        again = type(self).__new__(type(self))
        memo[id(self)] = again
        vars(again).update(copy.deepcopy(vars(self), memo))
        return again

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        lags = tuple(float(k) for k in range(1, max(1, min(FARTHEST, scan.n_spots - 1)) + 1))
        return (
            Parameter("leak", "1", 0.0, 0.05, 0.0, 0.9, kind="percent"),
            Parameter("lag", "1", None, 1.0, 1.0, FARTHEST + 1.0, grid=lags),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"leak": 0.1}

    def settle(self, expected: Tensor) -> None:
        """The light of all spots is that, and no longer what the capture counted.

        Args:
            expected: ``[S, T]`` counts without crosstalk; of the last T bins up to the gate's end.
        """
        missing = self.scan.n_bins - expected.shape[1]
        self.light = torch.nn.functional.pad(expected.detach(), (missing, 0)).to(self.light)

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        lag = self.value("lag")
        whole = lag.detach().floor()
        part, k = lag - whole, whole.long()
        before = (1 - part) * self.earlier(spots, k) + part * self.earlier(spots, k + 1)
        return expected + self.value("leak") * before

    def earlier(self, spots: Tensor, lag: Tensor) -> Tensor:
        """Light of the spots that were taken ``lag`` spots before.

        Args:
            spots: ``[B]`` indices into the scan.
            lag: spots, a whole number.

        Returns:
            ``[B, T]`` counts per bin; zeros where there was no spot yet.
        """
        place = self.place[spots] - lag
        return self.light[self.sequence[place.clamp_min(0)]] * (place >= 0)[:, None]
