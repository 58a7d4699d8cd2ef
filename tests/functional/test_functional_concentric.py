"""The concentric map: solid angle, inverse, continuity, the bound the march relies on, wall frames."""

from __future__ import annotations

import math

import literal
import pytest
import torch

from nlos_lit.functional.concentric import (
    LIPSCHITZ,
    hemisphere_to_square,
    ray_grid,
    square_to_hemisphere,
    wall_frame,
)

DOUBLE = torch.float64


def test_hand_computed_directions():
    square = torch.tensor(
        [[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [0.5, 0], [-0.5, 0.25]], dtype=DOUBLE
    )
    half = math.sqrt(0.5)
    long = 0.5 * math.sqrt(1.75)
    expected = [
        [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [half, half, 0], [long, 0, 0.75],
        [-long * math.cos(math.pi / 8), long * math.sin(math.pi / 8), 0.75],
    ]  # fmt: skip
    assert torch.allclose(square_to_hemisphere(square), torch.tensor(expected, dtype=DOUBLE), atol=1e-12)


@pytest.mark.parametrize("n", [1, 4, 7, 20])
def test_ray_grid_is_shirley_and_chius_map(n):
    rays = ray_grid(n)
    assert torch.allclose(rays.double(), literal.concentric_directions(n), atol=1e-7)
    assert torch.allclose(rays.norm(dim=1), torch.ones(n * n), atol=1e-6)


def test_every_cell_has_the_same_solid_angle():
    """Area element |∂d/∂a × ∂d/∂b| is π/2 everywhere (2π over the square's area 4), so a cell of n × n covers
    2π/n².
    """
    square = (torch.rand(2000, 2, dtype=DOUBLE, generator=torch.manual_seed(0)) * 2 - 1) * 0.999
    square = square[(square[:, 0].abs() - square[:, 1].abs()).abs() > 1e-3].requires_grad_()
    direction = square_to_hemisphere(square)
    columns = [torch.autograd.grad(direction[:, i].sum(), square, retain_graph=True)[0] for i in range(3)]
    jacobian = torch.stack(columns, dim=1)
    element = torch.linalg.cross(jacobian[..., 0], jacobian[..., 1]).norm(dim=1)
    assert torch.allclose(element, torch.full_like(element, math.pi / 2), atol=1e-9)


def test_a_region_of_the_sphere_gets_its_share_of_rays():
    rays = literal.concentric_directions(100)
    axis = torch.tensor([0.3, -0.5, 0.6], dtype=DOUBLE)
    cap = (rays @ (axis / axis.norm()) > math.cos(0.4)).sum().item() * 2 * math.pi / 100**2
    assert cap == pytest.approx(2 * math.pi * (1 - math.cos(0.4)), rel=0.02)


def test_inverse():
    square = torch.rand(5000, 2, dtype=DOUBLE, generator=torch.manual_seed(1)) * 2 - 1
    assert torch.allclose(hemisphere_to_square(square_to_hemisphere(square)), square, atol=1e-7)
    corners = torch.tensor([[1.0, 1], [-1, 1], [1, -1], [-1, -1], [1, 0.3], [0.3, -1]], dtype=DOUBLE)
    assert torch.allclose(hemisphere_to_square(square_to_hemisphere(corners)), corners, atol=1e-7)


def pairs(count: int, seed: int):
    """Random pairs of directions of the hemisphere, at log-uniform angles down to a thousandth, and the
    angles.
    """
    generator = torch.manual_seed(seed)
    first = torch.randn(count, 3, dtype=DOUBLE, generator=generator)
    first[: count // 2, 2] *= 0.02  # many close to the horizon, where the map stretches most
    first = first / first.norm(dim=1, keepdim=True)
    first[:, 2] = first[:, 2].abs()
    side = torch.randn(count, 3, dtype=DOUBLE, generator=generator)
    side = side - (side * first).sum(1, keepdim=True) * first
    side = side / side.norm(dim=1, keepdim=True)
    angle = torch.exp(
        torch.empty(count, dtype=DOUBLE).uniform_(math.log(1e-3), math.log(math.pi / 2), generator=generator)
    )
    second = first * angle.cos()[:, None] + side * angle.sin()[:, None]
    above = second[:, 2] >= 0
    return first[above], second[above], angle[above]


def test_lipschitz_bound_holds_and_is_tight():
    first, second, angle = pairs(400_000, seed=2)
    stretch = (
        ((hemisphere_to_square(first) - hemisphere_to_square(second)).abs().amax(1) / angle).max().item()
    )
    assert 0.97 * LIPSCHITZ < stretch <= LIPSCHITZ
    assert math.sqrt(0.25 + 16 / math.pi**2) <= LIPSCHITZ < 1.01 * math.sqrt(0.25 + 16 / math.pi**2)


def test_continuous_across_the_seams():
    """Either side of each diagonal and axis."""
    angle = torch.arange(8, dtype=DOUBLE) * math.pi / 4
    for z in (0.0, 0.2, 0.9):
        s = math.sqrt(1 - z * z)

        def at(shift, s=s, z=z):
            return torch.stack(
                [s * torch.cos(angle + shift), s * torch.sin(angle + shift), torch.full_like(angle, z)], dim=1
            )

        assert (hemisphere_to_square(at(-1e-9)) - hemisphere_to_square(at(1e-9))).abs().max() < 1e-8


def test_wall_frames_are_rotations_onto_the_normal():
    normals = torch.nn.functional.normalize(
        torch.randn(200, 3, dtype=DOUBLE, generator=torch.manual_seed(3)), dim=1
    )
    normals = torch.cat(
        [normals, torch.tensor([[0.0, 0, 1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [0, 0, -1]], dtype=DOUBLE)]
    )
    frames = wall_frame(normals)
    identity = torch.eye(3, dtype=DOUBLE).expand_as(frames)
    assert torch.allclose(frames.transpose(1, 2) @ frames, identity, atol=1e-12)
    assert torch.allclose(torch.linalg.det(frames), torch.ones(len(frames), dtype=DOUBLE), atol=1e-12)
    assert torch.allclose(frames[:, :, 2], normals)
    assert torch.equal(wall_frame(torch.tensor([[0.0, 0, 1]]))[0], torch.eye(3))
