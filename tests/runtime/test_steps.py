"""Steps of a diagnosis: kept, gone on from, and estimated; joint steps of effects and base."""

from __future__ import annotations

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
from nlos_lit.inference.criticise import CriticismSettings
from nlos_lit.inference.diagnose import diagnose
from nlos_lit.inference.joint_step import best_start, copy_effects, move_base, set_step
from nlos_lit.inference.problem import build_problem, effect_columns
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
    """A base of 10 s: a refit is taken for 3 s until one took 2 s."""
    clock = [0.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    said = []
    steps = Steps(lambda *report: said.append(report))

    def lasts(seconds):
        clock[0] += seconds

    steps.plan(fit=2, refit=2)
    steps("fit", "base", "base", lambda: lasts(10))
    steps("refit", "one", "one", lambda: lasts(2))
    steps("refit", "two", "two", lambda: lasts(4))
    steps("fit", "last", "last", lambda: lasts(12))
    assert said == [("base", 0, 0), ("one", 10, 10 + 2 * 3), ("two", 12, 10 + 2), ("last", 16, 10)]
    steps.plan(refit=3)
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
    """Surfels known beforehand, fitted for a few steps."""

    def __init__(self, scene):
        self.model, self.surfels, self.seeds = surfels(scene), SurfelSettings(steps=4, test_spots=64), []

    def image(self, capture):
        return torch.ones(2, 3, 4), None

    def fit(self, capture, split, image, extension, seed) -> SurfelFit:
        self.seeds.append((seed, tuple(e.name for e in extension.effects)))
        fit = fit_of(self.model, capture, extension, split.fit).copy(extension, seed)
        fit.settings = self.surfels
        fit.run(1)
        return fit


def test_an_interrupted_diagnosis_ends_like_one_that_was_not(tmp_path):
    """Interrupted at its third turn of work, gone on with: the same numbers, and nothing done twice."""
    scene = capture_of(raster(16))
    hidden = effect_of("irf_tail", Scan.of(scene), fraction=0.5, decay=0.1)
    scene = drawn(surfels(scene, level=4.0), Extension([hidden]), scene)
    options = CriticismSettings(spots=96, steps=3, rivals=2, finalists=1, most=1, numerics=False, far_off=9.0)
    texts = []

    def interrupt(text, *_):
        texts.append(text)
        if text.startswith("rebuilding the scene"):
            raise KeyboardInterrupt

    whole, _ = diagnose(scene, Pipeline(scene), options, name="x", seed=0)
    first, second = Pipeline(scene), Pipeline(scene)
    with pytest.raises(KeyboardInterrupt):
        diagnose(scene, first, options, name="x", seed=0, folder=tmp_path, report=interrupt)
    assert texts[:3] == ["imaging", "fitting the base", "screening effects, turn 1"]
    said = []
    again, _ = diagnose(
        scene, second, options, name="x", seed=0, folder=tmp_path, report=lambda text, *_: said.append(text)
    )
    assert said[0].startswith("rebuilding the scene")
    assert first.seeds == [(0, ()), (1, ())]
    assert all(names for _, names in second.seeds)
    same = [dataclasses.asdict(dataclasses.replace(d, seconds=0.0, profiles=[])) for d in (whole, again)]
    np.testing.assert_equal(*same)


def test_joint_steps_follow_the_columns():
    """A small step in all of the base's coefficients and an effect's moves the counts as the columns say."""
    scene = capture_of(raster(5))
    model, scan = surfels(scene), Scan.of(scene)
    present = Extension([effect_of("irf_tail", scan, fraction=0.2, decay=0.1)])
    fit, spots = fit_of(model, scene, present), torch.arange(25)
    problem = build_problem(model, present, spots, torch.ones(25, 58))
    generator = torch.Generator().manual_seed(3)
    step = 1e-3 * torch.randn(problem.nuisance.shape[1], generator=generator)
    before = model.expected(spots, present).double()
    columns = problem.nuisance.double() * before.reshape(-1, 1).sqrt()
    moved = fit.copy(copy_effects(present, []), 0)
    move_base(moved, moved.extension, step)
    change = moved.model.expected(spots, moved.extension).double() - before
    expected = (columns @ step.double()).view_as(change)
    assert float((change - expected).norm() / expected.norm()) < 0.02
    assert torch.equal(model.expected(spots, present).double(), before)  # the copy alone has moved
    drift = effect_of("power_drift", scan)
    column = effect_columns(model, present, spots, drift)
    both = copy_effects(present, [drift])
    set_step(both.effects[1], torch.tensor([0.01, -0.02, 0.01, 0.0, 0.03]))
    change = model.expected(spots, both).double() - before
    asked = (column.double() @ torch.tensor([0.01, -0.02, 0.01, 0.0, 0.03]).double()).view_as(change)
    assert float((change - asked).norm() / asked.norm()) < 0.02


def test_the_likeliest_start_is_taken():
    """A gain drift that the albedos have no part in starts alone; a step of the base that breaks the fit is
    not taken along.
    """
    scene = capture_of(raster(8))
    model, scan = surfels(scene, level=2.0), Scan.of(scene)
    hidden = effect_of("power_drift", scan, drift=torch.tensor([0.2, 0.1, 0.0, 0.0, 0.0]))
    fit = fit_of(model, drawn(model, Extension([hidden]), scene))
    step = torch.tensor([4.0, 2.0, 0.0, 0.0, 0.0])
    size = build_problem(model, Extension([]), torch.arange(2), torch.ones(2, 58)).nuisance.shape[1]
    broken = torch.full((size,), -0.5)
    start = best_start(fit, [effect_of("power_drift", scan)], [step], broken, 0)
    assert torch.equal(start.model.albedo(), model.albedo())
    assert start.extension.effects[0].value("drift").tolist()[:2] == pytest.approx([0.2, 0.1])
    # With albedos that are a third too dark the base's step belongs to the start.
    dark = fit_of(surfels(scene, level=2.0), fit.capture)
    with torch.no_grad():
        dark.model.set_albedo(model.albedo() / 1.5)
    brighter = torch.zeros(size)
    brighter[: len(model)] = 0.5
    start = best_start(dark, [effect_of("power_drift", scan)], [step], brighter, 0)
    assert start.model.albedo()[2:].detach() == pytest.approx(model.albedo()[2:].detach(), rel=1e-3)
