"""Terms of the objective (paper Eq. 11-14)."""

from __future__ import annotations

import torch
from torch import Tensor


def transient_loss(measured: Tensor, rendered: Tensor, observed: Tensor | None = None) -> Tensor:
    """E_H, paper Eq. 12: mean squared error over all elements, ``Σ(H - H_R)²/(S·T)``.

    Args:
        measured: ``[S, T]`` transients H, over the counts that count as 1.
        rendered: ``[S, T]`` transients H_R, over the same.
        observed: ``[S, T]`` bool, the elements that were recorded; the mean is over them. None: all.

    Returns:
        A scalar; 0 where nothing was recorded.

    Examples:
        >>> import torch
        >>> transient_loss(torch.tensor([[1.0, 2.0]]), torch.tensor([[1.0, 0.0]]))
        tensor(2.)
        >>> recorded = torch.tensor([[False, True]])
        >>> transient_loss(torch.tensor([[0.0, 2.0]]), torch.tensor([[4.0, 0.0]]), recorded)
        tensor(4.)
    """
    square = (measured - rendered) ** 2
    if observed is None:
        return square.mean()
    # A sum with zeros, not a selection: its size does not depend on the data.
    return (square * observed).sum() / observed.sum().clamp_min(1)


def sparsity(intensity: Tensor) -> Tensor:
    """E_Ipf/λ1, paper Eq. 13: mean of the maximum projection along z.

    Args:
        intensity: ``[nz, nx, ny]`` phasor intensity I_pf.

    Returns:
        A scalar.

    Examples:
        >>> import torch
        >>> sparsity(torch.tensor([[[1.0, 0.0]], [[0.5, 0.25]]]))
        tensor(0.6250)
    """
    return intensity.amax(0).abs().mean()


def albedo_variation(albedo: Tensor) -> Tensor:
    """E_ρ/λ2, paper Eq. 14: mean over the voxels of ``|∇_xy ρ|₁`` by forward differences.

    Args:
        albedo: ``[n, nx, ny]`` albedo of n depth planes.

    Returns:
        A scalar.

    Examples:
        >>> import torch
        >>> albedo_variation(torch.tensor([[[0.0, 1.0], [0.0, 1.0]]]))  # two steps of 1 among four voxels
        tensor(0.5000)
    """
    along_x, along_y = torch.diff(albedo, dim=1).abs(), torch.diff(albedo, dim=2).abs()
    return (along_x.sum() + along_y.sum()) / albedo.numel()
