"""Per-voxel albedo Θ_G."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class FreeAlbedo(nn.Module):
    """Albedo in (0, 1) stored per voxel without regard to the intensity, as the paper writes it: ``ρ =
    sigmoid(raw)``.
    """

    def __init__(self, shape: tuple[int, int, int], initial: float) -> None:
        super().__init__()
        self.raw = nn.Parameter(torch.full(shape, math.log(initial / (1 - initial))))

    def forward(self, intensity: Tensor) -> Tensor:
        return torch.sigmoid(self.raw)


class ResidualAlbedo(nn.Module):
    """Albedo as the paper's code stores it: ``ρ = clamp(mask·(I_pf + δ), 0, 1)``, δ ∈ ±0.2 from 0, mask where
    I_pf > threshold.
    """

    def __init__(self, shape: tuple[int, int, int], threshold: float, span: float = 0.2) -> None:
        super().__init__()
        self.threshold, self.span = threshold, span
        self.raw = nn.Parameter(torch.zeros(shape))

    def forward(self, intensity: Tensor) -> Tensor:
        shifted = intensity + self.span * torch.tanh(self.raw)
        return torch.where(intensity > self.threshold, shifted.clamp(0, 1), torch.zeros_like(shifted))
