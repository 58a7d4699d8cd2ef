"""Whole simulated measurements: axes, windows, exposure, truth and files."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest

from data_modules.simulate.capture import simulate_capture
from data_modules.simulate.mesh import Mesh, load_mesh
from data_modules.simulate.plan import ScanPlan, wall_grid
from data_modules.simulate.scenes import bunny_two_albedo, default_scene, letters, plate, sphere, strokes
from data_modules.simulate.sensor import SensorModel
from data_modules.simulate.truth import load_truth, save_truth, view_from_wall
from nlos_lit.capture.errors import UserError

SCAN = ScanPlan(nx=4, ny=3, width=0.8, height=0.6, bin_length=0.01, n_bins=200)
QUIET = SensorModel(sigma=0.01, kappa=60.0, background=0.0, mean_counts=1000.0)


def test_wall_grid_holds_cell_centres():
    grid = wall_grid(4, 2, 2.0, 1.0)
    assert grid[:, 0, 0] == pytest.approx([-0.75, -0.25, 0.25, 0.75])
    assert grid[0, :, 1] == pytest.approx([-0.25, 0.25])
    assert (grid[..., 2] == 0).all()


def test_scan_plans_list_pairs_in_the_order_of_their_shape():
    laser, sensor = ScanPlan(kind="exhaustive", nx=3, ny=2, width=1.0).points()
    grid = wall_grid(3, 2, 1.0, 1.0)
    assert np.array_equal(laser.reshape(3, 2, 3, 2, 3)[2, 0, 1, 1], grid[2, 0])
    assert np.array_equal(sensor.reshape(3, 2, 3, 2, 3)[2, 0, 1, 1], grid[1, 1])
    laser, sensor = ScanPlan(kind="single", nx=3, ny=2, fixed="sensor", fixed_point=(0.1, -0.2)).points()
    assert np.array_equal(laser, grid.reshape(-1, 3))
    assert np.array_equal(sensor, np.tile([0.1, -0.2, 0.0], (6, 1)))


@pytest.mark.parametrize(("kind", "fixed", "found"), [
    ("confocal", "laser", "confocal"), ("single", "laser", "single_laser"),
    ("single", "sensor", "single_sensor"), ("exhaustive", "laser", "exhaustive"),
])  # fmt: skip
def test_every_kind_of_scan_is_recognised_by_its_capture(kind, fixed, found):
    scan = ScanPlan(kind=kind, fixed=fixed, nx=3, ny=2, width=0.8, bin_length=0.01, n_bins=200)
    capture, _ = simulate_capture(plate((0.1, 0, 0.5), 0.2, 0.2), scan, QUIET, 0, oversample=1)
    assert capture.kind == found
    assert capture.scan_shape == scan.scan_shape
    json.dumps(capture.provenance)


def test_the_brightest_and_earliest_spot_is_the_one_before_the_object():
    """An object before the wall point (x_3, y_0) is seen first and brightest from spot [3, 0]."""
    capture, _ = simulate_capture(plate((0.3, -0.2, 0.4), 0.05, 0.05), SCAN, QUIET, None)
    cube = capture.counts.reshape(4, 3, -1)
    assert np.unravel_index(cube.sum(axis=2).argmax(), (4, 3)) == (3, 0)
    assert cube[3, 0].argmax() in (79, 80, 81)
    assert (cube[0, 2].argmax() - 0.5) * 0.01 == pytest.approx(
        2 * np.sqrt(0.6**2 + 0.4**2 + 0.4**2), abs=0.03
    )


def test_exposure_sets_the_mean_counts_and_background_adds_to_every_bin():
    capture, truth = simulate_capture(
        default_scene(), SCAN, SensorModel(background=0.5, mean_counts=800.0), None, keep_transients=True
    )
    assert not capture.is_counts
    assert capture.counts[:, :60] == pytest.approx(0.5, abs=1e-4)
    assert (capture.counts.sum() - 0.5 * capture.counts.size) / 12 == pytest.approx(800, rel=1e-3)
    assert truth.clean.sum() * truth.gain / 12 == pytest.approx(800, rel=1e-9)
    assert truth.expected == pytest.approx(capture.counts, rel=1e-5)


def test_counts_scatter_about_the_expectation_and_repeat_with_their_seed():
    first, truth = simulate_capture(letters(), SCAN, SensorModel(), 5, keep_transients=True)
    again, _ = simulate_capture(letters(), SCAN, SensorModel(), 5)
    other, _ = simulate_capture(letters(), SCAN, SensorModel(), 6)
    assert np.array_equal(first.counts, again.counts)
    assert not np.array_equal(first.counts, other.counts)
    chi2 = ((first.counts - truth.expected) ** 2 / truth.expected).mean()
    assert chi2 == pytest.approx(1, abs=0.15)


def test_light_from_before_the_window_still_smears_into_it(caplog):
    whole, _ = simulate_capture(plate((0, 0, 0.5), 0.3, 0.3), SCAN, SensorModel(kappa=10.0), None)
    late = ScanPlan(nx=4, ny=3, width=0.8, height=0.6, bin_length=0.01, n_bins=80, t_start=1.2)
    part, _ = simulate_capture(plate((0, 0, 0.5), 0.3, 0.3), late, SensorModel(kappa=10.0), None)
    assert "87 % of the light arrives outside the window of 1.2 … 2 m" in caplog.text
    a, b = whole.counts[:, 120:] - 0.1, part.counts - 0.1
    scale = (a * b).sum() / (a * a).sum()
    assert b == pytest.approx(scale * a, abs=1e-3 * float(b.max()))


def test_a_window_that_misses_the_scene_says_so():
    with pytest.raises(UserError, match="no light of the scene arrives between 5 and 7 m"):
        simulate_capture(
            plate((0, 0, 0.5), 0.2, 0.2),
            ScanPlan(nx=2, ny=2, bin_length=0.01, n_bins=200, t_start=5.0),
            QUIET,
            0,
        )


def test_the_direct_pulse_lies_before_the_gate():
    sensor = SensorModel(direct_counts=5000.0, background=0.0)
    capture, _ = simulate_capture(plate((0, 0, 0.5), 0.2, 0.2), SCAN, sensor, None)
    assert capture.counts[:, 0:4].sum(axis=1).min() > 1000
    assert 10 < capture.gate[0] < 100
    without, _ = simulate_capture(plate((0, 0, 0.5), 0.2, 0.2), SCAN, SensorModel(background=0.0), None)
    assert capture.gated_counts() == pytest.approx(without.counts[:, capture.gate[0] :], abs=0.01)
    with pytest.raises(UserError, match="confocal"):
        simulate_capture(plate((0, 0, 0.5), 0.2, 0.2), ScanPlan(kind="single", nx=2, ny=2), sensor, 0)


@pytest.mark.parametrize(
    "bad", [{"kind": "spiral"}, {"fixed": "mirror"}, {"nx": 0}, {"bin_length": 0.0}, {"height": -1.0}]
)
def test_impossible_scans_are_refused(bad):
    with pytest.raises(UserError):
        ScanPlan(**bad)


def test_truth_is_what_lies_along_z_first():
    x, y = np.linspace(-0.45, 0.45, 19), np.linspace(-0.4, 0.4, 17)
    truth = view_from_wall(default_scene(), x, y)
    on_f, on_dome = (
        (np.argmin(np.abs(x - 0.25)), np.argmin(np.abs(y - 0.2))),
        (np.argmin(np.abs(x + 0.05)), np.argmin(np.abs(y + 0.2))),
    )
    assert truth.depth[on_f] == pytest.approx(0.5, abs=1e-6)
    assert truth.albedo[on_f] == pytest.approx(0.5)
    assert truth.normal[on_f] == pytest.approx([0, 0, -1], abs=1e-9)
    assert truth.depth[on_dome] == pytest.approx(0.86 - np.sqrt(0.18**2 - 0.01**2), abs=1e-3)
    assert truth.albedo[on_dome] == pytest.approx(0.9)
    assert np.isnan(truth.depth[-1]).all()
    assert np.isnan(truth.albedo[np.isnan(truth.depth)]).all()


def test_backs_are_seen_black_with_the_normal_towards_the_wall():
    back = plate((0, 0, 0.5), 0.2, 0.2, turn_y=0.3, albedo=0.7).flipped()
    one, two = (
        view_from_wall(back, np.array([0.0]), np.array([0.0]), two_sided=both) for both in (False, True)
    )
    assert one.albedo[0, 0] == 0
    assert two.albedo[0, 0] == pytest.approx(0.7)
    assert one.normal[0, 0] == pytest.approx([-np.sin(0.3), 0, -np.cos(0.3)], abs=1e-9)


def test_truth_survives_its_file(tmp_path):
    _, truth = simulate_capture(default_scene(), SCAN, QUIET, 1, truth_shape=(20, 15), keep_transients=True)
    save_truth(tmp_path / "truth.h5", truth)
    back = load_truth(tmp_path / "truth.h5")
    assert truth.depth.shape == (20, 15)
    for name in ("x", "y", "depth", "normal", "albedo", "clean", "expected"):
        assert getattr(back, name) == pytest.approx(getattr(truth, name), rel=1e-6, abs=1e-7, nan_ok=True)
    assert np.array_equal(back.mesh.faces, truth.mesh.faces)
    assert back.gain == truth.gain


def test_truth_files_that_cannot_be_read_say_why(tmp_path):
    with pytest.raises(UserError, match="no ground-truth file"):
        load_truth(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("depth")
    with pytest.raises(UserError, match="not an HDF5 file"):
        load_truth(tmp_path / "text.h5")
    with h5py.File(tmp_path / "half.h5", "w") as file:
        file["x"] = file["y"] = file["depth"] = np.zeros(3)
    with pytest.raises(UserError, match="lacks normal"):
        load_truth(tmp_path / "half.h5")


def test_meshes_face_the_wall_and_close_where_they_should():
    assert (plate((0, 0, 1), 0.1, 0.2).face_vectors[:, 2] < 0).all()
    assert plate((0, 0, 1), 0.1, 0.2).area == pytest.approx(0.02)
    assert (letters().face_vectors[:, 2] < 0).all()
    ball = sphere((0.1, 0.2, 0.9), 0.3, rings=40)
    volume = (
        ball.corners.mean(axis=1) * ball.face_vectors
    ).sum() / 3  # divergence theorem: positive when normals point out
    assert volume == pytest.approx(4 / 3 * np.pi * 0.3**3, rel=0.01)
    bar = strokes([np.array([[0.0, 0.0], [0.2, 0.0]])], depth=0.5, stroke=0.1, bevel=0.02, cell=0.01)
    assert bar.vertices[:, 2].min() == 0.5
    assert bar.vertices[:, 2].max() == pytest.approx(0.52)
    assert bar.vertices[:, 0].max() == pytest.approx(0.25)


def test_the_default_scene_is_asymmetric():
    """Mirroring x or y or exchanging them changes what is seen over more than a fifth of the surface."""
    lattice = wall_grid(60, 60, 1.0, 1.0)
    depth = view_from_wall(default_scene(), lattice[:, 0, 0], lattice[0, :, 1]).depth
    seen = np.nan_to_num(depth)
    for other in (seen[::-1], seen[:, ::-1], seen.T, seen[::-1, ::-1]):
        assert (np.abs(seen - other) > 0.01).sum() > 0.2 * (seen > 0).sum()


def test_mesh_files_are_read_with_their_colours(tmp_path):
    (tmp_path / "two.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 1 255 255 255\n0 1 1 51 51 51\n1 0 1 0 51 102\n3 0 1 2\n"
    )
    mesh = load_mesh(tmp_path / "two.ply")
    assert mesh.albedo == pytest.approx([1.0, 0.2, 0.2], abs=1e-6)
    assert mesh.face_vectors[0] == pytest.approx([0, 0, -0.5])


def test_bunny_has_two_albedos_with_a_sharp_step(tmp_path):
    (tmp_path / "quad.obj").write_text("v 0 0 1\nv 1 0 1\nv 0 1 1\nv 1 1 1\nf 1 3 2\nf 2 3 4\n")
    mesh = bunny_two_albedo(tmp_path / "quad.obj")
    assert mesh.albedo[mesh.faces].tolist() == [[0.3] * 3, [1.0] * 3]


def test_meshes_that_cannot_work_are_refused(tmp_path):
    with pytest.raises(UserError, match="no mesh file"):
        load_mesh(tmp_path / "none.obj")
    (tmp_path / "empty.obj").write_text("v 0 0 1\n")
    with pytest.raises(UserError, match="no triangles"):
        load_mesh(tmp_path / "empty.obj")
    square = plate((0, 0, 1), 1, 1)
    for broken, words in [
        ((square.vertices * np.nan, square.faces, 1.0), "NaN"),
        ((square.vertices, square.faces + 2, 1.0), "name vertices"),
        ((square.vertices, square.faces, 1.5), r"\[0, 1\]"),
        ((square.vertices[:, :2], square.faces, 1.0), "vertices"),
    ]:
        with pytest.raises(UserError, match=words):
            Mesh(*broken)
