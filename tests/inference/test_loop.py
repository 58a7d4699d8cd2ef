"""The loop: which terms the scene is rebuilt with, what is taken, and what is dropped again."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inference_scenes import BLOCK, candidate, capture_of, effect_of, per_spot, scattered
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference import criticise as loop
from nlos_lit.inference.criticise import (
    CriticismSettings,
    Findings,
    Loop,
    Trial,
    Turn,
    begun_with,
    best_of_each,
    choose,
    copy_effects,
    criticise,
    finalists,
    leaders,
    needed,
    weighed,
)
from nlos_lit.inference.heldout import compare
from nlos_lit.inference.pool import Candidate
from nlos_lit.runtime.steps import Steps

SCAN = Scan.of(capture_of(scattered(12)))
SPLIT = SimpleNamespace(select=np.arange(120), fit=np.arange(300), block=BLOCK)
SETTINGS = CriticismSettings(processes=1)
NOTHING = torch.zeros(120, dtype=torch.float64)


def bar(values: Tensor) -> float:
    """Standard error of what single spots gain, nats."""
    return compare(NOTHING, values, BLOCK).error


def gaining(errors: float, seed: int = 0, scatter: float = 0.1) -> Tensor:
    """``[120]`` nats of a gain of so many of its standard errors."""
    off = per_spot(0.0, scatter, seed)
    return off + errors * bar(off) / 120


class FakeFit:
    """Stands for a fit with some effects."""

    tested, train, counts = torch.tensor([0]), torch.tensor([0]), torch.tensor([[1.0]])
    model = SimpleNamespace(expected=lambda rows, extension: torch.tensor([[1.0]]))

    def __init__(self, extension: Extension, seed: int = 0, fine: bool = False, warm: bool = False) -> None:
        self.extension, self.seed, self.fine, self.warm = extension, seed, fine, warm

    def copy(self, extension: Extension, seed: int) -> FakeFit:
        return FakeFit(extension, seed, self.fine, warm=True)

    def run(self, *_: object, **__: object) -> None:
        pass

    @property
    def names(self) -> frozenset[str]:
        return frozenset(e.name for e in self.extension.effects)


def fitted(*names: str, fine: bool = False) -> FakeFit:
    return FakeFit(Extension([effect_of(n, SCAN) for n in names]), fine=fine)


class World:
    """Rebuilds that are worth what a table says.

    Args:
        table: nats of the select spots by names of effects; "fine" counts for a fine scene on top, "warm" for
            one that was gone on with.
        pool: all that is ever found.
        impossible: effects with which no surfel survives.
    """

    def __init__(
        self, monkeypatch, table: dict[str, Tensor], pool: list[Candidate], impossible: tuple[str, ...] = ()
    ) -> None:
        self.table, self.pool, self.impossible = table, pool, impossible
        self.rebuilt: list[tuple[frozenset[str], int, bool]] = []
        self.grown: list[int] = []
        monkeypatch.setattr(loop, "log_likelihood", self.likelihood)
        monkeypatch.setattr(loop, "ask", self.ask)

    def likelihood(self, fit: FakeFit, spots: np.ndarray) -> Tensor:
        assert np.array_equal(spots, SPLIT.select)
        kind, names = ["fine"] * fit.fine, sorted(fit.names)
        if fit.warm and "warm" in self.table:
            kind.append("warm")
        names = [*kind, *names]
        if "+".join(names) in self.table:
            return self.table["+".join(names)]
        return sum((self.table[n] for n in names if n in self.table), NOTHING)

    def ask(self, fit: FakeFit, *_: object) -> list[Candidate]:
        return [c for c in self.pool if c.name not in fit.names]

    def rebuild(self, extension: Extension, seed: int, fine: bool) -> FakeFit:
        fit = FakeFit(extension, seed, fine)
        self.rebuilt.append((fit.names, seed, fine))
        if fit.names & set(self.impossible):
            raise UserError("no surface")
        return fit

    def grow(self, fit: FakeFit, seed: int) -> FakeFit:
        self.grown.append(seed)
        return FakeFit(fit.extension, seed, fine=True)

    def loop(self, steps: Steps | None = None) -> Loop:
        return Loop(self.rebuild, self.grow, SPLIT, SCAN, SETTINGS, 4, steps or Steps())

    def turn(self, fit: FakeFit, grown: bool = False) -> Turn:
        return self.loop().turn(fit, grown)

    def criticise(self, s: CriticismSettings = SETTINGS) -> Findings:
        return criticise(fitted(), self.rebuild, self.grow, SPLIT, SCAN, s, 4)


def trial(name: str, likelihood: Tensor) -> Trial:
    return Trial(candidate(name), None, likelihood, compare(NOTHING, likelihood, BLOCK))


def test_a_larger_pool_needs_more():
    """ln(terms/level): a mean Bayes factor of 1 for each."""
    assert needed([candidate("irf_tail")] * 40, CriticismSettings(level=0.01)) == pytest.approx(
        math.log(4000)
    )
    assert needed([candidate("irf_tail")], CriticismSettings(level=0.1)) == pytest.approx(math.log(10))


def test_leaders_are_the_best_of_each_kind():
    """One free term, one with a number for each spot, and laws."""
    names = [
        *("free_wall", "free_time", "irf_tail", "pile_up", "vignetting", "free_scan", "hum", "hot_spots"),
        "ambient_map",
    ]
    wanted = [candidate(n, 100.0 - k) for k, n in enumerate(names)]
    assert [c.name for c in leaders(wanted, 4)] == ["free_wall", "irf_tail", "pile_up", "hot_spots"]
    assert [c.name for c in leaders(wanted[2:], 4)] == ["irf_tail", "pile_up", "free_scan", "hot_spots"]
    assert [c.name for c in leaders(wanted[2:7], 4)] == ["irf_tail", "pile_up", "vignetting", "free_scan"]
    assert [c.name for c in leaders(wanted[2:5], 2)] == ["irf_tail", "pile_up"]
    assert leaders([], 4) == []
    hopeless = [candidate("irf_tail", 1000.0), candidate("pile_up", 51.0), candidate("vignetting", 49.0)]
    assert [c.name for c in leaders(hopeless, 4)] == ["irf_tail", "pile_up"]


def test_a_term_begins_where_the_pool_saw_it():
    """Within its bounds; numbers of single spots are solved for; all that was there is copied."""
    have = fitted("pile_up")
    have.extension.effects[0].set("detections", 0.2)
    tail, spots = candidate("irf_tail"), candidate("hot_spots")
    tail.step.fill_(3.0)
    found = begun_with(have, [spots, tail])
    assert [e.name for e in found.effects] == ["irf_tail", "hot_spots", "pile_up"]
    assert found.effects[0].value("fraction").item() == pytest.approx(0.15)
    assert [any(p.requires_grad for p in e.parameters()) for e in found.effects] == [True, False, True]
    assert tail.effect.value("fraction").item() == 0
    assert found.effects[2] is not have.extension.effects[0]
    assert found.effects[2].value("detections").item() == pytest.approx(0.2)
    tail.step.fill_(-3.0)
    assert begun_with(have, [tail]).effects[0].value("fraction").item() == 0
    free = copy_effects(have.extension, [candidate("free_scan_delay").effect, candidate("time_drift").effect])
    assert [e.name for e in free.effects] == ["time_drift", "pile_up", "free_scan_delay"]


@pytest.mark.parametrize(("truth", "begun"), [(0.5, 0.5), (0.2, 0.15), (0.04, 0.05)])
def test_too_long_a_step_is_shortened(truth, begun):
    """To three tenths or a tenth, whichever makes the counts likeliest: they are 1 + fraction here."""
    fit = fitted()
    fit.counts = torch.tensor([[1000.0 * (1 + truth)]])
    fit.model = SimpleNamespace(
        expected=lambda rows, extension: (
            1000 * (1 + extension.effects[0].value("fraction").detach()).view(1, 1)
        )
    )
    tail = candidate("irf_tail")
    tail.step.fill_(10.0)
    assert begun_with(fit, [tail]).effects[0].value("fraction").item() == pytest.approx(begun)


def test_a_law_is_rebuilt_with_though_others_gain_more():
    """Numbers of single spots and free terms take up at once what a law has to drive the scene out of."""
    names = (("free_wall", 9.0), ("hot_spots", 8.0), ("vignetting", 1.0), ("pile_up", 2.0))
    trials = [trial(n, gaining(k)) for n, k in names]
    assert [t.name for t in finalists(trials, 2)] == ["free_wall", "hot_spots", "vignetting"]


def test_the_finalists_gain_most_or_have_the_most_evidence():
    trials = [
        trial(n, gaining(k))
        for n, k in (("irf_tail", 1.0), ("pile_up", 9.0), ("hum", 5.0), ("vignetting", 8.0))
    ]
    assert [t.name for t in finalists(trials, 2)] == ["irf_tail", "pile_up", "vignetting"]
    assert [t.name for t in finalists(trials[1:], 2)] == ["pile_up", "vignetting"]
    assert finalists([], 2) == []


def test_the_better_trial_of_a_term_stands_for_it():
    trials = [
        trial("irf_tail", gaining(1.0)),
        trial("pile_up", gaining(3.0)),
        trial("irf_tail", gaining(5.0)),
    ]
    assert best_of_each(trials) == [trials[2], trials[1]]


def test_the_simplest_of_those_that_are_left_open():
    """Fewer coefficients win above the weight; an effect wins over a free term with fewer coefficients."""

    def weighing(name: str, weight: float) -> Trial:
        return replace(trial(name, NOTHING + 1.0), weight=weight)

    wide, free = weighing("wall_reflectance", 0.9), weighing("free_rate", 0.9)
    assert len(wide.candidate.step) > len(free.candidate.step) > 1
    near, far = weighing("vignetting", 0.051), weighing("vignetting", 0.049)
    assert choose([wide, near], 0.05) is near
    assert choose([wide, far], 0.05) is wide
    assert choose([free, wide], 0.05) is wide
    assert choose([free, far], 0.05) is free
    assert choose([weighing("free_rate", 0.04), far], 0.05) is far, "the heaviest where none is above"
    # A number a spot is as many coefficients as there are spots.
    jitter = weighing("timing_jitter", 0.5)
    assert len(jitter.candidate.step) == 12 > len(wide.candidate.step)
    assert choose([jitter, wide, far], 0.05) is wide


def test_trials_stand_by_gain_with_their_weights():
    found = weighed([trial("irf_tail", gaining(3.0)), trial("pile_up", gaining(30.0))], BLOCK)
    assert [t.name for t in found] == ["pile_up", "irf_tail"]
    assert [t.weight for t in found] == pytest.approx([1, 0], abs=1e-3)


@pytest.mark.parametrize(("errors", "accepted"), [(1.95, False), (2.05, True)])
def test_the_bar_is_so_many_standard_errors(monkeypatch, errors, accepted):
    """Of the gain over the fit before, and over the scene by other seeds, which gains nothing here."""
    for grown in (False, True):
        world = World(monkeypatch, {"irf_tail": gaining(errors)}, [candidate("irf_tail")])
        found = world.turn(fitted(fine=grown), grown)
        assert (found.accepted is not None) is accepted
        assert found.trials[0].gain.nats == pytest.approx(errors * found.trials[0].gain.error)
        if accepted:
            assert found.accepted.name == "irf_tail"
        # A coarse scene is rebuilt with the term and refined; a fine one only serves again as the control.
        assert len(world.rebuilt) == (accepted if grown else 1)
        assert len(world.grown) == (not grown)


def test_nothing_is_rebuilt_where_nothing_is_asked_for(monkeypatch):
    pool = [candidate("irf_tail", math.log(2 / 0.01) - 0.01), candidate("pile_up", 0.0)]
    world = World(monkeypatch, {}, pool)
    found = world.turn(fitted())
    assert (found.accepted, found.trials, found.candidates) == (None, [], pool)
    assert (world.rebuilt, world.grown) == ([], [])
    world.pool[0] = candidate("irf_tail", math.log(2 / 0.01) + 0.01)
    world.turn(fitted())
    assert world.rebuilt == [({"irf_tail"}, 4, False)]
    assert world.grown == [5], "the control has other seeds"


def test_more_scene_wins_where_it_gains_more(monkeypatch):
    tail, fine = gaining(10.0), gaining(30.0, seed=1)
    found = World(monkeypatch, {"irf_tail": tail, "fine": fine}, [candidate("irf_tail")]).turn(fitted())
    assert found.accepted.candidate is None
    assert found.accepted.name == "more scene"
    assert found.accepted.fit.fine
    assert [t.name for t in found.trials] == ["more scene", "irf_tail"]
    # Within two errors of each other the term is tried: it has fewer coefficients than a scene.
    apart = per_spot(0.0, 0.05, seed=2)
    for errors, name in ((1.9, "irf_tail"), (2.1, "more scene")):
        table = {"irf_tail": tail, "fine": tail + apart + errors * bar(apart) / 120}
        found = World(monkeypatch, table, [candidate("irf_tail")]).turn(fitted())
        assert found.accepted.name == name


def test_a_term_that_stands_for_a_finer_scene_is_refused(monkeypatch):
    """It gains as the scene is coarse, and nothing more when it is not."""
    gain = gaining(20.0)
    table = {"irf_tail": gain, "fine": gain, "fine+irf_tail": gain}
    found = World(monkeypatch, table, [candidate("irf_tail")]).criticise()
    assert [t.accepted and t.accepted.name for t in found.turns] == ["irf_tail", None]
    assert (found.accepted, found.losses, found.again) == ([], {}, None)
    assert (found.final.names, found.final.fine, found.base.names, found.base.fine) == (
        set(),
        True,
        set(),
        True,
    )


def test_where_neither_gains_nothing_is_taken(monkeypatch):
    world = World(monkeypatch, {"irf_tail": gaining(1.0), "fine": -gaining(1.0)}, [candidate("irf_tail")])
    found = world.turn(fitted())
    assert found.accepted is None
    assert [t.name for t in found.trials] == ["irf_tail", "more scene"]


def test_a_free_term_yields_to_an_effect_that_gains_as_much(monkeypatch):
    best, apart = gaining(20.0), per_spot(0.0, 0.05, seed=1)
    pool = [candidate("free_time", 200.0), candidate("irf_tail", 100.0)]
    for errors, name in ((0.0, "irf_tail"), (9.0, "free_time")):
        table = {"free_time": best, "irf_tail": best - apart - errors * bar(apart) / 120}
        assert World(monkeypatch, table, pool).turn(fitted()).accepted.name == name


def test_a_simple_term_that_gains_nothing_sure_does_not_stand_in_for_one_that_does(monkeypatch):
    """The free term gains 3 of its errors; the effect half as much, within two errors of the difference, but
    below the bar itself.
    """
    free, tail = gaining(3.0, scatter=1.0), gaining(1.0, seed=1, scatter=1.0)
    pool = [candidate("free_time", 200.0), candidate("irf_tail", 100.0)]
    found = World(monkeypatch, {"free_time": free, "irf_tail": tail}, pool).turn(fitted())
    assert found.accepted.name == "free_time"


def test_what_cannot_be_told_apart_is_a_group(monkeypatch):
    """A rival whose weight is above a twentieth; control and clear losers are not in it."""
    best = gaining(20.0)
    near = best - per_spot(0.005, 1.0, seed=1)
    table = {"irf_tail": best, "pile_up": near, "vignetting": best - per_spot(1.0, 0.1, seed=2)}
    found = World(monkeypatch, table, [candidate(n) for n in table]).turn(fitted())
    names = {"irf_tail", "pile_up"}
    assert found.accepted.name in names
    assert found.group == list(names - {found.accepted.name})
    assert found.accepted.weight == max(t.weight for t in found.trials if t.name == found.accepted.name)
    assert sum(t.weight for t in found.trials) == pytest.approx(1)


def test_going_on_must_not_gain_as_much(monkeypatch):
    """A fit that had not come to rest gains by more batches, with or without a term."""
    gain = gaining(20.0)
    table = {"warm": gain, "irf_tail": gain, "warm+irf_tail": gain}
    found = World(monkeypatch, table, [candidate("irf_tail")]).turn(fitted())
    assert found.accepted is None
    table["irf_tail"] = 2 * gain
    found = World(monkeypatch, table, [candidate("irf_tail")]).turn(fitted())
    assert found.accepted.name == "irf_tail"


def test_a_rebuild_that_leaves_nothing_is_passed_over(monkeypatch):
    pool = [candidate("pile_up"), candidate("irf_tail", 90.0)]
    table = {"irf_tail": gaining(10.0), "pile_up": gaining(20.0), "warm": NOTHING, "warm+pile_up": NOTHING}
    world = World(monkeypatch, table, pool, impossible=("pile_up",))
    found = world.turn(fitted())
    assert found.accepted.name == "irf_tail"
    assert frozenset({"pile_up"}) in [names for names, *_ in world.rebuilt]
    found = World(monkeypatch, table, pool[:1], impossible=("pile_up",)).turn(fitted())
    assert found.accepted is None
    assert {t.name for t in found.trials} == {"pile_up", "more scene"}


def test_a_control_that_cannot_be_rebuilt_says_nothing(monkeypatch):
    world = World(monkeypatch, {"irf_tail": gaining(20.0)}, [candidate("irf_tail")])

    def rebuild(*_: object) -> FakeFit:
        raise UserError("no surface")

    monkeypatch.setattr(world, "rebuild", rebuild)
    found = world.turn(fitted(fine=True), grown=True)
    assert (found.accepted.name, [t.name for t in found.trials]) == ("irf_tail", ["irf_tail"])


def test_needless_terms_are_dropped_one_by_one(monkeypatch):
    """Least needed first; each time the scene is refined with all that are left, and without each."""
    table = {
        "irf_tail": gaining(20.0),
        "afterpulsing": gaining(1.5, seed=1),
        "pile_up": -gaining(5.0, seed=2),
    }
    said = []
    world, given = World(monkeypatch, table, []), fitted("irf_tail", "afterpulsing", "pile_up", fine=True)
    kept, losses = world.loop(Steps(lambda text, *_: said.append(text))).drop_needless(given)
    assert (kept.names, kept.fine) == ({"irf_tail"}, True)
    assert list(losses) == ["irf_tail"]
    assert losses["irf_tail"].nats == pytest.approx(float(table["irf_tail"].sum()))
    without = [f"refining the scene without {name}" for name in ("irf_tail", "afterpulsing", "pile_up")]
    whole = "refining the scene"
    assert said == [whole, *without, whole, *without[:2], whole, without[0]]


@pytest.mark.parametrize(("errors", "stays"), [(2.95, False), (3.05, True)])
def test_terms_that_are_missed_stay(monkeypatch, errors, stays):
    """By three errors, beside a fine scene."""
    world = World(monkeypatch, {"irf_tail": gaining(20.0), "pile_up": gaining(errors, seed=1)}, [])
    kept, losses = world.loop().drop_needless(fitted("irf_tail", "pile_up"))
    assert kept.fine
    assert kept.names == set(losses) == ({"irf_tail", "pile_up"} if stays else {"irf_tail"})
    alone, losses = world.loop().drop_needless(fitted())
    assert (alone.names, losses) == (set(), {})


def test_the_loop_takes_one_term_after_the_other(monkeypatch):
    """Until nothing is asked for, or enough is there; a term that became needless is no accepted one."""
    pool = [candidate("irf_tail", 300.0), candidate("pile_up", 200.0), candidate("vignetting", 100.0)]
    table = {
        "irf_tail": gaining(40.0),
        "pile_up": gaining(20.0, seed=1),
        "vignetting": gaining(10.0, seed=2),
        "irf_tail+pile_up+vignetting": gaining(40.0) + gaining(20.0, seed=1) + gaining(10.0, seed=2),
    }
    found = World(monkeypatch, table, pool).criticise()
    assert [t.accepted and t.accepted.name for t in found.turns] == [
        "irf_tail",
        "pile_up",
        "vignetting",
        None,
    ]
    assert found.final.names == {"irf_tail", "pile_up", "vignetting"}
    assert list(found.losses) == [e.name for e in found.final.extension.effects]
    assert (found.again.names, found.again.fine) == (found.final.names, False)
    assert (found.base.names, found.base.fine) == (set(), True)
    found = World(monkeypatch, table, pool).criticise(CriticismSettings(processes=1, most=2))
    assert [t.accepted.name for t in found.turns] == ["irf_tail", "pile_up"]
    # With the third at hand the second is no longer needed.
    table["irf_tail+pile_up+vignetting"] = table["irf_tail+vignetting"] = table["irf_tail"] + gaining(30.0, 3)
    found = World(monkeypatch, table, pool).criticise()
    assert [t.accepted and t.accepted.name for t in found.turns][:3] == ["irf_tail", "vignetting", None]


def test_a_loop_that_finds_nothing(monkeypatch):
    found = World(monkeypatch, {}, [candidate("irf_tail", 0.0)]).criticise()
    assert isinstance(found, Findings)
    assert (found.accepted, found.again, len(found.turns), found.losses) == ([], None, 1, {})
    assert found.base is found.final
