"""Concentric map between square and hemisphere, uniform in solid angle (Shirley and Chiu 1997)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Largest change of a square coordinate per radian on the hemisphere: √(1/4 + 16/π²) = 1.368, reached at the
# horizon's seams.
LIPSCHITZ = 1.37


def square_to_hemisphere(square: Tensor) -> Tensor:
    """Unit directions ``[…, 3]`` (z ≥ 0) of points ``[…, 2]`` in the square [-1, 1]²."""
    a, b = square.unbind(-1)
    wide = a.abs() >= b.abs()
    radius = torch.where(wide, a, b)
    safe = torch.where(radius == 0, torch.ones_like(radius), radius)
    angle = torch.where(wide, math.pi / 4 * b / safe, math.pi / 2 - math.pi / 4 * a / safe)
    stretch = radius * torch.sqrt(2 - radius * radius)
    return torch.stack([stretch * angle.cos(), stretch * angle.sin(), 1 - radius * radius], dim=-1)


def hemisphere_to_square(direction: Tensor) -> Tensor:
    """Inverse of :func:`square_to_hemisphere` for unit directions ``[…, 3]``; below the horizon the map
    continues smoothly.
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
    """``[n·n, 3]`` directions at the cell centres of an n × n grid over the square; ray ``i·n + j`` is cell
    (i, j).
    """
    centres = (2 * torch.arange(n, dtype=torch.float64, device=device) + 1) / n - 1
    grid = torch.stack(torch.meshgrid(centres, centres, indexing="ij"), dim=-1)
    return square_to_hemisphere(grid).reshape(-1, 3).to(torch.float32)


def wall_frame(normal: Tensor) -> Tensor:
    """``[S, 3, 3]`` rotations from a wall point's local frame (z along its normal) to the world; identity for
    a normal +z.
    """
    upright = (normal[:, 1:2].abs() < 0.9).to(normal.dtype)  # up (0, 1, 0) helps, else (1, 0, 0)
    helper = torch.cat([1 - upright, upright, torch.zeros_like(upright)], dim=1)
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, normal), dim=1)
    y = torch.linalg.cross(normal, x)
    return torch.stack([x, y, normal], dim=2)
