"""Every method finds analytic point scatterers where they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from baseline_scenes import box, capture_of, lattice, off_by

from nlos_lit.baselines import METHODS, reconstruct

POINT = (0.11, -0.17, 0.52)
GRID = box((-0.3, 0.24, 19), (-0.27, 0.3, 20), (0.36, 0.72, 31))
WALL = lattice(24, 20, 0.03, 0.035, centre=(0.02, -0.01))


FLAT = {method: {} if method == "rsd" else {"falloff": 0.0} for method in METHODS}


@pytest.mark.parametrize("t_start", [0.0, 0.33, -0.2])
@pytest.mark.parametrize("method", sorted(METHODS))
def test_point_confocal(method, t_start):
    capture = capture_of(WALL, WALL, [POINT], 256, 0.01, t_start, scan_shape=(24, 20))
    volume = reconstruct(capture, GRID, method)
    assert volume.shape == (31, 19, 20)
    assert volume.dtype == torch.float32
    assert float(volume.min()) >= 0
    assert off_by(volume, GRID, POINT) <= 1.001


@pytest.mark.parametrize("method", sorted(METHODS))
def test_coinciding_grid(method):
    x, y = WALL[::20, 0], WALL[:20, 1]
    grid = box((x[0], x[-1], 24), (y[0], y[-1], 20), (0.4, 0.64, 25))
    capture = capture_of(WALL, WALL, [POINT], 200, 0.01, scan_shape=(24, 20))
    assert off_by(reconstruct(capture, grid, method), grid, POINT) <= 1.001


@pytest.mark.parametrize("method", sorted(METHODS))
def test_spots_in_any_order(method):
    order = np.random.default_rng(3).permutation(len(WALL))
    expected = reconstruct(capture_of(WALL, WALL, [POINT], 200, 0.01), GRID, method)
    shuffled = reconstruct(capture_of(WALL[order], WALL[order], [POINT], 200, 0.01), GRID, method)
    torch.testing.assert_close(shuffled, expected, rtol=1e-4, atol=1e-5 * float(expected.max()))


@pytest.mark.parametrize("method", sorted(METHODS))
def test_wall_away_from_the_origin(method):
    wall = WALL + np.array([0.0, 0.0, -0.15])
    capture = capture_of(wall, wall, [POINT], 256, 0.01)
    assert off_by(reconstruct(capture, GRID, method), GRID, POINT) <= 1.001


@pytest.mark.parametrize("method", ["bp", "fbp"])
@pytest.mark.parametrize("kind", ["single_laser", "single_sensor", "exhaustive", "irregular"])
def test_point_other_scans(method, kind):
    one = np.tile([0.21, 0.08, 0.0], (len(WALL), 1))
    coarse_l, coarse_s = lattice(5, 4, 0.13, 0.15), lattice(6, 5, 0.11, 0.12)
    rng = np.random.default_rng(7)
    rough = np.concatenate([rng.uniform(-0.35, 0.35, (300, 2)), rng.uniform(-0.06, 0.03, (300, 1))], axis=1)
    laser, sensor, shape = {
        "single_laser": (one, WALL, (24, 20)),
        "single_sensor": (WALL, one, (24, 20)),
        "exhaustive": (np.repeat(coarse_l, 30, axis=0), np.tile(coarse_s, (20, 1)), (5, 4, 6, 5)),
        "irregular": (rough, rng.permutation(rough), None),
    }[kind]
    capture = capture_of(laser, sensor, [POINT], 256, 0.01, 0.2, scan_shape=shape)
    assert capture.kind == kind
    assert off_by(reconstruct(capture, GRID, method), GRID, POINT) <= 1.001


@pytest.mark.parametrize("method", ["fbp", "lct", "fk"])
def test_two_depths_are_separated(method):
    near, far = (0.11, -0.17, 0.46), (-0.13, 0.12, 0.64)
    capture = capture_of(WALL, WALL, [near, far], 256, 0.01)
    options = {"falloff": 4.0} if method == "fbp" else {}
    volume = reconstruct(capture, GRID, method, **options)
    for point, part in ((near, slice(0, 15)), (far, slice(16, 31))):
        half = torch.zeros_like(volume)
        half[part] = volume[part]
        assert off_by(half, GRID, point) <= 1
        assert float(half.max()) > 0.2 * float(volume.max())
    between = round((0.55 - 0.36) / GRID.pitch[2])
    assert float(volume[between].max()) < 0.2 * float(volume.max())


@pytest.mark.parametrize(("power", "falloff"), [(1.0, 2.0), (2.0, 4.0)], ids=["retroreflective", "diffuse"])
@pytest.mark.parametrize("method", ["lct", "fk"])
def test_falloff_is_compensated(method, power, falloff):
    near, far = (0.05, -0.07, 0.4), (0.05, -0.07, 0.8)
    grid = box((-0.2, 0.25, 16), (-0.3, 0.15, 16), (0.3, 0.9, 61))
    wall = lattice(32, 32, 0.03, 0.03)
    peaks = [
        float(
            reconstruct(
                capture_of(wall, wall, [p], 256, 0.01, power=power), grid, method, falloff=falloff
            ).max()
        )
        for p in (near, far)
    ]
    # a falloff wrong by one power of z² would change the ratio by 4
    assert 0.5 < peaks[0] / peaks[1] < 1.5


@pytest.mark.parametrize("method", sorted(METHODS))
def test_bins_outside_the_gate_do_not_count(method):
    decoy = (-0.1, 0.1, 0.4)
    reach = (
        2 if method == "rsd" else 1
    )  # |u|² of a 14 cm pulse peaks 1.6 cm early: it falls steeply with depth so near the wall
    both = capture_of(WALL, WALL, [POINT, decoy], 256, 0.01, gate=(100, 256))
    assert off_by(reconstruct(both.with_gate(first=0), GRID, method, **FLAT[method]), GRID, decoy) <= reach
    direct = both.counts.copy()
    direct[:, :100] = 1e6
    before = both.counts.copy()
    expected = reconstruct(both, GRID, method)
    found = reconstruct(dataclasses.replace(both, counts=direct), GRID, method)
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    np.testing.assert_array_equal(both.counts, before)
