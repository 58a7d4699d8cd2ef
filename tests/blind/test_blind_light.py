"""The blind test's own light and what its path effects do to it."""

import blind_scenes
import numpy as np
import pytest
from blind_elements import Axis, Elements, fourth_bounce, third_bounce
from blind_helpers import WINDOW, mean_path, one_dot, points, scene_of, work_on
from blind_inject import EFFECTS
from blind_scenes import FINE, PAD, PLANS, Scene, finer, load
from conftest import real_file

from data_modules.readers import read_capture
from data_modules.simulate import simulate_transients


@pytest.fixture(scope="module")
def dot() -> Scene:
    return one_dot()


@pytest.mark.parametrize("name", ["default", "sphere_before_plate"])
def test_own_light_is_the_simulators(name):
    plan = PLANS[name]
    scene, window = load(name), plan.window
    chosen = np.array([0, 45, 333, 500, 708, 1010])
    normals = np.tile([0.0, 0.0, 1.0], (len(chosen), 1))
    wall = scene.laser[chosen]
    expected = simulate_transients(
        plan.mesh(),
        wall,
        wall,
        normals,
        normals,
        bin_length=window.bin_length,
        n_bins=window.n_bins,
        t_start=window.t_start,
    )
    mine = scene.clean[chosen].reshape(len(chosen), -1, FINE).sum(axis=2)[:, PAD:-PAD]
    np.testing.assert_allclose(mine.sum(axis=1), expected.sum(axis=1), rtol=0.01)
    total = expected.sum(axis=1, keepdims=True)
    assert np.abs(np.cumsum(mine - expected, axis=1) / total).max() < 0.005
    assert expected[:, :8].sum() == 0


def test_third_bounce_of_one_element_by_hand():
    # Laser right before the element, sensor 0.6 m aside: d1 = 0.8, d2 = 1.0, both cosines at the sensor's leg
    # are 0.8.
    laser, sensor = np.array([[0.0, 0.0, 0.0]]), np.array([[0.6, 0.0, 0.0]])
    light = third_bounce(
        points((0, 0, 0.8), area=2e-4, albedo=0.5), laser, sensor, np.ones((1, 1), bool), Axis(0.0, 0.01, 300)
    )
    assert np.flatnonzero(light[0]).tolist() in ([179], [180])
    assert light.sum() == pytest.approx(2e-4 * 0.5 / np.pi**3 * 0.8**2 / (0.8**2 * 1.0**2))


def test_fourth_bounce_of_one_pair_by_hand():
    # Elements at (±0.3, 0, 0.4) face each other and the wall at 45°; the spot lies between them.
    half = np.sqrt(0.5)
    places = np.array([[0.3, 0, 0.4], [-0.3, 0, 0.4]])
    normals = np.array([[-half, 0, -half], [half, 0, -half]])
    pair = Elements(places, normals, np.full(2, 1e-4), np.array([0.9, 0.6]))
    light = fourth_bounce(pair, np.zeros((1, 3)), np.ones((1, 2), bool), Axis(0.0, 0.01, 300))
    leg = 0.8 * (0.6 + 0.8) * half / 0.25
    assert light.sum() == pytest.approx(2 * leg**2 * half**2 / 0.36 * 0.9 * 0.6 * 1e-8 / np.pi**4)
    assert (np.flatnonzero(light[0])[0] + 0.5) * 0.01 == pytest.approx(0.5 + 0.6 + 0.5, abs=0.006)


def test_refining_keeps_each_bin_and_never_goes_below_zero():
    coarse = np.random.default_rng(0).exponential(1.0, (3, 40)) * (np.arange(40) > 11)
    fine = finer(coarse, 1.0, 0.008, Axis(1.0, 0.001, 320))
    assert fine.min() >= 0
    np.testing.assert_allclose(fine.reshape(3, 40, 8).sum(axis=2), coarse, atol=1e-9)


@pytest.mark.parametrize("name", ["z_confocal", "bunny_confocal", "z_single"])
def test_renders_lie_inside_their_window(name):
    capture = read_capture(real_file(f"rendered/{PLANS[name].render}.hdf5"))
    scene = load(name)
    chosen = [0, 37, 1023]
    step = capture.scan_shape[0] // 32
    rows = [(s // 32 * step) * capture.scan_shape[0] + s % 32 * step for s in chosen]
    np.testing.assert_allclose(scene.sensor[chosen], capture.sensor[rows])
    np.testing.assert_allclose(scene.clean[chosen].sum(axis=1), capture.counts[rows].sum(axis=1), rtol=1e-3)
    inside = scene.clean[:, PAD * FINE : -PAD * FINE].sum() / scene.clean.sum()
    assert inside > 0.9999


def test_the_bunnys_bounces_come_later_than_the_third():
    real_file("rendered/bunny_confocal_32_d8.hdf5")
    scene = load("bunny_confocal")
    assert (
        mean_path(scene.fourth().sum(0)[None], scene.window.fine)
        > mean_path(scene.clean.sum(0)[None], scene.window.fine) + 0.1
    )


# Path


def test_retroreflection_leaves_only_the_square_of_the_distance():
    scene = scene_of(points((0.1, 0.0, 0.65), (-0.2, 0.1, 0.9)))
    work = work_on(scene)
    assert EFFECTS["retroreflection"].inject(work, 2.0) == {"falloff": 2.0, "cosine": 0.0}
    near, far = (scene.elements.centre[k] - scene.laser[70] for k in (0, 1))
    a, b = np.linalg.norm(near), np.linalg.norm(far)
    split = int(((a + b) - WINDOW.fine.start) / WINDOW.fine.step)
    light = work.light[70]
    # What is left are the wall's cosines and d⁻².
    assert light[:split].sum() / light[split:].sum() == pytest.approx(
        (0.65 / a / a) ** 2 / (0.9 / b / b) ** 2
    )


def test_specular_lobe_raises_what_mirrors(dot):
    work = work_on(dot)
    values = EFFECTS["specular_lobe"].inject(work, 3.0)
    way = dot.laser - dot.elements.centre[0]
    cosine = 0.7 / np.linalg.norm(way, axis=1)
    expected = 1 + 3 * (values["p"] + 2) / 2 * cosine ** values["p"]
    np.testing.assert_allclose(work.light.sum(axis=1) / dot.clean.sum(axis=1), expected, rtol=1e-9)


def test_occlusion_takes_both_legs(dot):
    work = work_on(dot)
    values = EFFECTS["occlusion"].inject(work, 0.5)
    f = values["z"] / 0.7
    crossing = dot.laser[:, :2] * (1 - f) + dot.elements.centre[0, :2] * f
    behind = np.hypot(crossing[:, 0] - values["x"], crossing[:, 1] - values["y"]) < values["radius"]
    assert 20 < behind.sum() < 900
    np.testing.assert_allclose(work.light.sum(axis=1) / dot.clean.sum(axis=1), np.where(behind, 0.25, 1))


@pytest.mark.parametrize("share", [0.03, 0.2])
def test_bounces_have_their_share(share):
    scene = load("corner")
    work = work_on(scene)
    EFFECTS["higher_order_bounces"].inject(work, share)
    more = (work.light - scene.clean)[:, PAD * FINE : -PAD * FINE].sum()
    assert more / work.light[:, PAD * FINE : -PAD * FINE].sum() == pytest.approx(share)


def test_tilted_wall_moves_light_by_twice_z_cosine(dot):
    work = work_on(dot)
    values = EFFECTS["wall_tilt"].inject(work, 0.01)
    assert np.hypot(values["tilt_x"], values["tilt_y"]) == pytest.approx(0.01)
    z = dot.laser[:, 0] * values["tilt_x"] + dot.laser[:, 1] * values["tilt_y"]
    cosine = 0.7 / np.linalg.norm(dot.laser - dot.elements.centre[0], axis=1)
    moved = mean_path(work.light, WINDOW.fine) - mean_path(dot.clean, WINDOW.fine)
    np.testing.assert_allclose(moved, -2 * z * cosine, atol=1.1e-3)  # single points fall into bins of 1 mm
    assert np.abs(np.mean(moved + 2 * z * cosine)) < 5e-5


def test_baseline_lengthens_the_sensors_leg(dot, monkeypatch):
    monkeypatch.setattr(blind_scenes, "sight", lambda mesh, elements, wall: np.ones((len(wall), 1), bool))
    work = work_on(dot)
    values = EFFECTS["laser_sensor_baseline"].inject(work, 0.1)
    aside = dot.laser + np.array([values["baseline_x"], values["baseline_y"], 0])
    length = sum(np.linalg.norm(p - dot.elements.centre[0], axis=1) for p in (dot.laser, aside))
    np.testing.assert_allclose(mean_path(work.light, WINDOW.fine), length, atol=0.51 * WINDOW.fine.step)
