"""Laser-sensor model (paper Eq. 10 and supplement Sec. 1): H_R = Ψ(I_l, κ_s, σ_ls) * H_r + η_s."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from nlos_lit.functional.irf import convolve_time, response
from nlos_lit.functional.splat import splat_variance
from nlos_lit.model.parameters import BoundedParameter


class LaserSensor(nn.Module):
    """Four parameters turn rendered transients into expected photon counts (paper Eq. 10).

    ``H_R = I_l · (N(0, σ_ls) * κ_s e^{-κ_s t}) * H_r + η_s``, integrated over time bins.

    Args:
        bin_length: path length of a bin, m.
        n_bins: bins of the transients; the kernel reaches that far behind the arrival at most.
        sigma_ls: σ_ls, joint width of laser pulse and jitter, m of path.
        kappa_s: κ_s, decay rate, 1/m of path.
        intensity: I_l, counts per unit of H_r.
        background: η_s, counts per bin.
        splat_sigma: width of the renderer's splat in bins. When given, its variance is taken out of Ψ, so
            that σ_ls is the physical width; then σ_ls cannot be smaller than the splat. None applies Ψ on top
            of the splat, as the paper does.

    Examples:
        >>> import torch
        >>> sensor = LaserSensor(
        ...     bin_length=0.01,
        ...     n_bins=100,
        ...     sigma_ls=BoundedParameter(0.01, 0.005, 0.1, "m"),
        ...     kappa_s=BoundedParameter(200.0, 50.0, 1000.0, "1/m"),
        ...     intensity=BoundedParameter(1000.0, 1.0, 1e6, "counts m2"),
        ...     background=BoundedParameter(0.5, 0.01, 10.0, "counts/bin"),
        ... )
        >>> rendered = torch.zeros(1, 100)
        >>> rendered[0, 40] = 0.02
        >>> expected = sensor(rendered)  # 20 counts of signal and 0.5 a bin
        >>> round(expected.sum().item(), 2), expected.argmax().item()
        (70.0, 40)
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

    def set_intensity(self, value: float) -> None:
        """Begin I_l anew at a value, from a thousandth to a thousand times of which it may go.

        Args:
            value: > 0, in the present unit.
        """
        old = self.intensity
        device = next(old.parameters()).device
        self.intensity = BoundedParameter(value, value * 1e-3, value * 1e3, old.unit).to(device)

    def kernel(self) -> Tensor:
        """Share Ψ/I_l ``[length]`` of a path's energy per bin, bin ``lead`` centred on its arrival."""
        sigma = self.sigma_ls() / self.bin_length
        width = torch.sqrt((sigma**2 - self.splat_variance).clamp_min(1e-6))
        return response(width, self.kappa_s() * self.bin_length, self.length, self.lead)

    def forward(self, transients: Tensor) -> Tensor:
        """``[S, T]`` expected counts from rendered transients ``[S, T]``."""
        return self.intensity() * convolve_time(transients, self.kernel(), self.lead) + self.background()

    @staticmethod
    def smallest_sigma(splat_sigma: float) -> float:
        """Smallest σ_ls in bins that leaves Ψ a width of a twentieth of a bin without the splat.

        Args:
            splat_sigma: σ_t of the splat, in bins.
        """
        return math.sqrt(splat_variance(splat_sigma) + 0.05**2)
