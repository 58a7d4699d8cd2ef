"""How surfels hang together: neighbours on the same sheet, how well they fit one surface, who hides whom."""

from __future__ import annotations

import torch
from torch import Tensor


def neighbour_pairs(
    centre: Tensor, normal: Tensor, reach: float | Tensor, agree: float = 0.3, chunk: int = 1024
) -> tuple[Tensor, Tensor]:
    """Directed pairs (i, j) of surfels that are near each other and face alike.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit.
        reach: largest distance of a pair, m, or ``[M]`` for a reach of each first surfel.
        agree: least cosine between a pair's normals.
        chunk: first surfels worked on at once, bounds the memory.

    Returns:
        i and j ``[P]`` long, i ≠ j; ordered by i.

    Examples:
        >>> import torch
        >>> centre = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.9, 0.0, 1.0]])
        >>> normal = torch.tensor([0.0, 0.0, -1.0]).expand(3, 3)
        >>> neighbour_pairs(centre, normal, reach=0.2)
        (tensor([0, 1]), tensor([1, 0]))
    """
    first, second = [], []
    reaches = torch.as_tensor(reach, device=centre.device).expand(len(centre))
    for start in range(0, len(centre), chunk):
        part = slice(start, start + chunk)
        distance = torch.cdist(centre[part], centre, compute_mode="donot_use_mm_for_euclid_dist")
        near = (distance < reaches[part, None]) & (normal[part] @ normal.T > agree)
        i, j = torch.nonzero(near, as_tuple=True)
        i = i + start
        first.append(i[i != j])
        second.append(j[i != j])
    return torch.cat(first), torch.cat(second)


def bending(
    centre: Tensor,
    normal: Tensor,
    weight: Tensor,
    pairs: tuple[Tensor, Tensor],
    crease: float = 0.5,
    stiffness: float = 0.05,
) -> Tensor:
    """How badly neighbours fit one surface: ``Σ w r²/(1 + r²/c²)`` over pairs.

    The robust loss is that of Geman and McClure (1987): an edge costs no more than c².

    ``r² = (n̄·d)² + stiffness·|n_i - n_j|²/4``, n̄ the mean of the two normals, d the unit vector between the
    centres. On any arc of constant curvature n̄·d = 0, so curved surfaces are not flattened, but normals
    cannot turn without the places following.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit.
        weight: ``[M]`` trust in each surfel; a pair counts their product.
        pairs: i and j ``[P]`` from :func:`neighbour_pairs`.
        crease: c, the angle (rad) at which an edge has half its greatest cost.
        stiffness: how much a turn of the normals costs beside a step of the places.

    Returns:
        A scalar, differentiable in places, normals and weights.

    Examples:
        >>> import torch
        >>> centre = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])
        >>> flat = torch.tensor([0.0, 0.0, -1.0]).expand(2, 3)
        >>> pairs = torch.tensor([0, 1]), torch.tensor([1, 0])
        >>> bending(centre, flat, torch.ones(2), pairs)
        tensor(0.)
    """
    i, j = pairs
    d = centre[j] - centre[i]
    mean, half = (normal[i] + normal[j]) / 2, (normal[i] - normal[j]) / 2
    r2 = (mean * d).sum(1) ** 2 / (d**2).sum(1).clamp_min(1e-12) + stiffness * (half**2).sum(1)
    return (weight[i] * weight[j] * r2 / (1 + r2 / crease**2)).sum()


def front_sheet(index: Tensor, depth: Tensor, limits: tuple[int, int]) -> Tensor:
    """Depth of the nearest surfel of each lateral cell.

    Args:
        index: ``[M, 2]`` long, cell of each surfel; cells outside the limits are left out.
        depth: ``[M]`` m.
        limits: ``(nx, ny)`` numbers of cells.

    Returns:
        ``[nx, ny]`` m, infinite where there is none.

    Examples:
        >>> import torch
        >>> front_sheet(torch.tensor([[0, 0], [0, 0], [0, 1]]), torch.tensor([2.0, 1.0, 3.0]), (1, 3))
        tensor([[1., 3., inf]])
    """
    sheet = torch.full((limits[0] * limits[1],), torch.inf, dtype=depth.dtype, device=depth.device)
    inside = ((index >= 0) & (index < torch.tensor(limits, device=index.device))).all(1)
    key = index[inside, 0] * limits[1] + index[inside, 1]
    return sheet.scatter_reduce(0, key, depth[inside], "amin").view(limits)


def clear_view(
    sheet: Tensor,
    origin: Tensor,
    pitch: Tensor,
    wall: Tensor,
    target: Tensor,
    samples: int,
    skip: float,
    chunk: int = 1 << 22,
) -> Tensor:
    """Which straight lines from wall points to targets do not pierce the front sheet.

    A line pierces the sheet where, between two samples in occupied cells, it goes from before it to behind
    it; lines that pass behind a sheet's edge are clear.

    Args:
        sheet: ``[nx, ny]`` from :func:`front_sheet`, m.
        origin: ``[2]`` x and y of the centre of cell (0, 0), m.
        pitch: ``[2]`` signed spacing of cells, m.
        wall: ``[W, 3]`` wall points, m.
        target: ``[V, 3]`` m.
        samples: looked at along each line.
        skip: within this many cells of the target nothing hides it.
        chunk: samples worked on at once, bounds the memory.

    Returns:
        ``[W, V]`` bool, True where the view is clear.
    """
    nx, ny = sheet.shape
    flat = torch.nn.functional.pad(sheet, (1, 1, 1, 1), value=torch.inf).reshape(-1)
    share = (torch.arange(samples, device=wall.device) + 0.5) / samples
    rows = []
    for part in wall.split(max(1, chunk // (len(target) * samples))):
        d = target[None] - part[:, None]
        far = (1 - share) * torch.linalg.vector_norm(d, dim=2, keepdim=True) > skip * pitch.abs().max()
        i = ((part[:, None, None, 0] + share * d[..., :1] - origin[0]) / pitch[0]).round().clamp(
            -1, nx
        ).long() + 1
        j = ((part[:, None, None, 1] + share * d[..., 1:2] - origin[1]) / pitch[1]).round().clamp(
            -1, ny
        ).long() + 1
        height = flat[i * (ny + 2) + j]
        behind = part[:, None, None, 2] + share * d[..., 2:] > height
        solid = torch.isfinite(height)
        pierced = ~behind[..., :-1] & behind[..., 1:] & solid[..., :-1] & solid[..., 1:] & far[..., 1:]
        rows.append(~pierced.any(2))
    return torch.cat(rows)
