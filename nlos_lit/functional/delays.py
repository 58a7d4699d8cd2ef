"""Grids of delays and decays, and exponential delays, for effects that act along time."""

from __future__ import annotations

import torch
from torch import Tensor


def geometric(low: float, high: float, n: int) -> tuple[float, ...]:
    """``n`` values from ``low`` to ``high`` with a constant ratio; only ``low`` where ``high`` is not above
    it.
    """
    return tuple(low * (high / low) ** (k / (n - 1)) for k in range(n)) if high > low else (low,)


def whole_record(kernel: Tensor, lead: int, n_bins: int) -> Tensor:
    """``kernel`` with zeros up to ``lead + n_bins``, as late as a response can matter."""
    length = lead + n_bins
    return torch.nn.functional.pad(kernel, (0, max(0, length - len(kernel))))[:length]


def convolve(values: Tensor, kernel: Tensor) -> Tensor:
    """``[…, T]`` causal convolution of ``values`` ``[…, T]`` with ``kernel`` ``[K]``; what leaves the end is
    lost.
    """
    size = values.shape[-1] + len(kernel)
    return torch.fft.irfft(torch.fft.rfft(values, size) * torch.fft.rfft(kernel, size), size)[
        ..., : values.shape[-1]
    ]
