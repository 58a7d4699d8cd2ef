"""Concentric map between square and hemisphere, uniform in solid angle.

Shirley and Chiu, *A low distortion map between disk and square*, Journal of Graphics Tools 2(3), 45 (1997).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Largest change of a square coordinate per radian on the hemisphere: √(1/4 + 16/π²) = 1.368, reached at the
# horizon's seams.
LIPSCHITZ = 1.37


def square_to_hemisphere(square: Tensor) -> Tensor:
    """Unit directions of points in a square; equal areas become equal solid angles.

    With ``r = a, φ = π/4·b/a`` where ``|a| ≥ |b|``, and ``r = b, φ = π/2 - π/4·a/b`` elsewhere, the
    direction is ``(r√(2-r²) cosφ, r√(2-r²) sinφ, 1-r²)``.

    Args:
        square: ``[…, 2]`` points (a, b) in [-1, 1]²; the centre is the pole, the edge the horizon.

    Returns:
        ``[…, 3]`` unit vectors, z ≥ 0.

    Examples:
        >>> import torch
        >>> square_to_hemisphere(torch.tensor([[0.0, 0.0], [1.0, 0.0]])).tolist()
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    """
    a, b = square.unbind(-1)
    wide = a.abs() >= b.abs()
    radius = torch.where(wide, a, b)
    safe = torch.where(radius == 0, torch.ones_like(radius), radius)
    angle = torch.where(wide, math.pi / 4 * b / safe, math.pi / 2 - math.pi / 4 * a / safe)
    stretch = radius * torch.sqrt(2 - radius * radius)
    return torch.stack([stretch * angle.cos(), stretch * angle.sin(), 1 - radius * radius], dim=-1)


def hemisphere_to_square(direction: Tensor) -> Tensor:
    """Inverse of :func:`square_to_hemisphere`; below the horizon the map continues smoothly.

    Args:
        direction: ``[…, 3]`` unit vectors.

    Returns:
        ``[…, 2]`` points, in [-1, 1]² for z ≥ 0.

    Examples:
        >>> import torch
        >>> place = torch.tensor([0.25, -0.75])
        >>> torch.allclose(hemisphere_to_square(square_to_hemisphere(place)), place)
        True
    """
    x, y, z = direction.unbind(-1)
    radius = torch.sqrt((1 - z).clamp_min(0))
    wide = x.abs() >= y.abs()
    # Angle from the nearest horizontal (wide) or vertical axis, in (-π/4, π/4].
    angle = torch.where(wide, torch.atan2(y * x.sign(), x.abs()), torch.atan2(x * y.sign(), y.abs()))
    along = radius * torch.where(wide, x.sign(), y.sign())
    across = along * angle * (4 / math.pi)
    return torch.stack([torch.where(wide, along, across), torch.where(wide, across, along)], dim=-1)


def ray_grid(n: int, device: torch.device | str = "cpu") -> Tensor:
    """Directions at the cell centres of an n × n grid over the square.

    Args:
        n: cells along a side; each ray stands for the solid angle ``2π/n²``.
        device: where the result lies.

    Returns:
        ``[n·n, 3]`` float32 unit vectors, z > 0; ray ``i·n + j`` is cell (i, j).

    Examples:
        >>> ray_grid(1)
        tensor([[0., 0., 1.]])
        >>> ray_grid(200)[:, 2].mean()  # the mean cosine over a hemisphere is 1/2
        tensor(0.5000)
    """
    centres = (2 * torch.arange(n, dtype=torch.float64, device=device) + 1) / n - 1
    grid = torch.stack(torch.meshgrid(centres, centres, indexing="ij"), dim=-1)
    return square_to_hemisphere(grid).reshape(-1, 3).to(torch.float32)


def wall_frame(normal: Tensor) -> Tensor:
    """Rotations from the local frames of wall points (z along the normal) to the world.

    Args:
        normal: ``[S, 3]`` unit normals.

    Returns:
        ``[S, 3, 3]``, the local axes as columns; the identity for a normal +z.

    Examples:
        >>> import torch
        >>> wall_frame(torch.tensor([[0.0, 0.0, 1.0]]))[0]
        tensor([[1., 0., 0.],
                [0., 1., 0.],
                [0., 0., 1.]])
    """
    upright = (normal[:, 1:2].abs() < 0.9).to(normal.dtype)  # up (0, 1, 0) helps, else (1, 0, 0)
    helper = torch.cat([1 - upright, upright, torch.zeros_like(upright)], dim=1)
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, normal), dim=1)
    y = torch.linalg.cross(normal, x)
    return torch.stack([x, y, normal], dim=2)
