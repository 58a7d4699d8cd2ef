"""Sheets that go on: hand-worked cases of where, and at what depth."""

import math

import pytest
import torch

from nlos_lit.functional.surfel_lattice import BACK, ENDS, LAYER, TAKEN, TURN, flank, ring, side
from nlos_lit.functional.surfel_paths import STEEP

UP = torch.tensor([0.0, 0.0, -1.0])
ORIGIN, CELL = torch.zeros(2), torch.tensor([0.1, 0.1])


def around(centre, normal=None, albedo=None, source=None):
    normal = UP.expand(len(centre), 3) if normal is None else normal
    albedo = torch.ones(len(centre)) if albedo is None else albedo
    source = torch.ones(len(centre), dtype=torch.bool) if source is None else source
    return ring(centre, normal, albedo, source, ORIGIN, CELL)


def board(n=5, z=1.0):
    x = 0.1 * (torch.arange(n) - (n - 1) / 2)
    return torch.cat([torch.cartesian_prod(x, x), torch.full((n * n, 1), z)], 1)


def cells(centre):
    return {(round(x / 0.1), round(y / 0.1)) for x, y, _ in centre.tolist()}


def test_a_board_goes_on_by_one_ring_in_its_own_plane():
    centre, normal, albedo = around(board(3))
    assert cells(centre) == {(i, j) for i in range(-2, 3) for j in range(-2, 3) if max(abs(i), abs(j)) == 2}
    assert len(centre) == 16
    assert torch.allclose(centre[:, 2], torch.ones(16))
    assert torch.allclose(normal, UP.expand(16, 3))
    assert torch.allclose(albedo, torch.ones(16))


def test_a_leaning_sheet_goes_on_in_its_own_plane():
    centre = board(3)
    centre[:, 2] = 1 + 0.5 * centre[:, 0] - 0.2 * centre[:, 1]
    leaning = torch.nn.functional.normalize(torch.tensor([0.5, -0.2, -1.0]), dim=0)
    found, normal, _ = around(centre, leaning.expand(9, 3))
    assert torch.allclose(found[:, 2], 1 + 0.5 * found[:, 0] - 0.2 * found[:, 1], atol=1e-6)
    assert torch.allclose(normal, leaning.expand(16, 3), atol=1e-6)


def bowl(centre):
    """z = 1 + 2 x² + y², and its normals."""
    x, y = centre[:, 0], centre[:, 1]
    places = torch.stack([x, y, 1 + 2 * x**2 + y**2], 1)
    return places, torch.nn.functional.normalize(torch.stack([4 * x, 2 * y, -torch.ones_like(x)], 1), dim=1)


def test_a_hole_in_a_curved_sheet_is_filled_where_the_sheet_is():
    places, normal = bowl(board(5))
    inside = torch.arange(25) != 12
    found, facing, _ = around(places[inside], normal[inside])
    (middle,) = [k for k, (x, y, _) in enumerate(found.tolist()) if abs(x) < 0.01 and abs(y) < 0.01]
    assert found[middle, 2] == pytest.approx(1.0, abs=1e-6)
    assert torch.allclose(facing[middle], UP, atol=1e-6)


def test_beyond_an_outline_a_curved_sheet_bends_away_by_less_than_from_a_plane():
    places, normal = bowl(board(5))
    found, _, _ = around(places, normal)
    (right,) = [k for k, (x, y, _) in enumerate(found.tolist()) if abs(x - 0.3) < 0.01 and abs(y) < 0.01]
    # Planes through the two columns next to it, and their weights with it.
    near, far = math.exp(-1 / 2), math.exp(-2)
    planes = (near * (1.08 + 0.1 * 0.8) + far * (1.02 + 0.2 * 0.4)) / (near + far)
    assert 0 < 1.18 - found[right, 2] < 1.18 - planes


@pytest.mark.parametrize(("apart", "sheets"), [(0.98 * LAYER, 1), (1.02 * LAYER, 2)])
def test_layers_a_little_more_than_a_cell_apart_go_on_by_themselves(apart, sheets):
    centre = torch.cat([board(3), board(3, 1.0 + apart * 0.1)])
    assert len(around(centre)[0]) == 16 * sheets


def test_a_sheet_goes_on_past_another_in_front():
    front = torch.tensor([[0.1, 0.0, 0.5]])  # a cell of the back one's ring
    found, _, _ = around(torch.cat([board(1), front]), source=torch.tensor([True, False]))
    back = found[found[:, 2] > 0.9]
    assert len(back) == 8


@pytest.mark.parametrize(("off", "free"), [(0.98 * TAKEN, False), (1.02 * TAKEN, True)])
def test_a_cell_is_free_where_no_surfel_of_the_sheet_lies_in_it(off, free):
    centre = torch.tensor([[0.0, 0.0, 1.0], [0.1 + 0.1 * off, 0.0, 1.0]])
    found, _, _ = around(centre, source=torch.tensor([True, False]))
    assert ((1, 0) in cells(found)) == free


def test_only_around_sources_and_with_the_brightness_of_what_lies_within():
    albedo = torch.tensor([1.0, 0.01, 0.01])
    row = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.2, 0.0, 1.0]])
    found, _, light = around(row, albedo=albedo, source=albedo > 0.5)
    assert max(i for i, _ in cells(found)) == 1
    assert light.min() > 0.9


def test_dark_surfels_have_little_say_in_where_a_sheet_lies_and_steep_ones_take_no_part():
    centre = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.1]])
    found, _, _ = around(centre, albedo=torch.tensor([1.0, 1e-5]))
    assert found[:, 2].max() < 1.001
    steep = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, -0.1]]), dim=1)
    both = around(centre, torch.cat([UP[None], steep]))
    assert torch.allclose(both[0][:, 2], torch.ones(8))
    assert len(around(centre[1:], steep)[0]) == 0


def of_cylinder(degrees: list[float], radius: float = 0.3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Places, normals and curvatures on an upright cylinder behind the wall, by their angle to the z axis."""
    angle = torch.deg2rad(torch.tensor(degrees))
    normal = torch.stack([angle.sin(), 0 * angle, -angle.cos()], 1)
    along = torch.stack([angle.cos(), 0 * angle, angle.sin()], 1)
    at = torch.tensor([0.1, 0.0, 0.8]) + radius * normal
    return at, normal, along[:, :, None] * along[:, None] / radius


@pytest.mark.parametrize("bulge", [1.0, -1.0])
def test_flanks_go_on_where_the_next_patch_is_steep(bulge):
    """The last surfel before 66° goes on, one at 30° does not: the next lateral cell is as good. Going on
    from what was begun leads round a cylinder, away from the wall, or up the inside of one, towards it, and
    ends where its back faces away from the wall; or back to where it came from.
    """
    cell, radius = torch.tensor([0.03, 0.03]), 0.3
    axis = torch.tensor([0.1, 0.0, 0.8])
    at, normal, curvature = of_cylinder([-30.0, 30.0, 60.0])
    at, curvature = axis + bulge * (at - axis), bulge * curvature
    reached, source, known = [60.0], torch.ones(3, dtype=torch.bool), at
    while True:
        place, normal, which = flank(at, normal, curvature, source, cell)
        onward = bulge * (place[:, 2] - at[which][:, 2]) > 0
        assert torch.cdist(place[~onward], known).min(1).values.le(0.01).all()
        if not onward.any():
            break
        assert int(onward.sum()) == 1
        known, at, normal = torch.cat([known, place[onward]]), place[onward], normal[onward]
        along = torch.stack([-normal[:, 2], 0 * normal[:, 2], normal[:, 0]], 1)
        curvature, source = bulge * along[:, :, None] * along[:, None] / radius, source[which[onward]]
        reached.append(float(torch.rad2deg(torch.atan2(normal[0, 0], -normal[0, 2]))))
        assert abs(float((at[0] - axis).norm()) - radius) < 0.012
    assert reached[-1] < 90 + math.degrees(math.asin(BACK))
    assert reached == sorted(reached)
    assert reached[-1] > 85


def test_flat_sheets_have_no_flanks_however_they_lean():
    at, normal, curvature = of_cylinder([0.0, 50.0, 65.0])
    source, cell = torch.ones(3, dtype=torch.bool), torch.tensor([0.03, 0.03])
    assert len(flank(at, normal, 0 * curvature, source, cell)[0]) == 0
    assert len(flank(at, normal, curvature, ~source, cell)[0]) == 0


@pytest.mark.parametrize(("lacks", "stands"), [(0.01, 1), (-0.01, 0)])
def test_a_side_stands_behind_what_ends_and_the_wall_may_see_it(lacks, stands):
    """Just above what must lack, and facing away by just less than the wall's far side sees; nowhere else."""
    cell, one = torch.tensor([0.03, 0.03]), torch.ones(1, dtype=torch.bool)
    at, ahead = torch.tensor([[0.1, 0.0, 0.8]]), torch.tensor([[0.0, 0.0, -1.0]])
    way = torch.tensor([[0.0, 1.0, 0.0]])
    assert len(side(at, ahead, (ENDS + lacks) * way, one, cell)[0]) == stands
    tilt = math.asin(BACK - lacks)
    normal = torch.tensor([[0.0, math.sin(tilt), -math.cos(tilt)]])
    away = torch.tensor([[0.0, math.cos(tilt), math.sin(tilt)]])
    assert len(side(at, normal, away, one, cell)[0]) == stands
    place, out, which = side(at, normal, -away, one, cell)  # the other end leans towards the wall
    assert torch.allclose(out, -away)
    assert which.tolist() == [0]
    assert float((place - at)[0] @ -away[0]) == pytest.approx(0.015)
    assert float((place - at)[0] @ -normal[0]) == pytest.approx(0.03 / max(STEEP, math.sin(tilt)) / 2)
    assert len(side(at, normal, -away, ~one, cell)[0]) == 0
    assert len(side(at, away, -normal, one, cell)[0]) == 0  # of what stands itself


@pytest.mark.parametrize(("below", "begun"), [(0.02, 1), (-0.02, 0)])
def test_a_patch_that_would_turn_too_far_is_too_long_for_a_flank(below, begun):
    """On the smallest cylinder that gets one the next patch is turned by just that much; on one that is two
    hundredths smaller none begins.
    """
    cell = 0.03
    own = cell / math.cos(math.radians(60.0))
    at, normal, _ = of_cylinder([60.0])

    def found(radius: float) -> torch.Tensor:
        _, _, bend = of_cylinder([60.0], radius)
        return flank(at, normal, bend, torch.ones(1, dtype=torch.bool), torch.full((2,), cell))[1]

    def turned(facing: torch.Tensor) -> float:
        return float((facing @ normal[0]).acos())

    radii = [own / TURN * (1 + 0.002 * k) for k in range(1500)]
    edge = next(r for r in radii if len(found(r)))
    assert turned(found(edge)) == pytest.approx(TURN, abs=0.01)
    assert len(found(edge * (1 + below))) == begun
