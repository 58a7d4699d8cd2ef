"""Surfels laid anew: sheets sampled once a lateral cell, where surfels had gathered or left gaps."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nlos_lit.functional.surfel_paths import STEEP

WIDE = 0.5  # cells: deviation of a surfel's weight about its place; with one a cell the weights add up to one
FAR = 3.0  # such deviations beyond which it has none
LAYER = 1.2  # cells along z between two sheets
COVERED = 0.4  # share of a cell that a sheet covers at least, to have a surfel there
FAINT = 0.3  # of the mean albedo, from which on a surfel has its whole say in where the sheet lies
CHUNK = 1 << 22  # pairs of places and surfels at a time


def lay_anew(
    centre: Tensor, normal: Tensor, albedo: Tensor, origin: Tensor, cell: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Sheets with one surfel for each lateral cell that they cover.

    Where a cell's middle lies on the plane of each surfel around it says how many sheets there are, and how
    far away: the mean of those that lie together. The new surfel lies in the middle of these: at an outline
    aside, where the sheet is. Surfels that stand steeply cover no lateral cell, and stay.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit, towards the wall's side.
        albedo: ``[M]``.
        origin: ``[2]`` middle of one cell, m.
        cell: ``[2]`` lateral extents, m.

    Returns:
        centres, normals and albedos; an albedo is smaller where the sheet covers its cell in part.

    Examples:
        Two surfels in one cell of a sheet become one half-way:

        >>> two = torch.tensor([[0.2, 0.0, 1.0], [-0.2, 0.0, 1.2]])
        >>> facing = torch.tensor([0.0, 0.0, -1.0]).expand(2, 3)
        >>> centre, _, albedo = lay_anew(two, facing, torch.ones(2), torch.zeros(2), torch.ones(2))
        >>> [[round(x, 2) for x in place] for place in centre.tolist()], albedo.tolist()
        ([[0.0, 0.0, 1.1]], [1.0])
    """
    flat = -normal[:, 2] >= STEEP
    if not flat.any():
        return centre, normal, albedo
    c, n, a = centre[flat], normal[flat], albedo[flat]
    here = ((c[:, :2] - origin) / cell).round().long()
    around = torch.cartesian_prod(torch.arange(-1, 2), torch.arange(-1, 2)).to(here)
    index = torch.unique((here[:, None] + around).reshape(-1, 2), dim=0)
    places = origin + index * cell
    i, j = _near(places / cell, c[:, :2] / cell)
    away = places[i] - c[j, :2]
    z = c[j, 2] - (n[j, :2] * away).sum(1) / n[j, 2]
    order = z.argsort(stable=True)
    order = order[i[order].argsort(stable=True)]
    i, j, z, away = i[order], j[order], z[order], away[order]
    new = torch.ones_like(i)
    new[1:] = ((i[1:] != i[:-1]) | (z[1:] - z[:-1] > LAYER * cell.max())).long()
    sheet = new.cumsum(0) - 1
    weight = torch.exp(-(away / cell).square().sum(1) / (2 * WIDE**2))
    say = weight * (a[j] / (FAINT * a.mean())).clamp(1e-6, 1.0)

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(int(new.sum()), *values.shape[1:]).index_add_(0, sheet, values)

    covered = total(weight) / (2 * math.pi * WIDE**2)
    depth = total(say * z) / total(say)
    mean = torch.nn.functional.normalize(total(say[:, None] * n[j]), dim=1)
    light = total(weight * a[j]) / total(weight) * covered.clamp_max(1.0)
    aside = -total(weight[:, None] * away) / total(weight)[:, None]
    depth = depth - (mean[:, :2] * aside).sum(1) / mean[:, 2]
    kept = covered >= COVERED
    laid = torch.cat([places[i[new.bool()]] + aside, depth[:, None]], 1), mean, light
    both = zip(laid, (centre, normal, albedo), strict=True)
    centre, normal, albedo = (torch.cat([anew[kept], old[~flat]]) for anew, old in both)
    return centre, normal, albedo


def _near(places: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """Which surfels ``[M, 2]`` have a weight at which places ``[V, 2]``, both in cells."""
    found, size = [], max(1, CHUNK // len(centre))
    for first in range(0, len(places), size):
        part = places[first : first + size]
        distance = torch.cdist(part, centre, compute_mode="donot_use_mm_for_euclid_dist")
        i, j = torch.nonzero(distance < FAR * WIDE, as_tuple=True)
        found.append((i + first, j))
    return torch.cat([i for i, _ in found]), torch.cat([j for _, j in found])
