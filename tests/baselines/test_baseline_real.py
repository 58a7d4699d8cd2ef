"""Independent renders and a real capture: depth, coverage, legible letters. Files are read here directly."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import scipy.io
from baseline_scenes import box
from conftest import real_file

from nlos_lit.baselines import reconstruct
from nlos_lit.capture import SPEED_OF_LIGHT, Capture
from nlos_lit.capture.volume_grid import VolumeGrid


def rendered(name: str) -> Capture:
    with h5py.File(real_file(f"rendered/{name}.hdf5")) as file:
        counts, bin_length, t_start = file["H"][()], float(file["delta_t"][()]), float(file["t_start"][()])
        sensor = file["sensor_grid_xyz"][()].reshape(-1, 3).astype(float)
        laser = file["laser_grid_xyz"][()].reshape(-1, 3).astype(float)
    shape = counts.shape[1:]
    if len(shape) == 4:
        laser, sensor = np.repeat(laser, len(sensor), axis=0), np.tile(sensor, (len(laser), 1))
    else:
        laser = np.broadcast_to(laser, sensor.shape)
    normals = np.tile([0.0, 0.0, 1.0], (len(sensor), 1))
    flat = np.ascontiguousarray(counts.reshape(len(counts), -1).T)
    return Capture(
        flat, laser, sensor, normals, normals, bin_length, t_start, scan_shape=shape, is_counts=False
    )


def depth_errors(volume, grid: VolumeGrid, threshold: float) -> tuple[np.ndarray, float, float]:
    """Depth error in voxels where truth and volume have a surface, share of the truth that is covered, share
    that is false.
    """
    with h5py.File(real_file("rendered/z_gt.h5")) as file:
        depth, x, y = file["depth"][()], file["x"][()], file["y"][()]
    nearest = np.ix_(np.abs(x - grid.x[:, None]).argmin(1), np.abs(y - grid.y[:, None]).argmin(1))
    truth = depth[nearest]
    front = volume.max(0)
    seen = (front.values > threshold * volume.max()).numpy()
    errors = np.abs(grid.z[front.indices.numpy()] - truth)[seen & (truth > 0)] / grid.pitch[2]
    return (
        errors,
        float((seen & (truth > 0)).sum() / (truth > 0).sum()),
        float((seen & (truth < 0)).sum() / seen.sum()),
    )


@pytest.mark.parametrize(
    ("method", "threshold", "false_share"), [("lct", 0.4, 0.35), ("fk", 0.4, 0.25), ("fbp", 0.4, 0.35)]
)
def test_letter_z_confocal(method, threshold, false_share):
    grid = box((-0.484375, 0.484375, 32), (-0.484375, 0.484375, 32), (0.35, 0.75, 51))
    volume = reconstruct(rendered("z_confocal_64_d3"), grid, method)
    errors, coverage, false = depth_errors(volume, grid, threshold)
    assert np.median(errors) <= 1
    assert np.percentile(errors, 95) <= 2
    assert coverage > 0.9
    assert false < false_share


@pytest.mark.parametrize("name", ["z_single_32_d3", "z_exhaustive_8x8x8x8_d3"])
def test_letter_z_other_scans(name):
    grid = box((-0.484375, 0.484375, 32), (-0.484375, 0.484375, 32), (0.35, 0.75, 41))
    volume = reconstruct(rendered(name), grid, "fbp")
    errors, coverage, false = depth_errors(volume, grid, 0.4)
    assert np.median(errors) <= 1
    assert coverage > 0.65
    assert false < 0.4


@pytest.mark.parametrize("method", ["lct", "fk", "fbp"])
def test_su_is_legible(method):
    """Seen from the wall, +x to the left: S in front at about 0.65 m, U behind at about 1.05 m."""
    data = scipy.io.loadmat(real_file("measured/data_s_u.mat"))
    half, counts = float(data["width"].squeeze()), data["rect_data"]
    across = np.linspace(-half, half, 64)
    wall = np.stack([np.repeat(across, 64), np.tile(-across, 64), np.zeros(4096)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (4096, 1))
    bin_length = 4e-12 * SPEED_OF_LIGHT
    flat = counts.reshape(4096, 2048)
    capture = Capture(flat, wall, wall, normals, normals, bin_length, gate=(600, 2048), scan_shape=(64, 64))
    grid = box((-0.34, 0.34, 32), (-0.34, 0.34, 32), (0.5, 1.2, 71))
    capture = capture.sum_bins(4)
    volume = reconstruct(capture.sum_spots(2) if method == "fbp" else capture, grid, method, falloff=2.0)
    letters = {}
    for name, (near, far) in {"S": (0.5, 0.8), "U": (0.95, 1.15)}.items():
        part = volume[(grid.z > near) & (grid.z < far)]
        front = part.max(0).values.numpy()
        letters[name] = front / front.max()
        depths = grid.z[(grid.z > near) & (grid.z < far)][part.max(0).indices.numpy()][letters[name] > 0.5]
        assert {"S": 0.6, "U": 1.02}[name] < np.median(depths) < {"S": 0.7, "U": 1.1}[name]

    def stroke(letter: str, x: float, y: float) -> float:
        i, j = np.abs(grid.x - x).argmin(), np.abs(grid.y - y).argmin()
        return float(letters[letter][i - 1 : i + 2, j - 1 : j + 2].mean())

    on = {
        "S": [(0.12, 0.10), (0.15, 0.02), (0.05, -0.05), (-0.06, -0.12), (0.08, -0.20)],
        "U": [(0.0, 0.15), (-0.22, 0.1), (-0.23, -0.05), (-0.1, -0.11)],
    }
    off = {
        "S": [(-0.02, 0.03), (0.1, -0.12), (-0.2, 0.1), (0.28, -0.05)],
        "U": [(-0.1, 0.1), (-0.1, 0.25), (0.25, 0.0), (-0.1, -0.25)],
    }
    for letter in ("S", "U"):
        dimmest, brightest = (
            min(stroke(letter, *p) for p in on[letter]),
            max(stroke(letter, *p) for p in off[letter]),
        )
        assert dimmest > 1.25 * brightest


def test_figure_4_is_legible():
    """Not confocal, one detector: bars, crossbar and the open top of the 4, with +x to the left."""
    readers = pytest.importorskip("data_modules.readers")
    capture = readers.read_capture(real_file("measured/figure_4"))
    assert capture.kind == "single_sensor"
    grid = box((-0.6, 0.6, 31), (-0.6, 0.6, 31), (0.75, 1.1, 36))
    front = reconstruct(capture, grid, "fbp").max(0).values.numpy()

    def near(x: float, y: float) -> float:
        i, j = np.abs(grid.x - x).argmin(), np.abs(grid.y - y).argmin()
        return float(front[i - 1 : i + 2, j - 1 : j + 2].mean())

    strokes = [
        near(x, y)
        for x, y in ((0.42, 0.18), (0.42, 0.05), (0.26, -0.02), (0.1, 0.2), (0.1, 0.0), (0.1, -0.2))
    ]
    gaps = [near(x, y) for x, y in ((0.26, 0.25), (0.34, -0.3), (-0.15, 0.1), (-0.15, -0.3))]
    assert min(strokes) > 1.25 * max(gaps)
