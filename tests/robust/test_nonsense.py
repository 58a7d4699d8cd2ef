"""Captures that cannot be are refused or told of; good ones are neither, and force=true goes on."""

from __future__ import annotations

import dataclasses

import nonsense_cases as cases
import numpy as np
import pytest
from conftest import SHARED, real_file

from data_modules.load import load_scene
from data_modules.nonsense import nonsense, volume_without_light
from data_modules.plan import plan_capture
from data_modules.readers import ReaderOptions, read_capture
from nlos_lit.capture import Capture
from nlos_lit.training.configs import compose

SAID = {
    "1e9 in every bin": "every bin of the gate [0, 200) holds the same value, 1e+09",
    "counts a million million times too large": "the capture's largest value is ",
    "delta_t=9.9": "a bin is 3.3e+04 ps wide (9.9 m of path); usual are 1 to 100 ps",
    "wall in millimetres": "the 144 spots lie on a wall 648.2 m across; usual are 0.1 to 5 m",
    "laser normals against the sensor's": "the wall's normals at the laser points are turned by 180° against",
    "Poisson noise of mean 5": "the gate [0, 200) holds nothing but noise, 4.99 a bin at every time",
    "evenly distributed noise": "the gate [0, 200) holds nothing but noise, 0.501 a bin at every time",
    "t_accounts_first_and_last_bounces='yes'": "t_accounts_first_and_last_bounces in capture.hdf5 must",
    "light outside the gate": "the gate [2, 60) holds nothing but noise, 0.201 a bin at every time, the",
    "a volume 50 m away": "the volume spans depths of 50 to 52 m, and light comes back from 0.",
}  # fmt: skip


@pytest.mark.parametrize("kind", ["confocal", "single", "exhaustive", "expected"])
def test_good_captures_are_taken_without_a_word(tmp_path, kind):
    for seed in range(3):
        assert cases.outcome(cases.base(kind, seed), tmp_path) == ("accepted", "")


@pytest.mark.parametrize("name", cases.ALL)
def test_nonsense_is_refused_or_told_of(tmp_path, name):
    kind, change = cases.ALL[name]
    came, said = cases.outcome(change(cases.base(kind, 0), np.random.default_rng(0)), tmp_path)
    assert came in ("refused", "warned"), said
    assert said
    assert said.isprintable()
    if kind == "confocal":
        sentence = SAID.get(name.removeprefix("confocal: "), "")
        assert said.startswith(sentence), said


@pytest.mark.parametrize("name", ["1e9 in every bin", "wall in millimetres", "light outside the gate"])
def test_force_goes_on_and_tells(tmp_path, name):
    items = cases.CASES[name](cases.base("confocal", 0), np.random.default_rng(0))
    items["scene_depth"] = (0.4, 0.9)
    came, said = cases.outcome(items, tmp_path)
    assert (came, said.endswith("(force=true goes on)")) == ("refused", True)
    forced, told = cases.outcome(items, tmp_path, force=True)
    assert (forced, f"{told} (force=true goes on)") == ("warned", said)


FILES = [
    *((f"measured/{path.name}", {}) for path in sorted((SHARED / "measured").glob("*.mat"))),
    *(
        (f"measured/slab/{path.name}", {"bin_width_ps": 16.0, "wall_size": 0.7})
        for path in sorted((SHARED / "measured" / "slab").glob("letter_*.mat"))
    ),
    ("measured/figure_4", {}),
    *((f"rendered/{path.name}", {}) for path in sorted((SHARED / "rendered").glob("*.hdf5"))),
]


@pytest.mark.parametrize(("name", "given"), FILES)
def test_no_real_capture_is_refused(name, given):
    capture = read_capture(real_file(name), options=ReaderOptions(**given))
    assert nonsense(capture) == []
    plan = plan_capture(capture)
    assert nonsense(capture.sum_bins(plan.sum_bins).with_gate(*plan.gate)) == []
    assert plan.depth is not None
    assert volume_without_light(capture, plan.depth) == []


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["default", "letters"])
def test_no_embedded_scene_is_refused(name, seed):
    size = ["scene.simulate.scan.nx=12", "scene.simulate.scan.ny=12"]
    capture, _ = load_scene(compose("train", [f"scene={name}", *size])["scene"], ".", seed)
    assert nonsense(capture) == []


@pytest.mark.parametrize("photons", [1, 3, 30, 1000])
def test_few_photons_are_no_noise(photons):
    """Light of so many photons a spot over a background of twice as many is still seen as light."""
    items = cases.base("confocal", 0)
    mean = cases.base("expected", 0)["H"].reshape(cases.BINS, -1).T - 0.2
    rng = np.random.default_rng(photons)
    lit = rng.poisson(photons * mean / mean.sum(axis=1, keepdims=True) + 2 * photons / cases.BINS)
    assert lit.sum() == pytest.approx(3 * photons * len(mean), rel=0.2)
    places = items["laser_grid_xyz"].reshape(-1, 3)
    up = np.broadcast_to([0.0, 0.0, 1.0], places.shape)
    capture = Capture(lit.astype(np.uint16), places, places, up, up, cases.BIN)
    assert nonsense(capture) == []
    dark = rng.poisson(lit.mean(axis=1, keepdims=True), lit.shape).astype(np.uint16)
    assert "nothing but noise" in nonsense(dataclasses.replace(capture, counts=dark))[0]


def test_noise_is_told_from_light_as_often_as_it_says():
    """Of sixty captures of noise, of Poisson, gamma and Gaussian numbers, none is taken for light."""
    rng = np.random.default_rng(0)
    items = cases.base("confocal", 0)
    places = items["laser_grid_xyz"].reshape(-1, 3)
    up = np.broadcast_to([0.0, 0.0, 1.0], places.shape)
    for number in range(60):
        shape = (len(places), int(rng.integers(20, 120)))
        level = rng.uniform(0.5, 5, (len(places), 1))
        values = (
            rng.poisson(level, shape).astype(np.uint16),
            rng.gamma(2, level, shape),
            100 + rng.normal(size=shape) * level,
        )[number % 3]
        capture = Capture(values, places, places, up, up, cases.BIN, is_counts=number % 3 == 0)
        assert "nothing but noise" in nonsense(capture)[0]


def test_forced_noise_has_no_depths_to_plan(tmp_path):
    items = cases.CASES["Poisson noise of mean 5"](cases.base("confocal", 0), np.random.default_rng(0))
    came, said = cases.outcome(items, tmp_path, force=True)
    assert (came, "give them as 'scene.volume.depth=[NEAR,FAR]'" in said) == ("refused", True)
