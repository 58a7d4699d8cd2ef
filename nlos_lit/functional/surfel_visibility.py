"""Who hides whom: surfels seen from the wall as in a shadow map.

From every wall point the patches are drawn into the pixels of a perspective picture, the nearest in front.
What falls into a pixel behind the plane of the patch that is drawn there is hidden by it. The work grows with
wall points × surfels, not with the square of the surfels (L. Williams, *Casting curved shadows on curved
surfaces*, 1978; comparing with a plane instead of a depth keeps a slanted sheet from hiding itself).
"""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.functional import view_loops
from nlos_lit.functional.compiled import for_loops, numpy_of
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
    chunk: int = 1 << 20,
    names: Tensor | None = None,
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
        chunk: points and pixels worked on at once where nothing is compiled, bounds the memory.
        names: ``[M]`` int32 of the patches; None counts them from 1.

    Returns:
        ``[W, V, K]`` int32, name of the patch; 0 where the view is clear.

    Examples:
        A patch half-way hides what is straight behind it from the first wall point, not from the second:

        >>> half_way, towards = torch.tensor([[0.0, 0.0, 0.5]]), torch.tensor([[0.0, 0.0, -1.0]])
        >>> wall = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
        >>> behind = torch.tensor([[[0.0, 0.0, 1.0]]])
        >>> who_hides(half_way, towards, torch.tensor([0.1, 0.1]), wall, behind).flatten()
        tensor([1, 0], dtype=torch.int32)
    """
    found_by = target.new_zeros((len(wall), *target.shape[:2]), dtype=torch.int32)
    if not len(centre):
        return found_by
    shift, _ = spread(normal, cell, quadrature(drawn, cell.device))
    points = (centre[:, None] + shift).reshape(-1, 3)
    patch = torch.arange(len(centre), device=wall.device)
    names, patch = (patch + 1).to(torch.int32) if names is None else names, patch.repeat_interleave(drawn**2)
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
    size = max(1, chunk // (len(points) + len(target) + pixels))
    for height in wall[:, 2].unique():  # one, mostly: depths are those of all wall points
        drawn_at, depth = _seen_from(height, points, pixel)
        looked_at, own_depth = _seen_from(height, target, pixel)
        code = depth * STEPS + patch
        if for_loops(wall):
            rows = torch.nonzero(wall[:, 2] == height)[:, 0]
            order = code.argsort(descending=True)
            fixed = (drawn_at[:, :, order], code[order], looked_at, own_depth * STEPS, middle, normal, level)
            given = map(numpy_of, (wall[rows], rows, *fixed, names, behind, found_by))
            view_loops.pictures(*given, CLEAR * float(side), STEPS)
            continue
        for rows in torch.nonzero(wall[:, 2] == height)[:, 0].split(size):
            part = wall[rows]
            tu, tv = _columns(part, looked_at, 0.0, 0.0)
            left, low = tu.amin(1, keepdim=True) - 1, tv.amin(1, keepdim=True) - 1
            tu, tv = tu - left, tv - low
            wide, high = int(tu.max()) + 2, int(tv.max()) + 2
            # What lies beside the targets' window is drawn on its rim, where no target looks.
            u, v = _columns(part, drawn_at, left, low)
            at = u.clamp_(0, wide - 1).mul_(high).add_(v.clamp_(0, high - 1)).long()
            picture = torch.full((len(part), wide * high), 1 << 62, device=wall.device)
            picture.scatter_reduce_(1, at, code.expand(len(part), -1), "amin")
            found = picture.gather(1, (tu * high + tv).long())
            at_front = found < own_depth * STEPS
            hider = torch.where(at_front, found % STEPS, 0)
            own = (normal[hider] * middle).sum(2) - level[hider]
            eye = (part @ normal.T - level).gather(1, hider)
            hidden = at_front & (own * eye < 0) & (own.abs() > CLEAR * side)
            by = torch.where(hidden, names[hider], 0)
            found_by[rows[:, None], behind] = by.view(len(part), len(behind), -1)
    return found_by


def _seen_from(height: Tensor, points: Tensor, pixel: Tensor) -> tuple[Tensor, Tensor]:
    """What pictures from wall points of one height have in common: ``[2, 3, P]``, from which :func:`_columns`
    are, and depths ``[P]`` in steps.
    """
    depth = (points[:, 2] - height).clamp_min(1e-3)
    scale = 1 / (depth * pixel)
    along = [torch.stack([scale, points[:, k] * scale, torch.ones_like(scale)]) for k in range(2)]
    return torch.stack(along), (depth * STEPS).long()


def _columns(wall: Tensor, seen: Tensor, left: Tensor | float, low: Tensor | float) -> tuple[Tensor, Tensor]:
    """Column and row ``[W, P]`` in the picture from each of ``[W, 3]`` wall points, from ``left`` and ``low``
    on ``[W, 1]``, as floats.
    """
    one = wall.new_ones(len(wall), 1)

    def along(k: int, first: Tensor | float) -> Tensor:
        return (torch.cat([-wall[:, k : k + 1], one, 0.5 - first * one], 1) @ seen[k]).floor_()

    return along(0, left), along(1, low)
