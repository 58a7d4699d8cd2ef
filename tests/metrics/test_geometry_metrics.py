"""Geometry errors, against values worked out by hand."""

from __future__ import annotations

import json
import math

import h5py
import numpy as np
import pytest
from conftest import real_file

from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.io.points import Points
from nlos_lit.metrics.geometry import depth_at, depth_map, geometry_errors

NAN = float("nan")
X, Y = np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.1, 0.2, 0.3])
# [nx, ny]: rows are x. Six cells of surface: two flat pieces and nothing between.
DEPTH = np.array([[0.50, 0.52, NAN, 0.80], [0.54, 0.56, NAN, 0.80], [NAN, NAN, NAN, NAN]])
ALBEDO = np.array([[1.0, 1.0, NAN, 0.25], [1.0, 1.0, NAN, 0.25], [NAN, NAN, NAN, NAN]])


def truth() -> SurfaceTruth:
    normals = np.zeros((3, 4, 3))
    normals[..., 2] = -1.0
    return SurfaceTruth(X, Y, DEPTH, normals, ALBEDO)


def points(rows: list[tuple[float, float, float, float]], normals: np.ndarray | None = None) -> Points:
    """(x, y, z, albedo) rows, facing the wall unless said otherwise."""
    rows = np.array(rows)
    facing = np.tile([0.0, 0.0, -1.0], (len(rows), 1)) if normals is None else normals
    return Points(rows[:, :3], facing, rows[:, 3])


@pytest.mark.parametrize(
    ("xy", "depth"),
    [
        ((0.05, 0.05), 0.53),  # the mean of four corners
        ((0.075, 0.0), 0.53),  # 0.50 + 0.75·0.04, on the lattice's edge
        ((0.0, 0.025), 0.505),  # x and y are not swapped: 0.50 + 0.25·0.02
        ((-0.04, 0.0), 0.50),  # within half a cell of the edge
        ((0.04, 0.27), 0.80),  # a neighbour is missing: nearest cell
        ((0.0, 0.16), NAN),  # nearest cell is empty
        ((-0.06, 0.0), NAN),  # beside the lattice
        ((0.0, 0.36), NAN),
    ],
)
def test_depth_of_the_truth_between_cells(xy, depth):
    found, _ = depth_at(truth(), np.array([xy]))
    np.testing.assert_allclose(found, [depth], atol=1e-12)


def test_no_surface_is_invented_across_a_step():
    step = SurfaceTruth(X, Y, np.array([[0.5, 0.5, 2.5, 2.5]] * 3))
    found, _ = depth_at(step, np.array([[0.1, 0.14], [0.1, 0.16]]))
    np.testing.assert_array_equal(found, [0.5, 2.5])


def test_depth_errors():
    estimate = points([(0.05, 0.05, 0.54, 1), (0.0, 0.0, 0.47, 1), (0.1, 0.3, 0.84, 1), (0.2, 0.2, 0.5, 1)])
    errors = geometry_errors(estimate, truth())
    assert (errors.points, errors.compared) == (4, 3)
    # +0.01, -0.03, +0.04
    assert errors.depth_median_abs == pytest.approx(0.03)
    assert errors.depth_bias == pytest.approx(0.02 / 3)
    assert errors.depth_p95_abs == pytest.approx(
        0.03 + 0.9 * 0.01
    )  # 95 % of the way through 0.01, 0.03, 0.04


def test_coverage_and_points_off_the_truth():
    rows = [
        (0.0, 0.0, 0.51, 1),
        (0.1, 0.3, 0.82, 1),
        (0.2, 0.0, 0.50, 1),
        (0.0, 0.0, 0.9, 1),
        (0.25, 0.0, 0.54, 1),
    ]
    errors = geometry_errors(points(rows), truth(), depth_tolerance=0.02, lateral_tolerance=0.05)
    assert errors.coverage == pytest.approx(2 / 6)  # cells (0, 0) and (1, 3)
    assert errors.off_truth == pytest.approx(3 / 5)  # only the first two are near a cell
    wide = geometry_errors(points(rows), truth(), depth_tolerance=0.02)  # one cell, 0.1 m
    # (0,0) and (0,1) by the first point, (0,3) and (1,3) by the second; (1,0) is 0.03 and 0.04 m off.
    assert wide.coverage == pytest.approx(4 / 6)
    assert wide.off_truth == pytest.approx(3 / 5)


def test_normal_errors():
    tilt = math.sqrt(0.5)
    normals = np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, tilt, -tilt], [0.0, 0.0, 1.0]])
    rows = [
        (0.0, 0.0, 0.5, 1),
        (0.1, 0.0, 0.54, 1),
        (0.0, 0.3, 0.8, 1),
        (0.2, 0.2, 0.5, 1),
    ]  # the last has no truth below it
    errors = geometry_errors(points(rows, normals), truth())
    sixth = math.degrees(math.acos(0.8))  # 36.87°
    assert errors.normal_median_deg == pytest.approx(sixth)
    assert errors.normal_mean_deg == pytest.approx((0 + sixth + 45) / 3)
    assert errors.normal_p95_deg == pytest.approx(sixth + 0.9 * (45 - sixth))


def test_albedo_ratio_of_two_regions():
    rows = [
        (0.0, 0.0, 0.50, 0.8),
        (0.1, 0.1, 0.56, 0.6),
        (0.1, 0.3, 0.80, 0.2),
        (0.0, 0.3, 0.9, 9.0),
    ]  # the last is 0.1 m off
    bright, dark = ALBEDO == 1.0, ALBEDO == 0.25
    errors = geometry_errors(points(rows), truth(), regions=(bright, dark))
    assert errors.albedo_ratio == pytest.approx(0.7 / 0.2)
    assert errors.albedo_ratio_truth == pytest.approx(4.0)
    assert math.isnan(geometry_errors(points(rows), truth()).albedo_ratio)


def test_no_points_give_nan_not_a_crash():
    empty = Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    errors = geometry_errors(empty, truth(), regions=(ALBEDO == 1.0, ALBEDO == 0.25))
    assert (errors.points, errors.compared, errors.coverage) == (0, 0, 0.0)
    assert all(
        math.isnan(value)
        for value in (errors.depth_median_abs, errors.off_truth, errors.normal_mean_deg, errors.albedo_ratio)
    )
    assert set(json.loads(json.dumps(errors.to_dict()))) == set(errors.to_dict())


def test_depth_map_takes_the_median_of_each_cell():
    rows = [
        (0.01, 0.0, 0.5, 1),
        (-0.01, 0.02, 0.7, 1),
        (0.0, -0.02, 0.6, 1),
        (0.2, 0.1, 0.8, 1),
        (0.2, 0.1, 0.9, 1),
        (0.5, 0.0, 1.0, 1),
    ]
    expected = np.full((3, 4), NAN)
    expected[0, 0] = 0.6
    expected[2, 1] = 0.85  # the last point lies beside the lattice
    np.testing.assert_allclose(depth_map(points(rows), X, Y), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": DEPTH.T}, r"depth of the truth must be \[3, 4\]"),
        ({"x": X[::-1]}, "x of the truth must be evenly spaced"),
        ({"y": np.array([0.0, 0.1, 0.2, 0.4])}, "y of the truth must be evenly spaced"),
        ({"depth": np.full((3, 4), NAN)}, "no surface"),
        ({"normals": np.zeros((3, 4))}, "normals of the truth"),
    ],
)
def test_truth_checks_itself(change, message):
    with pytest.raises(ValueError, match=message):
        SurfaceTruth(**{"x": X, "y": Y, "depth": DEPTH, **change})


def test_vertices_of_the_bunny_lie_on_its_rendered_depth_map():
    """Mesh and depth map come from another program; only vertices that the wall sees are on the map."""
    with h5py.File(real_file("rendered/bunny_gt.h5")) as file:
        depth, normals, x, y = (file[name][()] for name in ("depth", "normal", "x", "y"))
    surface = SurfaceTruth(x, y, np.where(depth < 0, np.nan, depth), normals)
    lines = real_file("rendered/bunny_mesh.obj").read_text().splitlines()
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)
    first = depth_at(surface, vertices[:, :2])[0]
    seen = vertices[np.abs(vertices[:, 2] - first) < 0.02]
    facing = np.tile([0.0, 0.0, -1.0], (len(seen), 1))
    errors = geometry_errors(Points(seen, facing, np.ones(len(seen))), surface, lateral_tolerance=0.02)
    assert errors.depth_median_abs < 0.001
    assert errors.coverage > 0.9
    assert errors.off_truth < 0.01
    mirrored = Points(seen * [-1, 1, 1], facing, np.ones(len(seen)))
    assert geometry_errors(mirrored, surface).depth_median_abs > 0.02
