"""Wall points as a lattice: found in any order, refused where they form none."""

from __future__ import annotations

import numpy as np
import pytest
from small_capture import fields, grid_points

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import find_lattice, scan_geometry
from nlos_lit.capture.errors import CaptureError


def test_find_lattice():
    points = grid_points(pitch=(-0.1, 0.2))
    found = find_lattice(points)
    assert found.origin == pytest.approx((-0.5, 0.1, 0.0))
    assert found.pitch == pytest.approx((0.1, 0.2))
    assert points[found.spots[0]] == pytest.approx((-0.5, 0.1, 0.0))
    assert points[found.spots[1]] == pytest.approx((-0.5, 0.3, 0.0))
    assert find_lattice(grid_points() + np.random.default_rng(0).normal(0, 2e-4, (12, 3))).shape == (4, 3)


def bent(points: np.ndarray, how: str) -> np.ndarray:
    points = points.copy()
    if how == "bulging wall":
        points[:, 2] += 0.3 * points[:, 0] ** 2
    elif how == "tilted wall":
        points[:, 2] += 0.05 * points[:, 1]
    elif how == "sheared":
        points[:, 0] += 0.05 * points[:, 1]
    elif how == "stretched":
        points[:, 0] += 0.4 * points[:, 0] ** 2
    elif how == "one astray":
        points[5, 1] += 0.005
    elif how == "doubled":
        points[5] = points[4]
    return points


@pytest.mark.parametrize(
    "how", ["bulging wall", "tilted wall", "sheared", "stretched", "one astray", "doubled"]
)
def test_find_lattice_rejects(how):
    points = bent(grid_points(), how)
    with pytest.raises(CaptureError, match="its"):
        find_lattice(points)
    capture = Capture(**fields(laser=points, sensor=points))
    assert scan_geometry(capture) is None


def test_a_single_row_is_no_lattice():
    with pytest.raises(CaptureError, match="do not extend along y"):
        find_lattice(grid_points(12, 1))
