"""Steps of a diagnosis: kept, gone on from, and estimated."""

from __future__ import annotations

import copy
import dataclasses
import threading
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, surfels

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference import scenes
from nlos_lit.inference.diagnose import diagnose
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.runtime import steps as module
from nlos_lit.runtime.steps import Steps
from nlos_lit.surfels.fit import SurfelFit, SurfelSettings

pytestmark = FORWARD_MODE


def test_a_step_is_done_once(tmp_path):
    """Shared objects stay the same ones; the rest is read back."""
    counts, made = torch.arange(5.0), []

    def make():
        made.append(1)
        return {"counts": counts, "own": counts + 1}

    steps = Steps(folder=tmp_path, settings="a")
    steps.share({"counts": counts})
    first = steps("fit", "fitting", "base", make)
    again = Steps(folder=tmp_path, settings="a")
    again.share({"counts": counts})
    second = again("fit", "fitting", "base", make)
    assert len(made) == 1
    assert second["counts"] is counts
    assert torch.equal(second["own"], first["own"])
    assert (tmp_path / "base.npz").stat().st_size < 2000
    with pytest.raises(UserError, match="interrupted diagnosis with other settings"):
        Steps(folder=tmp_path, settings="b")
    assert Steps()("fit", "fitting", "base", make)["own"] is not None  # without a folder nothing is kept
    assert len(made) == 2


def test_seconds_of_kept_steps_count(tmp_path):
    steps = Steps(folder=tmp_path)
    steps("fit", "fitting", "base", lambda: time.sleep(0.05))
    assert steps.earlier == 0
    again = Steps(folder=tmp_path)
    again("fit", "fitting", "base", lambda: None)
    assert 0.05 <= again.earlier < 5


def test_what_is_interrupted_is_not_kept(tmp_path):
    def broken():
        raise KeyboardInterrupt

    steps = Steps(folder=tmp_path)
    with pytest.raises(KeyboardInterrupt):
        steps("fit", "fitting", "base", broken)
    assert not list(tmp_path.iterdir())


def test_time_left_by_hand(monkeypatch):
    """A base of 10 s: an image is taken for 3 s until one took 2 s."""
    clock = [0.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    said = []
    steps = Steps(lambda *report: said.append(report))

    def lasts(seconds):
        clock[0] += seconds

    steps.plan(fit=2, image=2)
    steps("fit", "base", "base", lambda: lasts(10))
    steps("image", "one", "one", lambda: lasts(2))
    steps("image", "two", "two", lambda: lasts(4))
    steps("fit", "last", "last", lambda: lasts(12))
    assert said == [("base", 0, 0), ("one", 10, 10 + 2 * 3), ("two", 12, 10 + 2), ("last", 16, 10)]
    steps.plan(image=3)
    assert steps.left() == pytest.approx(3 * 3)


def test_steps_side_by_side(tmp_path):
    """Both at once (each waits for the other), with one thread of torch, in the order asked for; what was
    kept is not repeated.
    """
    before, meet, threads = torch.get_num_threads(), threading.Barrier(2, timeout=20), []

    def together(value: int) -> int:
        threads.append(torch.get_num_threads())
        meet.wait()
        return value

    jobs = [("one", "one", partial(together, 1)), ("two", "two", partial(together, 2))]
    assert Steps(folder=tmp_path).several("fit", jobs, 2) == [1, 2]
    assert threads == [1, 1]
    assert torch.get_num_threads() == before
    assert Steps(folder=tmp_path).several("fit", [*jobs, ("three", "three", lambda: 3)], 2) == [1, 2, 3]
    assert len(threads) == 2


def test_a_failed_step_stops_those_that_wait(tmp_path):
    def broken():
        raise UserError("no surface")

    def slow(k: int) -> None:
        time.sleep(0.05)
        made.append(k)

    made = []
    jobs = [("broken", "broken", broken)] * 2 + [(f"{k}", f"{k}", partial(slow, k)) for k in range(50)]
    with pytest.raises(UserError, match="no surface"):
        Steps(folder=tmp_path).several("fit", jobs, 2)
    assert len(made) < 50


class Pipeline:
    """Surfels known beforehand, fitted until their effects are found, as begun scenes are asked without."""

    def __init__(self, scene):
        self.model, self.surfels, self.seeds = surfels(scene), SurfelSettings(steps=4, test_spots=64), []

    def image(self, capture):
        return torch.ones(2, 3, 4), None

    def fit(self, capture, split, image, extension, seed) -> SurfelFit:
        self.seeds.append((seed, tuple(e.name for e in extension.effects), False))
        fit = fit_of(self.model, capture, extension, split.fit).copy(extension, seed)
        fit.settings = self.surfels
        fit.go_on(80)
        return fit

    def grow(self, fit, seed) -> SurfelFit:
        self.seeds.append((seed, tuple(e.name for e in fit.extension.effects), True))
        again = fit.copy(copy.deepcopy(fit.extension), seed)
        again.go_on(80)
        return again


def test_an_interrupted_diagnosis_ends_like_one_that_was_not(tmp_path, monkeypatch):
    """Interrupted as the first scene is rebuilt, gone on with: the same numbers, and nothing done twice."""
    scene = capture_of(raster(16))
    hidden = effect_of("irf_tail", Scan.of(scene), fraction=0.5, decay=0.1)
    scene = drawn(surfels(scene, level=4.0), Extension([hidden]), scene)
    monkeypatch.setattr(scenes, "WARM", 3)
    options = CriticismSettings(spots=96, rivals=2, most=1, processes=1)
    texts = []

    def interrupt(text, *_):
        texts.append(text)
        if text.startswith("rebuilding the scene"):
            raise KeyboardInterrupt

    once, first, second = (Pipeline(scene) for _ in range(3))
    whole, _ = diagnose(scene, once, options, name="x", seed=0)
    with pytest.raises(KeyboardInterrupt):
        diagnose(scene, first, options, name="x", seed=0, folder=tmp_path, report=interrupt)
    assert texts[:3] == ["imaging", "fitting the base", "refining the scene without effects"]
    kept = {file.stem for file in tmp_path.rglob("begun_*")}
    assert {"begun_irf_tail", "begun_irf_tail_bare"} <= kept, "by effects: other versions have other kinds"
    said = []
    again, _ = diagnose(
        scene, second, options, name="x", seed=0, folder=tmp_path, report=lambda text, *_: said.append(text)
    )
    assert said[0].startswith("rebuilding the scene")
    light = ("retroreflection", "irf_tail", "wall_reflectance", "ambient_map")
    geometry = ("wall_tilt", "wall_scale", "laser_sensor_baseline", "time_offset", "clock_scale")
    echoes = ("higher_order_bounces", "ghost_pulse")
    late = ("irf_tail",)  # does all that the others do with more, and is what the search begins with
    begun = [(0, names, fine) for fine in (False, True) for names in (light, geometry, echoes, late)]
    assert first.seeds == [(0, (), False), (0, (), True), *begun]
    assert first.seeds + second.seeds == once.seeds, "nothing is fitted again"
    same = [dataclasses.asdict(dataclasses.replace(d, seconds=0.0, profiles=[])) for d in (whole, again)]
    np.testing.assert_equal(*same)
