"""Early photons that hide later ones."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
import torch
from scipy.optimize import brentq
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords


class PileUp(Effect):
    """At most one photon is counted in a laser cycle.

    ``m'_t = N (1 - e^{-m_t/N}) · e^{-Σ_{s<t} m_s/N}``, N the number of laser cycles per spot, ``N = mean
    counts/detections``; t from bin 0 of the record on.

    Parameters: ``detections`` (1): counts recorded per cycle, averaged over the spots; null 0 (N → ∞), below
    1.

    Signature: late returns and late background too weak, the more so the brighter the spot.

    Degenerate with: ``background_slope`` (which is equal at all spots), ``irf_tail``; a scan whose spots are
    equally bright.

    Source: P. B. Coates, *The correction for photon 'pile-up' in the measurement of radiative lifetimes*, J.
    Phys. E 1, 1968.
    """

    name = "pile_up"
    followed_by = ("free_rate",)
    words = EffectWords(
        phrase="pile-up (early photons hide later ones)",
        cause="The detector counts at most one photon a laser cycle, so a high rate distorts the histogram "
        "towards early times.",
        remedy="Attenuate to below 5 % detections a cycle, or gate out the direct pulse.",
        headline="{detections} counts recorded a laser cycle",
    )
    split_by: ClassVar = {
        "wall_reflectance": "a capture at a tenth of the laser power",
    }

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("detections", "1", 0.0, 0.05, 0.0, 0.95),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"detections": 0.3}

    def settle(self, expected: Tensor) -> None:
        """As many laser cycles as record ``detections`` counts each, averaged over the spots."""
        detections = float(self.value("detections"))
        counted = detections * laser_cycles(expected.sum(1), detections)
        self.scan = dataclasses.replace(self.scan, mean_counts=counted)

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        share = expected * (self.value("detections") / self.scan.mean_counts)
        before = share.cumsum(1) - share
        return expected * first_photon(share) * torch.exp(-before)


def laser_cycles(photons: Tensor, detections: float) -> float:
    """N with ``mean_s (1 - e^{-M_s/N}) = detections``; infinite for no detections.

    Args:
        photons: ``[S]`` M, expected at each spot.
        detections: counts recorded a cycle, averaged over the spots.

    Returns:
        N, not rounded.

    Raises:
        UserError: spots without photons are too many for that.

    Examples:
        All spots alike and every other cycle detected, M/N = ln 2:

        >>> round(laser_cycles(torch.tensor([70.0, 70.0]), 0.5), 3)
        100.989
    """
    if detections == 0:
        return float("inf")
    counts = photons.double().numpy()
    most = float((counts > 0).mean())
    if detections >= most:
        raise UserError(
            f"pile_up.detections={detections:g} is more than any laser power gives:"
            f" {1 - most:.0%} of the spots are dark"
        )

    def excess(log_cycles: float) -> float:
        return float(-np.expm1(-counts / np.exp(log_cycles)).mean()) - detections

    level = np.log(counts[counts > 0])
    return float(np.exp(brentq(excess, level.min() - 10, level.max() + 40)))


def first_photon(mean: Tensor) -> Tensor:
    """``(1 - e^{-x})/x``, smooth through 0.

    Examples:
        >>> first_photon(torch.tensor([0.0, 0.6931472]))
        tensor([1.0000, 0.7213])
    """
    small = mean.abs() < 1e-3
    safe = torch.where(small, 1.0, mean)
    return torch.where(small, 1 - mean / 2 + mean**2 / 6, -torch.expm1(-safe) / safe)
