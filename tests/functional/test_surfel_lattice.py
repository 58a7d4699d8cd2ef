"""Sheets laid anew: hand-worked cases, and that a wavy sheet stays where it is."""

import math

import pytest
import torch

from nlos_lit.functional.surfel_lattice import COVERED, LAYER, WIDE, lay_anew

UP = torch.tensor([0.0, 0.0, -1.0])
ORIGIN, CELL = torch.zeros(2), torch.tensor([0.1, 0.1])


def laid(centre, normal=None, albedo=None):
    normal = UP.expand(len(centre), 3) if normal is None else normal
    albedo = torch.ones(len(centre)) if albedo is None else albedo
    return lay_anew(centre, normal, albedo, ORIGIN, CELL)


def board(n=5, z=1.0):
    x = 0.1 * (torch.arange(n) - (n - 1) / 2)
    return torch.cat([torch.cartesian_prod(x, x), torch.full((n * n, 1), z)], 1)


def test_a_board_with_a_surfel_a_cell_stays():
    centre, normal, albedo = laid(board())
    middle = (centre[:, :2].abs() < 0.15).all(1)
    assert int(middle.sum()) == 9
    wanted = board(3)[torch.argsort(board(3) @ torch.tensor([10.0, 1.0, 0.0]))]
    found = centre[middle][torch.argsort(centre[middle] @ torch.tensor([10.0, 1.0, 0.0]))]
    assert torch.allclose(found, wanted, atol=1e-4)
    assert torch.allclose(normal, UP.expand(len(normal), 3))
    assert torch.allclose(albedo[middle], torch.ones(9))
    assert float(centre[:, :2].abs().max()) < 0.25  # nothing beyond its outline


def test_a_leaning_sheet_is_sampled_on_its_own_plane_and_crowds_become_one():
    places = board(7)[:, :2].repeat_interleave(4, 0)
    places = places + 0.04 * (torch.rand(places.shape, generator=torch.Generator().manual_seed(1)) - 0.5)
    centre = torch.cat([places, 1 + 0.5 * places[:, :1]], 1)
    leaning = torch.nn.functional.normalize(torch.tensor([0.5, 0.0, -1.0]), dim=0).expand(len(centre), 3)
    found, normal, albedo = laid(centre, leaning)
    inside = (found[:, :2].abs() < 0.25).all(1)
    assert int(inside.sum()) == 25
    assert torch.allclose(found[:, 2], 1 + 0.5 * found[:, 0], atol=1e-5)
    assert torch.allclose(normal, leaning[: len(normal)], atol=1e-6)
    assert torch.allclose(albedo[inside], torch.ones(25))


@pytest.mark.parametrize(("apart", "sheets"), [(0.98 * LAYER, 1), (1.02 * LAYER, 2)])
def test_layers_a_little_more_than_a_cell_apart_are_two_sheets(apart, sheets):
    centre = torch.cat([board(3), board(3, 1.0 + apart * 0.1)])
    found = laid(centre)[0]
    assert int((found[:, :2].abs() < 0.05).all(1).sum()) == sheets


@pytest.mark.parametrize(("share", "stays"), [(0.98, False), (1.02, True)])
def test_a_cell_must_be_covered_in_part(share, stays):
    # One surfel covers the cell by exp(-r²/2 WIDE²)/(2π WIDE²), r cells from its middle.
    r = WIDE * math.sqrt(-2 * math.log(share * COVERED * 2 * math.pi * WIDE**2))
    assert 0.25 < r < 0.5
    found = laid(torch.tensor([[0.1 * r, 0.0, 1.0]]))[0]
    assert len(found) == (1 if stays else 0)


def test_at_an_outline_a_surfel_lies_where_the_sheet_is():
    found = laid(torch.tensor([[0.02, 0.0, 1.0]]))[0]
    assert torch.allclose(found, torch.tensor([[0.02, 0.0, 1.0]]), atol=1e-6)


def test_dark_surfels_have_little_say_in_where_a_sheet_lies_and_steep_ones_stay():
    centre = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.1]])
    found = laid(centre, albedo=torch.tensor([1.0, 0.001]))[0]
    assert found[0, 2] == pytest.approx(1.0, abs=1e-3)
    steep = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, -0.1]]), dim=1)
    both = laid(centre, torch.cat([UP[None], steep]))
    assert torch.equal(both[0][-1], centre[1])
    assert torch.equal(both[1][-1], steep[0])
    alone = laid(centre[1:], steep)
    assert torch.equal(alone[0], centre[1:])
