"""The simulator against independent path-traced renders (mitransient), at their Monte-Carlo noise."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import yaml
from conftest import real_file

from data_modules.simulate.mesh import load_mesh
from data_modules.simulate.scenes import sphere_before_plate
from data_modules.simulate.transients import simulate_transients
from data_modules.simulate.truth import load_truth, view_from_wall

RENDERS = [
    # file, mesh, every n-th spot
    ("z_confocal_64_d3", "z", 7),
    ("z_single_32_d3", "z", 3),
    ("z_exhaustive_8x8x8x8_d3", "z", 5),
    ("bunny_confocal_32_d3", "bunny", 9),
    ("bunny_single_32_d3", "bunny", 9),
    ("sphereplate_single_32_d3", "sphereplate", 9),
]


def scene(name: str):
    return (
        sphere_before_plate() if name == "sphereplate" else load_mesh(real_file(f"rendered/{name}_mesh.obj"))
    )


def read_render(name: str, step: int):
    """Radiance ``[S, T]``, laser and sensor points ``[S, 3]``, bin length and stated noise.

    They are read without the project's readers.
    """
    with h5py.File(real_file(f"rendered/{name}.hdf5")) as file:
        h = file["H"][()].astype(np.float64)
        sensor = file["sensor_grid_xyz"][()].reshape(-1, 3).astype(np.float64)
        laser = file["laser_grid_xyz"][()].reshape(-1, 3).astype(np.float64)
        bin_length = float(file["delta_t"][()])
        noise = yaml.safe_load(file["scene_info"][()])["noise"]["rel_l2"]
    if h.ndim == 5:
        laser, sensor = np.repeat(laser, len(sensor), axis=0), np.tile(sensor, (len(laser), 1))
    laser = np.broadcast_to(laser, sensor.shape)
    return h.reshape(len(h), -1).T[::step], laser[::step], sensor[::step], bin_length, noise


@pytest.mark.parametrize(("name", "mesh", "step"), RENDERS, ids=[row[0] for row in RENDERS])
def test_agrees_with_an_independent_render_at_its_noise(name, mesh, step):
    render, laser, sensor, bin_length, noise = read_render(name, step)
    normals = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    ours = simulate_transients(
        scene(mesh), laser, sensor, normals, normals, bin_length=bin_length, n_bins=render.shape[1]
    )
    assert np.linalg.norm(render - ours) < 1.1 * noise * np.linalg.norm(render)
    assert (render * ours).sum() / (ours**2).sum() == pytest.approx(1, abs=0.01)
    assert render.sum() == pytest.approx(ours.sum(), rel=0.006)
    assert np.std(render.sum(axis=1) / ours.sum(axis=1)) < 0.018
    assert render[ours == 0].sum() < 1e-4 * render.sum()


def test_a_transposed_scan_would_be_noticed():
    """The comparison above can fail: with the sensor's x and y exchanged the error is far above the noise."""
    render, laser, sensor, bin_length, noise = read_render("bunny_single_32_d3", 29)
    normals = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    ours = simulate_transients(
        scene("bunny"),
        laser,
        sensor[:, [1, 0, 2]],
        normals,
        normals,
        bin_length=bin_length,
        n_bins=render.shape[1],
    )
    assert np.linalg.norm(render - ours) > 3 * noise * np.linalg.norm(render)


@pytest.mark.parametrize("name", ["z", "bunny", "sphereplate"])
def test_the_view_from_the_wall_is_the_given_truth(name):
    mesh = scene(name)
    given = load_truth(real_file(f"rendered/{name}_gt.h5"))
    seen = view_from_wall(mesh, given.x, given.y)
    both = np.isfinite(seen.depth) & np.isfinite(given.depth)
    # Pixels whose ray grazes the outline may differ; a sphere of facets is a little smaller than the sphere.
    assert both.sum() > 0.98 * np.isfinite(given.depth).sum()
    assert both.sum() > 0.99 * np.isfinite(seen.depth).sum()
    assert np.median(np.abs(seen.depth - given.depth)[both]) < 3e-4
    assert np.median((seen.normal * given.normal).sum(axis=2)[both]) > 0.999
