"""Per-voxel albedo Θ_G."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class FreeAlbedo(nn.Module):
    """Albedo in (0, 1) stored per voxel without regard to the intensity, as the paper writes it.

    ``ρ = sigmoid(raw)``.

    Args:
        shape: ``(nz, nx, ny)`` voxels.
        initial: start value, the same everywhere, between 0 and 1.

    Examples:
        >>> import torch
        >>> FreeAlbedo((1, 1, 2), initial=0.25)(torch.zeros(1, 1, 2)).tolist()
        [[[0.25, 0.25]]]
    """

    def __init__(self, shape: tuple[int, int, int], initial: float) -> None:
        super().__init__()
        self.raw = nn.Parameter(torch.full(shape, math.log(initial / (1 - initial))))

    def forward(self, intensity: Tensor) -> Tensor:
        """``[nz, nx, ny]`` albedo; the ``intensity`` of the same shape is not looked at."""
        return torch.sigmoid(self.raw)


class ResidualAlbedo(nn.Module):
    """Albedo as the paper's code stores it: the intensity and a bounded difference from it.

    ``ρ = clamp(mask·(I_pf + δ), 0, 1)`` with ``δ = span·tanh(raw)`` and mask where ``I_pf > threshold``.

    Args:
        shape: ``(nz, nx, ny)`` voxels.
        threshold: intensity up to which there is no surface.
        span: largest |δ|.

    Examples:
        >>> import torch
        >>> ResidualAlbedo((1, 1, 2), threshold=0.1)(torch.tensor([[[0.0625, 0.75]]])).tolist()
        [[[0.0, 0.75]]]
    """

    def __init__(self, shape: tuple[int, int, int], threshold: float, span: float = 0.2) -> None:
        super().__init__()
        self.threshold, self.span = threshold, span
        self.raw = nn.Parameter(torch.zeros(shape))

    def forward(self, intensity: Tensor) -> Tensor:
        """``[nz, nx, ny]`` albedo from the ``intensity`` I_pf of the same shape."""
        shifted = intensity + self.span * torch.tanh(self.raw)
        return torch.where(intensity > self.threshold, shifted.clamp(0, 1), torch.zeros_like(shifted))
