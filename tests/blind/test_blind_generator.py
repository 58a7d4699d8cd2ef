"""The blind test's generator: its light is right, every effect changes what it should, and the files tell nothing."""

import ast
import subprocess
import sys
from pathlib import Path

import blind_scenes
import h5py
import numpy as np
import pytest
from blind_elements import Axis, Elements, fourth_bounce, third_bounce
from blind_inject import BACKGROUND, EFFECTS, FINE, PAD, UNKNOWN, Work, moved_in_time
from blind_scenes import PLANS, Scene, Window, load, refine
from blind_truth import CASES, LEVELS, Spec, Truth, draw_spec, hide, make_capture, true_statistic
from conftest import ROOT, real_file

from data_modules.readers import read_capture
from data_modules.simulate import simulate_transients, wall_grid

HERE = Path(__file__).parent
WINDOW = Window(0.008, 224, 1.1)
LEVEL = 1500.0


def points(*places, normal=(0.0, 0.0, -1.0), area=1e-4, albedo=1.0) -> Elements:
    n = len(places)
    return Elements(np.array(places, dtype=float), np.tile(np.array(normal, float), (n, 1)), np.full(n, area), np.full(n, albedo))


def scene_of(elements: Elements) -> Scene:
    wall = wall_grid(32, 32, 0.8, 0.8).reshape(-1, 3)
    seen = np.ones((1024, len(elements.area)), dtype=bool)
    return Scene("points", WINDOW, wall, wall, third_bounce(elements, wall, wall, seen, WINDOW.fine), None, elements, seen)


@pytest.fixture(scope="module")
def dot() -> Scene:
    return scene_of(points((0.1, -0.05, 0.7)))


def work_on(scene: Scene, seed: int = 3) -> Work:
    return Work(scene, LEVEL, 2 * np.arange(1024) / 1023 - 1, np.random.default_rng(seed))


def mean_path(light: np.ndarray, axis: Axis) -> np.ndarray:
    return light @ (axis.edges[:-1] + axis.step / 2) / light.sum(axis=1)


def bin_path(counts: np.ndarray) -> np.ndarray:
    return counts @ (WINDOW.t_start + (np.arange(WINDOW.n_bins) + 0.5) * WINDOW.bin_length) / counts.sum(axis=1)


def shift_of(work: Work) -> np.ndarray:
    """``[S]`` how much later the light comes than in the untouched scene, m."""
    return bin_path(work.signal()) - bin_path(work_on(work.scene).signal())


# Light


@pytest.mark.parametrize("name", ["default", "sphere_before_plate"])
def test_own_light_is_the_simulators(name):
    plan = PLANS[name]
    scene, window = load(name), plan.window
    chosen = np.array([0, 45, 333, 500, 708, 1010])
    normals = np.tile([0.0, 0.0, 1.0], (len(chosen), 1))
    wall = scene.laser[chosen]
    expected = simulate_transients(
        plan.mesh(), wall, wall, normals, normals, bin_length=window.bin_length, n_bins=window.n_bins, t_start=window.t_start
    )
    mine = scene.clean[chosen].reshape(len(chosen), -1, FINE).sum(axis=2)[:, PAD:-PAD]
    np.testing.assert_allclose(mine.sum(axis=1), expected.sum(axis=1), rtol=0.01)
    total = expected.sum(axis=1, keepdims=True)
    assert np.abs(np.cumsum(mine - expected, axis=1) / total).max() < 0.005
    assert expected[:, :8].sum() == 0


def test_third_bounce_of_one_element_by_hand():
    # Laser right before the element, sensor 0.6 m aside: d1 = 0.8, d2 = 1.0, both cosines at the sensor's leg are 0.8.
    laser, sensor = np.array([[0.0, 0.0, 0.0]]), np.array([[0.6, 0.0, 0.0]])
    light = third_bounce(points((0, 0, 0.8), area=2e-4, albedo=0.5), laser, sensor, np.ones((1, 1), bool), Axis(0.0, 0.01, 300))
    assert np.flatnonzero(light[0]).tolist() in ([179], [180])
    assert light.sum() == pytest.approx(2e-4 * 0.5 / np.pi**3 * 0.8**2 / (0.8**2 * 1.0**2))


def test_fourth_bounce_of_one_pair_by_hand():
    # Elements at (±0.3, 0, 0.4) face each other and the wall at 45°; the spot lies between them.
    half = np.sqrt(0.5)
    pair = Elements(
        np.array([[0.3, 0, 0.4], [-0.3, 0, 0.4]]), np.array([[-half, 0, -half], [half, 0, -half]]), np.full(2, 1e-4),
        np.array([0.9, 0.6]),
    )  # fmt: skip
    light = fourth_bounce(pair, np.zeros((1, 3)), np.ones((1, 2), bool), Axis(0.0, 0.01, 300))
    leg = 0.8 * (0.6 + 0.8) * half / 0.25
    assert light.sum() == pytest.approx(2 * leg**2 * half**2 / 0.36 * 0.9 * 0.6 * 1e-8 / np.pi**4)
    assert (np.flatnonzero(light[0])[0] + 0.5) * 0.01 == pytest.approx(0.5 + 0.6 + 0.5, abs=0.006)


def test_refining_keeps_each_bin_and_never_goes_below_zero():
    coarse = np.random.default_rng(0).exponential(1.0, (3, 40)) * (np.arange(40) > 11)
    fine = refine(coarse, 1.0, 0.008, Axis(1.0, 0.001, 320))
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
    assert mean_path(scene.fourth().sum(0)[None], scene.window.fine) > mean_path(scene.clean.sum(0)[None], scene.window.fine) + 0.1


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
    assert light[:split].sum() / light[split:].sum() == pytest.approx((0.65 / a / a) ** 2 / (0.9 / b / b) ** 2)


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


# Time and response


def test_delays_below_a_bin_keep_energy_and_move_the_mean(dot):
    delay = np.linspace(-0.02, 0.03, 1024)
    light = moved_in_time(dot.clean, dot, delay, 0.0)
    np.testing.assert_allclose(light.sum(axis=1), dot.clean.sum(axis=1))
    np.testing.assert_allclose(mean_path(light, WINDOW.fine) - mean_path(dot.clean, WINDOW.fine), delay, atol=1e-12)


def test_offset_drift_jitter_and_clock(dot):
    work = work_on(dot)
    offset = EFFECTS["time_offset"].inject(work, 3.0)["offset"]
    assert abs(offset) == pytest.approx(0.024)
    np.testing.assert_allclose(shift_of(work), offset, atol=1e-6)

    work = work_on(dot)
    values = EFFECTS["time_drift"].inject(work, 2.0)
    shift = shift_of(work)
    assert np.ptp(shift) == pytest.approx(0.016, rel=1e-3) == values["peak_to_peak"]
    assert shift.mean() == pytest.approx(0, abs=1e-6)
    assert np.abs(np.diff(shift)).max() < 3e-4
    assert np.polyfit(work.rank, shift, 1, full=True)[1][0] > 0.05 * (shift**2).sum()  # more than a slope

    work = work_on(dot)
    EFFECTS["timing_jitter"].inject(work, 1.0)
    shift = shift_of(work)
    assert shift.std() == pytest.approx(0.008, rel=0.08)
    assert abs(np.corrcoef(shift[1:], shift[:-1])[0, 1]) < 0.12

    work = work_on(dot)
    scale = EFFECTS["clock_scale"].inject(work, 0.03)["scale"]
    path = mean_path(dot.clean, WINDOW.fine)
    np.testing.assert_allclose(shift_of(work), scale * (path - (1.1 + 112 * 0.008)), atol=0.02 * WINDOW.fine.step)


def test_tail_delays_the_mean_by_its_share(dot):
    late = scene_of(points((0.0, 0.0, 0.62)))  # early light, so that the tail stays inside the window
    work = work_on(late)
    values = EFFECTS["irf_tail"].inject(work, 0.2)
    seen = work.signal()[528]
    base = work_on(late).signal()[528]
    tail = (seen - 0.8 * base) / 0.2
    decay = -WINDOW.bin_length / np.polyfit(np.arange(60), np.log(tail[40:100]), 1)[0]
    assert decay == pytest.approx(values["decay"], rel=0.01)
    rest = np.exp(-(WINDOW.t_start + 224 * 0.008 - mean_path(late.clean, WINDOW.fine)[528]) / values["decay"])
    assert tail.sum() == pytest.approx(base.sum() * (1 - rest), rel=0.02)


def test_ghost_comes_again_with_its_share(dot):
    work = work_on(scene_of(points((0.0, 0.0, 0.62))))
    values = EFFECTS["ghost_pulse"].inject(work, 0.15)
    extra = work.signal() - work_on(work.scene).signal()
    near = np.linalg.norm(work.scene.laser, axis=1) < 0.3
    np.testing.assert_allclose(extra.sum(axis=1)[near] / work_on(work.scene).signal().sum(axis=1)[near], 0.15, rtol=1e-3)
    np.testing.assert_allclose(
        (bin_path(np.maximum(extra, 0)) - bin_path(work_on(work.scene).signal()))[near], values["delay"], atol=1e-4
    )


# Gain and background


def log_gain(work: Work) -> np.ndarray:
    """What the counts tell of it, up to a constant."""
    signal, base = work.expected() - work.background, work_on(work.scene).signal()
    assert signal.sum() == pytest.approx(LEVEL * 1024, rel=1e-3)
    return np.log(signal.sum(axis=1) / base.sum(axis=1))


def test_gains(dot):
    work = work_on(dot)
    EFFECTS["power_drift"].inject(work, 0.4)
    gain = log_gain(work)
    assert np.ptp(gain) == pytest.approx(0.4)
    assert np.abs(np.diff(gain)).max() < 0.004

    work = work_on(dot)
    EFFECTS["wall_reflectance"].inject(work, 0.2)
    gain = log_gain(work)
    assert gain.std() == pytest.approx(0.2)
    assert max(np.abs(np.diff(gain.reshape(32, 32), axis=k)).max() for k in (0, 1)) < 0.12  # smooth along both axes

    work = work_on(dot)
    strength = EFFECTS["vignetting"].inject(work, 0.5)["strength"]
    gain = log_gain(work)
    assert gain[0] - gain[32 * 16 + 16] == pytest.approx(-strength * (2 - 2 / 31**2))


def test_backgrounds(dot):
    dark = BACKGROUND * LEVEL
    assert dark == pytest.approx(0.15)
    kinds = {name: work_on(dot) for name in ("ambient_map", "hot_spots", "background_slope", "direct_leak")}
    values = {name: EFFECTS[name].inject(work, 0.5) for name, work in kinds.items()}
    assert np.log(kinds["ambient_map"].background[:, 7] / dark).std() == pytest.approx(0.5)
    extra = kinds["hot_spots"].background - dark
    assert (extra[:, 0] > 1e-9).sum() == 10 == values["hot_spots"]["number"]
    assert extra.sum() / 224 / 10 == pytest.approx(values["hot_spots"]["level"])
    ends = kinds["background_slope"].background[3, [0, -1]]
    assert ends[1] / ends[0] == pytest.approx(
        (1 + s * 223 / 224) / (1 - s * 223 / 224) if (s := values["background_slope"]["slope"]) else 0
    )
    leak = kinds["direct_leak"].background - dark
    assert leak[5].sum() * 0.008 == pytest.approx(values["direct_leak"]["amplitude"] * values["direct_leak"]["decay"], rel=0.01)
    np.testing.assert_array_equal(leak[0], leak[1000])
    assert all(np.array_equal(work.signal(), work_on(dot).signal()) for work in kinds.values())


# Counting


def counted(name: str, strength: float, counts: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
    work = work_on(Scene("none", Window(0.008, counts.shape[1], 0.0), np.zeros((len(counts), 3)), np.zeros(0), counts))
    values = (EFFECTS | UNKNOWN)[name].inject(work, strength)
    return work.counting[0](counts), values


def test_pile_up_records_only_the_first_photon_of_a_cycle():
    per_cycle = np.array([0.05, 0.6, 0.1, 0.3, 0.02, 0.5])
    cycles = 100_000
    photons = np.random.default_rng(1).poisson(per_cycle, (cycles, 6)) > 0
    first = np.where(photons.any(axis=1), photons.argmax(axis=1), 6)
    histogram = np.bincount(first, minlength=7)[:6]
    detections = -np.expm1(-per_cycle.sum())
    recorded, _ = counted("pile_up", detections, (cycles * per_cycle)[None])
    np.testing.assert_allclose(recorded[0], histogram, atol=4 * np.sqrt(cycles) / 2)
    assert recorded.sum() / cycles == pytest.approx(detections)


def test_pile_ups_parameter_is_the_mean_over_spots():
    counts = np.random.default_rng(2).exponential(3.0, (5, 40)) * np.array([1, 2, 3, 4, 5])[:, None]
    recorded, _ = counted("pile_up", 0.3, counts)
    cycles = recorded.sum(axis=1).mean() / 0.3
    np.testing.assert_allclose(recorded.sum(axis=1), cycles * -np.expm1(-counts.sum(axis=1) / cycles), rtol=1e-9)


def test_afterpulses_follow_every_count():
    counts = np.zeros((1, 300))
    counts[0, [10, 40]] = 100, 10
    recorded, values = counted("afterpulsing", 0.3, counts)
    assert recorded[0, :10].max() < 1e-9
    assert recorded[0, 10] == pytest.approx(100)
    q = np.exp(-0.008 / values["decay"])
    assert recorded[0, 11] == pytest.approx(100 * 0.3 * (1 - q), rel=1e-6)
    assert recorded[0, 41] == pytest.approx(0.3 * (1 - q) * (100 * q**30 + 10), rel=1e-6)


def test_codes_gate_and_unknowns():
    flat = np.full((2, 200), 10.0)
    ripple, values = counted("tcspc_nonlinearity", 0.1, flat)
    wave = ripple[0] / 10 - 1
    t = np.arange(200)
    basis = np.stack([np.sin(2 * np.pi * t / values["period"]), np.cos(2 * np.pi * t / values["period"])], axis=1)
    found, rest, *_ = np.linalg.lstsq(basis, wave, rcond=None)
    assert np.hypot(*found) == pytest.approx(0.1)
    assert rest < 1e-20
    edge, values = counted("gate_edges", 0.5, flat)
    assert edge[0, [0, -1]] == pytest.approx([5, 10 * (1 - values["end"])], rel=1e-4)
    assert edge[0, 3] == pytest.approx(10 * (1 - 0.5 * np.exp(-3 / values["width"])), rel=1e-4)
    less, _ = counted("saturation", 0.5, np.array([[1.0, 3.0], [2.0, 6.0]]))
    np.testing.assert_allclose(
        less, [[1 / (1 + 0.5 * 4 / 6), 3 / (1 + 0.5 * 4 / 6)], [2 / (1 + 0.5 * 8 / 6), 6 / (1 + 0.5 * 8 / 6)]]
    )


def test_missing_codes_lie_in_the_light(dot):
    work = work_on(dot)
    first = int(UNKNOWN["missing_codes"].inject(work, 0.6)["first"])
    ratio = work.expected() / work_on(dot).expected()
    np.testing.assert_allclose(
        ratio, np.broadcast_to(np.where(np.isin(np.arange(224), range(first, first + 5)), 0.4, 1), ratio.shape)
    )
    arrived = np.cumsum(work.signal().sum(axis=0)) / work.signal().sum()
    assert 0.2 < arrived[first] < 0.9


def test_unknowns_of_the_scan_and_the_wall(dot):
    work = work_on(dot)
    cycles = UNKNOWN["mains_ripple"].inject(work, 0.2)["cycles"]
    spectrum = np.abs(np.fft.rfft(work.gain - work.gain.mean(), 16 * 1024))
    assert 12 <= cycles <= 20
    assert spectrum.argmax() / 16 == pytest.approx(cycles, abs=0.15)

    work = work_on(dot)
    UNKNOWN["dead_stripe"].inject(work, 0.5)
    halved = (work.gain == 0.5).reshape(32, 32)
    assert set(np.unique(work.gain)) == {0.5, 1.0}
    assert not halved.all(axis=0).any()
    assert not halved.all(axis=1).any()

    work = work_on(dot)
    UNKNOWN["moving_object"].inject(work, 0.01)
    shift = mean_path(work.light, WINDOW.fine) - mean_path(dot.clean, WINDOW.fine)
    cosine = 0.7 / np.linalg.norm(dot.laser - dot.elements.centre[0], axis=1)
    np.testing.assert_allclose(shift, np.where(np.arange(1024) < 512, 0, -0.02 * cosine), atol=1.3e-3)


# Captures


def test_files_tell_nothing_and_repeat(tmp_path):
    specs = {
        "null": Spec("letters", seed=4, order="serpentine"),
        "hidden": Spec("letters", ("pile_up", "vignetting"), (3, 2), seed=4, order="serpentine"),
        "unknown": Spec("letters", ("mains_ripple",), (3,), seed=4, order="serpentine"),
    }
    infos = {}
    for name, spec in specs.items():
        make_capture(spec, tmp_path / f"{name}.hdf5")
        with h5py.File(tmp_path / f"{name}.hdf5") as file:
            infos[name] = {key: (file[key].dtype.str, file[key].shape) for key in file} | {"text": file["scene_info"][()]}
            assert not file.attrs
        data = (tmp_path / f"{name}.hdf5").read_bytes()
        assert not any(word.encode() in data for word in (*EFFECTS, *UNKNOWN, *PLANS))
    assert infos["null"] == infos["hidden"] == infos["unknown"]
    make_capture(specs["hidden"], tmp_path / "again.hdf5")
    assert (tmp_path / "again.hdf5").read_bytes() == (tmp_path / "hidden.hdf5").read_bytes()
    capture = read_capture(tmp_path / "hidden.hdf5")
    assert capture.is_counts
    assert capture.scan_order[32:35].tolist() == [63, 62, 61]


def test_the_file_holds_photons_of_what_is_expected(tmp_path):
    truth = make_capture(Spec("default", ("wall_reflectance",), (2,), 500, seed=9), tmp_path / "c.hdf5")
    counts = read_capture(tmp_path / "c.hdf5").counts
    chi = (counts - truth.expected) ** 2 / truth.expected
    assert chi.mean() == pytest.approx(1, abs=0.05)
    assert truth.without.sum() / 1024 == pytest.approx(500 * (1 + 224 * BACKGROUND), rel=0.005)
    other = make_capture(Spec("default", ("wall_reflectance",), (2,), 500, seed=10), tmp_path / "d.hdf5")
    assert np.abs(np.log(other.expected / truth.expected)).max() > 0.1


def test_an_effect_is_the_same_alone_and_in_a_pair():
    alone = hide(Spec("default", ("ghost_pulse",), (2,), seed=6))
    pair = hide(Spec("default", ("pile_up", "ghost_pulse"), (1, 2), seed=6))
    assert pair.values["ghost_pulse"] == alone.values["ghost_pulse"]
    assert pair.names == ("ghost_pulse", "pile_up")
    assert pair.labels == {"ghost_pulse": "strong", "pile_up": "weak"}


def test_statistic_by_hand():
    with_, without = np.array([[30.0, 10.0]]), np.array([[10.0, 10.0]])
    truth = Truth(Spec("default"), (), "", "", {}, {}, with_, without, "raster")
    assert true_statistic(truth) == pytest.approx(2 * (30 * np.log(1.5) + 10 * np.log(0.5)))
    assert true_statistic(Truth(Spec("default"), (), "", "", {}, {}, 3 * without, without, "raster")) == 0


@pytest.mark.parametrize("name", CASES)
def test_cases(name):
    spec = CASES[name]
    truth = hide(spec)
    assert truth.expected.shape == truth.without.shape
    assert np.isfinite(truth.expected).all()
    assert truth.expected.min() > 0
    assert (*truth.names, *([truth.unknown] if truth.unknown else [])) == tuple(truth.values)
    assert set(truth.values) == set(spec.effects)
    if spec.effects:
        assert true_statistic(truth) > 1000
    else:
        assert true_statistic(truth) == 0


def test_cases_hold_every_effect_and_what_else_is_asked():
    hidden = [spec.effects for spec in CASES.values()]
    assert {e for (e, *rest) in (h for h in hidden if h) if not rest} >= set(EFFECTS)
    assert hidden.count(()) == 3
    assert sum(len(h) == 2 for h in hidden) == 1


def test_draws():
    own = tuple(name for name, plan in PLANS.items() if plan.mesh)
    specs = [draw_spec(seed, scenes=own) for seed in range(300)]
    assert specs[:5] == [draw_spec(seed, scenes=own) for seed in range(5)]
    assert {s.effects[0] for s in specs} == set(EFFECTS)
    assert {s.level for s in specs} == set(LEVELS)
    assert {s.strengths[0] for s in specs} == {0, 1, 2, 3}
    assert {s.order for s in specs} == {"raster", "serpentine"}
    assert {len(set(draw_spec(seed, "pair", scenes=own).effects)) for seed in range(50)} == {2}
    assert {draw_spec(seed, "unknown", scenes=own).effects[0] for seed in range(60)} == set(UNKNOWN)
    assert draw_spec(1, "null", scenes=("letters",)).effects == ()


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="wall_tilt cannot be hidden in z_confocal"):
        Spec("z_confocal", ("wall_tilt",), (1,))
    with pytest.raises(ValueError, match="both render the scene anew"):
        Spec("default", ("wall_tilt", "occlusion"), (1, 1))


def test_no_code_is_shared_with_what_is_tested():
    for path in HERE.glob("blind_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            assert all(n == "nlos_lit.capture" for n in names if n.startswith("nlos_lit")), path
            assert "torch" not in {n.split(".")[0] for n in names}, path
    code = "import blind_truth, sys; print(*(m for m in sys.modules if m.startswith('nlos_lit.')))"
    environment = {"PYTHONPATH": f"{HERE}:{ROOT}", "PATH": ""}
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    loaded = {module.split(".")[1] for module in run.stdout.split()}
    assert "capture" in loaded
    assert not {m for m in loaded if m.startswith(("effects", "surfel", "functional", "criticism"))}
