"""Volume grids over a scan, and the light paths through them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from small_capture import fields, grid_points

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError, UserError
from nlos_lit.capture.volume_grid import VolumeGrid, path_range, volume_grid


def test_volume_grid_over_the_scan():
    capture = Capture(**fields())
    grid = volume_grid(capture, depth=(0.3, 0.5))
    assert grid.shape == (5, 4, 3)
    assert np.allclose(
        [grid.x[0], grid.x[-1], grid.y[0], grid.y[-1], grid.z[0], grid.z[-1]], [-0.2, 0.1, 0.1, 0.5, 0.3, 0.5]
    )
    fine = volume_grid(capture, depth=(0.3, 0.5), depth_pitch=0.1, upsample=2, lateral=(9, 3))
    assert fine.pitch == pytest.approx((0.05, 0.1, 0.1))
    assert np.allclose([fine.x.mean(), fine.y.mean()], [-0.05, 0.3])
    assert np.allclose(np.mod((fine.x + 0.2) / 0.05 + 1e-9, 1), 0, atol=1e-6)
    shift = np.array([0, 0, 0.02])
    apart = dataclasses.replace(capture, laser=capture.laser + shift, sensor=capture.sensor + shift)
    assert volume_grid(apart, depth=(0.3, 0.5)).z[0] == pytest.approx(0.32)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"depth": (0.5, 0.5)}, r"0 < nearest < farthest; found \[0.5, 0.5\]"),
        ({"depth": (-0.1, 0.5)}, "nearest < farthest"),
        ({"depth": (0.3, 0.5), "depth_pitch": 0.0}, "must be positive"),
        ({"depth": (0.3, 0.5), "upsample": 0}, r"upsample \(0\)"),
        ({"depth": (5.0, 6.0)}, r"outside the capture's time window.*0.5 to 1.5.*0.25 to 0.75"),
        ({"depth": (0.01, 0.05)}, "outside the capture's time window"),
    ],
)
def test_volume_grid_refuses(options, sentence):
    points = grid_points(pitch=(0.01, 0.02))
    with pytest.raises(UserError, match=sentence):
        volume_grid(Capture(**fields(laser=points, sensor=points)), **options)


def test_volume_grid_of_spots_on_a_line():
    line = np.stack([np.linspace(0, 1, 12), np.zeros(12), np.zeros(12)], axis=1)
    with pytest.raises(UserError, match="on one line"):
        volume_grid(Capture(**fields(laser=line, sensor=line, scan_shape=None)), depth=(0.3, 0.5))


def test_path_range_bounds_every_path():
    rng = np.random.default_rng(1)
    laser = rng.normal(0, 0.3, (12, 3)) * [1, 1, 0.05]
    capture = Capture(**fields(laser=laser, scan_shape=None))
    grid = VolumeGrid((0.4, -0.1, 0.3), (-0.1, 0.05, 0.06), (5, 6, 4))
    z, x, y = np.meshgrid(grid.z, grid.x, grid.y, indexing="ij")
    voxels = np.stack([x, y, z], axis=-1).reshape(-1, 1, 3)
    paths = np.linalg.norm(voxels - laser, axis=2) + np.linalg.norm(voxels - capture.sensor, axis=2)
    near, far = path_range(capture, grid)
    assert near <= paths.min() < 1.5 * near
    assert paths.max() <= far < 1.5 * paths.max()


def test_a_volume_that_holds_the_wall_is_refused():
    """A wall tilted by 30° reaches into it, and light would take no time there."""
    flat = fields()["laser"]
    tilted = flat @ np.array([[0.866, 0.0, -0.5], [0.0, 1.0, 0.0], [0.5, 0.0, 0.866]])
    capture = Capture(**fields(laser=tilted, sensor=tilted, t_start=0.0))
    with pytest.raises(CaptureError, match=r"holds points of the wall, which lie at z = .* begin deeper"):
        volume_grid(capture, depth=(0.02, 0.4))
