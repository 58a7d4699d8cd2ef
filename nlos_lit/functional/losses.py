"""The objective, Eq. 11-14."""

from __future__ import annotations

import torch
from torch import Tensor


def transient_loss(measured: Tensor, rendered: Tensor) -> Tensor:
    """E_H, Eq. 12: mean squared error over all elements of normalised transients ``[S, T]``."""
    return ((measured - rendered) ** 2).mean()


def sparsity(intensity: Tensor) -> Tensor:
    """E_Ipf/λ1, Eq. 13: mean of the maximum projection along z of ``[nz, nx, ny]``."""
    return intensity.amax(0).abs().mean()


def albedo_variation(albedo: Tensor) -> Tensor:
    """E_ρ/λ2, Eq. 14: mean over the voxels of ``[n, nx, ny]`` of ``|∇_xy ρ|₁``, forward differences."""
    along_x, along_y = torch.diff(albedo, dim=1).abs(), torch.diff(albedo, dim=2).abs()
    return (along_x.sum() + along_y.sum()) / albedo.numel()
