"""Laser-sensor response Ψ, Eq. 10, in closed form: an exponential decay convolved with a Gaussian, integrated
over time bins.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def emg_cdf(time: Tensor, sigma: Tensor, kappa: Tensor) -> Tensor:
    """Distribution function of ``κ e^{-κt} * N(0, σ)``: ``F(t) = Φ(t/σ) - e^{-κt + κ²σ²/2} Φ(t/σ - κσ)``.

    Accurate for σ and 1/κ far below or far above the spacing of ``time`` (same unit as ``sigma`` and
    ``1/kappa``): Φ(x) of a negative x is ½ e^{-x²/2} erfcx(-x/√2), so that the huge exponential of the second
    term meets the tiny Φ analytically, and in the left tail both terms share the factor e^{-t²/(2σ²)}.
    """
    scaled = time / sigma
    late = scaled - kappa * sigma
    left = 0.5 * torch.exp(-0.5 * scaled**2)
    root = math.sqrt(0.5)
    # Clamps keep the branch that is not taken finite, for the gradient's sake.
    jitter = torch.where(
        scaled < 0, left * torch.special.erfcx(-scaled.clamp_max(0) * root), torch.special.ndtr(scaled)
    )
    decay = torch.exp((0.5 * (kappa * sigma) ** 2 - kappa * time).clamp_max(0)) * torch.special.ndtr(late)
    delayed = torch.where(late < 0, left * torch.special.erfcx(-late.clamp_max(0) * root), decay)
    return (jitter - delayed).clamp(0.0, 1.0)


def response(sigma: Tensor, kappa: Tensor, n_bins: int, lead: int) -> Tensor:
    """``[n_bins]`` share of Ψ that falls into each bin; bin ``lead`` is centred on the arrival time.

    Args:
        sigma: σ_ls in bins; kappa: κ_s per bin.
        n_bins: length of the kernel; ``lead`` bins lie before the arrival.
    """
    edges = torch.arange(n_bins + 1, dtype=torch.float64, device=sigma.device) - lead - 0.5
    return torch.diff(emg_cdf(edges, sigma.double(), kappa.double())).to(torch.float32)


def convolve_time(transients: Tensor, kernel: Tensor, lead: int) -> Tensor:
    """Causal-with-lead linear convolution of ``[S, T]`` with ``[K]`` along time by zero-padded FFT; result
    ``[S, T]``.
    """
    bins, length = transients.shape[1], kernel.shape[0]
    size = bins + length - 1
    size += size % 2
    product = torch.fft.rfft(transients, size) * torch.fft.rfft(kernel, size)
    return torch.fft.irfft(product, size)[:, lead : lead + bins]
