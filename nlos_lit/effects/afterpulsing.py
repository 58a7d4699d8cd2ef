"""Counts that cause later counts."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.two_parts import quicker_part, share_left
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import convolve, geometric


class Afterpulsing(Effect):
    """Carriers trapped during an avalanche are released later and count again.

    ``m'_t = m_t + probability · Σ_{s<t} m_s p_{t-s}``, ``Σ_k p_k = 1``, ``p_k`` a sum of ``e^{-k/τ}`` of
    one or two kinds of traps; only counts of this record matter.

    Parameters: ``probability`` (1), null 0. ``decay`` τ (m of path), scanned. ``quick`` q (1): share of those
    of quicker traps, fitted along from 0 on; those of the others, ``slow``, are reported, too.
    ``quick_decay`` τ₂ (m of path).

    Signature: excess behind every strong return, as with ``irf_tail``, and energy is gained; the background
    rises along the record.

    Degenerate with: ``irf_tail`` (the same decay, but energy is kept and the background stays flat).

    Source: S. Cova, A. Lacaita, G. Ripamonti, *Trapping phenomena in avalanche photodiodes on nanosecond
    scale*, IEEE Electron Device Lett. 12, 1991.
    """

    name = "afterpulsing"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="afterpulsing (counts that trigger further counts)",
        cause="Carriers trapped in the detector are released later and are counted again.",
        remedy="Lengthen the hold-off time, lower the excess bias, or warm the detector a little.",
        headline="{slow} of the counts, τ = {decay}",
    )
    split_by: ClassVar = {
        "irf_tail": "a dark or ambient-only record: afterpulses follow background counts, a slow tail does "
        "not",
        "background_slope": "a capture with the laser off",
    }
    witness = "tail"

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        bins = scan.bin_length
        decays = geometric(4 * bins, 0.75 * bins * scan.n_bins, 7)
        return (
            Parameter("probability", "1", 0.0, 0.05, 0.0, 0.9, kind="percent"),
            Parameter("decay", "m", None, 0.2, bins, 4 * bins * scan.n_bins, grid=decays, log=True),
            *quicker_part(scan),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"probability": 0.1}

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        edges = self.scan.bin_length * torch.arange(
            expected.shape[1], dtype=expected.dtype, device=expected.device
        )
        late = -share_left(self, edges).diff()
        kernel = torch.nn.functional.pad(late, (1, 0))  # never in the same bin
        return expected + self.value("probability") * convolve(expected, kernel)

    def quantities(self) -> dict[str, Quantity]:
        slow = self.value("probability") * (1 - self.value("quick"))
        return super().quantities() | {"slow": Quantity(slow, "1", kind="percent")}
