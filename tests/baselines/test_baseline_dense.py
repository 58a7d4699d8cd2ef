"""Every method against a dense, literal numpy implementation of its equations, on small cases."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from baseline_scenes import box, capture_of, lattice
from scipy.fft import next_fast_len
from scipy.ndimage import gaussian_laplace

from nlos_lit.baselines import bp, fbp, fk, lct
from nlos_lit.baselines.light_cone import wiener_cone
from nlos_lit.baselines.migration import stolt
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError


def noisy_capture(
    laser: np.ndarray, sensor: np.ndarray, bins: int, t_start: float, gate: tuple[int, int]
) -> Capture:
    counts = np.random.default_rng(5).poisson(3.0, (len(laser), bins)).astype(np.uint16)
    normals = np.tile([0.0, 0.0, 1.0], (len(laser), 1))
    return Capture(counts, laser, sensor, normals, normals, 0.02, t_start, gate=gate)


@pytest.mark.parametrize("kind", ["confocal", "pairs"])
def test_bp_sums_the_bin_of_every_path(kind, monkeypatch):
    monkeypatch.setattr("nlos_lit.baselines.backprojection._BLOCK", 50)
    monkeypatch.setattr("nlos_lit.baselines.backprojection._TABLE", 700)
    wall = lattice(4, 3, 0.1, 0.13)
    laser = wall if kind == "confocal" else wall[[3, 3, 1, 0, 7, 7, 2, 9, 3, 3, 1, 0]] + [0.01, 0.0, -0.02]
    capture = noisy_capture(laser, wall, 60, 0.31, (5, 52))
    grid = box((-0.2, 0.15, 9), (-0.1, 0.2, 11), (0.2, 0.9, 8))
    gated = np.where((np.arange(60) >= 5) & (np.arange(60) < 52), capture.counts, 0.0)
    centres = 0.31 + 0.02 * (np.arange(60) + 0.5)
    expected = np.zeros(grid.shape)
    for (k, z), (i, x), (j, y) in itertools.product(enumerate(grid.z), enumerate(grid.x), enumerate(grid.y)):
        for s in range(len(wall)):
            path = np.linalg.norm(laser[s] - (x, y, z)) + np.linalg.norm(wall[s] - (x, y, z))
            expected[k, i, j] += np.interp(path, centres, gated[s])
    assert expected.max() > 30
    np.testing.assert_allclose(bp(capture, grid).numpy(), expected, rtol=2e-4, atol=2e-3)


def test_fbp_is_the_laplacian_of_gaussian_of_bp():
    wall = lattice(6, 5, 0.1, 0.13)
    capture = capture_of(wall, wall, [(0.1, -0.05, 0.5)], 120, 0.02)
    grid = box((-0.2, 0.25, 10), (-0.2, 0.2, 9), (0.3, 0.8, 26))
    volume = bp(capture, grid).numpy().astype(np.float64)
    expected = np.maximum(-(1.5**2) * gaussian_laplace(volume, 1.5, mode="nearest", truncate=4), 0)
    np.testing.assert_allclose(fbp(capture, grid, sigma=1.5).numpy(), expected, atol=0.01 * expected.max())


def test_fbp_second_derivative_of_a_parabola():
    """On counts that are a parabola of depth the filter returns its curvature: -σ²·d²/dz² (in voxels) of
    -(z/dz)² is 2σ².
    """
    t = (np.arange(200) + 0.5) * 0.01
    counts = (400.0 - (t / 2 / 0.025 - 15) ** 2)[None].astype(np.float32).clip(0)
    zero = np.zeros((1, 3))
    capture = Capture(counts, zero, zero, np.array([[0, 0, 1.0]]), np.array([[0, 0, 1.0]]), 0.01)
    grid = box((0.0, 0.01, 2), (0.0, 0.01, 2), (0.025, 0.775, 31))
    volume = fbp(capture, grid, filter="second_derivative", sigma=2.0).numpy()
    np.testing.assert_allclose(volume[10:20, 0, 0], 8.0, rtol=0.01)


def test_fbp_options_are_checked():
    wall = lattice(3, 3, 0.1, 0.1)
    capture = noisy_capture(wall, wall, 60, 0.0, (0, 60))
    grid = box((-0.1, 0.1, 3), (-0.1, 0.1, 3), (0.2, 0.5, 4))
    with pytest.raises(UserError, match="'log' and 'second_derivative'; found 'sobel'"):
        fbp(capture, grid, filter="sobel")
    with pytest.raises(UserError, match="positive sigma"):
        fbp(capture, grid, sigma=0.0)
    with pytest.raises(UserError, match="positive snr"):
        lct(capture, grid, snr=-1.0)


def dense_wiener(cone: np.ndarray, pitch: tuple[float, float], step: float, snr: float) -> np.ndarray:
    """Least squares with the kernel written out as a matrix on the padded, circular domain."""
    size = [next_fast_len(2 * n, real=True) for n in cone.shape]
    kernel = np.zeros(size)
    for i, j in itertools.product(
        range(-cone.shape[1] + 1, cone.shape[1]), range(-cone.shape[2] + 1, cone.shape[2])
    ):
        w = ((i * pitch[0]) ** 2 + (j * pitch[1]) ** 2) / step
        for cell in range(cone.shape[0]):
            kernel[cell, i, j] = max(0.0, 1 - abs(w - cell)) * pitch[0] * pitch[1]
    cells = list(itertools.product(*(range(n) for n in size)))
    matrix = np.stack([np.roll(kernel, shift, axis=(0, 1, 2)).ravel() for shift in cells], axis=1)
    padded = np.zeros(size)
    padded[tuple(slice(n) for n in cone.shape)] = cone
    normal = matrix.T @ matrix + (kernel**2).sum() / snr * np.eye(len(cells))
    solved = np.linalg.solve(normal, matrix.T @ padded.ravel()).reshape(size)
    return solved[tuple(slice(n) for n in cone.shape)]


@pytest.mark.parametrize("snr", [0.8, 50.0])
def test_wiener_filter_is_the_regularised_inverse(snr):
    cone = np.random.default_rng(1).uniform(0, 1, (8, 4, 3))
    found = wiener_cone(torch.from_numpy(cone).float(), (0.1, 0.12), 0.013, snr)
    expected = dense_wiener(cone, (0.1, 0.12), 0.013, snr)
    np.testing.assert_allclose(found.numpy(), expected, atol=2e-5 * np.abs(expected).max())


def test_wiener_filter_inverts_the_cone():
    """Two points put through the literal light-cone sum come back, in units of density, when the noise is
    small.

    The pitch is so large that each cone leaves the last cell of v before it leaves the lattice: nothing is
    cut off.
    """
    points = {(4, 6): 1.0, (6, 4): 0.6}
    cone = np.zeros((24, 11, 11))
    for ((x, y), albedo), i, j, v in itertools.product(points.items(), range(11), range(11), range(24)):
        w = (((i - x) * 0.13) ** 2 + ((j - y) * 0.14) ** 2) / 0.01
        cone[v, i, j] += albedo * 0.13 * 0.14 * max(0.0, 1 - abs(w - v))
    found = wiener_cone(torch.from_numpy(cone).float(), (0.13, 0.14), 0.01, 1e4).numpy()
    expected = np.zeros((24, 11, 11))
    for (x, y), albedo in points.items():
        expected[0, x, y] = albedo
    np.testing.assert_allclose(found, expected, atol=0.07)


@pytest.mark.parametrize(("falloff", "t_start"), [(4.0, 0.0), (2.0, 0.31)])
def test_lct_is_the_light_cone_transform(falloff, t_start):
    wall = lattice(4, 3, 0.1, 0.12)
    capture = noisy_capture(wall, wall, 30, t_start, (9, 19))
    first, last = t_start + 9 * 0.02, t_start + 19 * 0.02
    v_first, v_last = (first / 2) ** 2, (last / 2) ** 2
    step = (v_last - v_first) / 10
    cone = np.zeros((10, 4, 3))
    fine = 4000  # each bin cut into this many slices of equal v, each dropped into its cell
    for k in range(10):
        low, high = ((first + k * 0.02) / 2) ** 2, ((first + (k + 1) * 0.02) / 2) ** 2
        for v in low + (np.arange(fine) + 0.5) / fine * (high - low):
            cell = min(int((v - v_first) / step), 9)
            cone[cell] += capture.counts[:, 9 + k].reshape(4, 3) / fine / step * v ** (falloff / 2)
    solved = dense_wiener(cone, (0.1, 0.12), step, 0.8)
    x, y = wall[::3, 0], wall[:3, 1]
    z0, z1 = first / 2 + 0.02, last / 2 - 0.02
    grid = box((x[0], x[-1], 4), (y[0], y[-1], 3), (z0, z0 + 5e-4, 6))
    for start in np.linspace(z0, z1, 5):
        moved = type(grid)((grid.origin[0], grid.origin[1], start), grid.pitch, grid.shape)
        u = v_first + step * (np.arange(10) + 0.5)
        expected = np.stack(
            [
                [[2 * z * np.interp(z * z, u, solved[:, i, j]) for j in range(3)] for i in range(4)]
                for z in moved.z
            ]
        )
        expected = np.maximum(expected, 0)
        np.testing.assert_allclose(
            lct(capture, moved, falloff=falloff).numpy(), expected, atol=2e-3 * solved.max()
        )


def literal_migration(field: np.ndarray, pitch: tuple[float, float], step: float, first: float) -> np.ndarray:
    """The migration integral with the spectrum evaluated exactly at every ``f`` by its defining sum."""
    bins, nx, ny = field.shape
    size, px, py = (next_fast_len(2 * n, real=True) for n in (bins, nx, ny))
    zeta, x, y = first + step * np.arange(bins), pitch[0] * np.arange(nx), pitch[1] * np.arange(ny)
    image = np.zeros((bins, nx, ny), dtype=complex)
    for a, b, m in itertools.product(range(px), range(py), range(1, size // 2 + 1)):
        kx, ky, kz = np.fft.fftfreq(px, pitch[0])[a], np.fft.fftfreq(py, pitch[1])[b], m / size / step
        f = np.sqrt(kx**2 + ky**2 + kz**2)
        if f > 0.5 / step * (1 + 1e-9):
            continue
        wave = np.exp(-2j * np.pi * kx * x)[:, None] * np.exp(-2j * np.pi * ky * y)
        spectrum = (np.exp(-2j * np.pi * f * zeta) @ (field * wave).sum((1, 2))) * kz / f
        image += 2 * spectrum * np.exp(2j * np.pi * kz * zeta)[:, None, None] * wave.conj()
    return image / (size * px * py)


@pytest.mark.parametrize("first", [0.0, 0.37])
def test_stolt_is_the_migration_integral(first):
    step, pitch = 0.02, (0.05, 0.06)
    field = np.random.default_rng(2).uniform(0, 1, (24, 6, 5))
    found = stolt(torch.from_numpy(field).float(), pitch, step, first).numpy()
    expected = literal_migration(field, pitch, step, first)
    assert np.abs(found - expected).max() < 0.02 * np.abs(expected).max()


def test_fk_migrates_the_root_of_the_counts():
    wall = lattice(6, 5, 0.05, 0.06)
    capture = noisy_capture(wall, wall, 40, 0.11, (9, 33))
    x, y = wall[::5, 0], wall[:5, 1]
    first = (0.11 + 9.5 * 0.02) / 2
    grid = box((x[0], x[-1], 6), (y[0], y[-1], 5), (first, first + 0.23, 24))
    depth = first + 0.01 * np.arange(24)
    field = np.sqrt(capture.counts[:, 9:33].T * depth[:, None] ** 2.0).reshape(24, 6, 5)
    expected = np.abs(literal_migration(field, (0.05, 0.06), 0.01, first)) ** 2
    np.testing.assert_allclose(fk(capture, grid, falloff=2.0).numpy(), expected, atol=0.02 * expected.max())
