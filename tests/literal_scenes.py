"""Small asymmetric scenes of every kind of scan, with the package's pipeline for each."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid, volume_grid
from nlos_lit.model.albedo import FreeAlbedo, ResidualAlbedo
from nlos_lit.model.geometry import ImplicitGeometry
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.model.phasor import PhasorImaging
from nlos_lit.model.pipeline import Pipeline
from nlos_lit.model.renderer import TransientRenderer

BIN, BINS, START = 0.02, 128, 0.06
RAYS, BETA, STEP = 32, 1e3, 0.01
NAMES = ("omega_pf", "sigma_pf", "sigma_ls", "I_l", "kappa_s", "eta_s", "albedo")


@dataclass(frozen=True)
class Case:
    scan: str
    power: float
    depth_exponent: float
    albedo: str
    threshold: float
    conserve: bool
    subtract: bool
    gate: tuple[int, int] = (0, BINS)
    upsample: int = 1
    fine: int | None = None  # the package's own depth search (with a relative β) instead of the paper's
    seed: int = 0


CASES = {
    "confocal": Case("confocal", 1, 2, "free", 0.2, True, True),
    "confocal, mirrored": Case("mirrored", 2, 0, "residual", 0.07, False, False, seed=1),
    "one laser": Case("single_laser", 2, 0, "residual", 0.1, False, False, gate=(9, 120), seed=8),
    "one sensor": Case("single_sensor", 1, 1, "residual", 0.25, True, True, seed=3),
    "exhaustive": Case("exhaustive", 2, 0, "free", 0.05, False, True, seed=15),
    "curved wall": Case("curved", 1, 0, "free", 0.3, True, False, gate=(0, 118), seed=5),
    "irregular spots": Case("irregular", 2, 1, "residual", 0.06, True, True, seed=6),
    "upsampled": Case("confocal", 1, 2, "free", 0.25, False, True, upsample=2, seed=7),
    "fine": Case("confocal", 1, 2, "free", 0.2, True, True, fine=4, seed=12),
}


def wall(case: Case, rng: np.random.Generator):
    """Laser and sensor points, both with normals, and the scan's shape."""

    def grid(nx, ny, dx=0.071, dy=0.064, x0=-0.22, y0=-0.25):
        x, y = np.meshgrid(x0 + dx * np.arange(nx), y0 + dy * np.arange(ny), indexing="ij")
        return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)

    shape = None
    if case.scan in ("confocal", "mirrored"):
        points = grid(7, 8) if case.scan == "confocal" else grid(7, 8, dx=-0.071, x0=0.2)
        laser, sensor, shape = points, points, (7, 8)
    elif case.scan == "single_laser":
        sensor, shape = grid(7, 8), (7, 8)
        laser = np.broadcast_to([0.37, -0.11, 0.0], sensor.shape)
    elif case.scan == "single_sensor":
        laser, shape = grid(8, 7), (8, 7)
        sensor = np.broadcast_to([-0.09, 0.04, 0.0], laser.shape)
    elif case.scan == "exhaustive":
        lasers, sensors, shape = grid(2, 2, dx=0.23, dy=0.17, x0=-0.1, y0=-0.2), grid(6, 7), (2, 2, 6, 7)
        laser, sensor = np.repeat(lasers, len(sensors), axis=0), np.tile(sensors, (len(lasers), 1))
    else:
        sensor = grid(7, 8) + rng.normal(0, 0.006, (56, 3)) * [1, 1, 0]
        laser = sensor.copy() if case.scan == "curved" else sensor + rng.normal(0, 0.03, (56, 3)) * [1, 1, 0]
    normals = []
    for points in (laser, sensor):
        points = np.array(points)
        normal = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        if case.scan in ("curved", "irregular"):
            x, y = points[:, 0].copy(), points[:, 1].copy()
            points[:, 2] = 0.25 * x**2 - 0.1 * x * y + 0.05 * y
            normal = np.stack([-0.5 * x + 0.1 * y, 0.1 * x - 0.05, np.ones_like(x)], axis=1)
        normals.append((points, normal))
    (laser, laser_normal), (sensor, sensor_normal) = normals
    return laser, laser_normal, sensor, sensor_normal, shape


def transients(laser, sensor, rng: np.random.Generator) -> np.ndarray:
    """Two tilted plates and a lone scatterer as sums of points, each a short pulse of 1/(d_l² d_s²) at its
    path length.
    """
    u, v = (c.reshape(-1, 1) for c in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)))
    first = np.array([-0.1, 0.09, 0.47]) + u * [0.1, 0.01, 0.04] + v * [0.0, 0.12, -0.03]
    second = np.array([0.13, -0.12, 0.66]) + u * [0.08, 0.0, -0.05] + v * [0.01, 0.09, 0.02]
    scene = np.concatenate([first, second, [[0.05, 0.21, 0.58]]]) + rng.normal(0, 0.002, (163, 3))
    strength = np.concatenate([np.full(81, 0.4), np.full(81, 1.0), [12.0]])
    d_l = np.linalg.norm(laser[:, None] - scene, axis=2)
    d_s = np.linalg.norm(sensor[:, None] - scene, axis=2)
    centre = START + (np.arange(BINS) + 0.5) * BIN
    pulse = np.exp(-0.5 * ((centre - (d_l + d_s)[..., None]) / (1.3 * BIN)) ** 2)
    return ((strength / (d_l * d_s) ** 2)[..., None] * pulse).sum(1) * 0.3 + 0.4


def build(case: Case) -> SimpleNamespace:
    """A capture and the package's pipeline for it, with parameters away from their start values."""
    rng = np.random.default_rng(100 + case.seed)
    laser, laser_normal, sensor, sensor_normal, shape = wall(case, rng)
    counts = rng.poisson(40 * transients(laser, sensor, rng)).astype(np.uint16)
    capture = Capture(
        counts, laser, sensor, laser_normal, sensor_normal, BIN, START, gate=case.gate, scan_shape=shape
    )
    if case.scan == "exhaustive":
        grid = volume_grid(capture, depth=(0.38, 0.8), depth_pitch=0.023, lateral=(7, 8))
    elif shape is None:
        grid = VolumeGrid((-0.24, -0.26, 0.37), (0.068, 0.062, 0.021), (22, 8, 9))
    else:
        grid = volume_grid(capture, depth=(0.37, 0.82), depth_pitch=0.021, upsample=case.upsample)
    bounds = SimpleNamespace(
        omega_pf=(42.0, 15.0, 70.0), sigma_pf=(0.15, 0.06, 0.3), sigma_ls=(0.03, 0.016, 0.1),
        I_l=(4.0e4, 1.0, 1e6), kappa_s=(40.0, 5.0, 200.0), eta_s=(8.0, 0.1, 100.0),
    )  # fmt: skip
    torch.manual_seed(case.seed)
    parameters = {name: BoundedParameter(*values, "unit") for name, values in vars(bounds).items()}
    phasor = PhasorImaging(
        grid,
        parameters["omega_pf"],
        parameters["sigma_pf"],
        power=case.power,
        depth_exponent=case.depth_exponent,
    )
    albedo = (
        FreeAlbedo(grid.shape, 0.4) if case.albedo == "free" else ResidualAlbedo(grid.shape, case.threshold)
    )
    with torch.no_grad():
        albedo.raw += torch.randn(grid.shape) * 0.5
    geometry = ImplicitGeometry(
        grid,
        rays=RAYS,
        threshold=case.threshold,
        step=STEP,
        beta=BETA,
        fine=case.fine or 1,
        relative=case.fine is not None,
    )
    renderer = TransientRenderer(
        n_bins=case.gate[1],
        bin_length=BIN,
        t_start=START,
        rays=RAYS**2,
        splat_sigma=0.62,
        conserve_energy=case.conserve,
    )
    laser_sensor = LaserSensor(
        bin_length=BIN, n_bins=case.gate[1], sigma_ls=parameters["sigma_ls"], kappa_s=parameters["kappa_s"],
        intensity=parameters["I_l"], background=parameters["eta_s"],
        splat_sigma=0.62 if case.subtract else None,
    )  # fmt: skip
    pipeline = Pipeline(capture, phasor, geometry, albedo, renderer, laser_sensor)
    spots = torch.from_numpy(rng.permutation(capture.n_spots)[:3])
    raw = {name: parameter.raw for name, parameter in parameters.items()} | {"albedo": albedo.raw}
    limits = {name: values[1:] for name, values in vars(bounds).items()}
    return SimpleNamespace(capture=capture, grid=grid, pipeline=pipeline, spots=spots, raw=raw, limits=limits)
