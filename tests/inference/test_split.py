"""Which spots do what, and which axis a misfit shows on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, GATE, capture_of, drawn, problem_of, raster, scattered, surfels
from scipy import ndimage

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.discrepancy import BANDS, bands, discrepancies, flexible
from nlos_lit.inference.problem import Problem, build_problem
from nlos_lit.inference.screen import FOLDS, Projector
from nlos_lit.inference.split import split_spots


def roles(split, spots: int) -> np.ndarray:
    found = np.full(spots, "", dtype="<U6")
    for name in ("fit", "select", "test"):
        assert not found[getattr(split, name)].any(), "a spot has two roles"
        found[getattr(split, name)] = name
    return found


@pytest.mark.parametrize(("nx", "ny"), [(24, 24), (17, 40)])
def test_whole_patches_of_the_wall_have_one_role_each(nx, ny):
    scene = capture_of(raster(nx, ny), scan_shape=(nx, ny))
    split = split_spots(scene)
    role = roles(split, nx * ny)
    assert (role != "").all()
    share = {name: (role == name).mean() for name in ("fit", "select", "test")}
    assert share == pytest.approx({"fit": 5 / 8, "select": 2 / 8, "test": 1 / 8}, abs=0.04)
    wall = split.block.reshape(nx, ny)
    assert len(np.unique(wall)) == 64
    for block in np.unique(wall):
        inside = wall == block
        assert ndimage.label(inside)[1] == 1, "a patch is in pieces"
        assert inside.sum() == inside.any(1).sum() * inside.any(0).sum(), "a patch is not a rectangle"
        assert len(set(role[inside.ravel()])) == 1
    across = role.reshape(nx, ny)
    for line in (*across, *across.T):
        assert set(line) == {"fit", "select", "test"}, "a line of spots lacks a role"


def test_folds_are_whole_patches():
    scene = capture_of(raster(24), scan_shape=(24, 24))
    split = split_spots(scene)
    folds = split.folds(torch.from_numpy(split.fit), FOLDS)
    assert sorted(set(folds.tolist())) == list(range(FOLDS))
    for block in np.unique(split.block):
        assert len(set(folds[split.block[split.fit] == block].tolist())) <= 1
    sizes = np.bincount(folds)
    assert sizes.max() < 2 * sizes.min()


def test_spots_without_counts_have_no_role():
    counts = np.ones((576, GATE[1]))
    counts[[5, 77, 300], GATE[0] :] = 0
    split = split_spots(capture_of(raster(24), counts=counts))
    assert sorted(np.setdiff1d(np.arange(576), np.concatenate([split.fit, split.select, split.test]))) == [
        5,
        77,
        300,
    ]


def test_patches_lie_where_spots_differ():
    """One laser point: the patches are the sensor's."""
    scene = capture_of(raster(24), "single")
    assert np.array_equal(split_spots(scene).block, split_spots(capture_of(raster(24))).block)


def test_a_tiny_scan_is_refused_in_a_sentence():
    with pytest.raises(UserError, match=r"only \d measured spots are left to \w+; .* at least 16 × 16 spots"):
        split_spots(capture_of(raster(6)))
    split_spots(capture_of(raster(16)))


@pytest.fixture(scope="module")
def scene():
    return capture_of(raster(20))


def weighed(scene, factor=1.0, seed=0) -> tuple[Problem, Scan]:
    """Counts of the model times ``factor``, against the model."""
    model, scan = surfels(scene), Scan.of(scene)
    measured = drawn(model, Extension([]), scene, seed, factor)
    spots = torch.arange(scene.n_spots)
    return build_problem(model, Extension([]), spots, torch.from_numpy(measured.gated_counts())), scan


@FORWARD_MODE
def test_no_discrepancy_in_counts_of_the_model_itself(scene):
    problem, scan = weighed(scene)
    found = discrepancies(problem, Projector(problem), scan)
    assert {d.axis for d in found} == set(BANDS)
    for d in found:
        assert d.gain < 3
        assert (
            abs(d.statistic - d.degrees) < 5 * (2 * d.degrees) ** 0.5 + 10
        )  # the nuisance takes some of the columns
        assert d.p_value > 1e-3
    assert [d.gain for d in found] == sorted((d.gain for d in found), reverse=True)


@FORWARD_MODE
@pytest.mark.parametrize("axis", BANDS)
def test_a_misfit_is_seen_on_its_axis(scene, axis):
    """Five bins too few codes, a checkerboard on the wall, a ripple along the scan (whose order is random),
    bright spots dimmed.
    """
    plain, scan = weighed(scene)
    factor = torch.ones_like(plain.expected)
    if axis == "time":
        factor[:, 30:35] = 0.6
    elif axis == "wall":
        cell = ((scan.places[0] + 1) * 4).long().clamp_max(7).sum(1)
        factor *= 1 + 0.2 * (1 - 2.0 * (cell % 2))[:, None]
    elif axis == "scan":
        factor *= 1 + 0.25 * torch.sin(40 * scan.rank)[:, None]
    else:
        total = plain.expected.sum(1)
        middle = ((total > total.quantile(0.3)) & (total < total.quantile(0.7))).float()
        factor *= 1 + 0.3 * middle[:, None]
    problem, _ = weighed(scene, factor, seed=1)
    found = discrepancies(problem, Projector(problem), scan)
    assert found[0].axis == axis
    assert found[0].gain > 25
    assert found[0].gain > 1.5 * found[1].gain
    assert found[0].p_value < 1e-6


def test_bands_by_hand():
    scene = capture_of(
        np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.49, 0.26]]), scan_order=np.array([3, 0, 1, 2])
    )
    expected = torch.tensor([[2.0] * 80, [1.0] * 80, [4.0] * 80, [3.0] * 80])
    problem = problem_of(torch.tensor([3, 0, 1, 2]), expected, expected, expected)
    scan = Scan.of(scene)
    assert bands(problem, "wall", scan).tolist() == [3 * 8 + 2, 0, 7 * 8, 7]
    assert bands(problem, "scan", scan).tolist() == [42, 63, 0, 21]  # ranks 2/3, 1, 0, 1/3 of 64
    assert bands(problem, "rate", scan).tolist() == [2, 0, 7, 5]  # ranks 1, 0, 3, 2 of 4, times 10
    time = bands(problem, "time", scan)
    assert time.tolist() == [k // 2 for k in range(80)]


def test_bands_follow_irregular_spots():
    scene = capture_of(scattered(50))
    flat = torch.ones(50, 58)
    problem = problem_of(torch.arange(50), flat, flat, flat)
    band = bands(problem, "wall", Scan.of(scene))
    assert 0 <= int(band.min()) <= int(band.max()) < 64


@FORWARD_MODE
def test_stretches_of_a_raster_are_not_taken_for_a_map_of_the_wall(scene):
    """The second half of a raster is half of the wall, too (and gains more as such here); a checkerboard is
    the wall's alone.
    """
    raster = dataclasses.replace(scene, scan_order=np.arange(scene.n_spots))
    scan = Scan.of(raster)
    cell = ((scan.places[0] + 1) * 4).long().clamp_max(7).sum(1)
    for factor, axis in (
        (1 + 0.2 * torch.sign(scan.rank), "scan"),
        (1 + 0.2 * (1 - 2.0 * (cell % 2)), "wall"),
    ):
        problem, _ = weighed(raster, factor[:, None], seed=1)
        found = discrepancies(problem, Projector(problem), scan)
        assert found[0].axis == axis
        assert ("wall" in {d.axis for d in found}) is (axis == "wall")


@FORWARD_MODE
def test_what_the_base_can_imitate_is_no_degree_of_freedom(scene):
    """The common factor of all counts is the scene's own; rounding errors of its score may not be taken for a
    gain.
    """
    problem, _ = weighed(scene, 1.3)
    projector, (spots, bins) = Projector(problem), problem.expected.shape
    imitated = problem.nuisance[:, :1].view(spots, bins, 1)
    root = problem.expected.sqrt()[:, :, None]
    late = root * (torch.arange(bins) > bins // 2)[None, :, None]
    alone, both = (flexible(torch.cat(c, 2), problem, projector) for c in ([late], [late, imitated]))
    assert (alone[2], both[2]) == (1, 1)
    assert both[:2] == pytest.approx(alone[:2], rel=0.05, abs=0.05)
