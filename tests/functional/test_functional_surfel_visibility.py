"""Who hides whom, by hand, on a sphere, and against rays cast by Open3D on a scene of two bodies."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode

from data_modules.simulate.bodies import Plate, Torus, assemble
from data_modules.simulate.visibility import Occluder
from nlos_lit.functional.surfel_visibility import CLEAR, who_hides

CELL = torch.tensor([0.1, 0.1])


def clear_view(*scene, **options) -> torch.Tensor:
    """``[W, V, K]`` bool, where nothing hides a target."""
    return who_hides(*scene, **options) == 0


def lattice(x: tuple[int, int], y: tuple[int, int], z: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Upright patches of 0.1 m at the given ranges of cells."""
    centre = torch.cartesian_prod(torch.arange(*x) * 0.1, torch.arange(*y) * 0.1)
    centre = torch.cat([centre, torch.full((len(centre), 1), z)], 1)
    return centre, torch.tensor([0.0, 0.0, -1.0]).expand(len(centre), 3)


def test_a_sheet_hides_what_lies_behind_it_but_not_beside_it():
    sheet = lattice((0, 5), (0, 3), 0.5)
    wall = torch.tensor([[0.2, 0.1, 0.0], [1.0, 0.1, 0.0]])
    targets = torch.tensor([[0.2, 0.1, 1.0], [0.9, 0.1, 1.0]])
    # From (1.0, 0.1) the first target is seen past the edge: at z = 0.5 the line is at x = 0.6.
    assert clear_view(*sheet, CELL, wall, targets[:, None])[..., 0].tolist() == [[False, True], [True, True]]


def test_a_second_sheet_hides_where_a_nearer_one_stands_aside():
    near, far = lattice((0, 3), (-1, 2), 0.4), lattice((-5, 6), (-1, 2), 0.8)
    both = tuple(torch.cat(parts) for parts in zip(near, far, strict=True))
    wall, target = torch.tensor([[0.9, 0.0, 0.0]]), torch.tensor([[-0.1, 0.0, 1.0]])
    # The line passes x = 0.5 beside the near sheet, and x = 0.1 through the far one, behind the near one.
    assert clear_view(*near, CELL, wall, target[:, None]).item()
    by = int(who_hides(*both, CELL, wall, target[:, None])) - 1
    assert by >= len(near[0])  # one of the far ones,
    assert (both[0][by, :2] - torch.tensor([0.1, 0.0])).abs().max() < 0.05 + 1e-6  # where the line pierces it


@pytest.mark.parametrize(("behind", "seen"), [(0.9, True), (1.1, False)])
def test_neighbours_on_a_curved_sheet_stay_in_view_up_to_a_cell_behind(behind, seen):
    sheet, cell = lattice((-2, 3), (-2, 3), 0.6), float(CELL[0])
    wall, target = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 0.6 + behind * CLEAR * cell]])
    assert clear_view(*sheet, CELL, wall, target[:, None]).item() == seen


def test_of_an_extended_target_a_part_is_in_view_past_an_edge():
    sheet, wall = lattice((-5, 1), (-3, 4), 0.5), torch.zeros(1, 3)
    # The sheet ends at x = 0.05, seen from the wall point at 0.1 of z = 1.
    across = torch.tensor([-0.06, -0.02, 0.02, 0.06])
    target = torch.stack([0.1 + across, 0 * across, 1 + 0 * across], 1)
    assert clear_view(*sheet, CELL, wall, target[None]).flatten().tolist() == [False, False, True, True]


@pytest.mark.parametrize("tilt", [0.0, 45.0, 60.0])
def test_a_slanted_sheet_has_next_to_no_holes(tilt):
    """Points of its patches lie the farther apart in the picture the more it leans."""
    cell = 0.02
    x, y = torch.meshgrid(torch.arange(-12, 13) * cell, torch.arange(-12, 13) * cell, indexing="ij")
    slope = float(np.tan(np.radians(tilt)))
    centre = torch.stack([x.flatten(), y.flatten(), 0.8 + slope * x.flatten()], 1)
    normal = torch.nn.functional.normalize(torch.tensor([[slope, 0.0, -1.0]]), dim=1).expand(len(centre), 3)
    wall = torch.cartesian_prod(torch.linspace(-0.5, 0.5, 7), torch.linspace(-0.5, 0.5, 7))
    wall = torch.cat([wall, torch.zeros(49, 1)], 1)
    wall = wall[((wall - centre[312]) * normal[0]).sum(1) > 0.05]  # in front of it
    through = torch.rand(300, 2, generator=torch.Generator().manual_seed(0)) * 0.3 - 0.15
    passed = torch.cat([through, 0.8 + slope * through[:, :1]], 1)
    behind = wall[:, None] + 1.6 * (passed - wall[:, None])
    patches = centre, normal, torch.tensor([cell, cell])
    views = [
        clear_view(*patches, eye[None], target[:, None]) for eye, target in zip(wall, behind, strict=True)
    ]
    assert torch.cat(views).float().mean() < 0.01


def test_a_slanted_sheet_does_not_hide_itself():
    steep = torch.tensor([np.sin(1.2), 0.0, -np.cos(1.2)], dtype=torch.float32)
    along = torch.tensor([np.cos(1.2), 0.0, np.sin(1.2)], dtype=torch.float32)
    step = torch.cartesian_prod(torch.arange(-8.0, 9.0), torch.arange(-8.0, 9.0)) * 0.02
    centre = torch.tensor([0.0, 0.0, 0.8]) + step[:, :1] * along
    centre[:, 1] += step[:, 1]
    wall = torch.cartesian_prod(torch.linspace(-0.5, 0.5, 6), torch.linspace(-0.5, 0.5, 6))
    wall = torch.cat([wall, torch.zeros(36, 1)], 1)
    cell = torch.tensor([0.02, 0.02])
    assert clear_view(centre, steep.expand(len(centre), 3), cell, wall, centre[:, None]).all()


def test_the_front_of_a_sphere_hides_its_back_and_not_itself():
    cell, middle = torch.tensor([0.01, 0.01]), torch.tensor([0.05, 0.0, 0.8])
    lateral = torch.cartesian_prod(torch.arange(-20, 21), torch.arange(-20, 21)) * 0.01
    lateral = lateral[lateral.norm(dim=1) < 0.18]  # as steep as patches that cover their cell
    normal = torch.cat([lateral, -(0.04 - lateral.square().sum(1, keepdim=True)).sqrt()], 1) / 0.2
    front = middle + 0.2 * normal
    wall = torch.tensor([[-0.2, 0.15, 0.0], [0.05, 0.0, 0.0], [0.3, 0.2, 0.0]])
    towards = torch.nn.functional.normalize(wall[:, None] - front, dim=2)
    assert clear_view(front, normal, cell, wall, front[:, None])[..., 0][(towards * normal).sum(2) > 0].all()
    back = middle + 0.2 * torch.nn.functional.normalize(normal * torch.tensor([1.0, 1.0, -1.0]), dim=1)
    towards = torch.nn.functional.normalize(wall[:, None] - back, dim=2)
    # Two cells and more behind its outline, and where the way in leads through the patches.
    inside = (towards * (back - middle)).sum(2) < -0.13
    assert inside.float().mean() > 0.5
    views = clear_view(front, normal, cell, wall, back[:, None])[..., 0]
    assert views[inside].float().mean() < 0.01  # holes between points


def test_errors_of_outlines_on_a_ring_before_a_board():
    ring = Torus(radius=0.14, tube=0.035, at=(0.05, 0.0, 0.5), cell=0.02)
    board = Plate(width=0.5, height=0.4, at=(0.0, 0.0, 0.8), turn=(10.0, 20.0, 0.0), cell=0.02)
    mesh = assemble((ring, board))
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    rng, size = np.random.default_rng(0), 0.01
    face = rng.choice(len(area), int(4 * area.sum() / size**2), p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), len(face))
    centre = np.einsum("nk,nkd->nd", weights, corners[face])
    normal = normal[face] / (2 * area[face, None])
    line = np.linspace(-0.5, 0.5, 6)
    wall = np.stack([*(v.ravel() for v in np.meshgrid(line, line)), np.zeros(36)], 1)
    toward = wall[:, None] - centre
    facing = (toward * normal).sum(2) > 0
    start = np.repeat(wall, len(centre), 0)
    true = ~Occluder(mesh).blocked(start, np.tile(centre + 1e-3 * normal, (36, 1))).reshape(36, -1)
    hidden = float((facing & ~true).sum() / facing.sum())
    found = clear_view(
        *(torch.from_numpy(v.astype(np.float32)) for v in (centre, normal)),
        torch.tensor([size, size]),
        torch.from_numpy(wall.astype(np.float32)),
        torch.from_numpy(centre.astype(np.float32))[:, None],
    )[..., 0].numpy()
    wrong = float((facing & (found != true)).sum() / facing.sum())
    assert hidden > 0.1
    assert wrong < 0.03


def test_strays_at_the_wall_take_no_memory():
    sheet, stray = lattice((-5, 6), (-5, 6), 0.8), lattice((4, 5), (0, 1), 0.02)
    both = tuple(torch.cat(parts) for parts in zip(sheet, stray, strict=True))
    wall = torch.cat([torch.rand(500, 2), torch.zeros(500, 1)], 1)
    cell, behind = CELL / 20, torch.cat([both[0], torch.tensor([[0.0, 0.0, 1.2]])])
    pictures: list[int] = []

    class Watch(TorchFunctionMode):
        def __torch_function__(self, func, types, args=(), kwargs=None):
            result = func(*args, **(kwargs or {}))
            pictures.append(result.numel() if torch.is_tensor(result) else 0)
            return result

    with Watch():
        clear = clear_view(*both, cell, wall, behind[:, None])
    assert clear[:, 121].all()  # the stray itself
    assert max(pictures) <= 1 << 19


def test_the_size_of_a_batch_changes_nothing():
    sheet, gen = lattice((0, 5), (0, 3), 0.5), torch.Generator().manual_seed(0)
    wall = torch.rand(40, 3, generator=gen) * torch.tensor([1.0, 1.0, 0.0])
    targets = torch.rand(200, 3, generator=gen) + torch.tensor([0.0, 0.0, 0.3])
    whole = clear_view(*sheet, CELL, wall, targets[:, None])
    assert 0.2 < whole.float().mean() < 0.98
    assert torch.equal(clear_view(*sheet, CELL, wall, targets[:, None], chunk=1000), whole)
    assert clear_view(*(part[:0] for part in sheet), CELL, wall, targets[:, None]).all()
