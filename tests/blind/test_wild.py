"""The evaluation sets: drawn alike again, apart, balanced, their effects as worked out by hand."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import h5py
import numpy as np
import pytest
import wild_inject as inject
from blind_elements import Elements, third_bounce
from blind_scenes import RENDERS, Window
from conftest import ROOT
from scipy.special import ndtr
from wild_counting import photon_by_photon, recorded
from wild_scenes import FAMILIES, OWN, WildScene, load
from wild_statistic import (
    WHOLE,
    moved_scene,
    nuisances,
    profiled,
    rendering,
    statistic,
    true_statistics,
)
from wild_table import ALL, BLOCK, LENGTH, MASTER_SEEDS, Spec, _block, seed_of, spec_of, table
from wild_truth import hide, make, scan_order, true_values, write
from wild_unknown import UNKNOWN
from wild_work import WildWork

from data_modules.readers import read_capture
from data_modules.simulate import wall_grid
from data_modules.simulate.bodies import Plate

HERE = Path(__file__).parent
SIDE = 12
DOT = np.array([0.1, -0.05, 0.7])
SPOTS = SIDE**2


@lru_cache(maxsize=2)
def dot(confocal: bool = True) -> WildScene:
    """One small element before the wall."""
    wall = wall_grid(SIDE, SIDE, 0.8, 0.8).reshape(-1, 3)
    laser = wall if confocal else np.broadcast_to([0.1, 0.2, 0.0], wall.shape)
    element = Elements(DOT[None], np.array([[0.0, 0.0, -1.0]]), np.array([1e-4]), np.array([1.0]))
    seen, window = np.ones((SPOTS, 1), dtype=bool), Window(0.008, 240, 1.0)
    clean = third_bounce(element, laser, wall, seen, window.fine)
    mesh = Plate(width=0.01, height=0.01, at=tuple(DOT)).mesh()
    return WildScene("dot", window, laser, wall, clean, mesh, element, seen)


def work_on(scene: WildScene, seed: int = 4, level: float = 1000.0, order: str = "raster") -> WildWork:
    rank = 2 * scan_order(order, SIDE) / (SPOTS - 1) - 1
    return WildWork(scene, level, rank, np.random.default_rng(seed))


def path_of(work: WildWork) -> np.ndarray:
    """``[S]`` mean path of the light before the response, m."""
    axis = work.scene.window.fine
    return work.light @ (axis.edges[:-1] + axis.step / 2) / work.light.sum(axis=1)


def test_sets_are_drawn_alike_again_and_never_meet():
    before = {name: table(name, 450) for name in MASTER_SEEDS}
    _block.cache_clear()
    assert before == {name: table(name, 450) for name in MASTER_SEEDS}
    seeds = [spec.seed for specs in before.values() for spec in specs]
    assert len(set(seeds)) == len(seeds) == 3 * 450
    highest, lowest = (
        [seed_of(name, k, master) for name in MASTER_SEEDS] for k, master in ((10**6 - 1, 999), (0, 0))
    )
    assert all(a < b for a, b in zip(highest, lowest[1:], strict=False))
    assert spec_of("test", 3, master=1) != spec_of("test", 3, master=2)
    assert table("development", 20) == before["development"][:20]


@pytest.mark.parametrize("name", MASTER_SEEDS)
def test_a_table_is_balanced_from_its_beginning_on(name):
    specs = table(name)
    assert Counter(spec.kind for spec in specs) == BLOCK
    families = Counter(spec.family for spec in specs)
    assert set(families) == set(FAMILIES)
    assert max(families.values()) - min(families.values()) <= 6
    assert Counter(spec.scan for spec in specs)["single"] == pytest.approx(LENGTH / 5, abs=4)
    assert Counter(spec.order for spec in specs)["raster"] == pytest.approx(0.6 * LENGTH, abs=4)
    for length in (21, 42, 105):
        found = Counter(spec.kind for spec in specs[:length])
        for kind, count in BLOCK.items():
            assert abs(found[kind] - count * length / LENGTH) <= 2
    levels = np.array([spec.level for spec in specs if spec.family != "render"])
    assert levels.min() >= 500
    assert levels.max() <= 10_000
    assert np.median(levels) == pytest.approx(np.sqrt(500 * 10_000), rel=0.3)
    assert all(spec.level <= 1500 for spec in specs if spec.family == "render")
    singles = Counter(spec.effects[0] for spec in specs if spec.kind == "single")
    assert set(singles) == set(inject.EFFECTS)
    assert max(singles.values()) - min(singles.values()) <= 2
    strengths = Counter(s for spec in specs for s in spec.strengths)
    assert max(strengths.values()) - min(strengths.values()) <= 25
    assert {spec.effects[0] for spec in specs if spec.kind == "unknown"} == set(UNKNOWN)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="wall_scaled cannot be hidden in a confocal scan of render"):
        Spec("render", "confocal", ("wall_scaled",), (1,))
    with pytest.raises(ValueError, match="are no pair"):
        Spec("letters", "confocal", ("wall_scaled", "occluder_ragged"), (1, 1))
    with pytest.raises(ValueError, match="are no pair"):
        Spec("letters", "confocal", ("time_walk", "time_warm_up"), (1, 1))


@pytest.mark.parametrize("name", ALL)
def test_every_kind_changes_some_scene_and_says_what_is_right(name):
    kind = ALL[name]
    scan = kind.scan or "confocal"
    family = "sheet" if kind.families else "rounds"
    truth = hide(Spec(family, scan, (name,), (2,), 2000, seed=6, side=SIDE))
    assert np.isfinite(truth.expected).all()
    assert truth.expected.min() > 0
    assert np.abs(truth.expected - truth.without).max() > 0.1 * (
        name not in ("fourth_bounces", "hum_harmonics")
    )
    assert truth.without.sum() / SPOTS == pytest.approx(
        2000 + truth.dark * truth.scene.window.n_bins, rel=0.005
    )
    unknown = name in UNKNOWN and name != "moving_object"  # which has come to be known since
    assert bool(truth.axes) == bool(truth.unknown) == unknown == (truth.kind == "unknown")
    assert bool(truth.right[name]) == (not unknown)
    assert list(truth.values) == [name]
    assert truth.counts.shape == truth.expected.shape


def test_no_strength_is_no_change():
    for name, kind in ALL.items():
        # These say what is seen at the least, not how far from nothing it is.
        if name in ("pile_up_dead_time", "gate_erf", "rolling_gate", "fourth_bounces"):
            continue
        scene = dot(kind.scan != "single")
        work, other = work_on(scene), work_on(scene)
        kind.inject(work, 0.0)
        np.testing.assert_allclose(work.expected(), other.expected(), rtol=1e-6, atol=1e-9, err_msg=name)
    truth = hide(Spec("plates", seed=3, side=SIDE))
    assert truth.names == ()
    assert truth.expected is truth.without
    assert true_statistics(truth) == {}


@pytest.mark.parametrize("family", OWN)
def test_all_light_of_a_scene_falls_into_its_window(family):
    for confocal in (True, False):
        scene = load(family, 8, confocal, 8)
        inner = scene.clean[:, 16 * 8 : -16 * 8]
        assert inner.sum() == pytest.approx(scene.clean.sum(), rel=1e-9)
        assert 160 <= scene.window.n_bins <= 256
        assert (scene.clean.sum(axis=1) > 0).all()


@pytest.mark.skipif(not RENDERS.exists(), reason="no renders here")
def test_a_render_is_a_part_of_the_scan_mirrored():
    for confocal in (True, False):
        scene = load("render", 4, confocal)
        assert scene.clean.shape[0] == 24**2
        assert scene.confocal is confocal
        grid = scene.sensor.reshape(24, 24, 3)
        assert np.ptp(grid[:, 0, 0]) > 0
        assert np.ptp(grid[0, :, 0]) == pytest.approx(0, abs=1e-9)
        nearest = np.linalg.norm(scene.proxy.centre[None] - scene.sensor[::50, None], axis=2)
        nearest = nearest + np.linalg.norm(scene.proxy.centre[None] - scene.laser[::50, None], axis=2)
        axis = scene.window.fine
        first = axis.edges[(scene.clean[::50] > 1e-3 * scene.clean.max()).argmax(axis=1)]
        assert np.abs(first - nearest.min(axis=1)).max() < 0.08


def test_geometry_by_hand():
    scene = dot()
    x, y = scene.sensor[:, 0], scene.sensor[:, 1]
    plain = 2 * np.linalg.norm(scene.sensor - DOT, axis=1)
    np.testing.assert_allclose(path_of(work_on(scene)), plain, atol=0.001)
    work = work_on(scene)
    values = inject.wall_scaled(work, 0.1)
    true = np.stack([x * (1 + values["scale_x"]), y * (1 + values["scale_y"]), 0 * x], axis=1)
    np.testing.assert_allclose(path_of(work), 2 * np.linalg.norm(true - DOT, axis=1), atol=0.001)
    np.testing.assert_allclose(work.arrival(DOT[None])[:, 0], path_of(work), atol=0.001)
    work = work_on(scene)
    inject.baseline_skewed(work, 0.1)
    np.testing.assert_allclose(work.arrival(DOT[None])[:, 0], path_of(work), atol=0.001)
    work = work_on(scene)
    inject.baseline_skewed(work, 0.0)
    np.testing.assert_allclose(path_of(work), plain, atol=0.001)
    other = work_on(dot(False))
    apart = np.linalg.norm(other.scene.sensor - DOT, axis=1) + np.linalg.norm([0.1, 0.2, 0] - DOT)
    np.testing.assert_allclose(path_of(other), apart, atol=0.001)
    work = work_on(scene)
    inject.retro_paint(work, 0.25)
    half = np.linalg.norm(scene.sensor - DOT, axis=1)
    back = (half / (scene.window.middle / 2)) ** 2 / (DOT[2] / half)
    np.testing.assert_allclose(
        work.light.sum(axis=1) / scene.clean.sum(axis=1), 0.75 + 0.25 * back, rtol=1e-9
    )
    work = work_on(scene)
    values = inject.gloss(work, 0.4)
    tall, c = 1 / values["rough"] ** 2, DOT[2] / half.min()
    brighter = (work.light.sum(axis=1) / scene.clean.sum(axis=1))[half.argmin()]
    # The registry's lobe, (p + 2)/2 cos^p, as bright at its middle and as wide: p = 2/m² - 2.
    assert brighter == pytest.approx(1 + values["strength"] * tall * c ** (2 * tall - 2), rel=1e-3)
    work = work_on(scene)
    inject.occluder_ragged(work, 1.0)
    assert set(np.unique((work.light.sum(axis=1) / scene.clean.sum(axis=1)).round(9))) == {0.0, 1.0}


def test_delays_by_hand():
    for shape in (inject.time_warm_up, inject.time_walk):
        for order in ("raster", "columns"):
            work = work_on(dot(), order=order)
            shape(work, 2.0)
            assert np.ptp(work.delay) == pytest.approx(0.016)
            assert work.delay.mean() == pytest.approx(0, abs=1e-12)
            step = np.abs(np.diff(work.delay[work.turn])).max()
            assert step < 0.35 * 0.016
    work = work_on(dot())
    late = inject.time_offset(work, 2.0)["offset"] + inject.clock_scale(work, 0.1)["scale"] * (
        path_of(work) - work.scene.window.middle
    )
    np.testing.assert_allclose(work.arrival(DOT[None])[:, 0], path_of(work) + late, atol=0.001)
    work = work_on(dot())
    inject.jitter_heavy(work, 0.5)
    assert work.delay.std() == pytest.approx(0.004, rel=0.35)


def test_responses_by_hand():
    pulse = np.zeros((1, 40_000))
    pulse[0, 0] = 1
    work = work_on(dot())
    step = work.bin / 8
    values = inject.tail_two_exponentials(work, 0.2)
    seen = work.response[-1](pulse, step)[0]
    late = step * np.arange(len(seen))
    mean = values["share"] * values["fast"] + (1 - values["share"]) * values["slow"]
    assert seen.sum() == pytest.approx(1)
    assert seen @ late == pytest.approx(0.2 * mean, rel=0.02)
    values = inject.tail_power_law(work, 0.2)
    seen = work.response[-1](pulse, step)[0]
    knee = round(values["knee"] / step)
    assert seen.sum() == pytest.approx(1)
    assert seen[3 * knee] / seen[knee] == pytest.approx(0.5 ** values["power"], rel=0.02)
    values = inject.ghost_echoes(work, 0.1)
    seen, r = work.response[-1](pulse, step)[0], values["again"]
    delay = round(values["delay"] / step)
    assert seen.sum() == pytest.approx(1 + 0.1 * (1 + r + r**2 + r**3))
    assert seen[delay // 2 : 3 * delay // 2] @ late[delay // 2 : 3 * delay // 2] == pytest.approx(
        0.1 * values["delay"], rel=0.02
    )


def test_gains_and_backgrounds_by_hand():
    work = work_on(dot())
    values = inject.vignetting_cos4(work, 0.4)
    points = work.scene.sensor[:, :2]
    away = np.hypot(*(points - [values["x"], values["y"]]).T) / (points[:, 0].max() - points[:, 0].mean())
    np.testing.assert_allclose(work.gain, np.cos(np.arctan(away * np.sqrt(0.6**-0.5 - 1))) ** 4, rtol=1e-9)
    np.testing.assert_allclose(work.gain, (1 + values["strength"] * away**2 / 2) ** -2, rtol=1e-9)
    assert work.expected().sum() == pytest.approx(SPOTS * (1000 + 240 * work.dark), rel=1e-6)
    work = work_on(dot())
    inject.leak_power_law(work, 5.0)
    assert work.background.shape == (SPOTS, 240)
    assert work.background[0, 0] == pytest.approx(6 * work.dark, rel=0.25)
    for background in (inject.ambient_window, inject.hum_harmonics, inject.background_curve):
        work = work_on(dot())
        background(work, 0.5)
        assert work.background.mean() == pytest.approx(work.dark, rel=0.12)
        assert work.background.min() > 0


def test_counting_by_hand():
    rate = np.array([[0.3, 0.2, 0.5]])
    seen = -np.expm1(-rate[0])
    np.testing.assert_allclose(recorded(rate, 1)[0], seen)
    # Dead for the next bin only, and for the rest of the cycle.
    np.testing.assert_allclose(
        recorded(rate, 2)[0], [seen[0], seen[1] * (1 - seen[0]), seen[2] * (1 - seen[1] * (1 - seen[0]))]
    )
    np.testing.assert_allclose(
        recorded(rate, 9)[0], [seen[0], seen[1] * np.exp(-0.3), seen[2] * np.exp(-0.5)]
    )
    incident = np.tile([[30.0, 80.0, 10.0, 60.0, 0.0, 20.0]], (400, 1))
    counts = photon_by_photon(incident, 100, 3, np.random.default_rng(1))
    expected = 100 * recorded(incident / 100, 3)[0]
    np.testing.assert_allclose(counts.mean(axis=0), expected, atol=5 * np.sqrt(expected.max() / 400))
    assert counts[:, 1].var() < 0.8 * expected[1]
    work = work_on(dot(), order="columns")
    values = inject.crosstalk(work, 0.2)
    m = np.zeros((SPOTS, 2))
    m[work.turn[5]] = [10.0, 0.0]
    after = work.counting[-1](m)[work.turn]
    r = values["again"]
    np.testing.assert_allclose(after[4:9, 0], [0, 10, 2, 2 * r, 2 * r**2])
    assert after[:, 1].sum() == 0
    work = work_on(dot())
    values = inject.afterpulses(work, 0.1)
    m = np.zeros((1, 240))
    m[0, 0] = 1
    decays, shares = [values[k] / work.bin for k in ("fast", "slow")], [values["share"], 1 - values["share"]]
    inside = sum(s * -np.expm1(-239 / d) for s, d in zip(shares, decays, strict=True))
    assert work.counting[-1](m).sum() == pytest.approx(1 + 0.1 * inside)
    work = work_on(dot())
    values = inject.gate_erf(work, 0.3)
    gate = work.counting[-1](np.ones((1, 240)))[0]
    assert gate[0] == pytest.approx(0.7)
    assert gate[5] == pytest.approx(ndtr(5 * work.bin / values["soft"] + 0.524401), rel=1e-5)
    work = work_on(dot())
    period = int(inject.code_widths(work, 0.1)["period"])
    width = work.counting[-1](np.ones((1, 240)))[0]
    np.testing.assert_allclose(width[period:], width[:-period])
    assert width[:period].mean() == pytest.approx(1, abs=0.03)


def test_pile_up_is_drawn_photon_by_photon():
    truth = hide(
        Spec("rounds", effects=("pile_up_dead_time",), strengths=(2,), level=1000, seed=5, side=SIDE)
    )
    gap = (truth.counts - truth.expected) / np.sqrt(truth.expected)
    assert gap.mean() == pytest.approx(0, abs=0.03)
    # Half of the cycles see a photon, and no more than one or two: their number scatters less than Poisson's.
    each = (truth.counts - truth.expected).sum(axis=1) / np.sqrt(truth.expected.sum(axis=1))
    assert each.var() < 0.8
    pair = replace(truth.spec, effects=("pile_up_dead_time", "code_widths"), strengths=(2, 0))
    assert hide(pair).values["pile_up_dead_time"] == truth.values["pile_up_dead_time"]


def test_statistics_by_hand():
    without = np.full((2, 3), 10.0)
    with_ = np.array([[30.0, 30.0, 30.0], [30.0, 30.0, 30.0]])
    np.testing.assert_allclose(profiled(with_, without + np.arange(3)), 30, rtol=1e-6)
    shape = np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])
    none = np.zeros((1, 2, 3))
    found = statistic(10 + 0.1 * shape, without, none)
    assert found.plain == pytest.approx(4 * 0.01 / 10, rel=1e-3)
    assert found.projected == pytest.approx(found.plain, rel=1e-3)
    # A prior standard deviation of 0.1 of the same change, of information 4·0.01/10: it keeps 1/(1 + 0.004).
    taken = statistic(10 + 0.1 * shape, without, 0.1 * shape[None])
    assert taken.projected == pytest.approx(found.plain / 1.004, rel=1e-3)
    assert statistic(10 + 0.1 * shape, without, 1e3 * shape[None]).projected < 1e-4 * found.plain


def test_a_scene_takes_up_an_offset_but_no_jitter():
    shown = {}
    for name in ("time_offset", "jitter_heavy"):
        truth = hide(Spec("plates", effects=(name,), strengths=(0,), level=2000, seed=6, side=SIDE))
        shown[name] = true_statistics(truth)[name]
    assert 0 < shown["time_offset"].projected < 0.1 * shown["time_offset"].plain
    assert shown["jitter_heavy"].projected > 0.5 * shown["jitter_heavy"].plain
    basis = nuisances(truth, "jitter_heavy")
    number = (len(basis) - 5) // 6
    albedo = basis[:number].sum(axis=0)
    signal = truth.without - truth.dark
    assert albedo.sum() == pytest.approx(signal.sum(), rel=0.05)
    assert np.corrcoef(albedo.ravel(), signal.ravel())[0, 1] > 0.99


def test_a_scene_that_lies_aside_takes_up_a_wrong_baseline():
    """By half of it, to first order; a scene that must stay where it is would show most of it."""
    truth = hide(Spec("letters", effects=("baseline_skewed",), strengths=(1,), level=2000, seed=6, side=SIDE))
    at_once, again = (true_statistics(truth, steps)["baseline_skewed"] for steps in (0, 8))
    assert at_once.projected < 0.5 * at_once.plain
    assert again.projected < 0.5 * at_once.projected


@pytest.mark.parametrize("name", ["time_offset", pytest.param("clock_scale", marks=pytest.mark.slow)])
def test_a_scene_takes_up_what_moves_light_far(name):
    """By five bins or so: to the plates' own light no slope leads, to those of a moved scene it does."""
    truth = hide(Spec("plates", effects=(name,), strengths=(2,), level=2000, seed=6, side=SIDE))
    at_once, again = (true_statistics(truth, steps)[name] for steps in (0, 8))
    assert at_once.projected > 0.1 * at_once.plain
    assert again.projected < 0.05 * at_once.projected


@pytest.mark.slow
def test_a_scene_moves_by_half_a_baseline():
    truth = hide(Spec("letters", effects=("baseline_skewed",), strengths=(2,), level=2000, seed=6, side=SIDE))
    change = moved_scene(truth, "baseline_skewed", len(nuisances(truth, "baseline_skewed")))
    aside = change[-5:-2] * WHOLE * truth.scene.window.bin_length / 2
    values = truth.values["baseline_skewed"]
    half = -np.array([values["baseline_x"], values["baseline_y"], 0]) / 2
    np.testing.assert_allclose(aside, half, atol=0.1 * np.linalg.norm(half))
    statistics = true_statistics(truth)["baseline_skewed"]
    assert statistics.projected < 1e-3 * statistics.plain


@pytest.mark.parametrize("name", [pytest.param("wall_scratches", marks=pytest.mark.slow), "jitter_heavy"])
def test_no_scene_takes_up_what_single_spots_have(name):
    truth = hide(Spec("plates", effects=(name,), strengths=(2,), level=2000, seed=6, side=SIDE))
    at_once, again = (true_statistics(truth, steps)[name] for steps in (0, 8))
    assert 0.95 * at_once.projected < again.projected <= at_once.projected


def test_the_steps_see_the_scene_as_the_other_injection_lets_it_be_seen():
    effects = ("baseline_skewed", "wall_scratches")
    truth = hide(Spec("letters", effects=effects, strengths=(2, 1), level=2000, seed=6, side=SIDE))
    for name in effects:
        none = rendering(truth, name, np.zeros(len(nuisances(truth, name))))
        np.testing.assert_allclose(none, truth.lacking[name], rtol=1e-9)
    albedo = nuisances(truth, "wall_scratches")[:96].sum(axis=0)
    signal = truth.lacking["wall_scratches"] - truth.dark
    assert np.corrcoef(albedo.ravel(), signal.ravel())[0, 1] > 0.99


def test_moves_of_patches_are_those_of_a_scene_seen_anew():
    """By about a bin, of a patch or of the whole scene along each axis, or leaning: by the derivative, and
    rendered.
    """
    truth = hide(Spec("letters", effects=("jitter_heavy",), strengths=(0,), level=2000, seed=6, side=SIDE))
    basis = nuisances(truth, "jitter_heavy")
    number = (len(basis) - 5) // 6

    def seen(change: np.ndarray) -> np.ndarray:
        return rendering(truth, "jitter_heavy", change) / (2 * np.abs(change).max())

    one, whole = number * np.arange(1, 6) + 3, 6 * number + np.arange(3)
    for k in (*one, *whole):
        change, step = np.zeros(len(basis)), 0.3 if k < 6 * number else 0.03
        change[k] = step
        moved = seen(change) - seen(-change)
        assert np.corrcoef(moved.ravel(), basis[k].ravel())[0, 1] > 0.96, k
        assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(basis[k]), rel=0.08), k


def test_files_tell_nothing_and_repeat(tmp_path):
    infos = {}
    for name, effects in {"null": (), "hidden": ("pile_up_dead_time",), "unknown": ("mode_hops",)}.items():
        spec = Spec(
            "letters", effects=effects, strengths=(1,) * len(effects), seed=4, order="columns", side=SIDE
        )
        write(hide(spec), tmp_path / f"{name}.hdf5")
        with h5py.File(tmp_path / f"{name}.hdf5") as file:
            infos[name] = {key: (file[key].dtype.str, file[key].shape) for key in file} | {
                "text": file["scene_info"][()]
            }
            assert not file.attrs
        data = (tmp_path / f"{name}.hdf5").read_bytes()
        said = {word for kind in ALL.values() for word in kind.right}
        # Shorter words turn up in packed counts by chance.
        words = {word for word in (*ALL, *said, *FAMILIES, *MASTER_SEEDS) if len(word) > 4}
        assert not any(word.encode() in data for word in words)
    assert infos["null"] == infos["hidden"] == infos["unknown"]
    write(hide(spec), tmp_path / "again.hdf5")
    assert (tmp_path / "again.hdf5").read_bytes() == (tmp_path / "unknown.hdf5").read_bytes()
    capture = read_capture(tmp_path / "unknown.hdf5")
    assert capture.scan_order[:3].tolist() == [0, SIDE, 2 * SIDE]
    assert capture.is_counts
    index = next(k for k in range(50) if spec_of("development", k).family == "plates")
    truth = make("development", index, tmp_path / "made.hdf5")
    assert truth.spec == spec_of("development", index)
    np.testing.assert_array_equal(read_capture(tmp_path / "made.hdf5").counts, truth.counts)


def test_true_values_are_those_of_the_capture():
    spec = Spec("letters", effects=("mode_hops", "gloss"), strengths=(1, 1), seed=4, side=SIDE)
    assert true_values(spec) == hide(spec).values


def test_no_code_is_shared_with_what_is_tested():
    for path in HERE.glob("wild_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            assert all(n.split(".")[1:2] == ["capture"] for n in names if n.startswith("nlos_lit")), path
    code = "import wild_statistic, sys; print(*(m for m in sys.modules if m.startswith('nlos_lit.')))"
    environment = {"PYTHONPATH": f"{HERE}:{ROOT}", "PATH": ""}
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert {module.split(".")[1] for module in run.stdout.split()} == {"capture"}
