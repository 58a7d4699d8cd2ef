"""Early photons that hide later ones."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect, Parameter


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
    stage = "counting"

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("detections", "1", 0.0, 0.05, 0.0, 0.95),)

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        share = expected * (self.value("detections") / self.scan.mean_counts)
        before = share.cumsum(1) - share
        return expected * first_photon(share) * torch.exp(-before)


def first_photon(mean: Tensor) -> Tensor:
    """``(1 - e^{-x})/x``, smooth through 0."""
    small = mean.abs() < 1e-3
    safe = torch.where(small, 1.0, mean)
    return torch.where(small, 1 - mean / 2 + mean**2 / 6, -torch.expm1(-safe) / safe)
