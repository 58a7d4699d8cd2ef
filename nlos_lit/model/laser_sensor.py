"""Laser-sensor model (Eq. 10 and supplement Sec. 1): H_R = Ψ(I_l, κ_s, σ_ls) * H_r + η_s."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from nlos_lit.functional.irf import convolve_time, response
from nlos_lit.functional.splat import splat_variance
from nlos_lit.model.parameters import BoundedParameter


class LaserSensor(nn.Module):
    """Four parameters turn rendered transients into expected photon counts.

    Args:
        bin_length: m.
        n_bins: bins of the transients; the kernel reaches that far behind the arrival at most.
        sigma_ls: joint laser and jitter width, m of path. kappa_s: decay rate, 1/m of path.
        intensity: I_l, counts per unit of H_r. background: η_s, counts per bin.
        splat_sigma: width of the renderer's splat in bins. When given, its variance is taken out of Ψ, so
            that σ_ls is the physical width; then σ_ls cannot be smaller than the splat. None applies Ψ on top
            of the splat, as the paper does.
    """

    def __init__(
        self,
        *,
        bin_length: float,
        n_bins: int,
        sigma_ls: BoundedParameter,
        kappa_s: BoundedParameter,
        intensity: BoundedParameter,
        background: BoundedParameter,
        splat_sigma: float | None = None,
    ) -> None:
        super().__init__()
        self.bin_length = bin_length
        self.sigma_ls, self.kappa_s, self.intensity, self.background = (
            sigma_ls,
            kappa_s,
            intensity,
            background,
        )
        self.splat_variance = 0.0 if splat_sigma is None else splat_variance(splat_sigma)
        self.lead = min(n_bins - 1, math.ceil(5 * sigma_ls.upper / bin_length) + 1)
        tail = math.log(1e5) / (kappa_s.lower * bin_length) + 5 * sigma_ls.upper / bin_length
        self.length = self.lead + min(n_bins, 2 + math.ceil(tail))

    def kernel(self) -> Tensor:
        """Ψ/I_l ``[length]``: share of a path's energy per bin, bin ``lead`` centred on its arrival."""
        sigma = self.sigma_ls() / self.bin_length
        width = torch.sqrt((sigma**2 - self.splat_variance).clamp_min(1e-6))
        return response(width, self.kappa_s() * self.bin_length, self.length, self.lead)

    def forward(self, transients: Tensor) -> Tensor:
        """``[S, T]`` expected counts from rendered transients ``[S, T]``."""
        return self.intensity() * convolve_time(transients, self.kernel(), self.lead) + self.background()

    @staticmethod
    def smallest_sigma(splat_sigma: float) -> float:
        """Smallest σ_ls in bins that leaves Ψ a width of a twentieth of a bin once the splat is taken out."""
        return math.sqrt(splat_variance(splat_sigma) + 0.05**2)
