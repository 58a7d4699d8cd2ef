"""Recognising a lattice, refusing what cannot work, estimating memory, resampling."""

from __future__ import annotations

import contextlib
import dataclasses

import numpy as np
import pytest
import torch
from baseline_scenes import box, capture_of, lattice

from nlos_lit.baselines import METHODS, estimate_bytes, reconstruct
from nlos_lit.baselines.inputs import gated_transients
from nlos_lit.baselines.resample import apply_weights, linear_weights
from nlos_lit.capture.aperture import find_lattice
from nlos_lit.capture.errors import CaptureError, MemoryBudgetError, UserError
from nlos_lit.capture.volume_grid import path_range

WALL = lattice(6, 5, 0.1, 0.12, centre=(0.03, -0.2))
GRID = box((-0.2, 0.2, 7), (-0.3, 0.1, 6), (0.3, 0.7, 9))
POINT = (0.1, -0.1, 0.5)


def test_lattice_is_found_in_any_order():
    order = np.random.default_rng(0).permutation(30)
    points = WALL[order] + np.array([0.0, 0.0, 0.4])
    found = find_lattice(points)
    assert found.shape == (6, 5)
    np.testing.assert_allclose(found.pitch, (0.1, 0.12))
    np.testing.assert_allclose(found.origin, (-0.22, -0.44, 0.4))
    np.testing.assert_array_equal(points[found.spots], WALL + np.array([0.0, 0.0, 0.4]))


def bad_points(name: str) -> np.ndarray:
    points = WALL.copy()
    if name == "uneven":
        points[points[:, 0] > 0.2, 0] += 0.02
    elif name == "missing":
        points = points[:-1]
    elif name == "curved":
        points[:, 2] = 0.1 * points[:, 0] ** 2
    elif name == "line":
        points = points[:5]
    elif name == "doubled":
        points[7] = points[8]
    return points


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("uneven", r"not evenly spaced along x \(gaps between 0.1 and 0.12 m\)"),
        ("missing", "29 spots do not fill a lattice of 6 × 5 positions"),
        ("curved", "do not lie in a plane"),
        ("line", "do not extend along x"),
        ("doubled", "share one lattice position"),
    ],
)
@pytest.mark.parametrize("method", ["lct", "fk"])
def test_no_lattice_is_said_clearly(method, name, reason):
    points = bad_points(name)
    capture = capture_of(points, points, [POINT], 128, 0.02)
    title = {"lct": "lct", "fk": "f-k"}[method]
    with pytest.raises(
        CaptureError,
        match=f"{title} needs a confocal scan on a regular planar grid; this capture is .*{reason}",
    ):
        reconstruct(capture, GRID, method)
    assert reconstruct(capture, GRID, "bp").shape == GRID.shape


@pytest.mark.parametrize("method", ["lct", "fk"])
def test_not_confocal_is_said_clearly(method):
    capture = capture_of(np.tile(WALL[:1], (30, 1)), WALL, [POINT], 128, 0.02)
    for function in (reconstruct, estimate_bytes):
        with pytest.raises(
            CaptureError, match="needs a confocal scan on a regular planar grid; this capture is single_laser"
        ):
            function(capture, GRID, method)


def test_path_range_bounds_every_path():
    capture = capture_of(np.tile(WALL[:1], (30, 1)), WALL, [POINT], 128, 0.02)
    shortest, longest = path_range(capture, GRID)
    x, y, z = np.meshgrid(GRID.x, GRID.y, GRID.z, indexing="ij")
    voxels = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    paths = sum(
        np.linalg.norm(voxels[:, None] - points[None], axis=2) for points in (capture.laser, capture.sensor)
    )
    assert shortest <= paths.min()
    assert longest >= paths.max()
    assert shortest > 0.6
    assert longest < paths.max() + 0.05


@pytest.mark.parametrize("method", sorted(METHODS))
@pytest.mark.parametrize("gate", [(0, 20), (110, 128)])
def test_volume_outside_the_gate(method, gate):
    capture = capture_of(WALL, WALL, [POINT], 128, 0.02, gate=gate)
    sentence = r"the volume \(depth .* light paths 0\.6 to .* m\) lies outside the capture's time window"
    with pytest.raises(CaptureError, match=sentence):
        reconstruct(capture, GRID, method)


def test_gated_transients():
    capture = capture_of(WALL, WALL, [POINT], 128, 0.02, t_start=-0.05, gate=(1, 90))
    found, start = gated_transients(capture, 1.0, 0.0)
    # bins 0 to 2 begin at negative paths; the bin at path 1.0 is number 52 (from 0.99 to 1.01), one more is
    # kept
    assert start == pytest.approx(0.01)
    assert found.shape == (30, 51)
    np.testing.assert_allclose(found.numpy(), capture.counts[:, 3:54])
    weighted, _ = gated_transients(capture, 1.0, 2.0)
    np.testing.assert_allclose(weighted[:, 10].numpy(), capture.counts[:, 13] * (0.22 / 2) ** 2, rtol=1e-6)


def test_unknown_method_and_option():
    capture = capture_of(WALL, WALL, [POINT], 128, 0.02)
    with pytest.raises(UserError, match="unknown method 'mirror'; choose one of bp, fbp, lct, dlct, fk, rsd"):
        reconstruct(capture, GRID, "mirror")
    with pytest.raises(UserError, match="method lct has no option 'sigma'; it takes snr, falloff"):
        reconstruct(capture, GRID, "lct", sigma=1.0)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_budget_is_checked_before_work(method, monkeypatch):
    capture = capture_of(WALL, WALL, [POINT], 128, 0.02)
    need = estimate_bytes(capture, GRID, method)
    assert reconstruct(capture, GRID, method, budget_bytes=need).shape == GRID.shape

    def forbidden(*_):
        raise AssertionError("work was begun")

    for module in ("backprojection", "light_cone", "migration"):
        monkeypatch.setattr(f"nlos_lit.baselines.{module}.gated_transients", forbidden)
    monkeypatch.setattr("nlos_lit.model.phasor.PhasorImaging.prepare", forbidden)
    with pytest.raises(MemoryBudgetError, match=f"method {method} needs .* GiB, above the budget of"):
        reconstruct(capture, GRID, method, budget_bytes=need - 1)


def test_estimates_follow_the_size():
    wall = lattice(32, 32, 0.03, 0.03)
    small = capture_of(wall, wall, [POINT], 128, 0.02)
    large = dataclasses.replace(small, counts=np.repeat(small.counts, 4, axis=1), bin_length=0.005, gate=None)
    for method in ("lct", "fk"):
        # each further bin the volume's light can reach adds at least its padded spectrum: twice as many bins,
        # x and y of 4 bytes
        assert estimate_bytes(large, GRID, method) - estimate_bytes(small, GRID, method) > 4 * 8 * 1024 * 250
    big = dataclasses.replace(GRID, shape=(256, 256, 256))
    for method in METHODS:
        assert estimate_bytes(small, big, method) > 4 * 256**3


def test_linear_weights_by_hand():
    centres = np.array([-0.6, -0.4, 0.0, 0.25, 1.5, 2.0, 2.45, 2.6])
    found = linear_weights(0.0, 1.0, 3, centres, 0.5)
    expected = [
        [0, 0, 0],
        [1, 0, 0],
        [1, 0, 0],
        [0.75, 0.25, 0],
        [0, 0.5, 0.5],
        [0, 0, 1],
        [0, 0, 1],
        [0, 0, 0],
    ]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_wide_voxels_average_instead_of_skipping():
    found = linear_weights(0.0, 1.0, 12, np.array([3.5, 7.5]), 4.0)
    # four points at -1.5, -0.5, 0.5, 1.5 around each centre fall on samples 2 to 5 and 6 to 9
    expected = np.zeros((2, 12))
    expected[0, 2:6] = expected[1, 6:10] = 0.25
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_weights_act_on_their_own_axis():
    x, y, z = np.arange(4.0), np.arange(5.0), np.arange(6.0)
    volume = torch.from_numpy(100 * z[:, None, None] + 10 * x[:, None] + y).float()
    found = apply_weights(
        volume,
        linear_weights(0.0, 1.0, 6, np.array([0.5, 4.25]), 1.0),
        linear_weights(0.0, 1.0, 4, np.array([2.5]), 1.0),
        linear_weights(0.0, 1.0, 5, np.arange(5.0), 1.0),
    )
    expected = np.array([50, 425])[:, None, None] + 25 + y[None, None]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_a_volume_that_has_left_the_numbers_is_no_result(method):
    capture = capture_of(WALL, WALL, [POINT], 128, 0.02)
    counts = capture.counts.astype(np.float32)
    counts[3, 60] = 3e38
    broken = dataclasses.replace(capture, counts=counts, is_counts=False)
    told = pytest.raises(CaptureError, match=r"has left the numbers \(NaN or infinite voxels\), which is no")
    with told if method == "lct" else contextlib.suppress(CaptureError):
        assert torch.isfinite(reconstruct(broken, GRID, method)).all()
