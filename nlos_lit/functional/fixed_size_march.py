"""The march of :mod:`nlos_lit.functional.march` with tensors of fixed size: a GPU never waits for the host.

The host cannot know how many rays meet something without waiting for the device. Here it gives capacities
instead; what was needed is counted on the device and may be read now and then. Samples and hits are those of
the other march while they fit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from nlos_lit.functional.march import VoxelLattice, brick_maximum, constants, sample_unit, unit_scale, y_first

BLOCK = 16  # neighbouring samples of a ray that are taken or left together
AT_ONCE = 1 << 20  # blocks whose points are in memory together: a sample's take some 100 bytes on the way


class Capacity(NamedTuple):
    """Rows there is room for."""

    blocks: int  # of BLOCK samples of a ray
    rays: int  # that meet a surface


class StaticSamples(NamedTuple):
    """``2·fine + 1`` samples around the maximum of each of K = ``capacity.rays`` rays.

    Rows that are not ``used`` mean nothing.
    """

    line: Tensor  # [K] spot·n² + ray
    used: Tensor  # [K] bool
    distance: Tensor  # [K, 2·fine + 1] m from the wall point
    inside: Tensor  # [K, 2·fine + 1] whether the sample lies in the volume
    needed: Tensor  # [2] blocks and rays that there should have been room for


def compact(mask: Tensor, capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    """Places of the True elements of a mask, in a tensor whose length does not depend on their number.

    Args:
        mask: ``[N]`` bool.
        capacity: length of the result.

    Returns:
        Places ``[capacity]`` (long; 0 behind the last), which of these rows are used ``[capacity]``, and how
        many elements were True ``[1]``.

    Examples:
        >>> import torch
        >>> compact(torch.tensor([False, True, False, True]), capacity=3)
        (tensor([1, 3, 0]), tensor([ True,  True, False]), tensor([2]))
    """
    rank = torch.cumsum(mask, 0)
    row = torch.where(mask & (rank <= capacity), rank - 1, capacity)
    places = torch.zeros(capacity + 1, dtype=torch.long, device=mask.device)
    places.scatter_(0, row, torch.arange(len(mask), device=mask.device))
    needed = rank[-1:]
    return places[:capacity], torch.arange(capacity, device=mask.device) < needed, needed


@torch.no_grad()
def static_march(
    volume: Tensor,
    lattice: VoxelLattice,
    pitch: tuple[float, float, float],
    origins: Tensor,
    world: Tensor,
    *,
    threshold: float,
    step: float,
    fine: int,
    capacity: Capacity | None,
) -> StaticSamples:
    """Find the samples around the largest on every ray that meets the threshold, within a capacity.

    Args:
        volume: ``[nz, nx, ny]`` intensity, scaled to a unit maximum.
        lattice: of the volume.
        pitch: of the lattice, m, as numbers of the host.
        origins: ``[S, 3]`` wall points, m.
        world: ``[S, n·n, 3]`` unit directions of the rays.
        threshold: a ray whose largest sample is below it meets no surface.
        step: samples lie at ``(k + ½)·step`` from the wall point, m.
        fine: samples a step around the maximum, more than 1.
        capacity: blocks and rays there is room for; None measures what is needed first, which waits for the
            device.

    Returns:
        The samples, and how much room they needed; what did not fit is missing.
    """
    shape = lattice.shape
    spots, rays = world.shape[:2]
    last = constants((shape[1] - 1, shape[2] - 1, shape[0] - 1), origins)
    inverse = 1 / torch.where(world.abs() < 1e-12, torch.full_like(world, 1e-12), world)
    one = (lattice.origin - origins)[:, None] * inverse
    two = (lattice.origin + last * lattice.pitch - origins)[:, None] * inverse
    near, far = torch.minimum(one, two).amax(2).reshape(-1), torch.maximum(one, two).amin(2).reshape(-1)
    first = torch.ceil(near / step - 0.5).clamp_min(0)
    count = (torch.ceil(far / step - 0.5) - first).clamp_min(0)
    diagonal = math.sqrt(
        sum((p * (n - 1)) ** 2 for p, n in zip(pitch, (shape[1], shape[2], shape[0]), strict=True))
    )
    blocks = math.ceil((diagonal / step + 2) / BLOCK)

    half = BLOCK * step / 2
    deep, wide, high = (max(1, round(half / abs(p))) for p in (pitch[2], pitch[0], pitch[1]))
    size = (deep, wide, high)
    reach = [
        math.ceil(half / (s * abs(p)) + 1e-3)
        for s, p in zip(size, (pitch[2], pitch[0], pitch[1]), strict=True)
    ]
    bricks = (brick_maximum(volume, size) >= threshold).to(torch.float32)
    near_bricks = max_pool3d(bricks, [2 * r + 1 for r in reach], stride=1, padding=reach)[0, 0] > 0

    begin = torch.arange(blocks, device=volume.device) * BLOCK
    middle = (first[:, None] + begin + BLOCK / 2) * step  # [S·n², blocks]
    sizes, cells = (wide, high, deep), (*near_bricks.shape[1:], near_bricks.shape[0])
    brick = torch.zeros((), dtype=torch.int32, device=volume.device)
    for axis in (2, 0, 1):  # as bricks lie in memory
        at = (
            origins[:, None, None, axis]
            - lattice.origin[axis]
            + middle.view(spots, rays, -1) * world[..., axis, None]
        ) / lattice.pitch[axis]
        along = (at / sizes[axis]).floor().clamp(0, cells[axis] - 1)
        brick = brick * cells[axis] + along.to(torch.int32).view(-1, blocks)
    occupied = near_bricks.reshape(-1)[brick] & (begin < count[:, None])
    if capacity is None:
        capacity = _measured(occupied)
    chosen, used, needed_blocks = compact(occupied.view(-1), capacity.blocks)
    line, block = chosen // blocks, chosen % blocks
    scale, shift = unit_scale(lattice)
    unit_origin, unit_world = (
        y_first((origins - lattice.origin) * scale + shift),
        y_first(world * scale).reshape(-1, 3),
    )
    number = (block * BLOCK)[:, None] + torch.arange(BLOCK, device=volume.device)
    distance = (first[line][:, None] + number + 0.5) * step
    value = torch.cat(
        [
            sample_unit(
                volume,
                (unit_origin[some // rays][:, None] + far[..., None] * unit_world[some][:, None]).view(-1, 3),
            )
            for some, far in zip(line.split(AT_ONCE), distance.split(AT_ONCE), strict=True)
        ]
    ).view(-1, BLOCK)
    value = torch.where((number < count[line][:, None]) & used[:, None] & (value >= threshold), value, -1.0)
    peak = torch.full((spots * rays,), -1.0, device=volume.device, dtype=value.dtype).scatter_reduce(
        0, line, value.amax(1), "amax"
    )
    at_peak = torch.where((value == peak[line][:, None]) & (value > 0), distance, torch.inf).amin(1)
    best = torch.full((spots * rays,), torch.inf, device=volume.device, dtype=value.dtype).scatter_reduce(
        0, line, at_peak, "amin"
    )
    line, used, needed_rays = compact(peak > 0, capacity.rays)
    best = torch.where(used, best[line], 1.0)  # any place off the wall
    offsets = torch.arange(-fine, fine + 1, device=volume.device)
    distance = best[:, None] + offsets * (step / fine)
    position = (
        origins[line // rays][:, None]
        + distance[..., None] * world.reshape(-1, 3)[line][:, None]
        - lattice.origin
    ) / lattice.pitch
    inside = (position >= 0) & (position <= last)
    return StaticSamples(
        line, used, distance, inside.all(2) | (offsets == 0), torch.cat([needed_blocks, needed_rays])
    )


def _measured(occupied: Tensor) -> Capacity:
    """Half as many blocks again as are occupied now; a ray needs at least one."""
    blocks = int(occupied.sum() * 1.5) + 1024
    return Capacity(blocks, min(blocks, len(occupied)))
