"""The brick-skipping march against a dense one: same hits, same samples; interpolation and bricks by hand."""

from __future__ import annotations

import math

import pytest
import torch

from nlos_lit.functional.concentric import ray_grid, wall_frame
from nlos_lit.functional.march import VoxelLattice, expand, march, occupied_bricks, trilinear

REACH = 0.15


def lattice(origin, pitch, shape) -> VoxelLattice:
    return VoxelLattice(torch.tensor(origin), torch.tensor(pitch), shape)


def dense(volume, grid: VoxelLattice, origins, frames, rays, threshold, step, reach, far=None):
    """Every sample of every ray out to where nothing can be left; (ray line, sample number) of those near the
    ray's maximum.
    """
    direction = torch.einsum("sij,rj->sri", frames, rays)
    far = (
        far
        or (torch.tensor([grid.shape[1], grid.shape[2], grid.shape[0]]) * grid.pitch).norm()
        + (grid.origin - origins).norm(dim=1).max()
    )
    number = torch.arange(math.ceil(float(far) / step))
    points = origins[:, None, None] + ((number + 0.5) * step)[:, None] * direction[:, :, None]
    position = (points - grid.origin) / grid.pitch
    size = torch.tensor([grid.shape[1], grid.shape[2], grid.shape[0]]) - 1
    inside = ((position >= 0) & (position <= size)).all(-1)
    value = trilinear(volume, points.reshape(-1, 3), grid).reshape(inside.shape)
    value = torch.where(inside & (value >= threshold), value, -torch.inf).reshape(-1, len(number))
    near = (value >= value.amax(1, keepdim=True) - reach) & (value > -torch.inf)
    line, sample = torch.nonzero(near, as_tuple=True)
    return {(int(a), int(b)) for a, b in zip(line, sample, strict=True)}


def marched(volume, grid, origins, frames, rays, threshold, step, reach, chunk=1 << 20):
    found = march(
        volume, grid, origins, frames, rays, threshold=threshold, step=step, reach=reach, chunk=chunk
    )
    number = torch.round(found.distance / step - 0.5).long()
    assert torch.allclose((number + 0.5) * step, found.distance, atol=1e-6)
    line = (found.spot * rays.shape[0] + found.ray)[found.hit]
    listed = list(zip(line.tolist(), number.tolist(), strict=True))
    assert len(set(listed)) == len(listed), "a sample was taken twice"
    assert set(found.hit.tolist()) == set(range(len(found.spot)))
    return set(listed)


def scene(seed: int):
    """A random sparse volume and wall points: near it, inside it, far aside, normals tilted up to 70°."""
    generator = torch.manual_seed(seed)

    def uniform(low, high):
        return torch.rand((), generator=generator).item() * (high - low) + low

    shape = tuple(int(uniform(low, high)) for low, high in ((2, 24), (2, 15), (2, 15)))
    pitch = [
        uniform(0.02, 0.06) * (-1 if seed % 3 == 1 else 1),
        uniform(0.02, 0.06) * (-1 if seed % 4 == 2 else 1),
        uniform(0.01, 0.05),
    ]
    origin = [-0.5 * pitch[0] * shape[1], -0.4 * pitch[1] * shape[2], uniform(0.02, 0.3)]
    volume = torch.rand(shape, generator=generator) * (
        torch.rand(shape, generator=generator) < uniform(0.003, 0.08)
    )
    volume[shape[0] // 2, shape[1] // 2, shape[2] // 2] = 1.0
    origins = (torch.rand(5, 3, generator=generator) - 0.5) * torch.tensor([0.8, 0.8, 0.02])
    origins[4] = (
        torch.tensor(origin) + torch.tensor(pitch) * torch.tensor([shape[1], shape[2], shape[0]]) * 0.37
    )
    tilt = torch.randn(5, 3, generator=generator) * torch.tensor([0.6, 0.6, 0.0]) * (seed % 2) + torch.tensor(
        [0.0, 0.0, 1.0]
    )
    frames = wall_frame(torch.nn.functional.normalize(tilt, dim=1))
    return volume, lattice(origin, pitch, shape), origins, frames


@pytest.mark.parametrize("seed", range(16))
def test_march_equals_a_dense_march(seed):
    volume, grid, origins, frames = scene(seed)
    rays = ray_grid((16, 30)[seed % 2])
    step = 0.011
    expected = dense(volume, grid, origins, frames, rays, 0.2, step, REACH)
    assert expected
    assert marched(volume, grid, origins, frames, rays, 0.2, step, REACH) == expected


def test_chunks_do_not_change_the_result():
    volume, grid, origins, frames = scene(3)
    rays = ray_grid(48)
    whole = march(volume, grid, origins, frames, rays, threshold=0.05, step=0.004, reach=0.5)
    parts = march(volume, grid, origins, frames, rays, threshold=0.05, step=0.004, reach=0.5, chunk=1000)
    assert len(whole.hit) > 3000
    assert torch.equal(whole.spot, parts.spot)
    assert torch.equal(whole.ray, parts.ray)
    order = [torch.argsort(found.hit * 1e6 + found.distance.double()) for found in (whole, parts)]
    assert torch.equal(whole.hit[order[0]], parts.hit[order[1]])
    assert torch.equal(whole.distance[order[0]], parts.distance[order[1]])


def test_brick_barely_above_the_horizon_of_a_tilted_wall():
    """The centre of the only occupied brick lies below the wall point's horizon, one of its corners above."""
    rays = ray_grid(70)
    grid = lattice([0.0, 0.0, 0.05], [0.05, 0.05, 0.05], (5, 5, 5))
    volume = torch.zeros(5, 5, 5)
    volume[0, 0, 0] = 1.0
    origin = torch.tensor([[-0.05, 0.02, 0.04]])
    centre = torch.nn.functional.normalize(torch.tensor([0.1, 0.1, 0.15]) - origin[0], dim=0)
    missed = 0
    for seed in range(8):
        normal = torch.linalg.cross(centre, torch.randn(3, generator=torch.manual_seed(seed)))
        normal = normal / normal.norm() - (0.05 + 0.05 * seed) * centre
        frames = wall_frame((normal / normal.norm())[None])
        expected = dense(volume, grid, origin, frames, rays, 0.3, 0.016, REACH, far=0.3)
        missed += not expected
        assert marched(volume, grid, origin, frames, rays, 0.3, 0.016, REACH) == expected
    assert missed < 6


def test_threshold_edges():
    """An intensity equal to the threshold is a surface (all numbers are exact in binary), one just below is
    not.
    """
    grid = lattice([-0.0625, -0.0625, 0.25], [0.125, 0.125, 0.125], (2, 2, 2))
    volume = torch.full((2, 2, 2), 0.25)
    rays = torch.tensor([[0.0, 0.0, 1.0]])
    origin, frame = torch.zeros(1, 3), torch.eye(3)[None]
    at = march(volume, grid, origin, frame, rays, threshold=0.25, step=1 / 32, reach=0.1)
    assert at.spot.tolist() == [0]
    assert at.distance.sort().values.tolist() == [0.265625, 0.296875, 0.328125, 0.359375]
    above = march(volume, grid, origin, frame, rays, threshold=0.2500001, step=1 / 32, reach=0.1)
    assert len(above.spot) == len(above.hit) == 0


def test_samples_below_the_threshold_carry_no_weight_however_close_to_the_maximum():
    grid = lattice([-0.05, -0.05, 0.3], [0.1, 0.1, 0.1], (2, 2, 2))
    volume = torch.tensor([0.5, 0.7])[:, None, None].expand(2, 2, 2).contiguous()
    found = march(
        volume,
        grid,
        torch.zeros(1, 3),
        torch.eye(3)[None],
        torch.tensor([[0.0, 0, 1]]),
        threshold=0.63,
        step=0.02,
        reach=1,
    )
    assert torch.allclose(found.distance.sort().values, torch.tensor([0.37, 0.39]), atol=1e-6)


def test_empty_volume_and_volume_behind_the_wall():
    rays, frames, origin = ray_grid(8), torch.eye(3)[None], torch.zeros(1, 3)
    empty = march(
        torch.zeros(3, 3, 3),
        lattice([0.0, 0, 0.1], [0.1] * 3, (3, 3, 3)),
        origin,
        frames,
        rays,
        threshold=0.1,
        step=0.01,
        reach=1,
    )
    assert [len(part) for part in empty] == [0, 0, 0, 0]
    behind = lattice([-0.1, -0.1, -0.6], [0.1] * 3, (3, 3, 3))
    assert (
        len(march(torch.ones(3, 3, 3), behind, origin, frames, rays, threshold=0.1, step=0.01, reach=1).spot)
        == 0
    )


@pytest.mark.parametrize("size", [(1, 1, 1), (3, 4, 4), (7, 2, 5), (40, 40, 40)])
def test_occupied_bricks_are_those_with_a_corner_above_the_threshold(size):
    generator = torch.manual_seed(5)
    volume = torch.rand(13, 8, 11, generator=generator) * (torch.rand(13, 8, 11, generator=generator) < 0.01)
    volume[12, 7, 10] = 0.9
    found = {tuple(b) for b in occupied_bricks(volume, 0.4, size).tolist()}
    cells = {
        (z - dz, x - dx, y - dy)
        for z, x, y in torch.nonzero(volume >= 0.4).tolist()
        for dz in (0, 1) for dx in (0, 1) for dy in (0, 1)
    }  # fmt: skip
    cells = {c for c in cells if all(0 <= i < n - 1 for i, n in zip(c, volume.shape, strict=True))}
    needed = {tuple(i // s for i, s in zip(c, size, strict=True)) for c in cells}
    assert needed <= found
    for brick in found:
        spans = [slice(b * s, b * s + s + 1) for b, s in zip(brick, size, strict=True)]
        assert volume[spans[0], spans[1], spans[2]].max() >= 0.4


def test_trilinear_by_hand():
    grid = lattice([1.0, -2.0, 0.5], [0.5, -0.25, 0.1], (3, 2, 4))
    volume = torch.arange(24.0).reshape(3, 2, 4) ** 2
    centres = torch.tensor([[1.5, -2.75, 0.6], [1.0, -2.0, 0.5], [1.5, -2.0, 0.7]])
    assert torch.allclose(
        trilinear(volume, centres, grid),
        torch.stack([volume[1, 1, 3], volume[0, 0, 0], volume[2, 1, 0]]),
        atol=1e-3,
    )
    middle = torch.tensor([[1.25, -2.0, 0.5], [1.0, -2.125, 0.5], [1.0, -2.0, 0.55], [1.25, -2.375, 0.65]])
    expected = torch.stack([
        (volume[0, 0, 0] + volume[0, 1, 0]) / 2, (volume[0, 0, 0] + volume[0, 0, 1]) / 2,
        (volume[0, 0, 0] + volume[1, 0, 0]) / 2, volume[1:3, :, 1:3].mean(),
    ])  # fmt: skip
    assert torch.allclose(trilinear(volume, middle, grid), expected, rtol=1e-4)
    outside = torch.tensor([[0.2, -1.0, 0.1], [9.0, -9.0, 9.0]])
    assert torch.equal(trilinear(volume, outside, grid), torch.stack([volume[0, 0, 0], volume[2, 1, 3]]))


def test_trilinear_gradients():
    grid = VoxelLattice(
        torch.zeros(3, dtype=torch.float64), torch.tensor([0.3, 0.2, 0.5], dtype=torch.float64), (3, 4, 3)
    )
    generator = torch.manual_seed(6)
    volume = torch.rand(3, 4, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    points = (
        torch.rand(7, 3, dtype=torch.float64, generator=generator) * torch.tensor([0.85, 0.35, 0.95])
    ).requires_grad_()
    assert torch.autograd.gradcheck(lambda v, p: trilinear(v, p, grid), (volume, points))


def test_expand():
    owner, rank = expand(torch.tensor([2, 0, 3]))
    assert owner.tolist() == [0, 0, 2, 2, 2]
    assert rank.tolist() == [0, 1, 0, 1, 2]
