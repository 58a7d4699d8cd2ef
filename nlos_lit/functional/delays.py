"""Grids of delays and decays, convolutions and filters, for effects that act along time."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def geometric(low: float, high: float, n: int) -> tuple[float, ...]:
    """Values with a constant ratio.

    Args:
        low, high: the first and the last.
        n: how many.

    Returns:
        ``n`` values; only ``low`` where ``high`` is not above it.

    Examples:
        >>> geometric(1.0, 4.0, 3)
        (1.0, 2.0, 4.0)
        >>> geometric(1.0, 0.5, 3)
        (1.0,)
    """
    return tuple(low * (high / low) ** (k / (n - 1)) for k in range(n)) if high > low else (low,)


def whole_record(kernel: Tensor, lead: int, n_bins: int) -> Tensor:
    """A response with zeros behind it, as late as it can matter.

    Args:
        kernel: ``[L]``.
        lead: its bin that is centred on the arrival.
        n_bins: of the record.

    Returns:
        ``[lead + n_bins]``, cut where it was longer.

    Examples:
        >>> whole_record(torch.tensor([0.5, 0.5]), lead=1, n_bins=3)
        tensor([0.5000, 0.5000, 0.0000, 0.0000])
    """
    length = lead + n_bins
    return torch.nn.functional.pad(kernel, (0, max(0, length - len(kernel))))[:length]


def convolve(values: Tensor, kernel: Tensor) -> Tensor:
    """Causal convolution; what leaves the end is lost.

    Args:
        values: ``[…, T]``.
        kernel: ``[K]``, its first bin without delay.

    Returns:
        ``[…, T]``.

    Examples:
        >>> convolve(torch.tensor([2.0, 0.0, 1.0]), torch.tensor([1.0, 0.5])).round(decimals=3)
        tensor([2., 1., 1.])
    """
    size = values.shape[-1] + len(kernel)
    return torch.fft.irfft(torch.fft.rfft(values, size) * torch.fft.rfft(kernel, size), size)[
        ..., : values.shape[-1]
    ]


def filtered(signal: Tensor, response: Callable[[Tensor], Tensor]) -> Tensor:
    """Light whose spectrum over time is multiplied; nothing comes round from the end.

    Args:
        signal: ``[B, T]``.
        response: what angular frequencies ``[F]`` (rad per bin) are multiplied by, ``[F]`` or ``[B, F]``.

    Returns:
        ``[B, T]``.

    Examples:
        >>> filtered(torch.tensor([[0.0, 4.0, 0.0]]), lambda wave: 1 - (1 - wave.cos()) / 2).round(decimals=3)
        tensor([[1., 2., 1.]])
    """
    length = 2 * signal.shape[1]
    wave = 2 * torch.pi * torch.fft.rfftfreq(length, device=signal.device).to(signal)
    found = torch.fft.irfft(torch.fft.rfft(signal, length) * response(wave), length)
    return found[:, : signal.shape[1]]
