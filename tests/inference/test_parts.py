"""Toys, the direct pulse as a witness, residual profiles, and captures that cannot be diagnosed."""

from __future__ import annotations

import dataclasses
import json
import pickle
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inference_scenes import BIN, GATE, candidate, capture_of, drawn, effect_of, fit_of, raster, surfels

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference import toys
from nlos_lit.inference.base_pipeline import BasePipeline
from nlos_lit.inference.candidates import Pool
from nlos_lit.inference.diagnose import diagnose
from nlos_lit.inference.per_spot import neighbours
from nlos_lit.inference.pool import lit_by
from nlos_lit.inference.residuals import SIDE, profiles
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.inference.toys import Null, read_toys, run_toys, toy_capture
from nlos_lit.inference.witness import (
    by_chance,
    direct_decays,
    direct_delays,
    log_gain,
    over_neighbours,
    witness,
)
from nlos_lit.model.build import PipelineSettings
from nlos_lit.surfels.fit import SurfelSettings


def test_chance_is_counted(tmp_path):
    """Ten toys of 0 … 9 nats: two have 8 and more, and the capture itself is one of eleven."""
    for k in range(10):
        (tmp_path / f"toy_{k}.json").write_text(json.dumps({"largest": float(k), "term": "irf_tail"}))
    null = read_toys([tmp_path / f"toy_{k}.json" for k in range(10)])
    assert (null.toys, null.largest) == (10, [float(k) for k in range(10)])
    assert null.chance(8.0) == pytest.approx(3 / 11)
    assert null.chance(8.1) == pytest.approx(2 / 11)
    assert null.chance(1e6) == pytest.approx(1 / 11)
    assert null.chance(-1.0) == 1
    assert Null([]).chance(5.0) == 1, "nothing is known without toys"


def test_a_toy_is_drawn_from_the_fit():
    scene = capture_of(raster(8))
    model, scan = surfels(scene), Scan.of(scene)
    extension = Extension([effect_of("pile_up", scan, detections=0.4)])
    toy = toy_capture(scene, fit_of(model, scene, extension), 3)
    expected = model.expected(torch.arange(64), extension).double().numpy()
    assert not toy.counts[:, : GATE[0]].any()
    drawn_counts = toy.counts[:, GATE[0] :]
    assert drawn_counts.sum() == pytest.approx(expected.sum(), abs=4 * expected.sum() ** 0.5)
    assert ((drawn_counts - expected) ** 2 / expected).mean() == pytest.approx(1, abs=0.1)
    assert np.array_equal(toy.counts, toy_capture(scene, fit_of(model, scene, extension), 3).counts)
    assert not np.array_equal(toy.counts, toy_capture(scene, fit_of(model, scene, extension), 4).counts)
    assert (toy.gate, toy.bin_length) == (scene.gate, scene.bin_length)


def test_interrupted_toys_go_on(tmp_path, monkeypatch):
    """Toy 1 is there already: it is read as it is, and only 0 and 2 are run, with their own seeds."""
    (tmp_path / "toy_1.json").write_text(json.dumps({"largest": 7.0, "term": "hum"}))
    monkeypatch.setattr(
        toys, "ProcessPoolExecutor", lambda processes, mp_context: ThreadPoolExecutor(processes)
    )
    asked = []

    def ask(fit, split, scan, most, seed):
        asked.append((most, seed, np.array_equal(scan.light, lit_by(fit, scan).light)))
        return Pool([candidate("irf_tail", 3.0 + seed), candidate("hum", 1.0)], [])

    monkeypatch.setattr(toys, "ask", ask)
    scene = capture_of(raster(8))
    fit, seeds, said = fit_of(surfels(scene), scene), [], []

    def pipeline(capture, split, seed):
        seeds.append((seed, int(capture.counts.sum())))
        return fit

    threads = torch.get_num_threads()
    settings = CriticismSettings(toys=3, processes=1)
    null = run_toys(scene, fit, pipeline, None, settings, tmp_path, lambda *report: said.append(report))
    torch.set_num_threads(threads)
    assert seeds == [(k, int(toy_capture(scene, fit, k).counts.sum())) for k in (0, 2)]
    assert [text for text, *_ in said] == ["toy 2 of 3", "toy 3 of 3"]
    assert said[0][2] > said[1][2] == 0  # one to go, then none
    assert asked == [(settings.spots, 0, True), (settings.spots, 2, True)], (
        "by the fit's light, as captures are"
    )
    assert null == Null([3.0, 7.0, 5.0])
    assert json.loads((tmp_path / "toy_2.json").read_text()) == {"largest": 5.0, "term": "irf_tail"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["toy_0.json", "toy_1.json", "toy_2.json"]
    again = run_toys(scene, fit, None, None, settings, tmp_path, None)
    assert again == null


def pulse_capture(side: int = 8, decays: tuple[float, float] = (0.1, 0.25), gains: np.ndarray | None = None):
    """A direct pulse before a gate that begins at bin 160, slower from 1/200 of its peak on; spots' energies
    by ``gains``.
    """
    t = (np.arange(200) - 10) * BIN
    knee = decays[0] * np.log(200)
    tail = np.where(
        t < 0, 0, np.where(t < knee, np.exp(-t / decays[0]), np.exp(-(t - knee) / decays[1]) / 200)
    )
    gains = np.ones(side**2) if gains is None else gains
    counts = np.round(1e7 * gains[:, None] * tail) + 20
    shape = {"scan_shape": (side, side), "scan_order": np.arange(side**2)}
    return capture_of(raster(side), counts=counts, gate=(160, 200), t_start=0.0, **shape)


def test_decays_of_the_direct_pulse():
    assert direct_decays(pulse_capture()) == pytest.approx([0.1, 0.25], rel=0.03)
    assert direct_decays(pulse_capture(decays=(0.15, 0.15))) == pytest.approx([0.15, 0.15], rel=0.03)
    assert direct_decays(capture_of(raster(8), counts=np.full((64, 200), 50), gate=(160, 200))) is None


def test_the_witness_knows_the_gain():
    scene = pulse_capture()
    scan = Scan.of(scene)
    effects = [
        effect_of("vignetting", scan, strength=0.5),
        effect_of("irf_tail", scan, fraction=0.2, decay=0.2),
    ]
    x, y = scan.places[0].numpy().T
    true = -2 * np.log1p(0.25 * (x**2 + y**2))
    fit = SimpleNamespace(extension=Extension(effects))
    assert log_gain(fit, 64) == pytest.approx(true, abs=1e-5)
    seen = pulse_capture(gains=np.exp(true))
    found = witness(seen, fit)
    assert found["wall_gain_correlation"] == pytest.approx(1, abs=1e-3)
    assert found["wall_gain_by_chance"] == pytest.approx(1, abs=1e-3), "it looks alike from all sides"
    assert found["direct_pulse_counts"] == pytest.approx(seen.counts[:, :160].sum() / 64)
    assert found["tail_decay_fitted_m"] == pytest.approx(0.2, rel=1e-3)
    assert found["tail_decay_direct_m"] == direct_decays(seen)
    late = Extension([effect_of("afterpulsing", Scan.of(seen), probability=0.05, decay=0.3)])
    assert witness(seen, SimpleNamespace(extension=late))["tail_decay_fitted_m"] == pytest.approx(
        0.3, rel=1e-3
    )
    maps = {name: np.array(m) for name, m in found["maps"].items()}
    assert maps["fitted"].shape == (8, 8)
    assert maps["direct"] / maps["direct"][3, 3] == pytest.approx(
        maps["fitted"] / maps["fitted"][3, 3], rel=1e-3
    )
    mixed = np.exp(true + 0.3 * np.random.default_rng(1).standard_normal(64))
    by_hand = np.corrcoef(true, np.log(pulse_capture(gains=mixed).counts[:, :160].sum(1)))[0, 1]
    assert witness(pulse_capture(gains=mixed), fit)["wall_gain_correlation"] == pytest.approx(
        by_hand, abs=1e-4
    )


@pytest.mark.parametrize("columns", [5, 4])
def test_chance_is_what_turned_and_mirrored_maps_share(columns):
    """Seven other ways to lay a square on itself, three for a rectangle; the sign does not count."""
    rng = np.random.default_rng(2)
    one, other = rng.standard_normal((2, 5, columns))
    ways = []
    for transposed in (False, True) if columns == 5 else (False,):
        for x in (1, -1):
            for y in (1, -1):
                turned = other[::x, ::y]
                ways.append(turned.T if transposed else turned)
    expected = [abs(np.corrcoef(one.ravel(), way.ravel())[0, 1]) for way in ways[1:]]
    assert by_chance(one, other) == pytest.approx(max(expected))
    assert len(expected) == (7 if columns == 5 else 3)


def test_the_witness_knows_the_time_zero_of_single_spots():
    """Pulses of any strength that come up to a fifth of a bin late; a slope over the wall is no jitter."""
    side = 16
    rng = np.random.default_rng(0)
    late, gain = 0.1 * rng.standard_normal(side**2), rng.uniform(0.5, 2.0, side**2)
    t = np.arange(200) - 30 - late[:, None]
    counts = np.round(1e6 * gain[:, None] * np.exp(-0.5 * (t / 4) ** 2)) + 5
    seen = capture_of(raster(side), counts=counts, gate=(160, 200), t_start=0.0)
    assert direct_delays(seen) == pytest.approx(BIN * (late - late.mean()), abs=0.01 * BIN)
    places = seen.laser[:, :2]
    near = neighbours(seen, torch.arange(side**2)).numpy()
    assert over_neighbours(places[:, 0], near).reshape(side, side)[2:-2, 2:-2] == pytest.approx(0, abs=1e-9)
    for own, r in ((late, 1.0), (np.roll(late, 77), 0.0)):
        jitter = effect_of("timing_jitter", Scan.of(seen))
        with torch.no_grad():
            jitter.raw_offset.copy_(torch.from_numpy(own + places[:, 0]).reshape(jitter.raw_offset.shape))
        found = witness(seen, SimpleNamespace(extension=Extension([jitter])))
        assert found["delay_correlation"] == pytest.approx(r, abs=0.01 if r else 4 / side)
        assert np.std(found["delays"]["fitted"]) == pytest.approx(BIN * 0.1 * (1 + 1 / 8) ** 0.5, rel=0.2)
    assert witness(seen, SimpleNamespace(extension=Extension([])))["delays"] is None


def test_without_a_direct_pulse_there_is_no_witness():
    bare = SimpleNamespace(extension=Extension([]))
    assert witness(dataclasses.replace(pulse_capture(), gate=(0, 200)), bare) is None
    assert (
        witness(capture_of(raster(8), counts=np.full((64, 64), 2)), bare) is None
    )  # 12 counts before the gate
    assert witness(capture_of(raster(8), "single"), bare) is None
    found = witness(pulse_capture(), bare)
    assert found["wall_gain_correlation"] is None
    assert found["maps"] is None
    assert found["tail_decay_direct_m"] is None


@pytest.fixture(scope="module")
def residuals():
    """A wall twice as wide as high, with a fifth more light than expected in bins 30 … 33 and at spots x >
    0.4.
    """
    scene = capture_of(raster(24, 12))
    model, scan = surfels(scene), Scan.of(scene)
    factor = torch.ones(288, 58)
    factor[:, 24:28] *= 1.6
    factor[torch.from_numpy(scene.laser[:, 0] > 0.4)] *= 1.5
    measured = drawn(model, Extension([]), scene, factor=factor)
    after = fit_of(model, measured, Extension([effect_of("background_slope", scan, slope=0.9)]))
    found = profiles(fit_of(model, measured), after, scan, torch.arange(288))
    return {p.axis: p for p in found}, measured, scan, model


def test_profiles_have_an_edge_more_than_values(residuals):
    found = residuals[0]
    assert list(found) == ["time", "depth", "scan", "rate", "wall"]
    for axis in ("time", "depth", "scan", "rate"):
        p = found[axis]
        assert p.before.shape == p.after.shape == (len(p.edges) - 1,)
        assert np.all(np.diff(p.edges) > 0)
        assert p.edges_y is None
        assert not np.array_equal(p.before, p.after)
    assert found["wall"].before.shape == found["wall"].after.shape == (SIDE, SIDE)
    assert {a: p.unit for a, p in found.items()} == {
        "time": "bin",
        "depth": "m",
        "scan": "spot",
        "rate": "counts/spot",
        "wall": "m",
    }


def test_time_profile_by_hand(residuals):
    found, measured, _, model = residuals
    profile, expected = found["time"], model.expected(torch.arange(288)).double().numpy()
    assert (profile.edges[0], profile.edges[-1], len(profile.edges)) == (*GATE, 49)
    for band in (0, 20, 47):
        low, high = (int(e) - GATE[0] for e in profile.edges[band : band + 2])
        counts, mu = measured.counts[:, GATE[0] :][:, low:high].sum(), expected[:, low:high].sum()
        assert profile.before[band] == pytest.approx((counts - mu) / mu**0.5, abs=0.02)
    assert GATE[0] + 24 <= profile.edges[profile.before.argmax()] < GATE[0] + 28


def test_wall_profile_is_in_the_world_and_blank_where_no_spots_are(residuals):
    """The scan spans x from -0.3 to 0.5 and y from -0.24 to 0.14 m: its square reaches as far along y as
    along x.
    """
    found, measured, scan, _ = residuals
    wall = found["wall"]
    assert scan.centre.tolist() == pytest.approx([0.1, -0.05])
    assert wall.edges[[0, -1]] == pytest.approx([-0.3, 0.5], abs=1e-6)
    assert wall.edges_y[[0, -1]] == pytest.approx([-0.45, 0.35], abs=1e-6)
    spots = np.histogram2d(*measured.laser[:, :2].T, bins=(wall.edges, wall.edges_y))[0]
    blank = np.isnan(wall.before)
    assert np.array_equal(blank, np.isnan(wall.after))
    assert blank[:, :3].all()
    assert blank[:, -3:].all()
    assert not blank[:, 5:11].any()
    assert (blank == (spots == 0)).mean() > 0.95  # a spot on an edge may count to either side
    bright = wall.edges[:-1] > 0.4
    assert np.nanmean(wall.before[bright]) > 3 + np.nanmean(wall.before[~bright])


def test_a_render_is_refused_in_a_sentence():
    pipeline = BasePipeline({"depth": (0.4, 1.0)}, PipelineSettings(0.1), SurfelSettings(), 1 << 30)
    scene = dataclasses.replace(capture_of(raster(16)), is_counts=False)
    with pytest.raises(UserError, match="holds expected values"):
        diagnose(scene, pipeline, CriticismSettings(), name="x", seed=0)
    with pytest.raises(UserError, match="at least 16 × 16 spots"):
        diagnose(capture_of(raster(6)), pipeline, CriticismSettings(), name="x", seed=0)
    assert pickle.loads(pickle.dumps(pipeline)) == pipeline


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"largest": null}', '{"largest": [1]}', '{"largest": "x"}']
)
def test_a_toy_that_is_none_is_refused(tmp_path, text):
    file = tmp_path / "toy_0.json"
    file.write_text(text)
    with pytest.raises(UserError, match=r"toy_0\.json is damaged, or holds no toy: move it away"):
        read_toys([file])
