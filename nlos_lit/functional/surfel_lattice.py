"""Sheets that go on: places on the free lateral cells around them, where their surfels say they are."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.functional.surfel_paths import STEEP, on_patch

REACH = 1.0  # cells: deviation of a surfel's weight about its place
FAR = 2.6  # cells beyond which it has none: two rings, so that a curve shows
LAYER = 1.2  # cells along z between two sheets
TAKEN = 0.55  # cells along x and y within which a surfel has a cell: its own, and nearly no other's
FAINT = 0.03  # of the mean albedo, from which on a surfel has its whole say in where the sheet lies
BACK = 0.35  # cosine by which flanks may face away from the wall: its far side sees them
TURN = 0.4  # rad from one patch of a flank to the next, at most: beyond it patches are too long for it
ENDS = 0.3  # length of what lacks of a surfel's neighbours, from which on its sheet ends there
CHUNK = 1 << 22  # pairs of places and surfels at a time


def ring(
    centre: Tensor, normal: Tensor, albedo: Tensor, source: Tensor, origin: Tensor, cell: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The free cells next to some surfels, and where their sheets meet them.

    Where the surfels around a cell say that their surface passes its middle tells how many sheets there are:
    those that lie together are one. Each surfel's word is that of a parabola through its place and normal
    which leans by the sheet's mean slope where it arrives, ``z_j + d·(s_j + s̄)/2``: in a hole it is exact on
    any surface of even curvature; beyond an outline such a surface bends away from it, by less than from a
    plane. Surfels that stand steeply cover no lateral cell, and take no part.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit, towards the wall's side.
        albedo: ``[M]``.
        source: ``[M]`` bool, surfels around which sheets go on.
        origin: ``[2]`` middle of one cell, m.
        cell: ``[2]`` lateral extents, m.

    Returns:
        centres, normals and the albedo of the sheet there, weighted by itself: an outline is as bright as
        what lies within.

    Examples:
        A bowl ``z = x²/2`` with a hole in its middle:

        >>> x = torch.tensor([-2.0, -1.0, 1.0, 2.0])
        >>> bowl = torch.stack([x, 0 * x, x**2 / 2], 1)
        >>> normal = torch.nn.functional.normalize(torch.stack([x, 0 * x, -1 + 0 * x], 1), dim=1)
        >>> inner = torch.tensor([False, True, True, False])
        >>> places, _, _ = ring(bowl, normal, torch.ones(4), inner, torch.zeros(2), torch.ones(2))
        >>> [round(z, 3) + 0.0 for x, y, z in places.tolist() if x == 0 and y == 0]
        [0.0]
    """
    flat = -normal[:, 2] >= STEEP
    source = source & flat
    if not source.any():
        nothing = centre.new_zeros(0, 3)
        return nothing, nothing, nothing[:, 0]
    c, n, a, begins = centre[flat], normal[flat], albedo[flat], source[flat]
    here = ((centre[source, :2] - origin) / cell).round().long()
    around = torch.cartesian_prod(torch.arange(-1, 2), torch.arange(-1, 2)).to(here)
    places = origin + torch.unique((here[:, None] + around).reshape(-1, 2), dim=0) * cell
    i, j = _near(places / cell, c[:, :2] / cell)
    away = places[i] - c[j, :2]
    slope = -n[:, :2] / n[:, 2:]
    z = c[j, 2] + (slope[j] * away).sum(1)
    order = z.argsort(stable=True)
    order = order[i[order].argsort(stable=True)]
    i, j, z, away = i[order], j[order], z[order], away[order]
    new = torch.ones_like(i)
    new[1:] = ((i[1:] != i[:-1]) | (z[1:] - z[:-1] > LAYER * cell.max())).long()
    sheet, first = new.cumsum(0) - 1, new.bool()

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(int(new.sum()), *values.shape[1:]).index_add_(0, sheet, values)

    off = (away / cell).abs()
    say = torch.exp(-off.square().sum(1) / (2 * REACH**2)) * (a[j] / (FAINT * a.mean())).clamp(1e-6, 1.0)
    mean = total(say[:, None] * slope[j]) / total(say)[:, None]
    depth = total(say * (c[j, 2] + ((slope[j] + mean[sheet]) / 2 * away).sum(1))) / total(say)
    light = total(say * a[j] ** 2) / total(say * a[j]).clamp_min(1e-30)
    beside = total((begins[j] & (off.amax(1) < 1.5)).float()) > 0
    free = total((off.amax(1) < TAKEN).float()) == 0
    facing = torch.nn.functional.normalize(torch.cat([mean, -torch.ones_like(mean[:, :1])], 1), dim=1)
    at = torch.cat([places[i[first]], depth[:, None]], 1)
    kept = beside & free
    return at[kept], facing[kept], light[kept]


def flank(
    centre: Tensor, normal: Tensor, curvature: Tensor, source: Tensor, cell: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """How sheets go on where they become too steep for a lattice of lateral cells: the sides of round bodies,
    and those of bowls.

    One patch beyond each surfel, away from the wall, and one towards it, on a surface that goes on curving as
    it does there. A patch that stands steeply is as long as one that leans just enough to cover its cell.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit, towards the wall's side.
        curvature: ``[M, 3, 3]`` 1/m.
        source: ``[M]`` bool, surfels beyond which sheets go on.
        cell: ``[2]`` lateral extents, m.

    Returns:
        centres and normals of those that are steep, and which surfel each goes on from.

    Examples:
        A cylinder of radius 0.2 along y, from a surfel that leans by 60°, and the inside of one, which is
        steep towards the wall:

        >>> leaning = torch.tensor([[0.75**0.5, 0.0, -0.5]])
        >>> along = torch.tensor([[0.5, 0.0, 0.75**0.5]])
        >>> bend = along[:, :, None] * along[:, None] / 0.2
        >>> both = torch.ones(1, dtype=torch.bool), torch.tensor([0.02, 0.02])
        >>> place, facing, _ = flank(0.2 * leaning, leaning, bend, *both)
        >>> round(float(place.norm()), 3), round(float(facing[0, 2]), 2)
        (0.2, -0.3)
        >>> place, facing, _ = flank(-0.2 * leaning, leaning, -bend, *both)
        >>> round(float(place.norm()), 3), float(place[0, 2]) < 0.1
        (0.2, True)
    """
    down = torch.tensor([0.0, 0.0, 1.0], device=centre.device) - normal[:, 2:] * normal
    leans = down.norm(dim=1, keepdim=True)
    source = source & (leans[:, 0] > 1e-3)
    c, n, k = centre[source], normal[source], curvature[source]
    way, side = (down / leans.clamp_min(1e-3))[source], float(cell.max())
    c, n, k, way = (torch.cat(both) for both in ((c, c), (n, n), (k, k), (way, -way)))

    def length(facing: Tensor) -> Tensor:
        return side / (-facing[:, 2:]).clamp_min(STEEP)

    own = length(n)
    _, beyond = on_patch(n, (own * way)[:, None], k)
    shift, facing = on_patch(n, ((own + length(beyond[:, 0])) / 2 * way)[:, None], k)
    place, facing = c + shift[:, 0], facing[:, 0]
    turn = (facing * n).sum(1).clamp(-1, 1).acos()
    steep = (-facing[:, 2] < STEEP) & (facing[:, 2] < BACK) & (turn < TURN)
    return place[steep], facing[steep], torch.nonzero(source)[:, 0].repeat(2)[steep]


def side(
    centre: Tensor, normal: Tensor, outward: Tensor, source: Tensor, cell: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The sides of what has a thickness, as a box: behind each rim one patch at a right angle to the sheet.

    It begins half a cell beyond the surfel, as nobody knows where in its cell the sheet ends, and faces the
    way in which neighbours are missing.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit, towards the wall's side.
        outward: ``[M, 3]`` of :class:`~nlos_lit.functional.surfel_graph.Sheet`.
        source: ``[M]`` bool, surfels that may have one.
        cell: ``[2]`` lateral extents, m.

    Returns:
        centres and normals of those that the wall may see, and which surfel each stands behind.

    Examples:
        >>> middle, facing = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[0.0, 0.0, -1.0]])
        >>> end = torch.tensor([[0.8, 0.0, 0.0]])
        >>> place, out, _ = side(middle, facing, end, torch.tensor([True]), torch.tensor([0.02, 0.02]))
        >>> [round(x, 3) for x in place[0].tolist()], out.tolist()
        ([0.01, 0.0, 1.025], [[1.0, 0.0, 0.0]])
    """
    rim = source & (outward.norm(dim=1) > ENDS) & (-normal[:, 2] >= STEEP)
    c, n, out = centre[rim], normal[rim], torch.nn.functional.normalize(outward[rim], dim=1)
    wide = float(cell.max())
    long = wide / (-out[:, 2:]).clamp_min(STEEP)
    place, seen = c + wide / 2 * out - long / 2 * n, out[:, 2] < BACK
    return place[seen], out[seen], torch.nonzero(rim)[seen, 0]


def _near(places: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """Which surfels ``[M, 2]`` have a weight at which places ``[V, 2]``, both in cells."""
    found, size = [], max(1, CHUNK // len(centre))
    for first in range(0, len(places), size):
        part = places[first : first + size]
        distance = torch.cdist(part, centre, compute_mode="donot_use_mm_for_euclid_dist")
        i, j = torch.nonzero(distance < FAR, as_tuple=True)
        found.append((i + first, j))
    return torch.cat([i for i, _ in found]), torch.cat([j for _, j in found])
