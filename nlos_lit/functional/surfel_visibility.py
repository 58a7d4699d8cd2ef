"""Who hides whom: surfels seen from the wall as in a shadow map.

From every wall point the patches are drawn into the pixels of a perspective picture, the nearest in front.
What falls into a pixel behind the plane of the patch that is drawn there is hidden by it. The work grows with
wall points × surfels, not with the square of the surfels (L. Williams, *Casting curved shadows on curved
surfaces*, 1978; comparing with a plane instead of a depth keeps a slanted sheet from hiding itself).
"""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.functional.surfel_paths import quadrature, spread

PIXEL = 1.75  # widths of a patch by the points along each side: they lie farther apart on slanted ones
NEAR = 0.02  # share of the patches that may lie nearer to the wall than their pixels are fine for
CLEAR = 1.0  # cells behind a patch's plane up to which it hides nothing: neighbours on a curved sheet
STEPS = 1 << 20  # of depth a metre, and surfels, at most, that fit into one number with it


def who_hides(
    centre: Tensor,
    normal: Tensor,
    cell: Tensor,
    wall: Tensor,
    target: Tensor,
    drawn: int = 5,
    chunk: int = 1 << 19,
) -> Tensor:
    """The first patch that straight lines from wall points to targets pierce.

    What is nearer to the wall than nearly all patches is in view. Outlines are known to a pixel:
    ``PIXEL/drawn`` of a cell for the nearest patches, more in proportion for those farther away. A target may
    be an extended one, of K points: each lies in a pixel of its own, and their middle says on which side of a
    plane they are, so that a curved sheet does not hide the corners of its own flat patches.

    Args:
        centre: ``[M, 3]`` m, of the patches that hide.
        normal: ``[M, 3]`` unit.
        cell: ``[2]`` lateral extents of a patch, m.
        wall: ``[W, 3]`` wall points, m.
        target: ``[V, K, 3]`` m, points of each target.
        drawn: points along each side of a patch.
        chunk: points and pixels worked on at once, bounds the memory.

    Returns:
        ``[W, V, K]`` int32, which patch; -1 where the view is clear.

    Examples:
        A patch half-way hides what is straight behind it from the first wall point, not from the second:

        >>> half_way, towards = torch.tensor([[0.0, 0.0, 0.5]]), torch.tensor([[0.0, 0.0, -1.0]])
        >>> wall = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
        >>> behind = torch.tensor([[[0.0, 0.0, 1.0]]])
        >>> who_hides(half_way, towards, torch.tensor([0.1, 0.1]), wall, behind).flatten()
        tensor([ 0, -1], dtype=torch.int32)
    """
    found_by = target.new_full((len(wall), *target.shape[:2]), -1, dtype=torch.int32)
    if not len(centre):
        return found_by
    shift, _ = spread(normal, cell, quadrature(drawn, cell.device))
    points = (centre[:, None] + shift).reshape(-1, 3)
    patch = torch.arange(len(centre), device=wall.device).repeat_interleave(drawn**2)
    side, front = cell.max(), wall[:, 2].max()
    nearest = (torch.quantile(centre[:, 2], NEAR) - front).clamp_min(side)
    middle = target.mean(1)
    behind = torch.nonzero(middle[:, 2] - front > nearest)[:, 0]
    if not len(behind):
        return found_by
    middle = middle[behind].repeat_interleave(target.shape[1], 0)
    target = target[behind].reshape(-1, 3)
    width = PIXEL / drawn * side
    pixel = width / nearest
    level = (normal * centre).sum(1)  # of each patch's plane
    # No line of sight leaves the box around wall and targets: at most so many pixels across.
    across = torch.cat([wall[:, :2], target[:, :2]])
    pixels = int(((across.amax(0) - across.amin(0)) / width + 3).prod())
    first = 0
    for part in wall.split(max(1, chunk // (len(points) + len(target) + pixels))):
        rows = slice(first, first + len(part))
        first = rows.stop
        (u, v, z), (tu, tv, tz) = _seen_from(part, points, pixel), _seen_from(part, target, pixel)
        left, low = tu.amin(1, keepdim=True) - 1, tv.amin(1, keepdim=True) - 1
        wide, high = int((tu - left).max()) + 2, int((tv - low).max()) + 2
        # What lies beside the targets' window is drawn on its rim, where no target looks.
        at = (u - left).clamp_(0, wide - 1) * high + (v - low).clamp_(0, high - 1)
        code = (z * STEPS).long() * STEPS + patch
        picture = torch.full((len(part), wide * high), 1 << 62, device=wall.device)
        picture.scatter_reduce_(1, at.long(), code, "amin")
        found = picture.gather(1, ((tu - left) * high + (tv - low)).long())
        at_front = found // STEPS < (tz * STEPS).long()
        hider = torch.where(at_front, found % STEPS, 0)
        n = normal[hider]
        plane = level[hider]
        own = (n * middle).sum(2) - plane
        eye = (n * part[:, None]).sum(2) - plane
        hidden = at_front & (own * eye < 0) & (own.abs() > CLEAR * side)
        by = torch.where(hidden, hider, -1).to(torch.int32)
        found_by[rows, behind] = by.view(len(part), len(behind), -1)
    return found_by


def _seen_from(wall: Tensor, points: Tensor, pixel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Column and row of ``[P, 3]`` points in the picture from each of ``[W, 3]`` wall points, and depth."""
    x, y, z = (points[:, k] - wall[:, k, None] for k in range(3))
    z = z.clamp_min(1e-3)
    scale = 1 / (z * pixel)
    return (x * scale).round_(), (y * scale).round_(), z
