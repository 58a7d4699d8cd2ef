"""The loop: with which terms a fit goes on, which is chosen, and whether a fine scene confirms it."""

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
from nlos_lit.inference import company, turns
from nlos_lit.inference import criticise as loop
from nlos_lit.inference.criticise import (
    CriticismSettings,
    Findings,
    Loop,
    Trial,
    Turn,
    begun_with,
    chosen,
    copy_effects,
    group_of,
    leaders,
    misfit_of,
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


DUD = [candidate(n, 0.0) for n in ("hum", "crosstalk", "direct_leak")]


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

    def __init__(self, extension: Extension, seed: int = 0, fine: bool = False, anew: bool = False) -> None:
        self.extension, self.seed, self.fine, self.anew = extension, seed, fine, anew

    def copy(self, extension: Extension, seed: int) -> FakeFit:
        return FakeFit(extension, seed, self.fine)

    def run(self, *_: object, **__: object) -> None:
        pass

    @property
    def names(self) -> frozenset[str]:
        return frozenset(e.name for e in self.extension.effects)


def fitted(*names: str, fine: bool = False) -> FakeFit:
    return FakeFit(Extension([effect_of(n, SCAN) for n in names]), fine=fine)


class World:
    """Fits that are worth what a table says.

    Args:
        table: nats of the select spots by names of effects; "fine" counts for a fine scene on top, "anew" for
            one from new seeds, and a sum of names in this order may have an entry of its own.
        pool: all that is ever found.
        own: evidence of terms beside a fine scene; that of the pool where nothing is said.
        impossible: effects with which no surfel survives a rebuild.
        misfit: nats that every fine scene leaves of select spots. taken_up: of the fitted spots, fewer.
        together: what is refused is asked for in company.
    """

    def __init__(
        self,
        monkeypatch,
        table: dict[str, Tensor],
        pool: list[Candidate],
        own: dict[str, float] | None = None,
        impossible: tuple[str, ...] = (),
        misfit: float = 0.0,
        taken_up: float = 0.0,
        together: bool = False,
    ) -> None:
        self.table, self.pool, self.own, self.impossible = table, pool, own or {}, impossible
        self.together = together
        self.rebuilt: list[tuple[frozenset[str], int]] = []
        self.grown: list[frozenset[str]] = []
        self.asked: list[bool] = []
        for module in (loop, company):
            monkeypatch.setattr(module, "log_likelihood", self.likelihood)
        monkeypatch.setattr(loop, "ask", self.ask)
        monkeypatch.setattr(loop, "own_evidence", self.own_evidence)
        by = {len(SPLIT.select): misfit, len(SPLIT.fit): misfit - taken_up}
        monkeypatch.setattr(loop, "misfit_of", lambda fit, spots, number: by[len(spots)] * number / 300)
        if not together:
            monkeypatch.setattr(turns, "in_company", lambda *_: None)

    def likelihood(self, fit: FakeFit, spots: np.ndarray) -> Tensor:
        assert np.array_equal(spots, SPLIT.select)
        names = [*["fine"] * fit.fine, *["anew"] * fit.anew, *sorted(fit.names)]
        if "+".join(names) in self.table:
            return self.table["+".join(names)]
        return sum((self.table[n] for n in names if n in self.table), NOTHING)

    def ask(self, fit: FakeFit, *_: object) -> list[Candidate]:
        self.asked.append(fit.fine)
        return [*(c for c in self.pool if c.name not in fit.names), *DUD[: len(fit.names)]]

    def own_evidence(
        self, fit: FakeFit, split: object, most: int, seed: int, name: str
    ) -> tuple[float, float]:
        assert name in fit.names
        assert fit.fine or self.together
        found = next(c for c in self.pool if c.name == name)
        return self.own.get(name, found.evidence), found.lit

    def rebuild(self, extension: Extension, seed: int) -> FakeFit:
        fit = FakeFit(extension, seed, anew=True)
        self.rebuilt.append((fit.names, seed))
        if fit.names & set(self.impossible):
            raise UserError("no surface")
        return fit

    def grow(self, fit: FakeFit, seed: int) -> FakeFit:
        self.grown.append(fit.names)
        return FakeFit(fit.extension, seed, fine=True, anew=fit.anew)

    def loop(self, steps: Steps | None = None, s: CriticismSettings = SETTINGS) -> Loop:
        return Loop(self.rebuild, self.grow, SPLIT, SCAN, s, 4, steps or Steps())

    def turn(self) -> Turn:
        return self.loop().turn(fitted(), fitted(fine=True))

    def confirm(self, name: str) -> Turn:
        """The pool's turn, and its term beside a fine scene."""
        turn = self.turn()
        assert turn.best.name == name
        loop, fine = self.loop(), fitted(name, fine=True)
        return loop.confirm(turn, loop.own(turn, fine), fine, fitted(fine=True))

    def criticise(self, s: CriticismSettings = SETTINGS) -> Findings:
        return turns.criticise(fitted(), self.rebuild, self.grow, SPLIT, SCAN, s, 4)


def trial(name: str, likelihood: Tensor) -> Trial:
    return Trial(candidate(name), None, likelihood, compare(NOTHING, likelihood, BLOCK))


def test_a_larger_pool_needs_more():
    """ln(terms/level): a mean Bayes factor of 1 for each. A tenth of the misfit is needed on top."""
    pool = [candidate("irf_tail")] * 40
    assert needed(pool, CriticismSettings(level=0.01), 0.0) == pytest.approx(math.log(4000))
    assert needed(pool[:1], CriticismSettings(level=0.1), 0.0) == pytest.approx(math.log(10))
    s = CriticismSettings(share=0.1)
    assert needed(pool, s, 500.0) == pytest.approx(math.log(4000) + 50)
    for lit, share in ((1.0, 50), (0.2, 10), (0.0, 0)):
        assert needed(pool, s, 500.0, lit) == pytest.approx(math.log(4000) + share)


def test_misfit_is_half_the_deviance_above_the_noise(monkeypatch):
    """In 20 bins of 3 spots, 0.5 above 0.9 a bin: 15 nats, however many are looked at; 0.1 below it: -3."""
    fit = SimpleNamespace(counts=torch.zeros(9, 20))
    for deviance, nats in ((1.4, 15.0), (0.8, -3.0)):
        found = SimpleNamespace(deviance_per_bin=deviance, deviance_noise=0.9)
        monkeypatch.setattr(loop, "score", lambda *_, found=found: found)
        assert misfit_of(fit, np.arange(7), 3) == pytest.approx(nats)


def test_leaders_are_the_best_of_each_kind():
    """Half of the laws by evidence, half by what it were if the scatter were their own; one free term and one
    with a number for each spot besides.
    """
    names = [
        *("free_wall", "free_time", "irf_tail", "pile_up", "vignetting", "free_scan", "hum", "hot_spots"),
        *("ambient_map", "timing_jitter"),
    ]
    found = [candidate(n, 100.0 - k) for k, n in enumerate(names)]

    def names_of(number: int) -> list[str]:
        return [c.name for c in leaders(found, number)]

    assert names_of(2) == ["free_wall", "irf_tail", "pile_up", "hot_spots"]
    assert names_of(4) == ["free_wall", "irf_tail", "pile_up", "vignetting", "hum", "hot_spots"]
    found[8] = replace(found[8], loud=500.0)
    assert names_of(2) == ["free_wall", "irf_tail", "hot_spots", "ambient_map"]


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


def gained(name: str, nats: float, weight: float = 0.01) -> Trial:
    return replace(trial(name, NOTHING + nats / 120), weight=weight)


def test_the_simplest_of_the_terms_that_gain_most():
    """Nine tenths of the best gain, or a quarter of its weight, are enough for fewer coefficients, and for an
    effect beside free terms.
    """

    def name(*trials: Trial) -> str:
        return chosen(sorted(trials, key=lambda t: -t.gain.nats), SETTINGS).name

    wide, free = gained("wall_reflectance", 100.0, 0.8), gained("free_rate", 100.0, 0.8)
    assert len(wide.candidate.step) > len(free.candidate.step) > 1
    assert name(wide, gained("vignetting", 90.1)) == "vignetting"
    assert name(wide, gained("vignetting", 89.9)) == "wall_reflectance"
    assert name(wide, gained("vignetting", 50.0, 0.201)) == "vignetting"
    assert name(wide, gained("vignetting", 50.0, 0.199)) == "wall_reflectance"
    assert name(free, gained("wall_reflectance", 90.1)) == "wall_reflectance"
    assert name(free, gained("wall_reflectance", 89.9)) == "free_rate"


@pytest.mark.parametrize(("weight", "name"), [(0.051, None), (0.049, "irf_tail")])
def test_nothing_is_chosen_where_none_is_open(weight, name):
    none = Trial(None, None, NOTHING, compare(NOTHING, NOTHING, BLOCK), weight)
    best = chosen([gained("irf_tail", 100.0), none], SETTINGS)
    assert (best and best.name) == name


def test_trials_stand_by_gain_with_their_weights():
    found = weighed([trial("irf_tail", gaining(3.0)), trial("pile_up", gaining(30.0))], BLOCK)
    assert [t.name for t in found] == ["pile_up", "irf_tail"]
    assert [t.weight for t in found] == pytest.approx([1, 0], abs=1e-3)


def test_nothing_is_tried_where_nothing_is_asked_for(monkeypatch):
    bar = math.log(2 / 0.01) + SETTINGS.share * 30
    for above in (False, True):
        pool = [candidate("irf_tail", bar + (0.01 if above else -0.01)), candidate("pile_up", 0.0)]
        found = World(monkeypatch, {}, pool, misfit=30.0).turn()
        assert (found.best, found.candidates, found.needed) == (None, pool, pytest.approx(bar))
        assert [t.name for t in found.trials] == (["none", "irf_tail"] if above else [])


def test_what_gains_is_chosen_and_what_gains_nothing_is_not(monkeypatch):
    """A gain of one error leaves none open, which is the simplest; one of four does not."""
    for errors, name in ((1.0, None), (4.0, "irf_tail")):
        gain = gaining(errors, scatter=1.0)
        found = World(monkeypatch, {"irf_tail": gain}, [candidate("irf_tail")]).turn()
        assert (found.best and found.best.name) == name
        assert sum(t.weight for t in found.trials) == pytest.approx(1)


def test_a_gain_in_few_places_counts(monkeypatch):
    """A glossy spot shows in one wall patch of many: its standard error over patches is as large as its gain,
    but no draw of patches makes it a loss.
    """
    gain = torch.where(torch.from_numpy(BLOCK[0] == BLOCK), 20.0, 0.001).double()
    found = World(monkeypatch, {"specular_lobe": gain}, [candidate("specular_lobe")]).turn()
    assert found.trials[0].gain.nats < 1.5 * found.trials[0].gain.error
    none = next(t.weight for t in found.trials if t.candidate is None)
    assert (found.best is None) == (none > SETTINGS.open_share)


def test_what_cannot_be_told_apart_is_a_group(monkeypatch):
    """A rival whose weight is above a twentieth; none and clear losers are not in it."""
    best = gaining(20.0)
    near = best - per_spot(0.005, 1.0, seed=1)
    table = {"irf_tail": best, "pile_up": near, "vignetting": best - per_spot(1.0, 0.1, seed=2)}
    found = World(monkeypatch, table, [candidate(n) for n in table]).turn()
    names = {"irf_tail", "pile_up"}
    assert next(iter(found.group)) == found.best.name
    assert found.group.keys() == names
    assert sum(found.group.values()) == pytest.approx(1)
    # A free term that does the same is no other name; weights are among effects, however much more it gains.
    table = {"free_rate": best, "irf_tail": 0.95 * best, "afterpulsing": 0.95 * best}
    found = World(monkeypatch, table, [candidate(n) for n in table]).turn()
    assert found.group == {n: pytest.approx(0.5) for n in ("irf_tail", "afterpulsing")}


@pytest.mark.parametrize(("nats", "names"), [(2.5, {"irf_tail", "pile_up"}), (3.5, {"irf_tail"})])
def test_the_edge_of_a_group(nats, names):
    """Where all patches say the same, a weight of a twentieth is 2.94 nats."""
    trials = [gained("irf_tail", 100.0), gained("pile_up", 100.0 - nats)]
    assert group_of(trials[0], trials, BLOCK, 0.05).keys() == names


def test_a_term_is_confirmed_beside_a_fine_scene(monkeypatch):
    """By its evidence there, and as long as the scene that grew without it does not predict better."""
    tail, fine = gaining(10.0), gaining(30.0, seed=1)
    for misfit, accepted in ((0.0, True), (1001.0, False)):
        world = World(monkeypatch, {"irf_tail": tail}, [candidate("irf_tail", 200.0)], misfit=misfit)
        world.own["irf_tail"] = math.log(1 / 0.01) + 100 * SETTINGS.share * 10
        found = world.confirm("irf_tail")
        assert found.accepted is accepted
        assert found.confirmed.needed == pytest.approx(math.log(100) + SETTINGS.share * misfit)
        assert found.confirmed.gain.nats == pytest.approx(float(tail.sum()))
    for without, accepted in ((-fine, True), (fine, False)):
        table = {"irf_tail": tail, "fine+irf_tail": NOTHING, "fine": without}
        found = World(monkeypatch, table, [candidate("irf_tail", 200.0)]).confirm("irf_tail")
        assert found.accepted is accepted


def test_the_mean_of_fitted_and_other_spots_says_what_is_accepted(monkeypatch):
    """1000 nats on select spots, and 900 fewer on fitted ones: a tenth of 100 is asked before trials, on top
    of ln(1/level), and of 550 at the end, where noise that surfels took up counts once for and once against.
    """
    for evidence, accepted in ((59.5, False), (59.7, True)):
        pool = [candidate("irf_tail", evidence)]
        world = World(monkeypatch, {"irf_tail": gaining(20.0)}, pool, misfit=1000.0, taken_up=900.0)
        found = world.confirm("irf_tail")
        assert found.needed == pytest.approx(math.log(100) + 10)
        assert found.confirmed.needed == pytest.approx(math.log(100) + 55)
        assert found.accepted is accepted


def test_a_term_that_stands_for_a_finer_scene_is_refused(monkeypatch):
    """It gains as the scene is coarse, and nothing more when it is not."""
    table = {"irf_tail": gaining(20.0)}
    world = World(monkeypatch, table, [candidate("irf_tail", 200.0)], own={"irf_tail": 1.0})
    found = world.criticise()
    assert [(t.best.name, t.accepted) for t in found.turns] == [("irf_tail", False)]
    assert world.asked == [False]
    assert (found.accepted, found.losses, found.again) == ([], {}, None)
    assert found.final is found.base
    assert (found.base.names, found.base.fine) == (set(), True)


@pytest.mark.parametrize(
    ("evidence", "own", "names"),
    [(12.0, 200.0, ["pile_up"]), (12.0, 1.0, []), (10.0, 200.0, [])],
)
def test_what_is_next_best_is_asked_in_place_of_what_is_refused(monkeypatch, evidence, own, names):
    """If the pool asks for it: the bar is 5.3 + 5.3. A term that only its gain speaks for ends the turn."""
    table = {"irf_tail": gaining(40.0), "pile_up": gaining(20.0, seed=1)}
    pool = [candidate("irf_tail", 300.0), candidate("pile_up", evidence)]
    found = World(monkeypatch, table, pool, own={"irf_tail": 1.0, "pile_up": own}, misfit=53.0)
    turns = found.criticise().turns
    assert [t.best.name for t in turns if t.accepted] == names
    first = turns[0]
    asked = evidence > first.needed
    assert first.best.name == ("pile_up" if asked else "irf_tail")
    assert {n: c.evidence for n, c in first.refused.items()} == ({"irf_tail": 1.0} if asked else {})
    assert "irf_tail" not in first.group or not asked
    assert found.grown[0] == set()
    assert {"pile_up"} not in found.grown or asked


@pytest.mark.parametrize(("evidence", "named"), [(5.4, True), (5.2, False)])
def test_what_single_spots_have_over_their_neighbours_needs_no_share_of_the_misfit(
    monkeypatch, evidence, named
):
    """ln(2/level) = 5.3, beside a misfit of 10 000 nats, of which a map would need 1000."""
    monkeypatch.setattr(loop, "solve", lambda *_: None)
    pool = [candidate("wall_reflectance", 150.0), candidate("timing_jitter", evidence, 0.0)]
    table = {"timing_jitter": gaining(20.0), "wall_reflectance": gaining(40.0, seed=1)}
    found = World(monkeypatch, table, pool, misfit=10_000.0).criticise()
    assert [t.best.name for t in found.accepted] == (["timing_jitter"] if named else [])


def test_the_better_of_two_scenes_goes_on(monkeypatch):
    """The one that was gone on with, or one from new seeds, where surfels that imitated the term do not come
    back; none where no surfel survives.
    """
    for new, impossible, taken in (
        (gaining(1.0), (), True),
        (-gaining(1.0), (), False),
        (gaining(1.0), ("irf_tail",), False),
    ):
        table = {"irf_tail": gaining(20.0), "anew": new}
        world = World(monkeypatch, table, [candidate("irf_tail", 200.0)], impossible=impossible)
        best = world.turn().best
        again = world.loop().again(best)
        assert world.rebuilt == [({"irf_tail"}, 4)]
        assert (again is not best.fit) is taken


@pytest.mark.parametrize(("without", "accepted"), [(0.0, True), (10.0, False)])
def test_other_seeds_are_tried_without_the_term_where_they_were_with_it(monkeypatch, without, accepted):
    """With the term a scene that is built anew is better by ten nats when it is fine. If it is without the
    term, too, that is no merit of the term's.
    """
    table = {"irf_tail": gaining(20.0), "anew": NOTHING + 0.1}
    table |= {"fine+anew+irf_tail": NOTHING + 10 / 120, "fine+anew": NOTHING + without / 120}
    table["fine+irf_tail"] = NOTHING
    world = World(monkeypatch, table, [candidate("irf_tail", 200.0)])
    turn = world.criticise().turns[0]
    assert world.rebuilt[:2] == [({"irf_tail"}, 4), (set(), 4)]
    assert turn.accepted is accepted
    assert turn.confirmed.gain.nats == pytest.approx(10 if accepted else 0)


@pytest.mark.parametrize(("evidence", "accepted"), [(200.0, True), (1.0, False)])
def test_a_fine_scene_goes_on_with_the_term_where_two_scenes_do_not_tell(monkeypatch, evidence, accepted):
    """The scene that was refined with the term has bad luck; that without it gains by the term. It is tried
    where there is evidence enough, and stays.
    """
    gain = gaining(20.0)
    table = {"irf_tail": gain, "anew": NOTHING + 0.1, "fine+anew": NOTHING - 1, "fine+irf_tail": gain}
    table["fine+anew+irf_tail"] = gain - 2 * gain.mean()
    world = World(monkeypatch, table, [candidate("irf_tail", 200.0)], own={"irf_tail": evidence})
    found = world.criticise()
    assert bool(found.accepted) is accepted
    assert (found.final.names, found.final.anew) == ({"irf_tail"} if accepted else set(), False)


def test_the_loop_takes_one_term_after_the_other(monkeypatch):
    """Until nothing is asked for, or enough is there."""
    pool = [candidate("irf_tail", 300.0), candidate("pile_up", 200.0), candidate("vignetting", 100.0)]
    table = {
        "irf_tail": gaining(40.0),
        "pile_up": gaining(20.0, seed=1),
        "vignetting": gaining(10.0, seed=2),
    }
    world = World(monkeypatch, table, pool)
    found = world.criticise()
    assert [t.best and t.best.name for t in found.turns] == ["irf_tail", "pile_up", "vignetting", None]
    assert found.final.names == {"irf_tail", "pile_up", "vignetting"}
    assert [t.best.name for t in found.accepted] == ["irf_tail", "pile_up", "vignetting"]
    assert list(found.losses) == [e.name for e in found.final.extension.effects]
    assert found.losses["irf_tail"].nats == pytest.approx(float(table["irf_tail"].sum()))
    assert (found.again.names, found.again.fine) == (found.final.names, False)
    assert (found.base.names, found.base.fine) == (set(), True)
    assert len(world.grown) == 4, "the base, and once for each term"
    found = World(monkeypatch, table, pool).criticise(CriticismSettings(processes=1, most=2))
    assert [t.best.name for t in found.turns] == ["irf_tail", "pile_up"]


def test_a_loop_that_finds_nothing(monkeypatch):
    found = World(monkeypatch, {}, [candidate("irf_tail", 0.0)]).criticise()
    assert isinstance(found, Findings)
    assert (found.accepted, found.again, len(found.turns), found.losses) == ([], None, 1, {})
    assert found.base is found.final


def nats(value: float) -> Tensor:
    """``[120]`` of which every spot has the same share."""
    return NOTHING + value / 120


def hidden(monkeypatch, gains: dict[str, float], misfit: float = 100.0, **own: float) -> World:
    """A world whose terms have next to no evidence of their own beside any scene, but for those named."""
    pool = [candidate(name, 1e6) for name in gains]
    table = {name: nats(value) for name, value in gains.items()}
    return World(monkeypatch, table, pool, dict.fromkeys(gains, 1.0) | own, misfit=misfit, together=True)


@pytest.mark.parametrize(("gain", "accepted"), [(10.1, True), (9.9, False)])
def test_terms_that_are_refused_alone_are_asked_for_in_company(monkeypatch, gain, accepted):
    """Each explains a quarter of what 120 spots leave unexplained without it: 40 nats."""
    world = hidden(monkeypatch, {"irf_tail": 40.0, "vignetting": gain})
    found = world.criticise()
    names = {"irf_tail", "vignetting"} if accepted else {"irf_tail"}
    assert {t.best.name for t in found.accepted} == found.final.names == names
    assert found.losses.keys() == names
    if accepted:
        assert [(t.confirmed.evidence, t.confirmed.gain.nats) for t in found.accepted] == [
            (1.0, pytest.approx(40.0)),
            (1.0, pytest.approx(gain)),
        ]
        assert [t.refused for t in found.accepted] == [{}, {}]


def test_where_no_term_comes_to_the_first_there_is_no_company(monkeypatch):
    found = hidden(monkeypatch, {"irf_tail": 40.0}).criticise()
    assert [(t.best.name, t.accepted) for t in found.turns] == [("irf_tail", False)]


def test_who_does_not_hold_leaves_the_company(monkeypatch):
    nothing = hidden(monkeypatch, {"irf_tail": 9.0, "vignetting": 8.0}).criticise()
    assert (nothing.accepted, nothing.final) == ([], nothing.base)
    world = hidden(monkeypatch, {"irf_tail": 40.0, "vignetting": 30.0, "pile_up": 5.0})
    found = world.criticise()
    assert found.final.names == found.again.names == {"irf_tail", "vignetting"}
    assert {"irf_tail", "vignetting", "pile_up"} in world.grown


@pytest.mark.parametrize(("evidence", "held"), [(14.8, True), (14.6, False)])
def test_evidence_holds_in_company_too(monkeypatch, evidence, held):
    """ln(1/level) = 4.6 and a tenth of 100; what is gained is less than a quarter of the misfit."""
    world = hidden(monkeypatch, {"irf_tail": 5.0}, irf_tail=evidence)
    turn = world.turn()
    ((found, without),) = world.loop().held([turn], fitted("irf_tail", fine=True))
    assert (found.accepted, without.names) == (held, set())


def test_a_company_must_predict_better_than_a_finer_scene(monkeypatch):
    for finer, names in ((60.0, {"irf_tail", "vignetting"}), (80.0, set())):
        world = hidden(monkeypatch, {"irf_tail": 40.0, "vignetting": 30.0})
        world.table |= {"fine": nats(finer), "fine+irf_tail+vignetting": nats(70.0)}
        world.table |= {"fine+irf_tail": nats(40.0), "fine+vignetting": nats(30.0)}
        assert world.criticise().final.names == names


def test_the_company_keeps_the_scene_that_predicts_best(monkeypatch):
    """A scene that was refined may have taken up noise."""
    for finer, fine in ((1.0, True), (-1.0, False)):
        world = hidden(monkeypatch, {"irf_tail": 40.0, "vignetting": 30.0})
        world.table |= {"fine": nats(0.0), "fine+irf_tail+vignetting": nats(70.0 + finer)}
        world.table |= {"fine+irf_tail": nats(40.0), "fine+vignetting": nats(30.0)}
        assert world.criticise().final.fine is fine


def test_numbers_of_single_spots_are_no_company(monkeypatch):
    """They are asked for by themselves, after it."""
    monkeypatch.setattr(loop, "solve", lambda *_: None)
    world = hidden(monkeypatch, {"irf_tail": 40.0, "timing_jitter": 30.0}, timing_jitter=500.0)
    found = world.criticise()
    assert [t.best.name for t in found.accepted] == ["timing_jitter"]
    both = hidden(
        monkeypatch, {"irf_tail": 40.0, "vignetting": 30.0, "timing_jitter": 20.0}, timing_jitter=500.0
    )
    found = both.criticise()
    assert [t.best.name for t in found.accepted] == ["irf_tail", "vignetting", "timing_jitter"]
