"""Captures, scans and volume grids: what is refused, with which sentence, and what summing gives."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import find_lattice, scan_geometry
from nlos_lit.capture.errors import CaptureError, UserError
from nlos_lit.capture.volume_grid import VolumeGrid, path_range, volume_grid
from nlos_lit.model.build import PipelineSettings, build_pipeline

NORMAL = np.array([0.0, 0.0, 1.0])


def grid_points(nx=4, ny=3, pitch=(0.1, 0.2), first=(-0.2, 0.1, 0.0)) -> np.ndarray:
    x, y = np.meshgrid(
        first[0] + pitch[0] * np.arange(nx), first[1] + pitch[1] * np.arange(ny), indexing="ij"
    )
    return np.stack([x, y, np.full_like(x, first[2])], axis=-1).reshape(-1, 3)


def fields(**changes) -> dict:
    """A valid confocal 4 × 3 capture of 10 bins."""
    points = grid_points()
    counts = np.arange(120, dtype=np.uint16).reshape(12, 10)
    given = {
        "counts": counts, "laser": points, "sensor": points, "laser_normal": np.tile(NORMAL, (12, 1)),
        "sensor_normal": np.tile(NORMAL * 2, (12, 1)), "bin_length": 0.1, "t_start": 0.5,
        "scan_shape": (4, 3),
    }  # fmt: skip
    return given | changes


def altered(array: np.ndarray, index, value) -> np.ndarray:
    array = array.astype(np.float64)
    array[index] = value
    return array


COUNTS = np.arange(120, dtype=np.float64).reshape(12, 10)
REFUSED = {
    "flat counts": ({"counts": np.ones(12)}, r"\[spots, bins\].*\(12,\)"),
    "no spots": ({"counts": np.ones((0, 10))}, "not empty"),
    "no bins": ({"counts": np.ones((12, 0))}, "not empty"),
    "text": ({"counts": np.full((12, 10), "3")}, "must be numbers"),
    "complex": ({"counts": COUNTS.astype(complex)}, "must be numbers"),
    "NaN": ({"counts": altered(COUNTS, (2, 3), np.nan)}, "1 NaN or infinite values of 120"),
    "infinite": ({"counts": altered(COUNTS, (2, slice(0, 3)), np.inf)}, "3 NaN or infinite"),
    "negative": ({"counts": altered(COUNTS, (0, 0), -2)}, r"not be negative; found -2"),
    "negative integer": ({"counts": altered(COUNTS, (0, 0), -7).astype(np.int32)}, "found -7"),
    "all zero": ({"counts": np.zeros((12, 10), dtype=np.uint8)}, "every count is zero"),
    "few laser points": ({"laser": grid_points()[:5]}, r"laser must be \[12, 3\].*\(5, 3\)"),
    "flat sensor points": ({"sensor": grid_points()[:, :2]}, r"sensor must be \[12, 3\]"),
    "NaN position": ({"sensor": altered(grid_points(), (1, 1), np.nan)}, "sensor holds NaN"),
    "zero normal": (
        {"laser_normal": altered(np.tile(NORMAL, (12, 1)), 4, 0)},
        "laser_normal holds a zero vector",
    ),
    "infinite normal": (
        {"sensor_normal": altered(np.tile(NORMAL, (12, 1)), 4, np.inf)},
        "sensor_normal holds NaN",
    ),
    "no bin length": ({"bin_length": 0.0}, "positive length"),
    "NaN bin length": ({"bin_length": float("nan")}, "positive length"),
    "no start": ({"t_start": float("inf")}, "t_start must be finite"),
    "empty gate": ({"gate": (4, 4)}, r"gate \[4, 4\) leaves no bins"),
    "long gate": ({"gate": (0, 11)}, "capture's 10"),
    "early gate": ({"gate": (-1, 5)}, "leaves no bins"),
    "wrong scan": ({"scan_shape": (4, 4)}, "does not hold the capture's 12 spots"),
    "odd scan": ({"scan_shape": (2, 2, 3)}, "does not hold"),
    "repeated order": ({"scan_order": np.zeros(12, dtype=int)}, "permutation of 0 … 11"),
    "short order": ({"scan_order": np.arange(11)}, "permutation"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_capture_refuses(name):
    changes, sentence = REFUSED[name]
    with pytest.raises(CaptureError, match=sentence):
        Capture(**fields(**changes))


def test_capture_keeps_what_it_was_given():
    given = fields(gate=(2, 9))
    capture = Capture(**given)
    assert capture.counts is given["counts"]
    assert np.allclose(np.linalg.norm(capture.sensor_normal, axis=1), 1)
    assert (capture.n_spots, capture.n_bins, capture.kind) == (12, 10, "confocal")
    assert capture.path_gate == pytest.approx((0.7, 1.4))
    assert capture.gated_counts().shape == (12, 7)
    assert capture.scan_order.tolist() == list(range(12))
    assert capture.bin_width_ps == pytest.approx(333.5641)


def test_kinds():
    laser = np.tile([0.3, 0.0, 0.0], (12, 1))
    assert Capture(**fields(laser=laser)).kind == "single_laser"
    assert Capture(**fields(sensor=laser)).kind == "single_sensor"
    assert Capture(**fields(laser=grid_points() + 0.05)).kind == "irregular"
    assert (
        Capture(**fields(laser=np.repeat(laser[:2] * [[1], [2]], 6, axis=0), scan_shape=(2, 1, 2, 3))).kind
        == "exhaustive"
    )


def test_sum_bins_by_hand():
    capture = Capture(**fields(gate=(2, 9))).sum_bins(3)
    assert capture.counts[1].tolist() == [10 + 11 + 12, 13 + 14 + 15, 16 + 17 + 18]
    assert capture.gate == (1, 3)
    assert (capture.bin_length, capture.t_start) == (pytest.approx(0.3), 0.5)
    assert capture.provenance["steps"] == ["summed 3 bins into one"]
    assert Capture(**fields(counts=np.full((12, 10), 250, dtype=np.uint8))).sum_bins(10).counts[0, 0] == 2500


def test_sum_spots_by_hand():
    capture = Capture(**fields()).sum_spots(2)
    rows = [[0, 1, 3, 4], [6, 7, 9, 10]]
    assert capture.scan_shape == (2, 1)
    assert capture.counts[:, 3].tolist() == [sum(10 * r + 3 for r in group) for group in rows]
    assert np.allclose(capture.sensor, [[-0.15, 0.2, 0], [0.05, 0.2, 0]])
    backwards = dataclasses.replace(Capture(**fields()), scan_order=np.arange(12)[::-1]).sum_spots(2)
    assert backwards.scan_order.tolist() == [1, 0]


@pytest.mark.parametrize("factor", [0, -1, 11])
def test_summing_refuses(factor):
    with pytest.raises(CaptureError, match=f"cannot sum {factor}"):
        Capture(**fields()).sum_bins(factor)
    with pytest.raises(CaptureError, match=f"cannot sum {factor}"):
        Capture(**fields()).sum_spots(factor)


def test_summing_spots_needs_a_grid_and_an_open_gate():
    with pytest.raises(CaptureError, match="only a capture with one scanned grid"):
        Capture(**fields(scan_shape=None)).sum_spots(2)
    with pytest.raises(CaptureError, match="leaves no bins"):
        Capture(**fields(gate=(1, 4))).sum_bins(3)


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


def test_volume_grid_over_the_scan():
    capture = Capture(**fields())
    grid = volume_grid(capture, depth=(0.3, 0.5))
    assert grid.shape == (5, 4, 3)
    assert np.allclose(
        [grid.x[0], grid.x[-1], grid.y[0], grid.y[-1], grid.z[0], grid.z[-1]], [-0.2, 0.1, 0.1, 0.5, 0.3, 0.5]
    )
    fine = volume_grid(capture, depth=(0.3, 0.5), depth_pitch=0.1, refine=2, lateral=(9, 3))
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
        ({"depth": (0.3, 0.5), "refine": 0}, r"refinement \(0\)"),
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


def test_a_gate_without_photons_is_refused():
    counts = np.arange(120).reshape(12, 10)
    counts[:, 5:] = 0
    capture = Capture(**fields(counts=counts, gate=(5, 10)))
    with pytest.raises(UserError, match=r"gate \[5, 10\) holds no photons"):
        build_pipeline(
            capture, volume_grid(capture, depth=(0.5, 0.7)), PipelineSettings(threshold=0.2, rays=8)
        )
