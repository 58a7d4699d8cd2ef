"""Surface points of a volume, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from baseline_scenes import box

from nlos_lit.baselines.surface import front_points

GRID = box((-0.3, 0.3, 7), (0.1, 0.5, 5), (0.5, 0.9, 41))  # pitches 0.1, 0.1, 0.01


def test_depth_is_the_vertex_of_a_parabola():
    volume = np.zeros(GRID.shape)
    volume[20:23, 3, 2] = [
        0.5,
        1.0,
        0.75,
    ]  # vertex at 1/6: (0.5 - 0.75)/(2 (0.5 - 2 + 0.75)) planes past plane 21
    volume[10:13, 5, 1] = [0.0, 0.4, 0.0]
    volume[0, 0, 0] = 0.3  # below the threshold
    volume[40, 6, 4] = 0.9  # at the last plane: no vertex
    points = front_points(volume, GRID, 0.35)
    assert points.positions == pytest.approx(
        np.array([[0.0, 0.3, 0.71 + 0.01 / 6], [0.2, 0.2, 0.61], [0.3, 0.5, 0.9]])
    )
    assert points.albedo == pytest.approx([1.0, 0.4, 0.9])
    assert points.normals == pytest.approx(np.tile([0.0, 0.0, -1.0], (3, 1)))  # single columns face the wall


def sheet(depth: np.ndarray) -> np.ndarray:
    return np.exp(-(((GRID.z[:, None, None] - depth) / 0.015) ** 2))


@pytest.mark.parametrize("smooth", [0.0, 1.0])
def test_normals_of_a_sloping_sheet(smooth):
    x, y = np.meshgrid(GRID.x, GRID.y, indexing="ij")
    points = front_points(sheet(0.7 + 0.3 * x - 0.1 * (y - 0.3)), GRID, 0.2, smooth=smooth)
    expected = np.array([0.3, -0.1, -1.0]) / np.sqrt(1.1)
    middle = (np.abs(points.positions[:, 0]) < 0.05) & (np.abs(points.positions[:, 1] - 0.3) < 0.05)
    assert points.normals[middle][0] == pytest.approx(expected, abs=0.01)
    if smooth == 0:
        assert points.normals == pytest.approx(np.tile(expected, (len(points), 1)), abs=0.01)


def test_a_step_between_two_surfaces_is_no_slope():
    x, _ = np.meshgrid(GRID.x, GRID.y, indexing="ij")
    steep = front_points(
        sheet(np.where(x > -0.05, 0.9, 0.5)), GRID, 0.2, smooth=0.0
    )  # 0.4 m over a column of 0.1 m
    assert steep.normals == pytest.approx(np.tile([0.0, 0.0, -1.0], (len(steep), 1)), abs=1e-6)


def test_given_directions_are_the_normals():
    volume, field = np.zeros(GRID.shape), np.zeros((3, *GRID.shape))
    volume[20, 3, 2] = 2.0
    field[:, 20, 3, 2] = [0.6, 0.0, -0.8]
    field[:, 21, 3, 2] = [9.0, 9.0, 9.0]
    points = front_points(volume, GRID, 0.5, 3 * field)
    assert points.normals == pytest.approx(np.array([[0.6, 0.0, -0.8]]))


def test_an_empty_volume_has_no_points():
    assert len(front_points(np.zeros(GRID.shape), GRID, 0.2)) == 0
