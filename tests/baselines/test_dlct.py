"""The directional light-cone transform: normals of plates that an independent simulator measured, and its
equations written out.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from baseline_scenes import box, capture_of, lattice

from data_modules.simulate import ScanPlan, SensorModel, simulate_capture
from data_modules.simulate.scenes import plate
from nlos_lit.baselines import reconstruct, reconstruct_directed
from nlos_lit.baselines.dlct import dlct_field
from nlos_lit.baselines.light_cone import cone_kernel, light_cone, padded
from nlos_lit.baselines.surface import front_points
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError, UserError

GRID = box((-0.484375, 0.484375, 32), (-0.484375, 0.484375, 32), (0.4, 0.8, 81))


def measured_plate(turn_x: float, turn_y: float) -> Capture:
    """Expected values of a plate 0.4 m wide at (0.05, -0.03, 0.6), both cosines at the plate and at the wall
    included.
    """
    scan = ScanPlan(nx=32, ny=32, width=1.0, bin_length=0.01, n_bins=200)
    sensor = SensorModel(sigma=0.005, kappa=float("inf"), background=0.0)
    return simulate_capture(
        plate((0.05, -0.03, 0.6), 0.4, 0.4, turn_x=turn_x, turn_y=turn_y), scan, sensor, None
    )[0]


@pytest.mark.parametrize(
    ("turn_x", "turn_y", "normal"),
    [
        (0.0, 0.0, (0, 0, -1)),
        (0.0, 0.4, (-np.sin(0.4), 0, -np.cos(0.4))),
        (0.3, 0.0, (0, np.sin(0.3), -np.cos(0.3))),
        (0.25, -0.2, (0.192, 0.247, -0.950)),
    ],
)
def test_normal_of_a_tilted_plate(turn_x, turn_y, normal):
    volume, field = reconstruct_directed(measured_plate(turn_x, turn_y), GRID, "dlct")
    points = front_points(volume.numpy(), GRID, 0.3, field.numpy())
    middle = (np.abs(points.positions[:, :2] - [0.05, -0.03]) < 0.13).all(axis=1)
    assert middle.sum() > 50
    angle = np.degrees(np.arccos(np.clip(points.normals[middle] @ np.array(normal), -1, 1)))
    assert np.median(angle) < 2
    mean = points.normals[middle].mean(axis=0)
    assert mean / np.linalg.norm(mean) == pytest.approx(np.array(normal), abs=0.025)


def test_magnitude_of_a_plate_that_faces_the_wall_is_that_of_the_light_cone_transform():
    capture = measured_plate(0.0, 0.0)
    near = slice(30, 51)  # 0.55 to 0.65 m
    directed, plain = (
        reconstruct(capture, GRID, method, snr=30.0)[near].sum(0) for method in ("dlct", "lct")
    )
    inner = (slice(13, 22), slice(11, 20))
    assert (directed[inner] / plain[inner]).numpy() == pytest.approx(1.0, abs=0.18)
    assert np.corrcoef(directed.ravel(), plain.ravel())[0, 1] > 0.98


def test_three_channels_solve_the_least_squares_written_out():
    """``Σ_i K_i S_i = g`` with penalty, as dense matrices on the padded domain; then to depth by hand at the
    cells' own depths.
    """
    wall = lattice(3, 2, 0.12, 0.15)
    counts = np.random.default_rng(4).poisson(3.0, (6, 12)).astype(np.uint16)
    normals = np.tile([0.0, 0.0, 1.0], (6, 1))
    capture = Capture(counts, wall, wall, normals, normals, 0.1, 0.5, scan_shape=(3, 2))
    grid = box((-0.12, 0.12, 3), (-0.075, 0.075, 2), (0.5, 0.52, 2))
    cone = light_cone(capture, grid, "dlct", 5.0)
    shape, size, depth, snr = cone.values.shape, padded(cone.values.shape), 0.51, 2.0
    plain = cone_kernel(shape, size, cone.lattice.pitch, cone.step).numpy().astype(float)
    x = np.array([k if k <= size[1] // 2 else k - size[1] for k in range(size[1])]) * 0.12
    y = np.array([k if k <= size[2] // 2 else k - size[2] for k in range(size[2])]) * 0.15
    kernels = [plain * x[:, None] / depth, plain * y / depth, plain]
    cells = list(itertools.product(*(range(n) for n in size)))
    matrix = np.concatenate(
        [np.stack([np.roll(k, s, axis=(0, 1, 2)).ravel() for s in cells], axis=1) for k in kernels], axis=1
    )
    data = np.zeros(size)
    data[tuple(slice(n) for n in shape)] = cone.values.numpy()
    penalty = sum((k**2).sum() for k in kernels) / snr * np.eye(matrix.shape[1])
    solved = np.linalg.solve(matrix.T @ matrix + penalty, matrix.T @ data.ravel()).reshape(3, *size)
    inner = solved[(slice(None), *(slice(n) for n in shape))]
    at = (
        0.5**2 - cone.first
    ) / cone.step - 0.5  # where plane z = 0.5 lies among the cells, before averaging over its thickness
    low = int(at)
    plane = (1 - (at - low)) * inner[:, low] + (at - low) * inner[:, low + 1]
    expected = np.stack([2 * 0.5 * plane[0] / depth, 2 * 0.5 * plane[1] / depth, -2 * plane[2]])
    found = dlct_field(capture, grid, snr=snr).numpy()[:, 0]
    assert found == pytest.approx(expected, abs=0.02 * np.abs(expected).max())


def test_what_dlct_cannot_do_is_said():
    wall = lattice(6, 5, 0.1, 0.12)
    capture = capture_of(np.tile(wall[:1], (30, 1)), wall, [(0.1, -0.1, 0.5)], 128, 0.02)
    grid = box((-0.2, 0.2, 7), (-0.3, 0.1, 6), (0.3, 0.7, 9))
    with pytest.raises(CaptureError, match="dlct needs a confocal scan"):
        reconstruct_directed(capture, grid, "dlct")
    with pytest.raises(UserError, match="dlct needs a positive snr; found 0"):
        reconstruct_directed(capture, grid, "dlct", snr=0)


def test_only_directional_methods_give_a_field():
    wall = lattice(6, 5, 0.1, 0.12)
    capture = capture_of(wall, wall, [(0.1, -0.1, 0.5)], 128, 0.02)
    grid = box((-0.2, 0.2, 7), (-0.3, 0.1, 6), (0.3, 0.7, 9))
    volume, field = reconstruct_directed(capture, grid, "lct", snr=0.5)
    assert field is None
    assert (volume == reconstruct(capture, grid, "lct", snr=0.5)).all()
    volume, field = reconstruct_directed(capture, grid, "dlct")
    assert (volume == reconstruct(capture, grid, "dlct")).all()
    assert (volume[field[2] >= 0] == 0).all()
