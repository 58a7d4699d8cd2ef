"""A surface fit that is stopped anywhere goes on to the digits of the one that was not."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, surfels

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects.extension import Extension
from nlos_lit.functional.surfel_graph import BEND
from nlos_lit.surfels import fit as fitting
from nlos_lit.surfels.fit import Round, SurfelFit, SurfelSettings, plan_from_seeds
from nlos_lit.surfels.growth import Seeds

pytestmark = FORWARD_MODE
SETTINGS = SurfelSettings(
    contest=3, rounds=2, outlines=1, steps=3, more=2, batch=24, test_spots=50, quadrature=1
)


def begun() -> SurfelFit:
    """Surfels a bin too deep, a tail to be found, and a plan with every kind of round."""
    scene = capture_of(raster(8))
    scan, model = Scan.of(scene), surfels(scene, level=10.0)
    scene = drawn(model, Extension([effect_of("irf_tail", scan, fraction=0.3, decay=0.1)]), scene)
    with torch.no_grad():
        model.raw_depth.add_(1.0)
    fit = fit_of(model, scene, Extension([effect_of(n, scan) for n in ("irf_tail", "wall_reflectance")]))
    fit.settings, fit.tested = SETTINGS, fit.order[:50]
    fit.grid = VolumeGrid((-1.0, -1.0, 0.2), (0.1, 0.1, 0.1), (20, 20, 20))
    fit.reserve = Seeds(torch.tensor([[0.0, 0.0, 0.9]]), torch.tensor([[0.0, 0.0, -1.0]]))
    fit.schedule(plan_from_seeds(SETTINGS, 2, scan_shapes=True), SETTINGS.more, bodies=1)
    return fit


def through_a_file(fit: SurfelFit, path: Path) -> SurfelFit:
    """Another fit, from the file that this one's state leaves."""
    torch.save(fit.state(), path)
    again = begun()
    again.go_on(6)  # it was elsewhere before
    again.restore(torch.load(path, weights_only=True))
    return again


def same(first: object, second: object) -> bool:
    if torch.is_tensor(first):
        return torch.equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(v, second[k]) for k, v in first.items())
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(same, first, second))
    return first == second


def test_a_fit_that_is_stopped_after_every_call_ends_where_the_other_does(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "AGAIN", 2)
    straight, stopped, moments, tried, bends = begun(), begun(), 0, [], []
    while not straight.finished:
        straight.begin_round()
        tried.append(straight.state()["undo"])
        bends.append(straight.bend)
        while not straight.round_done:
            straight.step()
        straight.end_round()
    assert straight.history[0]["surfels"] <= 12
    assert len(straight.history) > 4  # rounds were added
    assert any(each is not None for each in tried), "no round could have been undone"
    assert bends[:3] == [BEND] * 3
    assert max(bends[3:]) < BEND, "flat sheets are stiff once they are found"
    while not stopped.finished:
        stopped = through_a_file(stopped, tmp_path / "state.pt")
        if not stopped.in_round:
            stopped.begin_round()
            stopped = through_a_file(stopped, tmp_path / "state.pt")
        stopped.step()
        stopped = through_a_file(stopped, tmp_path / "state.pt")
        assert stopped.in_round
        moments += 1
        if stopped.round_done:
            stopped.end_round()
    assert moments == straight.done
    assert same(stopped.state(), straight.state())


def test_a_fit_that_goes_on_is_stopped_and_ends_where_the_other_does(tmp_path):
    straight = begun()
    straight.schedule([Round(4)])
    straight.finish()
    straight.schedule([Round(5, onward=True)])
    stopped = through_a_file(straight, tmp_path / "state.pt")
    straight.finish()
    for _ in range(5):
        if not stopped.in_round:
            stopped.begin_round()
        stopped.step()
        stopped = through_a_file(stopped, tmp_path / "state.pt")
    stopped.end_round()
    assert same(stopped.state(), straight.state())


def test_a_state_is_a_copy():
    fit = begun()
    fit.begin_round()
    fit.step()
    kept = fit.state()
    before = copy.deepcopy(kept)
    fit.finish()
    assert same(kept, before)
    assert not same(kept["model"], fit.state()["model"])
    other = begun()
    other.restore(kept)
    other.finish()
    assert same(kept, before)


def test_surfels_that_are_taken_back_leave_what_was_kept_as_it_is():
    """Rounds that are undone go back to it more than once."""
    fit = begun()
    kept = fit._kept()
    before = copy.deepcopy(kept)
    fit._take_back(kept)
    for buffer in (*fit.model.buffers(), *fit.model.parameters()):
        buffer.detach().zero_()
    assert same(kept["model"], before["model"])


def test_a_fit_of_another_version_is_refused():
    fit = begun()
    kept = fit.state()
    del kept["bend"]
    with pytest.raises(UserError, match=r"another version of this project \(it lacks bend\); begin anew"):
        begun().restore(kept)


def test_rates_fall_within_a_round_and_the_last_cools_down():
    fit = begun()
    fit.schedule([Round(4, left=1, settling=True), Round(8, outline=True)])
    rates = []
    while not fit.finished:
        if not fit.in_round:
            fit.begin_round()
        rates.append([group["lr"] for group in fit.optimizer.param_groups])
        fit.step()
        if fit.round_done:
            fit.end_round()
    first, last = np.array(rates[:4]), np.array(rates[4:])
    waiting = [0.08, 0.1, 0.15, 0.2, 0.3 * 0.03]  # the response, and how far rims roll off
    highest = [0.08, 0.1, 0.15, 0.2, 0.05, 0.03]
    assert first == pytest.approx(np.outer(1 - 0.7 * np.arange(4) / 4, waiting))
    assert last == pytest.approx(np.outer(0.5 * (1 + np.cos(np.pi * np.arange(8) / 8)), highest))


def test_shapes_of_effects_wait_for_the_places():
    """A disc or a decay that is fitted while the scene is still wrong wanders off."""
    fit = begun()
    fit.schedule([Round(4, left=1, settling=True), Round(4)])
    tail = fit.extension.effects[0]
    tail.set("decay", 0.17)
    seen = []
    while not fit.finished:
        fit.begin_round()
        before = tail.raw_decay.item(), tail.raw_fraction.item()
        while not fit.round_done:
            fit.step()
        seen.append((tail.raw_decay.item() != before[0], tail.raw_fraction.item() != before[1]))
        fit.end_round()
    assert seen == [(False, True), (True, True)]


def test_what_moves_light_in_time_waits_for_the_places():
    """Fitted to seeds it would take up how far these are off."""
    fit = begun()
    fit.extension = Extension([effect_of("wall_scale", Scan.of(fit.capture)), *fit.extension.effects])
    fit.schedule([Round(4, left=1, settling=True), Round(4)])
    scale, seen = fit.extension.effects[0], []
    while not fit.finished:
        fit.begin_round()
        before = scale.raw_scale_x.item()
        while not fit.round_done:
            fit.step()
        seen.append(scale.raw_scale_x.item() != before)
        fit.end_round()
    assert seen == [False, True]


def test_a_plan_is_the_rounds_in_order():
    settings = dataclasses.replace(SETTINGS, rounds=2, outlines=2, steps=10, contest=7)
    contest = Round(7, left=4, settling=True, contest=True)
    assert plan_from_seeds(settings, 2, scan_shapes=False) == [
        contest,
        Round(10, left=3, settling=True, parts=2),
        Round(10, left=2, grow=True),
        Round(10, left=1, outline=True),
        Round(40, outline=True),
    ]
    bare = dataclasses.replace(settings, outlines=0, contest=0)
    assert plan_from_seeds(bare, 1, scan_shapes=True) == [
        Round(10, left=1, settling=True),
        Round(40, grow=True, shapes=True),
    ]
    assert len(plan_from_seeds(dataclasses.replace(bare, rounds=1), 1, scan_shapes=True)) == 2


def tried(
    fit: SurfelFit, values: list[int], monkeypatch: pytest.MonkeyPatch, more: int = 8
) -> list[tuple[int, int]]:
    """Into how many parts each round divides, and cells a side that are left, if rounds come to such nats."""
    monkeypatch.setattr(fitting, "FINEST", 0.0)
    ahead = iter(values)
    monkeypatch.setattr(
        SurfelFit, "_predicted", lambda self: (torch.full((len(self.judged),), float(next(ahead))), True)
    )
    fit.settings = dataclasses.replace(SETTINGS, most=10**6)
    fit.schedule([], more)
    before, seen = fit.model.lateral.shape[0], []
    for _ in values[1:]:
        parts = fit.plan[0].parts
        if parts > 1:
            fit.model.divide(parts)
        fit.plan = []
        fit._add_round()
        seen.append((parts, fit.model.lateral.shape[0] // before))
    return seen


def test_surfels_are_divided_again_where_that_predicts_more_than_a_round_without(monkeypatch):
    """From the same surfels, whatever a round without it gains: one that is undone leaves nothing behind."""
    fit = begun()
    assert tried(fit, [0, 10, 15, 12], monkeypatch) == [(2, 2), (2, 2), (1, 4)]
    assert fit.plan[0].parts == 2, "which may be divided once more"
    assert tried(begun(), [0, 10, 15, 9], monkeypatch) == [(2, 2), (2, 2), (1, 4)]


def test_no_more_rounds_than_may_be_added_are(monkeypatch):
    fit = begun()
    assert tried(fit, [0, 10, 15], monkeypatch, more=2) == [(2, 2), (2, 4)]
    assert fit.finished, "the round that it would be held against would be the third"
    fit = begun()
    assert tried(fit, [0, 10, 15, 18], monkeypatch, more=3) == [(2, 2), (2, 2), (1, 2)]
    assert fit.finished


def test_surfels_that_gain_more_undivided_are_divided_when_they_gain_no_more(monkeypatch):
    fit = begun()
    values = [0, 10, 15, 18, 20, 19, 25]
    assert tried(fit, values, monkeypatch) == [(2, 2), (2, 2), (1, 2), (1, 2), (1, 2), (2, 4)]
    fit = begun()
    values[-1] = 19
    assert tried(fit, values, monkeypatch) == [(2, 2), (2, 2), (1, 2), (1, 2), (1, 2), (2, 2)]
    assert fit.finished, "neither a round without nor a division does any more"


def test_a_scene_that_no_division_helps_goes_on_as_coarse_as_it_is(monkeypatch):
    fit = begun()
    assert tried(fit, [0, -1, 5, 4], monkeypatch) == [(2, 1), (1, 1), (1, 1)]
    assert fit.finished


def test_seeds_stand_still_while_they_contest_and_faint_ones_go():
    fit = begun()
    fit.settings = dataclasses.replace(SETTINGS, albedo_rate=1e-6)
    places = fit.model.centre().detach().clone()
    with torch.no_grad():
        fit.model.raw_albedo[3] = -12.0  # softplus: 6e-6
        albedo = fit.model.albedo()
        left = int((albedo > 0.01 * torch.quantile(albedo, 0.99)).sum())
    assert left < len(places)
    fit.begin_round()
    assert fit.plan[0].contest
    assert fit.model.quadrature == 1
    for _ in range(3):
        fit.step()
    assert torch.equal(fit.model.centre(), places)
    fit.end_round()
    assert len(fit.model) == left
    fit.begin_round()
    assert len(fit.model) == 4 * left
    fit.step()
    assert fit.model.raw_depth.abs().max() > 0
