"""Ray marching through a volume that is mostly empty: only samples in occupied bricks are ever touched.

A dense march of the paper's batch (32 spots × 40 000 rays × several hundred samples) interpolates some 10⁹
samples for 10⁵ hits. Here the few bricks that hold a voxel above the threshold are projected into every
spot's ray grid, the rays of that neighbourhood are clipped against the brick, and only those chords are
sampled, unless a brighter sample is known already. The result is that of the dense march: a sample has a
corner voxel no lower than itself, so it lies in a brick with a maximum no lower.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nlos_lit.functional.concentric import LIPSCHITZ, hemisphere_to_square

_ROWS = 1 << 17  # samples worked on at once on a CPU


class VoxelLattice(NamedTuple):
    """Voxel centres at ``origin + pitch·index``; volumes are ``[nz, nx, ny]``, vectors (x, y, z), metres."""

    origin: Tensor  # [3] float32
    pitch: Tensor  # [3] float32
    shape: tuple[int, int, int]


class Samples(NamedTuple):
    """Samples near each hit ray's maximum."""

    spot: Tensor  # [K] index into the batch of spots
    ray: Tensor  # [K] index into the ray grid
    hit: Tensor  # [M] which hit (row of spot/ray) the sample belongs to
    distance: Tensor  # [M] m from the spot


def corner_weights(points: Tensor, lattice: VoxelLattice) -> tuple[Tensor, Tensor]:
    """Voxels around points and their trilinear weights.

    Args:
        points: ``[M, 3]`` (x, y, z), m; those outside the lattice of voxel centres are clamped to its
            surface.
        lattice: of the volume.

    Returns:
        Indices ``[M, 8]`` (long) into the flattened volume and weights ``[M, 8]``, which sum to one and are
        differentiable in ``points``.
    """
    nz, nx, ny = lattice.shape
    size = constants((nx, ny, nz), points)
    position = torch.minimum(((points - lattice.origin) / lattice.pitch).clamp_min(0), size - 1)
    low = torch.minimum(position.detach().floor(), (size - 2).clamp_min(0))
    part = (position - low).to(lattice.pitch.dtype)
    low = low.long()
    high = torch.minimum(low + 1, (size - 1).long())
    x, y, z = (torch.stack([low[:, axis], high[:, axis]], 1) for axis in range(3))
    weight = torch.stack([1 - part, part], 2)
    index = (z[:, :, None, None] * nx + x[:, None, :, None]) * ny + y[:, None, None, :]
    product = weight[:, 2, :, None, None] * weight[:, 0, None, :, None] * weight[:, 1, None, None, :]
    return index.reshape(-1, 8), product.reshape(-1, 8)


def trilinear(volume: Tensor, points: Tensor, lattice: VoxelLattice) -> Tensor:
    """Values of a volume between its voxel centres.

    Args:
        volume: ``[nz, nx, ny]``.
        points: ``[M, 3]`` (x, y, z), m; outside the lattice the border's values continue.
        lattice: of the volume.

    Returns:
        ``[M]``, differentiable in volume and points.

    Examples:
        >>> import torch
        >>> lattice = VoxelLattice(torch.zeros(3), torch.ones(3), (2, 2, 2))
        >>> volume = torch.tensor([[[0.0, 1.0], [2.0, 3.0]], [[4.0, 5.0], [6.0, 7.0]]])  # 4z + 2x + y
        >>> trilinear(volume, torch.tensor([[0.5, 0.25, 0.0], [0.0, 0.0, 0.5]]), lattice)
        tensor([1.2500, 2.0000])
    """
    return _Trilinear.apply(volume, points, lattice)


class _Trilinear(torch.autograd.Function):
    """Keeps the points alone: corners and weights are worked out again, and only where a gradient arrives."""

    @staticmethod
    def forward(ctx: Any, volume: Tensor, points: Tensor, lattice: VoxelLattice) -> Tensor:
        ctx.lattice = lattice
        ctx.save_for_backward(volume, points)
        return sample(volume, points, lattice)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        volume, points = ctx.saved_tensors
        flat = volume.detach().reshape(-1)
        to_volume = torch.zeros_like(flat) if ctx.needs_input_grad[0] else None
        to_points = torch.zeros_like(points) if ctx.needs_input_grad[1] else None
        on_host = grad.device.type == "cpu"
        parts = torch.nonzero(grad).squeeze(1).split(_ROWS) if on_host else (slice(None),)
        for part in parts:
            pull = grad[part][:, None]
            with torch.enable_grad():
                where = points[part].detach().requires_grad_(to_points is not None)
                index, weight = corner_weights(where, ctx.lattice)
                if to_points is not None:
                    value = (flat[index] * weight).sum(1, keepdim=True)
                    to_points[part] = torch.autograd.grad(value, where, pull)[0]
            if to_volume is not None:
                to_volume.index_add_(0, index.reshape(-1), (pull * weight.detach()).reshape(-1))
        return None if to_volume is None else to_volume.view_as(volume), to_points, None


@torch.no_grad()
def sample(volume: Tensor, points: Tensor, lattice: VoxelLattice) -> Tensor:
    """:func:`trilinear` without gradients.

    Args:
        volume: ``[nz, nx, ny]``.
        points: ``[M, 3]`` (x, y, z), m; in single precision they go to a fused, faster kernel good to 1e-5
            voxels.
        lattice: of the volume.

    Returns:
        ``[M]``.
    """
    if points.dtype == torch.float64:
        parts, flat = points.split(_ROWS) if points.device.type == "cpu" else (points,), volume.reshape(-1)
        return torch.cat(
            [(flat[index] * weight).sum(1) for index, weight in (corner_weights(p, lattice) for p in parts)]
        )
    scale, shift = unit_scale(lattice)
    return sample_unit(volume, y_first((points - lattice.origin) * scale + shift))


def unit_scale(lattice: VoxelLattice) -> tuple[Tensor, Tensor]:
    """Factor and summand ``[3]`` that bring (x, y, z) relative to the lattice's origin into [-1, 1]."""
    sizes = (lattice.shape[1], lattice.shape[2], lattice.shape[0])
    cells = constants([max(n - 1, 1) for n in sizes], lattice.pitch)
    return 2 / (lattice.pitch * cells), constants([-1.0 if n > 1 else 0.0 for n in sizes], lattice.pitch)


def y_first(vectors: Tensor) -> Tensor:
    """The order of :func:`sample_unit`; for a list as an index, copied to the device, the host would wait.

    Args:
        vectors: ``[..., (x, y, z)]``.

    Returns:
        ``[..., (y, x, z)]``.
    """
    x, y, z = vectors.split(1, dim=-1)
    return torch.cat([y, x, z], dim=-1)


def constants(values: Sequence[float], like: Tensor) -> Tensor:
    """Numbers as a tensor, written by the device itself: a copy from the host would wait for it.

    Args:
        values: N numbers.
        like: tensor that gives type and device.

    Returns:
        ``[N]``.
    """
    return torch.stack([torch.full((), value, dtype=like.dtype, device=like.device) for value in values])


def sample_unit(volume: Tensor, unit: Tensor) -> Tensor:
    """Values of a volume at places in units of its half sides.

    The kernel is parallel over its batch only, so the points are dealt into as many batches as keep all
    threads busy.

    Args:
        volume: ``[nz, nx, ny]``.
        unit: ``[M, 3]`` places (y, x, z) in [-1, 1]; beyond, the border's values continue.

    Returns:
        ``[M]``.
    """
    batches = 4 * torch.get_num_threads() if volume.device.type == "cpu" else 1
    count = len(unit)
    missing = -count % batches
    if missing:
        unit = torch.cat([unit, unit[:1].expand(missing, 3)])
    field = volume[None, None].expand(batches, 1, *volume.shape)
    grid = unit.view(batches, 1, 1, -1, 3)
    return torch.nn.functional.grid_sample(field, grid, align_corners=True, padding_mode="border").reshape(
        -1
    )[:count]


def occupied_bricks(volume: Tensor, threshold: float, size: tuple[int, int, int]) -> Tensor:
    """Bricks of cells in which some corner voxel reaches a threshold.

    A cell lies between neighbouring voxel centres; brick ``b`` holds cells ``b·size … (b+1)·size - 1``.

    Args:
        volume: ``[nz, nx, ny]``.
        threshold: least value.
        size: cells of a brick along (z, x, y).

    Returns:
        ``[B, 3]`` indices (z, x, y) of the bricks.

    Examples:
        >>> import torch
        >>> volume = torch.zeros(5, 5, 5)
        >>> volume[4, 0, 3] = 1.0
        >>> occupied_bricks(volume, 0.5, (2, 2, 2))
        tensor([[1, 0, 1]])
    """
    return torch.nonzero(brick_maximum(volume, size)[0, 0] >= threshold)


def brick_maximum(volume: Tensor, size: tuple[int, int, int]) -> Tensor:
    """Largest corner voxel of each brick of :func:`occupied_bricks`.

    Args:
        volume: ``[nz, nx, ny]``.
        size: cells of a brick along (z, x, y).

    Returns:
        ``[1, 1, bz, bx, by]``.
    """
    nz, nx, ny = volume.shape
    cells = [max(n - 1, 1) for n in (nz, nx, ny)]
    bricks = [-(-n // s) for n, s in zip(cells, size, strict=True)]
    pad = [b * s + 1 - n for b, s, n in zip(bricks, size, (nz, nx, ny), strict=True)]
    padded = torch.nn.functional.pad(volume[None, None], (0, pad[2], 0, pad[1], 0, pad[0]), value=-torch.inf)
    # A brick spans size + 1 voxels in each direction, sharing its faces' voxels with its neighbours.
    return torch.nn.functional.max_pool3d(padded, [s + 1 for s in size], stride=size)


@torch.no_grad()
def march(
    volume: Tensor,
    lattice: VoxelLattice,
    origins: Tensor,
    frames: Tensor,
    rays: Tensor,
    *,
    threshold: float,
    step: float,
    reach: float,
    fine: int = 1,
    chunk: int = _ROWS,
) -> Samples:
    """Find, on every ray that meets the threshold, the samples that decide where its surface lies.

    With ``fine = 1`` these are all samples within ``reach`` of the ray's largest intensity. Otherwise the ray
    is sampled anew, ``fine`` times denser, from one step before to one step behind its largest sample.

    Args:
        volume: ``[nz, nx, ny]`` intensity, scaled to a unit maximum.
        lattice: of the volume.
        origins: ``[S, 3]`` wall points, m.
        frames: ``[S, 3, 3]`` local-to-world rotations, from
            :func:`~nlos_lit.functional.concentric.wall_frame`.
        rays: ``[n·n, 3]`` local directions from :func:`~nlos_lit.functional.concentric.ray_grid`.
        threshold: a ray whose largest sample is below it meets no surface.
        step: samples lie at ``(k + ½)·step`` from the wall point, m.
        reach: samples lower than the maximum by more than this carry no weight in the softargmax.
        fine: samples a step around the maximum.
        chunk: samples evaluated at once, bounds the memory.

    Returns:
        K hits, in the order of spots and rays, with M samples.

    Examples:
        A bright plane of voxels 1 m in front of one spot, seen along the wall's normal:

        >>> import torch
        >>> lattice = VoxelLattice(torch.tensor([-0.5, -0.5, 0.5]), torch.full((3,), 0.25), (5, 5, 5))
        >>> volume = torch.zeros(5, 5, 5)
        >>> volume[2] = 1.0
        >>> ahead, spot = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3)
        >>> march(volume, lattice, spot, torch.eye(3)[None], ahead, threshold=0.5, step=0.1, reach=0.05)
        Samples(spot=tensor([0]), ray=tensor([0]), hit=tensor([0, 0]), distance=tensor([0.9500, 1.0500]))
    """
    n, device = round(rays.shape[0] ** 0.5), volume.device
    # Bricks about as deep as wide, four lateral cells across: small enough to skip, large enough to be few.
    deep = max(1, round(4 * abs(float(lattice.pitch[0] / lattice.pitch[2]))))
    size = (deep, 4, 4)
    highest = brick_maximum(volume, size)[0, 0]
    bricks = torch.nonzero(highest >= threshold)
    highest = highest[tuple(bricks.T)]
    # The brightest first: many of the others then cannot hold any ray's maximum. Rounding of samples: 1e-6.
    order = torch.argsort(highest, descending=True, stable=True)
    bricks, highest = bricks[order], highest[order] * (1 + 1e-6) + (reach if fine == 1 else 0.0)
    edge = torch.tensor([size[1], size[2], size[0]], device=device)
    last = torch.tensor([lattice.shape[1], lattice.shape[2], lattice.shape[0]], device=device) - 1
    extent = edge * lattice.pitch
    cells = bricks[:, [1, 2, 0]]
    # Opposite corners; neighbours share the very same number, so that a sample on a face belongs to one brick
    # only.
    start = lattice.origin + cells * edge * lattice.pitch
    end = lattice.origin + torch.minimum((cells + 1) * edge, last) * lattice.pitch
    world = torch.einsum("sij,rj->sri", frames, rays).reshape(-1, 3)
    inverse = 1 / torch.where(world.abs() < 1e-12, torch.full_like(world, 1e-12), world)
    # Boxes as seen from each wall point: every pair of ray and brick is clipped with two look-ups.
    boxes = torch.cat([start - origins[:, None], end - origins[:, None]], dim=2).reshape(-1, 6)
    scale, shift = unit_scale(lattice)
    unit_origin = ((origins - lattice.origin) * scale + shift)[:, [1, 0, 2]]
    unit_world = (world * scale)[:, [1, 0, 2]]
    peak = torch.zeros(origins.shape[0] * n * n, device=device, dtype=volume.dtype)
    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    for pair, line in _candidates(cells, extent, lattice.origin, origins, frames, n, chunk):
        promising = torch.nonzero(
            highest.index_select(0, pair % len(bricks)) >= peak.index_select(0, line)
        ).squeeze(1)
        pair, line = pair.index_select(0, promising), line.index_select(0, promising)
        near, far = _clip(boxes.index_select(0, pair), inverse.index_select(0, line))
        first = torch.ceil(near / step - 0.5).clamp_min_(0)
        count = (torch.ceil(far / step - 0.5) - first).clamp_min_(0)
        meets = torch.nonzero(count).squeeze(1)
        first, count, line = (
            first.index_select(0, meets),
            count.index_select(0, meets).long(),
            line.index_select(0, meets),
        )
        chords = torch.cat(
            [unit_origin[line // (n * n)], unit_world.index_select(0, line), first[:, None]], dim=1
        )
        for part in _split_by_total(count, chunk):
            owner, rank = expand(count[part])
            chord = chords[part].index_select(0, owner)
            distance = (chord[:, 6] + rank + 0.5) * step
            value = sample_unit(volume, torch.addcmul(chord[:, :3], distance[:, None], chord[:, 3:6]))
            above = torch.nonzero(value >= threshold).squeeze(1)
            value, on = value[above], line[part].index_select(0, owner[above])
            peak.scatter_reduce_(0, on, value, "amax")
            # The peak can only rise: what is too low now stays too low.
            near_peak = torch.nonzero(value >= peak[on] - (reach if fine == 1 else 0.0)).squeeze(1)
            kept.append((on[near_peak], distance[above[near_peak]], value[near_peak]))
    if not kept:
        empty = torch.zeros(0, dtype=torch.long, device=device)
        return Samples(empty, empty, empty, torch.zeros(0, device=device))
    line, distance, value = (torch.cat(parts) for parts in zip(*kept, strict=True))
    near_peak = value >= peak[line] - (reach if fine == 1 else 0.0)
    line, distance = line[near_peak], distance[near_peak]
    hits, hit = torch.unique(line, return_inverse=True)
    if fine > 1:
        best = torch.zeros(len(hits), device=device, dtype=distance.dtype).scatter_reduce(
            0, hit, distance, "amin", include_self=False
        )
        offsets = torch.arange(-fine, fine + 1, device=device) * (step / fine)
        distance = (best[:, None] + offsets).reshape(-1)
        hit = torch.arange(len(hits), device=device).repeat_interleave(len(offsets))
        direction = torch.einsum("sij,sj->si", frames[hits // (n * n)], rays[hits % (n * n)])
        position = (
            origins[hits // (n * n)][hit] + distance[:, None] * direction[hit] - lattice.origin
        ) / lattice.pitch
        # Outside the volume there is no intensity, so no surface either; the largest sample stays whatever
        # the rounding.
        inside = ((position >= 0) & (position <= last)).all(1) | (offsets == 0).repeat(len(hits))
        distance, hit = distance[inside], hit[inside]
    return Samples(hits // (n * n), hits % (n * n), hit, distance)


def expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Owner index and running index, ``[Σ counts]`` each, of ``counts`` ``[P]`` elements in a row.

    Examples:
        >>> import torch
        >>> expand(torch.tensor([2, 0, 1]))
        (tensor([0, 0, 2]), tensor([0, 1, 0]))
    """
    owner = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    start = torch.cumsum(counts, 0) - counts
    return owner, torch.arange(len(owner), device=counts.device) - start[owner]


def _candidates(
    cells: Tensor, extent: Tensor, origin: Tensor, origins: Tensor, frames: Tensor, n: int, chunk: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield pairs spot·bricks + brick with rays spot·n² + ray that contain every ray through every brick.

    A brick lies in a cone of half-angle α about its centre; the concentric map stretches by at most
    ``LIPSCHITZ``, so its rays lie within ``LIPSCHITZ·α`` of the centre's coordinates in the square. A centre
    below the horizon is first moved to the horizon's nearest point, which brings it closer to every ray.
    """
    centre = origin + (cells + 0.5) * extent
    radius = 0.5 * torch.linalg.vector_norm(extent)
    offset = centre[None] - origins[:, None]
    local = torch.einsum("sji,sbj->sbi", frames, offset)
    distance = torch.linalg.vector_norm(local, dim=2)
    level = torch.cat([local[..., :2], local[..., 2:].clamp_min(0)], dim=2)
    square = hemisphere_to_square(torch.nn.functional.normalize(level, dim=2))
    half = torch.asin((radius / distance).clamp_max(1.0))
    span = LIPSCHITZ * half * n / 2 + 0.5
    span = torch.where(distance <= radius, torch.full_like(span, 2.0 * n), span)
    middle = (square + 1) * n / 2 - 0.5
    low = torch.ceil(middle - span[..., None]).clamp(0, n).long()
    high = (torch.floor(middle + span[..., None]) + 1).clamp(0, n).long()
    width = (high - low).clamp_min(0)
    below = (local[..., 2] + radius <= 0)[..., None]
    width = torch.where(below, torch.zeros_like(width), width)
    counts = (width[..., 0] * width[..., 1]).reshape(-1)
    occupied = torch.nonzero(counts).squeeze(1)
    low, width = low.reshape(-1, 2), width.reshape(-1, 2)
    spot = torch.arange(len(low), device=low.device) // cells.shape[0]
    corners = spot * (n * n) + low[:, 0] * n + low[:, 1]
    for part in _split_by_total(counts[occupied], chunk):
        pair = occupied[part]
        owner, rank = expand(counts[pair])
        columns, corner = width[pair, 1][owner], corners[pair][owner]
        row = torch.div(rank, columns, rounding_mode="floor")
        yield pair[owner], corner + row * n + (rank - row * columns)


def _clip(box: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Entry and exit distance of rays through boxes given by opposite corners; entry ≥ exit: a miss."""
    one, two = box[:, :3] * inverse, box[:, 3:] * inverse
    return torch.minimum(one, two).amax(1), torch.maximum(one, two).amin(1)


def _split_by_total(counts: Tensor, limit: int) -> list[Tensor]:
    """Consecutive index ranges whose counts add up to about ``limit`` at most."""
    if len(counts) == 0:
        return []
    block = torch.cumsum(counts, 0) // limit
    sizes = torch.unique_consecutive(block, return_counts=True)[1].tolist()
    return list(torch.arange(len(counts), device=counts.device).split(sizes))
