"""The loop: terms come together, and each must hold beside the others."""

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
from nlos_lit.effects import EFFECTS, ghost_pulse
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE, FREE_NAMES
from nlos_lit.inference import asking, beginning, members, scenes
from nlos_lit.inference.asking import Asking, misfit_of
from nlos_lit.inference.beginning import begun
from nlos_lit.inference.candidates import Candidate, Pool, Taken, foreign
from nlos_lit.inference.criticise import criticise, unsaid
from nlos_lit.inference.heldout import Comparison, compare
from nlos_lit.inference.holding import Holding
from nlos_lit.inference.members import Confirmed, Findings, Held, Member, Trial, chosen, group_of, weighed
from nlos_lit.inference.scenes import Scenes, begun_with, copy_effects
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.runtime.steps import Steps

SCAN = Scan.of(capture_of(scattered(12)))
SPLIT = SimpleNamespace(select=np.arange(120), fit=np.arange(300), block=BLOCK)
SETTINGS = CriticismSettings(processes=1)
NOTHING = torch.zeros(120, dtype=torch.float64)
LEAST = math.log((len(EFFECTS) + len(FREE)) / SETTINGS.level)


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
        self.on = False  # batches have moved it

    def copy(self, extension: Extension, seed: int) -> FakeFit:
        return FakeFit(extension, seed, self.fine)

    def go_on(self, *_: object, **__: object) -> None:
        self.on = True

    @property
    def names(self) -> frozenset[str]:
        return frozenset(e.name for e in self.extension.effects)


def fitted(*names: str, fine: bool = False) -> FakeFit:
    return FakeFit(Extension([effect_of(n, SCAN) for n in names]), fine=fine)


class World:
    """Fits that are worth what a table says.

    Args:
        table: nats of the select spots by names of effects; "fine" counts for a fine scene on top, "anew" for
            one from new seeds, "on" for one that was gone on with; a sum of names in this order may have an
            entry of its own.
        pool: all that is ever found; what has the evidence it needs is asked for together.
        own: evidence of terms in the model; that of the pool where nothing is said.
        beside: terms that show only where all of some others are in the model.
        rivals: of terms, by name.
        impossible: effects with which no surfel survives a rebuild.
        when_fine: what the pool says of terms beside a fine scene, where that is something else.
        misfit: nats that every scene leaves of select spots. taken_up: of the fitted spots, fewer.
        imitated: effects that scenes imitate, of each kind.
    """

    def __init__(
        self,
        monkeypatch,
        table: dict[str, Tensor],
        pool: list[Candidate],
        own: dict[str, float] | None = None,
        beside: dict[str, set[str]] | None = None,
        rivals: dict[str, list[str]] | None = None,
        impossible: tuple[str, ...] = (),
        misfit: float = 0.0,
        taken_up: float = 0.0,
        lost: dict[str, float] | None = None,
        when_fine: dict[str, float] | None = None,
        imitated: tuple[tuple[str, ...], ...] = (),
    ) -> None:
        monkeypatch.setattr(beginning, "IMITATED", [frozenset(names) for names in imitated])
        self.when_fine = when_fine or {}
        self.table, self.pool, self.own, self.impossible = table, pool, own or {}, impossible
        self.beside, self.rivals, self.lost = beside or {}, rivals or {}, lost or {}
        self.rebuilt: list[tuple[frozenset[str], int]] = []
        self.grown: list[frozenset[str]] = []
        self.asked: list[list[str]] = []
        monkeypatch.setattr(scenes, "solve", lambda *_: None)
        monkeypatch.setattr(scenes, "log_likelihood", self.likelihood)
        monkeypatch.setattr(asking, "ask", self.ask)
        monkeypatch.setattr(asking, "own_evidence", self.own_evidence)
        by = {len(SPLIT.select): misfit, len(SPLIT.fit): misfit - taken_up}
        monkeypatch.setattr(asking, "misfit_of", lambda fit, spots, number: by[len(spots)] * number / 300)

    def likelihood(self, fit: FakeFit, spots: np.ndarray) -> Tensor:
        assert np.array_equal(spots, SPLIT.select)
        names = [*["fine"] * fit.fine, *["anew"] * fit.anew, *sorted(fit.names)]
        on = self.table.get("on", NOTHING) if fit.on else NOTHING
        if "+".join(names) in self.table:
            return on + self.table["+".join(names)]
        return sum((self.table[n] for n in names if n in self.table), on)

    def ask(
        self, fit: FakeFit, split, scan, most, seed, least: float, room: int, effects: bool, only
    ) -> Pool:
        shown = [c for c in self.pool if self.beside.get(c.name, set()) <= fit.names]
        found = [c for c in shown if c.name not in fit.names and (only is None or c.name in only)]
        if fit.fine:
            found = [replace(c, evidence=self.when_fine.get(c.name, c.evidence)) for c in found]
        asked = [c for c in found if c.evidence > least and not c.effect.per_spot]
        named = [c for c in asked if c.name not in FREE_NAMES]
        asked = ((effects and named) or [c for c in asked if c.name in FREE_NAMES])[:room]
        rivals = {n: [candidate(r) for r in names] for n, names in self.rivals.items()}
        leads = foreign(found, least) if effects and room else None
        return Pool(found, [Taken(c, rivals.get(c.name, [])) for c in asked], leads)

    def own_evidence(
        self, fit: FakeFit, split, most, seed, names: list[str], bar
    ) -> tuple[dict[str, tuple[float, float, float]], list[str]]:
        assert set(names) <= fit.names
        self.asked.append(names)
        found = {c.name: c for c in self.pool}
        own = {n: (self.own.get(n, 300.0), found[n].lit if n in found else 1.0) for n in names}
        own |= {n: (found[n].evidence, found[n].lit) for n in names if n in found and n not in self.own}
        bars = {n: (bar(lit, self.lost.get(n, 0.0)), bar(lit, 0.0)) for n, (_, lit) in own.items()}
        asked = {n: (own[n][0], most, most - least) for n, (most, least) in bars.items()}
        return asked, [n for n, (nats, needed, _) in asked.items() if nats > needed]

    def rebuild(self, extension: Extension, seed: int) -> FakeFit:
        fit = FakeFit(extension, seed, anew=True)
        self.rebuilt.append((fit.names, seed))
        if fit.names & set(self.impossible):
            raise UserError("no surface")
        return fit

    def grow(self, fit: FakeFit, seed: int) -> FakeFit:
        self.grown.append(fit.names)
        return FakeFit(fit.extension, seed, fine=True, anew=fit.anew)

    def scenes(self, processes: int = 1) -> Scenes:
        return Scenes(self.rebuild, self.grow, SPLIT, 4, Steps(), processes)

    def asking(self) -> Asking:
        return Asking(self.scenes(), SCAN, SETTINGS)

    def holding(self) -> Holding:
        return Holding(self.asking())

    def begun(self, base: FakeFit, pool: Pool) -> Held:
        return begun(self.scenes(), base, fitted(fine=True), pool, LEAST, SETTINGS.odds)

    def hold(self, *names: str) -> tuple[dict[str, Member], FakeFit]:
        """Which of some terms hold, by name, and the scene that is left."""
        found = {c.name: c for c in self.pool}
        members, scene, _ = self.holding().hold([Member(found[n]) for n in names], fitted(*names, fine=True))
        assert [m.name for m in members] == list(names)
        return {m.name: m for m in members}, scene

    def criticise(self, s: CriticismSettings = SETTINGS) -> Findings:
        return criticise(fitted(), self.scenes(s.processes), SCAN, s)


def nats(value: float) -> Tensor:
    """``[120]`` of which every spot has the same share."""
    return NOTHING + value / 120


def trial(name: str, likelihood: Tensor) -> Trial:
    return Trial(candidate(name), None, likelihood, compare(NOTHING, likelihood, BLOCK))


def test_misfit_is_half_the_deviance_above_the_noise(monkeypatch):
    """In 20 bins of 3 spots, 0.5 above 0.9 a bin: 15 nats, however many are looked at; 0.1 below it: -3."""
    fit = SimpleNamespace(counts=torch.zeros(9, 20), extension=Extension([]))
    for deviance, nats in ((1.4, 15.0), (0.8, -3.0)):
        found = SimpleNamespace(deviance_per_bin=deviance, deviance_noise=0.9)
        monkeypatch.setattr(asking, "score", lambda *_, found=found: found)
        assert misfit_of(fit, np.arange(7), 3) == pytest.approx(nats)


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
    """Nine tenths of the best gain and of its evidence, or a quarter of its weight, are enough for fewer
    coefficients; a quarter of its weight for an effect beside a free term, unless that is asked for by 8 nats
    more and does what the effect cannot.
    """

    def name(*trials: Trial) -> str:
        return chosen(sorted(trials, key=lambda t: -t.gain.nats), SETTINGS.odds, LEAST).name

    wide, free = gained("wall_reflectance", 100.0, 0.8), gained("free_rate", 100.0, 0.8)
    assert len(wide.candidate.step) > len(free.candidate.step) > 1
    assert name(wide, gained("vignetting", 90.1)) == "vignetting"
    assert name(wide, gained("vignetting", 89.9)) == "wall_reflectance"
    for evidence, said in ((90.1, "vignetting"), (89.9, "wall_reflectance")):
        less = replace(gained("vignetting", 99.0), candidate=candidate("vignetting", evidence))
        assert name(wide, less) == said
    assert name(wide, gained("vignetting", 50.0, 0.201)) == "vignetting"
    assert name(wide, gained("vignetting", 50.0, 0.199)) == "wall_reflectance"
    assert name(free, gained("wall_reflectance", 99.0, 0.201)) == "wall_reflectance"
    assert name(free, gained("wall_reflectance", 99.0, 0.199)) == "free_rate"
    for more, cannot in ((0.1, "free_rate"), (-0.1, "wall_reflectance")):
        for does, said in (("free_rate", cannot), ("free_wall", "wall_reflectance")):
            asked = replace(gained(does, 100.0, 0.8), candidate=candidate(does, 100.0 + LEAST + more))
            assert name(asked, gained("wall_reflectance", 99.0, 0.7)) == said


def test_trials_stand_by_gain_with_their_weights():
    found = weighed([trial("irf_tail", gaining(3.0)), trial("pile_up", gaining(30.0))], BLOCK)
    assert [t.name for t in found] == ["pile_up", "irf_tail"]
    assert [t.weight for t in found] == pytest.approx([1, 0], abs=1e-3)


@pytest.mark.parametrize(("less", "names"), [(2.5, {"irf_tail", "pile_up"}), (3.5, {"irf_tail"})])
def test_the_edge_of_a_group(less, names):
    """Where all patches say the same, a weight of a twentieth is 2.94 nats."""
    trials = [gained("irf_tail", 100.0), gained("pile_up", 100.0 - less)]
    assert group_of(trials[0], trials, BLOCK, 0.05, LEAST).keys() == names


def test_fitted_spots_have_half_a_say_in_a_group():
    """Where they ask by more than 8 nats for another that gains nine tenths as much on select spots."""

    def group(more: float, gain: float) -> dict[str, float]:
        lines, drift = gained("line_delay", 100.0), gained("time_drift", gain)
        drift = replace(drift, candidate=candidate("time_drift", lines.candidate.evidence + more))
        return group_of(lines, [lines, drift], BLOCK, 0.05, LEAST)

    assert list(group(LEAST + 0.1, 90.1)) == ["line_delay", "time_drift"]
    assert list(group(LEAST + 0.1, 90.1).values()) == pytest.approx([0.5, 0.5], abs=1e-3)
    assert group(LEAST - 0.1, 90.1).keys() == group(LEAST + 0.1, 89.9).keys() == {"line_delay"}


def names_of(members: list[Member]) -> list[str]:
    return [m.name for m in members]


def test_where_nothing_is_asked_for_nothing_is_tried(monkeypatch):
    """ln(terms/level): a mean Bayes factor of 1 for each."""
    for above in (False, True):
        pool = [candidate("irf_tail", LEAST + (0.01 if above else -0.01)), candidate("pile_up", 0.0)]
        found = World(monkeypatch, {"irf_tail": nats(20.0)}, pool).criticise()
        assert names_of(found.members) == (["irf_tail"] if above else [])
        assert (found.final is found.base) is not above
        assert found.pools[0].candidates == pool
        assert (found.base.names, found.base.fine) == (set(), True)


def test_what_is_needed_is_a_tenth_of_the_misfit_besides(monkeypatch):
    """Of the mean of fitted and select spots: what surfels take up of the noise of the first they add to that
    of the others. 1000 nats and 900 fewer: 55.
    """
    world = World(monkeypatch, {}, [], misfit=1000.0, taken_up=900.0)
    assert world.asking().needed(fitted(fine=True)) == pytest.approx(LEAST + 55)
    assert World(monkeypatch, {}, [], misfit=-10.0).asking().needed(fitted()) == LEAST


@pytest.mark.parametrize(
    ("coarse", "gained", "begun"), [(2.9, 99.0, False), (3.0, 22.9, False), (3.0, 23.0, True)]
)
def test_a_scene_is_begun_with_what_scenes_imitate(monkeypatch, coarse, gained, begun):
    """From new seeds, and taken where it surely predicts better than the base and, when it is fine, than the
    fine scene without, whose 20 nats it must surpass by ln 19. The counts ask for none of the two beside a
    scene that has imitated them, and each must hold.
    """
    pool = [candidate("irf_tail", 0.0), candidate("ambient_map", 0.0), candidate("hum", 0.0)]
    table = {"fine": nats(20.0), "anew+ambient_map+irf_tail": nats(coarse), "irf_tail": nats(9.0)}
    table |= {"fine+anew+ambient_map+irf_tail": nats(gained), "fine+anew+irf_tail": nats(99.0)}
    own = {"irf_tail": 50.0, "ambient_map": 1.0}
    world = World(monkeypatch, table, pool, own, imitated=(("irf_tail", "ambient_map"),))
    found = world.criticise()
    assert world.rebuilt[0] == ({"irf_tail", "ambient_map"}, 4)
    assert names_of(found.members) == (["irf_tail", "ambient_map"] if begun else [])
    assert names_of(found.accepted) == (["irf_tail"] if begun else [])
    assert len(found.pools) == (3 if begun else 1)
    assert world.grown.count({"irf_tail", "ambient_map"}) == (coarse >= 3.0), "not again when they are asked"


@pytest.mark.parametrize(("gained", "taken"), [(30.0, "irf_tail"), (50.0, "wall_scale")])
def test_of_the_kinds_that_scenes_imitate_the_better_one_is_begun_with(monkeypatch, gained, taken):
    pool = [candidate("irf_tail", 0.0), candidate("wall_scale", 0.0)]
    table = {"anew+irf_tail": nats(40.0), "anew+wall_scale": nats(gained)}
    world = World(monkeypatch, table, pool, imitated=(("irf_tail",), ("pile_up",), ("wall_scale",)))
    members, scene, coarse = world.begun(fitted(), Pool(pool, []))
    assert scene.names == coarse.names == {taken} == set(names_of(members))
    assert [names for names, _ in world.rebuilt] == [{"irf_tail"}, {"wall_scale"}]


@pytest.mark.parametrize(("both", "taken"), [(41.3, 1), (41.5, 2)])
def test_of_scenes_that_predict_alike_the_one_with_fewer_effects_is_begun_with(monkeypatch, both, taken):
    """Beside a quarter of the weight of the best, ln 4 nats less."""
    names = ("irf_tail",), ("clock_scale", "wall_scale")
    pool = [candidate(name, 0.0) for some in names for name in some]
    table = {"anew+irf_tail": nats(40.0), "anew+clock_scale+wall_scale": nats(both)}
    members, _, _ = World(monkeypatch, table, pool, imitated=names).begun(fitted(), Pool(pool, []))
    assert names_of(members) == list(names[taken - 1])


@pytest.mark.parametrize(
    ("imitated", "asked", "taken"),
    [(40.0, 50.0, "time_drift"), (50.0, 40.0, "irf_tail"), (2.9, 50.0, "")],
)
def test_what_is_asked_for_is_begun_with_where_it_does_more(monkeypatch, imitated, asked, taken):
    """Where what scenes imitate would be taken, a scene is built with what the counts ask for together, too,
    unless that is all of one kind.
    """
    pool = [candidate("time_drift", 50.0), candidate("irf_tail", 0.0), candidate("free_scan", 60.0)]
    table = {"anew+irf_tail": nats(imitated), "anew+time_drift": nats(asked)}
    table |= {"fine+anew+irf_tail": nats(60.0), "fine+anew+time_drift": nats(60.0)}
    world = World(monkeypatch, table, pool, imitated=(("irf_tail", "ambient_map"),))
    taking = [Taken(pool[0], []), Taken(pool[2], [])]
    held = world.begun(fitted(), Pool(pool, taking))
    assert names_of(held.members) == [taken] * bool(taken)
    assert (held.scene.names, held.coarse.names) == (({taken},) * 2 if taken else (set(), set()))
    built = [{"irf_tail"}, {"time_drift"}][: 1 + (imitated > 3)]
    assert [names for names, _ in world.rebuilt] == built
    world.begun(fitted(), Pool(pool, [Taken(pool[1], [])]))
    assert [names for names, _ in world.rebuilt[len(built) :]] == [{"irf_tail"}]


def test_a_scene_begins_with_echoes_where_the_counts_repeat_or_the_pool_asks(monkeypatch):
    base, seen = fitted(), []
    base.counts = torch.ones(3, 5)
    monkeypatch.setattr(ghost_pulse, "repeats_after", lambda counts: seen.append(counts) or 20)
    world = World(monkeypatch, {}, [candidate("ghost_pulse", 0.0)], imitated=(("ghost_pulse",),))
    world.rebuild = lambda extension, seed: FakeFit(extension, seed, anew=True)
    world.table = {"anew+ghost_pulse": nats(40.0), "fine+anew+ghost_pulse": nats(40.0)}
    for above, delay in ((-0.01, 20), (0.01, 31)):
        asked = candidate("ghost_pulse", LEAST + above)
        asked.effect.set("delay", 31 * SCAN.bin_length)
        begun = world.begun(base, Pool([asked], [])).coarse
        (echo,) = begun.extension.effects
        assert echo.value("delay").item() == pytest.approx(delay * SCAN.bin_length)
        assert echo.value("fraction").item() == pytest.approx(0.05)
    assert seen[0] is base.counts


@pytest.mark.parametrize(("halves", "built"), [(0, 1), (1, 2), (2, 2)])
def test_echoes_are_halved_for_as_long_as_other_spots_gain(monkeypatch, halves, built):
    world, bins = World(monkeypatch, {}, []), SCAN.bin_length
    coarse = fitted("ghost_pulse")
    (echo,) = coarse.extension.effects
    echo.set_all({"fraction": 0.01, "delay": 18 * bins, "again": 0.0625})
    best = 18 * bins / 2**halves

    def likelihood(fit: FakeFit, spots: np.ndarray) -> Tensor:
        (effect,) = fit.extension.effects
        return nats(-abs(math.log(effect.value("delay").item() / best)))

    monkeypatch.setattr(scenes, "log_likelihood", likelihood)
    whole = world.scenes().whole(coarse)
    (found,) = whole.extension.effects
    values = [found.value(n).item() for n in ("fraction", "delay", "again")]
    asked = {0: (0.01, 18, 0.0625), 1: (0.04, 9, 0.25), 2: (0.08, 4.5, 0.5)}[halves]
    assert values == pytest.approx([asked[0], asked[1] * bins, asked[2]], rel=1e-4)
    assert len(world.rebuilt) == built
    assert (whole is coarse) == (halves == 0)
    assert echo.value("delay").item() == pytest.approx(18 * bins), "what was there is as it was"


@pytest.mark.parametrize("there", [True, False])
def test_what_is_told_of_echoes_is_told_of_the_whole(monkeypatch, there):
    """Terms are held beside the scene that has all echoes, if that predicts better."""
    world = World(monkeypatch, {"ghost_pulse": gaining(4.0)}, [candidate("ghost_pulse", 300.0)])
    likelihood = world.likelihood

    def halved(fit: FakeFit) -> bool:
        return any(
            e.name == "ghost_pulse" and e.value("delay") < 10 * SCAN.bin_length for e in fit.extension.effects
        )

    monkeypatch.setattr(
        scenes,
        "log_likelihood",
        lambda fit, spots: likelihood(fit, spots) + there * halved(fit) * gaining(1.0),
    )
    world.pool[0].effect.set_all({"fraction": 0.1, "delay": 16 * SCAN.bin_length, "again": 0.25})
    found = world.criticise()
    assert [m.name for m in found.accepted] == ["ghost_pulse"]
    assert halved(found.final) == there


@pytest.mark.parametrize(("more", "effects"), [(2.9, False), (3.0, True)])
def test_what_a_luckier_scene_gains_is_not_said_of_its_effects(monkeypatch, more, effects):
    """A scene built with an effect is as good without it but for less than ln 19 nats: that is the base,
    beside which the counts are asked anew.
    """
    pool = [candidate("irf_tail", 0.0), candidate("hum", 50.0)]
    table = {"fine": nats(20.0), "on": nats(38.0), "anew+irf_tail": nats(38.0 + more), "hum": nats(30.0)}
    table |= {"fine+anew+irf_tail": nats(99.0), "on+hum": nats(30.0)}
    world = World(monkeypatch, table, pool, imitated=(("irf_tail",),))
    held = world.begun(fitted(), Pool(pool, []))
    assert names_of(held.members) == ["irf_tail"] * effects
    assert held.coarse.names == held.scene.names == {"irf_tail"} & set(names_of(held.members))
    found = world.criticise()
    assert found.base.on is not effects
    assert found.needed == LEAST
    assert len(found.pools[0].candidates) == 2
    assert "hum" in names_of(found.accepted)


def test_what_lost_its_evidence_may_be_meant_instead(monkeypatch):
    """More than half of what it had beside the base; and it takes the place of what predicts less."""
    pool = [candidate("irf_tail", 0.0), candidate("pile_up", 50.0), candidate("hum", 50.0)]
    both = {"fine": nats(5.0), "anew+irf_tail": nats(30.0), "fine+anew+irf_tail": nats(60.0)}
    table = both | {"irf_tail": nats(20.0), "pile_up": nats(40.0)}
    world = World(monkeypatch, table, pool, {"irf_tail": 50.0}, imitated=(("irf_tail",),))
    ask = world.ask

    def asked(fit, *args):
        now = ask(fit, *args)
        left = {"pile_up": 24.9, "hum": 25.1} if "irf_tail" in fit.names else {}
        candidates = [replace(c, evidence=left.get(c.name, c.evidence)) for c in now.candidates]
        return Pool(candidates, [])

    monkeypatch.setattr(asking, "ask", asked)
    (member,) = world.criticise().members
    assert names_of(member.rivals) == ["pile_up"]
    assert member.name == "pile_up"


@pytest.mark.parametrize(("evidence", "rivals"), [(61.0, ["free_wall", "pile_up"]), (59.0, ["pile_up"])])
def test_of_free_terms_only_one_that_leads_may_be_meant_instead(monkeypatch, evidence, rivals):
    """They can do what most effects do, and would leave no room for effects that look alike."""
    free = [candidate("free_wall", evidence), candidate("free_time", 58.0)]
    pool = [free[0], candidate("irf_tail", 60.0), free[1], candidate("pile_up", 50.0)]
    pool = sorted(pool, key=lambda c: -c.evidence)
    table = {"anew+irf_tail": nats(30.0), "fine+anew+irf_tail": nats(60.0), "irf_tail": nats(60.0)}
    world = World(monkeypatch, table, pool, {"irf_tail": 60.0}, imitated=(("irf_tail",),))

    def asked(fit, *_):
        left = [replace(c, evidence=0.0) if "irf_tail" in fit.names else c for c in pool]
        return Pool([c for c in left if c.name not in fit.names], [])

    monkeypatch.setattr(asking, "ask", asked)
    (member,) = world.criticise().members
    assert names_of(member.rivals) == rivals


def test_rivals_of_what_is_asked_for_come_first(monkeypatch):
    """A scene is begun with a drift, of which a line's delay is the rival; a leak loses its evidence, too."""
    pool = [candidate("time_drift", 50.0), candidate("irf_tail", 0.0), candidate("line_delay", 50.0)]
    pool.append(candidate("direct_leak", 60.0))
    table = {"anew+irf_tail": nats(20.0), "anew+time_drift": nats(30.0), "time_drift": nats(30.0)}
    table |= {"fine+anew+irf_tail": nats(20.0), "fine+anew+time_drift": nats(30.0)}
    world = World(monkeypatch, table, pool, {"time_drift": 50.0}, imitated=(("irf_tail",),))

    def asked(fit, *_):
        left = [replace(c, evidence=0.0) if "time_drift" in fit.names else c for c in pool]
        left = [c for c in left if c.name not in fit.names]
        return Pool(left, [] if fit.names else [Taken(pool[0], [pool[2]])])

    monkeypatch.setattr(asking, "ask", asked)
    (member,) = world.criticise().members
    assert (member.name, names_of(member.rivals)) == ("time_drift", ["line_delay", "direct_leak"])


def test_a_term_that_is_there_takes_no_second_place(monkeypatch):
    """It came since, and predicts more than the member whose place it is tried in: that leaves."""
    table = {"irf_tail": nats(20.0), "free_rate": nats(40.0)}
    world = World(monkeypatch, table, [candidate(n) for n in table])
    none = Trial(None, fitted(), NOTHING, compare(NOTHING, NOTHING, BLOCK))
    trials = [trial("irf_tail", nats(20.0)), none]
    tail = Member(candidate("irf_tail"), [candidate("free_rate")], accepted=True, trials=trials)
    free = Member(candidate("free_rate"), accepted=True, trials=[trial("free_rate", nats(40.0)), none])
    (old, now), scene = world.holding().named([tail, free], fitted(*table))
    assert (old.name, old.accepted, old.gone) == ("irf_tail", False, True)
    assert (now.name, now.accepted, scene.names) == ("free_rate", True, {"free_rate"})


def test_where_no_surfel_survives_the_search_begins_with_the_base(monkeypatch):
    world = World(
        monkeypatch, {}, [candidate("irf_tail", 0.0)], imitated=(("irf_tail",),), impossible=("irf_tail",)
    )
    assert not world.criticise().members


def test_terms_come_together_and_others_after_them(monkeypatch):
    """The pool is asked again beside those that came, until nothing more is asked for, or enough is there."""
    pool = [candidate("irf_tail", 300.0), candidate("pile_up", 200.0), candidate("vignetting", 100.0)]
    table = {"irf_tail": gaining(40.0), "pile_up": gaining(20.0, 1), "vignetting": gaining(10.0, 2)}
    world = World(monkeypatch, table, pool, beside={"vignetting": {"irf_tail", "pile_up"}})
    found = world.criticise()
    assert names_of(found.members) == names_of(found.accepted) == ["irf_tail", "pile_up", "vignetting"]
    built = [names for names, _ in world.rebuilt]
    assert built[:2] == [{"irf_tail", "pile_up"}, {*table}]
    assert built[2:] == [{*table} - {name} for name in table], "each is asked for beside a scene without it"
    assert world.grown[:2] == [set(), {*table}], "the base, and once with all"
    assert world.grown[2:] == built[2:], "and these are asked again when they are fine"
    assert [len(p.together) for p in found.pools] == [2, 1, 0]
    assert found.final.names == found.again.names == {*table}
    assert (found.final.fine, found.again.fine) == (True, False)
    assert found.members[0].trial.gain.nats == pytest.approx(float(table["irf_tail"].sum()))
    found = World(monkeypatch, table, pool).criticise(CriticismSettings(processes=1, most=2))
    assert names_of(found.members) == ["irf_tail", "pile_up"]


def test_free_terms_come_beside_the_effects_that_hold(monkeypatch):
    """Not together with them, nor beside one that left. The effects are not asked again, since a scene that
    was fitted with a free term has less need of them. Where none of them holds all is as it was before.
    """
    pool = [candidate("free_time", 400.0), candidate("irf_tail", 300.0), candidate("pile_up", 200.0)]
    for gained in (30.0, -3.0):
        table = {"irf_tail": gaining(40.0), "free_time": gaining(gained, 1)}
        world = World(monkeypatch, table, pool, {"pile_up": 1.0, "free_time": 250.0})
        found = world.criticise()
        holding = {"irf_tail", "free_time"} if gained > 0 else {"irf_tail"}
        assert names_of(found.members) == ["irf_tail", "pile_up", "free_time"]
        assert {m.name for m in found.accepted} == found.final.names == found.again.names == holding
        built = [names for names, _ in world.rebuilt]
        assert built[0] == {"irf_tail", "pile_up"}
        assert all("pile_up" not in names for names in built[1:]), "it has left"
        assert world.grown[:3] == [set(), {"irf_tail", "pile_up"}, {"irf_tail"}]
        assert world.grown[3:] == [set(), {"irf_tail", "free_time"}], "without it once, and not again"
        assert world.asked == [["irf_tail", "pile_up"], ["irf_tail"], ["free_time"]]
        world.asked.clear()
        world.criticise(CriticismSettings(processes=1, most=2))
        assert world.asked[-1] == ["free_time"], "who has left makes room"


@pytest.mark.parametrize("gained", [30.0, -3.0])
@pytest.mark.parametrize(
    ("own", "leaving"),
    [
        ({"free_time": 300.1 - LEAST}, {"wall_reflectance"}),
        ({"free_time": 299.9 - LEAST}, set()),
        ({"free_time": 350.0, "irf_tail": 350.1}, set()),
        ({"free_time": 350.0, "irf_tail": 349.9}, {"wall_reflectance", "irf_tail"}),
        ({"free_rate": 350.0, "irf_tail": 350.1 + LEAST}, {"wall_reflectance"}),
        ({"free_rate": 350.0, "irf_tail": 349.9 + LEAST}, {"wall_reflectance", "irf_tail"}),
    ],
)
def test_something_unknown_that_does_more_is_tried_without_the_effect(monkeypatch, gained, own, leaving):
    """The counts ask for it as surely, beside the effect, as for the effect's 300 nats, which may stand for
    it. Where it holds without the effect, that leaves; else all is as before. One that goes on with a
    stronger effect (a tail along time) is no reason to doubt another.
    """
    free, *others = own
    effects = ["wall_reflectance", *others]
    pool = [candidate(free, 250.0), *(candidate(n, 300.0 - k) for k, n in enumerate(effects))]
    table = {n: gaining(40.0, k) for k, n in enumerate(effects)} | {free: gaining(gained, 7)}
    found = World(monkeypatch, table, pool, own).criticise()
    left = set(effects) - leaving
    holding = left | {free} if gained > 0 else set(effects)
    assert {m.name for m in found.accepted} == found.final.names == found.again.names == holding
    assert sorted(names_of(found.members)) == sorted([free, *effects])


@pytest.mark.parametrize(("nats", "named"), [(99.9 + LEAST, False), (100.1 + LEAST, True)])
def test_single_spots_are_not_named_beside_something_unknown_that_does_as_much(monkeypatch, nats, named):
    """Gains of single spots that nothing explains leave something of a background, too."""
    pool = [candidate("free_spot_gain", 100.0), candidate("hot_spots", nats)]
    table = {"free_spot_gain": gaining(30.0), "hot_spots": gaining(3.0, 1)}
    found = World(monkeypatch, table, pool, {"hot_spots": nats}).criticise()
    assert {m.name for m in found.accepted} == {"free_spot_gain"} | ({"hot_spots"} if named else set())


def test_what_something_unknown_does_is_not_put_down_to_effects(monkeypatch):
    """A free term that is asked for more than all effects, and does what none of them can, comes first by
    itself; effects are asked for beside it. If it does not hold all is as it would be without it.
    """
    pool = [candidate("free_rate", 400.0), candidate("irf_tail", 300.0), candidate("pile_up", 20.0)]
    for gained in (30.0, -3.0):
        table = {"free_rate": gaining(gained), "irf_tail": gaining(40.0, 1), "pile_up": gaining(-1.0)}
        world = World(monkeypatch, table, pool, {"pile_up": 1.0}, imitated=(("irf_tail",),))
        found = world.criticise(CriticismSettings(processes=1, most=3))
        assert next(names for names, _ in world.rebuilt if names) == {"free_rate"}
        holding = {"free_rate", "irf_tail"} if gained > 0 else {"irf_tail"}
        assert {m.name for m in found.accepted} == found.final.names == found.again.names == holding
        assert names_of(found.members).count("free_rate") <= 1
        begun = [names for names, _ in world.rebuilt if names == {"irf_tail"}]
        assert bool(begun) == ("free_rate" not in holding), "nothing is imitated where something unknown is"


@pytest.mark.parametrize(
    ("evidence", "effect", "first"),
    [
        (LEAST + 100.1, "irf_tail", True),
        (LEAST + 99.9, "irf_tail", False),
        (LEAST + 100.1, "pile_up", False),
    ],
)
def test_which_free_term_goes_before_all_effects(evidence, effect, first):
    """It is asked for more than any by what a term needs, and what bends with the count rate may be what no
    tail does, but a pile-up. Effects with less than nine tenths of the most say nothing of that.
    """
    others = [candidate("free_wall", 50.0), candidate(effect, 100.0), candidate("hum", 60.0)]
    found = [candidate("free_rate", evidence), *others]
    leads = foreign(found, LEAST)
    assert (leads is not None and leads.name == "free_rate") == first
    assert (leads is None) != first
    for near, still in ((90.1, False), (89.9, first)):
        beside = [*found, candidate("pile_up", near)] if effect != "pile_up" else found
        assert (foreign(beside, LEAST) is not None) == still
    assert foreign([candidate("free_rate", 400.0), candidate("hum", LEAST - 0.1)], LEAST) is None
    assert foreign([candidate("free_spot_gain", 400.0), *others], LEAST) is None


def one_or_other(effect: str, alone: Tensor) -> dict[str, Tensor]:
    """What scenes are worth of which each is good with an effect, or with the free term along the rate by
    itself, and with both less.
    """
    both = "+".join(sorted((effect, "free_rate")))
    table = {effect: gaining(20.0), "free_rate": alone}
    return table | {kind + both: gaining(15.0) for kind in ("", "fine+", "anew+", "fine+anew+")}


@pytest.mark.parametrize(
    ("effect", "alone", "named"),
    [
        ("ambient_map", gaining(22.0), "free_rate"),
        ("ambient_map", gaining(18.0), "ambient_map"),
        ("ambient_map", gaining(20.0) + gaining(1.2, seed=3), "free_rate"),
        ("ambient_map", gaining(20.0) + gaining(1.0, seed=3), "ambient_map"),
        ("pile_up", gaining(22.0), "pile_up"),
        ("hot_spots", gaining(22.0), "hot_spots"),
    ],
)
def test_effects_are_held_against_a_scene_that_never_had_them(monkeypatch, effect, alone, named):
    """An unknown by itself that predicts other spots better, with four times the weight, takes the place of
    all effects that hold, though they are asked for more, and nothing is gained by it beside them. Not what
    goes on with one of them, nor where one has a number for each spot, of which others know nothing.
    """
    pool = [candidate(effect, 300.0), candidate("free_rate", 150.0)]
    world = World(monkeypatch, one_or_other(effect, alone), pool)
    found = world.criticise()
    assert {m.name for m in found.accepted} == found.final.names == {named}
    assert (frozenset({"free_rate"}) in [names for names, _ in world.rebuilt]) == (effect == "ambient_map")


def test_all_is_as_it_was_where_the_unknown_does_not_hold(monkeypatch):
    """It predicts better than the effects, and has less evidence than the misfit asks for."""
    pool, built = [candidate("ambient_map", 300.0), candidate("free_rate", 50.0)], [frozenset({"free_rate"})]
    told = []
    for alone in (22.0, 18.0):
        world = World(monkeypatch, one_or_other("ambient_map", gaining(alone)), pool, misfit=1000.0)
        found = world.criticise()
        assert [names for names, _ in world.rebuilt if names == built[0]] == built
        told.append((names_of(found.members), found.final.names, len(found.pools), found.accepted[0].name))
    assert told[0] == told[1]
    assert told[0][-1] == "ambient_map"


def test_the_unknown_that_effects_are_held_against_is_the_one_that_may_have_most():
    """If its scatter is its own; it must be asked for, and be nothing that is there."""
    held = Member(candidate("ambient_map", 300.0), accepted=True)
    free = [
        replace(candidate("free_time", LEAST + 9), loud=50.0),
        replace(candidate("free_rate", LEAST + 0.1), loud=60.0),
    ]

    def told(members: list[Member], candidates: list[Candidate]) -> str | None:
        found = unsaid(Pool(candidates, []), Held(members, None, None), LEAST)
        return found and found.name

    assert told([held], free) == "free_rate"
    assert told([held], [free[0], replace(free[1], evidence=LEAST - 0.1)]) == "free_time"
    assert told([held, Member(candidate("free_rate", 60.0))], free) == "free_time"
    assert told([held], [replace(candidate("free_wall_background", 80.0), loud=80.0)]) is None
    assert told([held], [candidate("free_spot_gain", 80.0)]) is None
    assert told([replace(held, accepted=False)], free) is None
    assert told([Member(candidate("free_wall", 300.0), accepted=True)], free) is None


def test_the_better_of_two_scenes_goes_on(monkeypatch):
    """The one that was gone on with, or one from new seeds, where surfels that imitated the terms do not come
    back; none where no surfel survives.
    """
    for new, impossible, anew in (
        (gaining(1.0), (), True),
        (-gaining(1.0), (), False),
        (gaining(1.0), ("irf_tail",), False),
    ):
        world = World(monkeypatch, {"irf_tail": gaining(20.0), "anew": new}, [], impossible=impossible)
        found = world.scenes().joined(fitted("hum"), [candidate("irf_tail")])
        assert world.rebuilt == [({"irf_tail", "hum"}, 4)]
        assert (found.names, found.anew) == ({"irf_tail", "hum"}, anew)


def test_the_scene_that_predicts_best_is_asked(monkeypatch):
    """A scene that was refined may have taken up noise."""
    for finer, fine in ((1.0, True), (-1.0, False)):
        table = {"irf_tail": nats(70.0), "fine+anew+irf_tail": nats(70.0 + finer)}
        found = World(monkeypatch, table, [candidate("irf_tail")]).criticise()
        assert (found.final.names, found.final.fine) == ({"irf_tail"}, fine)


@pytest.mark.parametrize(("more", "accepted"), [(0.1, True), (-0.1, False)])
def test_a_term_alone_holds_by_its_own_evidence(monkeypatch, more, accepted):
    """Beside a misfit of 1000 nats, a tenth of which it needs, and 20 of 100 where four fifths of it lie
    beside the scene's light. That it explains all of 100 nats does not speak for it.
    """
    for lit in (1.0, 0.2):
        bar = LEAST + 100 * lit
        pool = [candidate("irf_tail", 200.0, lit)]
        world = World(monkeypatch, {"irf_tail": nats(1000.0)}, pool, {"irf_tail": bar + more}, misfit=1000.0)
        found, scene = world.hold("irf_tail")
        assert found["irf_tail"].accepted is accepted
        assert found["irf_tail"].confirmed.needed == pytest.approx(bar)
        assert scene.names == {"irf_tail"}, "it is likely"


@pytest.mark.parametrize(("more", "accepted"), [(0.1, True), (-0.1, False)])
def test_what_another_term_took_counts_against_its_look_alike(monkeypatch, more, accepted):
    """A quarter of the 2000 nats that it would have by itself: it may be what the other one gets wrong."""
    pool, own = [candidate("irf_tail"), candidate("ghost_pulse")], {"ghost_pulse": LEAST + 500 + more}
    table = {"irf_tail": nats(1000.0), "ghost_pulse": nats(50.0)}
    found, _ = World(monkeypatch, table, pool, own, lost={"ghost_pulse": 2000.0}).hold(
        "irf_tail", "ghost_pulse"
    )
    assert found["ghost_pulse"].confirmed.needed == pytest.approx(LEAST + 500)
    assert (found["irf_tail"].accepted, found["ghost_pulse"].accepted) == (True, accepted)


@pytest.mark.parametrize(
    ("name", "weight", "accepted"),
    [
        ("irf_tail", 0.49, False),
        ("irf_tail", 0.51, True),
        ("free_time", 0.049, False),
        ("free_time", 0.051, True),
        ("hot_spots", 0.049, False),
        ("hot_spots", 0.051, True),
    ],
)
def test_other_spots_must_not_contradict_a_term(name, weight, accepted):
    """An effect has to predict them; what claims no cause, or is of single spots, must not spoil them."""
    found = Confirmed(20.0, 10.0, compare(NOTHING, NOTHING, BLOCK), weight)
    assert found.holds(candidate(name)) is accepted


@pytest.mark.parametrize(("errors", "accepted"), [(-0.5, False), (0.5, True)])
def test_an_effect_must_predict_other_spots(monkeypatch, errors, accepted):
    world = World(monkeypatch, {"irf_tail": gaining(errors, scatter=1.0)}, [candidate("irf_tail")])
    assert world.hold("irf_tail")[0]["irf_tail"].accepted is accepted


@pytest.mark.parametrize(
    ("gain", "more", "told"), [(10.1, 0.1, True), (9.9, 0.1, False), (10.1, -0.1, False)]
)
def test_what_is_predicted_much_better_is_told(monkeypatch, gain, more, told):
    """A quarter of what 120 spots leave unexplained: 40 nats of 100 for 300. That names nothing, and it must
    be asked for by more than chance.
    """
    own = {"irf_tail": LEAST + more}
    world = World(monkeypatch, {"irf_tail": nats(gain)}, [candidate("irf_tail")], own, misfit=100.0)
    found, _ = world.hold("irf_tail")
    assert found["irf_tail"].confirmed.explained == pytest.approx(gain / 40, abs=1e-6)
    assert (found["irf_tail"].accepted, found["irf_tail"].likely) == (False, told)
    open_ = replace(found["irf_tail"].confirmed, weight=0.94)
    assert not replace(found["irf_tail"], confirmed=open_).likely


@pytest.mark.parametrize(("error", "much"), [(37.0, True), (38.0, False)])
def test_what_a_few_spots_gain_is_not_much(error, much):
    """Of 100 ± 37.5 nats that are 40 % of what is unexplained a quarter is left by a standard error less."""
    found = Confirmed(1.0, 10.0, Comparison(100.0, error, (0.0, 200.0)), 1.0, explained=0.4)
    assert (found.much, found.holds(candidate("free_time"))) == (much, much)
    assert not replace(found, gain=Comparison(-100.0, error, (-200.0, 0.0)), explained=-0.4).much


@pytest.mark.parametrize(("gain", "accepted"), [(10.1, True), (9.9, False)])
def test_a_free_term_holds_by_what_it_predicts(monkeypatch, gain, accepted):
    """It is no name. Beside an effect of the same kind that is told of; and not with a weight of 94 %."""
    table = {"free_time": nats(gain), "irf_tail": nats(gain)}
    world = World(monkeypatch, table, [candidate(n) for n in table], dict.fromkeys(table, 1.0), misfit=100.0)
    found, scene = world.hold("free_time")
    assert (found["free_time"].accepted, found["free_time"].likely) == (accepted, False)
    assert scene.names == ({"free_time"} if accepted else set())
    found, scene = world.hold("irf_tail", "free_time")
    assert {n: m.accepted for n, m in found.items()} == {"irf_tail": False, "free_time": accepted}
    assert not replace(found["free_time"].confirmed, weight=0.94).holds(candidate("free_time"))


@pytest.mark.parametrize(("gain", "stays"), [(3.0, True), (2.9, False)])
def test_what_predicts_surely_better_stays_in_the_scene_unnamed(monkeypatch, gain, stays):
    """Others need not stand against what it explains. Where all patches say the same, a weight of 95 % is ln
    19. It is told as likely from a quarter of 40 nats on. No free term stays so, nor single spots.
    """
    table = {"wall_reflectance": nats(gain), "irf_tail": nats(20.0)}
    pool, own = [candidate(n) for n in table], {"wall_reflectance": 1.0}
    found, scene = World(monkeypatch, table, pool, own, misfit=100.0).hold(*table)
    assert {n: (m.accepted, m.stays, m.likely) for n, m in found.items()} == {
        "wall_reflectance": (False, stays, False),
        "irf_tail": (True, True, False),
    }
    assert scene.names == ({*table} if stays else {"irf_tail"})
    for name in ("free_wall", "timing_jitter"):
        table = {name: nats(9.0), "irf_tail": nats(20.0)}
        world = World(monkeypatch, table, [candidate(n) for n in table], {name: 1.0}, misfit=100.0)
        assert world.hold(*table)[1].names == {"irf_tail"}


def test_what_is_kept_unnamed_does_not_stand_against_another(monkeypatch):
    """Without it the other has enough, and holds; both stay."""
    table = {"wall_reflectance": nats(99.0), "irf_tail": nats(9.0)}
    own = {"wall_reflectance": 1.0, "irf_tail": 50.0}  # when the first is gone
    found, scene = World(monkeypatch, table, [candidate(n) for n in table], own, misfit=100.0).hold(*table)
    assert {n: (m.accepted, m.stays) for n, m in found.items()} == {
        "wall_reflectance": (False, True),
        "irf_tail": (True, True),
    }
    assert scene.names == {*table}


@pytest.mark.parametrize(("over", "named"), [(0.1, {"irf_tail"}), (-0.1, set())])
def test_where_one_lacks_only_what_others_take_the_one_that_is_missed_least_leaves(monkeypatch, over, named):
    """By itself each needs ``LEAST``, beside the other 100 nats more. Other spots want both.

    The one that leaves has no evidence at all.
    """
    table = {"irf_tail": nats(99.0), "afterpulsing": nats(9.0)}
    own, lost = {"irf_tail": LEAST + over, "afterpulsing": 1.0}, dict.fromkeys(table, 400.0)
    world = World(monkeypatch, table, [candidate(n) for n in table], own, lost=lost)
    told = world.own_evidence

    def asked(fit, split, most, seed, names, bar):
        world.lost = lost if len(names) == 2 else {}
        return told(fit, split, most, seed, names, bar)

    monkeypatch.setattr(asking, "own_evidence", asked)
    found, scene = world.hold(*table)
    assert {n for n, m in found.items() if m.accepted} == named
    assert {n for n, m in found.items() if m.gone} == ({"afterpulsing"} if named else set())
    assert scene.names == (named or {*table})


def test_what_lacks_only_what_others_take_stays_where_one_that_holds_needs_it(monkeypatch):
    """Without the wall, which other spots want, the tail has less than it needs: what it did is misfit."""
    table = {"irf_tail": nats(99.0), "wall_reflectance": nats(9.0)}
    own, lost = {"irf_tail": 2 * LEAST, "wall_reflectance": LEAST + 0.1}, {"wall_reflectance": 400.0}
    world = World(monkeypatch, table, [candidate(n) for n in table], own, lost=lost)
    told = world.own_evidence

    def asked(fit, split, most, seed, names, bar):
        world.own["irf_tail"] = 2 * LEAST if len(names) == 2 else 0.5 * LEAST
        return told(fit, split, most, seed, names, bar)

    monkeypatch.setattr(asking, "own_evidence", asked)
    found, scene = world.hold(*table)
    assert {n: (m.accepted, m.gone) for n, m in found.items()} == {
        "irf_tail": (True, False),
        "wall_reflectance": (False, False),
    }
    assert scene.names == {*table}


@pytest.mark.parametrize(("alone", "stays"), [(105.0, True), (105.1, False)])
@pytest.mark.parametrize("late", [True, False])
def test_look_alikes_stay_where_nobody_holds_for_their_leaving(monkeypatch, late, alone, stays):
    """The tail holds with the wall and without it. Other spots decide: with both they have 108 nats, and
    ln(19) more are sure. What the wall lacks shows at once, or beside a fine scene without it (late).
    """
    both, few = {"irf_tail", "wall_reflectance"}, LEAST + 0.1
    table = {"irf_tail": nats(99.0), "wall_reflectance": nats(9.0), "fine+anew+irf_tail": nats(alone)}
    own = {"irf_tail": 2 * LEAST, "wall_reflectance": few + 100 * late}
    lost, when_fine = {"wall_reflectance": 400.0}, {"wall_reflectance": few}
    pool = [candidate(n) for n in sorted(both)]
    world = World(monkeypatch, table, pool, own, lost=lost, when_fine=when_fine)
    members, before = [Member(c) for c in pool], Held([], fitted(fine=True), fitted())
    found, scene, coarse = world.holding().hold(members, fitted(*both, fine=True), fitted(*both), before)
    assert [(m.accepted, m.stays, m.gone) for m in found] == [(True, True, False), (False, stays, not stays)]
    assert scene.names == coarse.names == (both if stays else {"irf_tail"})
    again = [sorted(both)] if stays and not late else []
    assert world.asked == [sorted(both), ["irf_tail"], *again], "whoever was asked in every way is not again"
    alone = world.grown.count({"irf_tail"}), [names for names, _ in world.rebuilt].count({"irf_tail"})
    assert alone == (1, 1), "the scene without the wall is built once"


def test_of_two_that_stand_for_each_other_one_leaves(monkeypatch):
    """Neither is missed beside the other; without the one that gains less the other is."""
    for pair, stays in ((("irf_tail", "afterpulsing"), "irf_tail"), (("free_time", "irf_tail"), "free_time")):
        both = "+".join(["fine", *sorted(pair)])
        table = {pair[0]: nats(99.0), pair[1]: nats(98.0), both: nats(97.0)}
        found, scene = World(monkeypatch, table, [candidate(n) for n in pair]).hold(*pair)
        assert [n for n, m in found.items() if m.accepted] == [stays]
        assert scene.names == {stays}
        assert len(found[stays].trials) == 2
        gain = found[stays].confirmed.gain.nats
        assert gain == pytest.approx(99.0 if stays == pair[0] else 98.0), (
            "asked again when the other had left"
        )


@pytest.mark.parametrize(("other", "accepted"), [(69.0, True), (71.0, False)])
def test_a_scene_that_never_had_a_term_may_do_without_it(monkeypatch, other, accepted):
    """The scene has bent itself to the term, and cannot go on without it; one from new seeds can."""
    table = {"irf_tail": nats(70.0), "anew": nats(other), "anew+irf_tail": nats(60.0)}
    world = World(monkeypatch, table, [candidate("irf_tail")])
    coarse = fitted("irf_tail")
    before = Held([], fitted(fine=True), fitted())
    members = [Member(world.pool[0])]
    (found,), scene, _ = world.holding().hold(members, fitted("irf_tail", fine=True), coarse, before)
    assert (found.accepted, scene.names) == (accepted, {"irf_tail"} if accepted else set())
    assert found.confirmed.gain.nats == pytest.approx(70.0 - other)
    assert world.rebuilt == [(set(), 4)]


@pytest.mark.parametrize(
    ("own", "fine", "accepted"), [(18.5, 65.4, True), (18.5, 65.5, False), (18.3, 65.4, False)]
)
def test_an_effect_that_predicts_surely_need_not_be_asked_for_beside_a_scene_that_imitates_it(
    monkeypatch, own, fine, accepted
):
    """The scene with it predicts other spots better than the fine one without it with a chance of 99 %, by
    ln 99, or not. With it the counts must ask for it as ever: 8.4 nats and a tenth of 100.
    """
    table = {"irf_tail": nats(70.0), "fine": nats(fine), "fine+irf_tail": nats(70.0)}
    pool, when_fine = [candidate("irf_tail")], {"irf_tail": 0.0}
    world = World(monkeypatch, table, pool, {"irf_tail": own}, misfit=100.0, when_fine=when_fine)
    scenes = fitted("irf_tail", fine=True), fitted("irf_tail")
    (found,), _, _ = world.holding().hold([Member(pool[0])], *scenes, Held([], fitted(fine=True), fitted()))
    assert found.accepted is accepted


@pytest.mark.parametrize(("gain", "accepted"), [(10.1, True), (9.9, False)])
def test_a_free_term_that_predicts_much_need_not_be_asked_for_beside_a_fine_scene(
    monkeypatch, gain, accepted
):
    """A quarter of the 40 nats that 120 spots leave of 100."""
    pool, scenes = [candidate("free_time")], (fitted("free_time", fine=True), fitted("free_time"))
    world = World(monkeypatch, {"free_time": nats(gain)}, pool, misfit=100.0, when_fine={"free_time": 0.0})
    (found,), _, _ = world.holding().hold([Member(pool[0])], *scenes, Held([], fitted(fine=True), fitted()))
    assert found.accepted is accepted


@pytest.mark.parametrize("name", ["retroreflection", "free_time", "timing_jitter"])
@pytest.mark.parametrize(("over", "accepted"), [(-0.1, False), (0.1, True)])
@pytest.mark.parametrize("misfit", [0.0, 100.0, 300.0, 800.0])
def test_a_term_must_be_asked_for_beside_a_fine_scene_without_it(monkeypatch, name, over, accepted, misfit):
    """As much as beside the scene with it. Wide cells may ask for what a finer scene does by itself, which
    predicts as well then. Single spots have over their neighbours what no scene can give them.
    """
    needed = LEAST + SETTINGS.share * misfit
    table = {name: nats(70.0), "fine": nats(69.0), f"fine+{name}": nats(70.0)}
    when_fine = {name: needed + over}
    world = World(monkeypatch, table, [candidate(name)], misfit=misfit, when_fine=when_fine)
    scenes = fitted(name, fine=True), fitted(name)
    (found,), scene, _ = world.holding().hold(
        [Member(world.pool[0])], *scenes, Held([], fitted(fine=True), fitted())
    )
    accepted = accepted or name == "timing_jitter"
    assert (found.accepted, scene.names) == (accepted, {name} if accepted else set())
    if not accepted:
        told = found.confirmed.evidence, found.confirmed.needed
        assert told == pytest.approx((needed - 0.1, needed))


def test_the_scene_is_built_anew_with_those_that_stay(monkeypatch):
    """It has bent itself to those that left, and does not go on: a finer one does, where that is better."""
    pool = [candidate("irf_tail"), candidate("vignetting")]
    for anew, finer, made in (
        (51.0, 60.0, (True, True)),
        (60.0, 55.0, (False, True)),
        (40.0, 41.0, (True, False)),
    ):
        table = {"irf_tail": nats(50.0), "anew": nats(-1.0), "anew+irf_tail": nats(anew)}
        table["fine+anew+irf_tail"] = nats(finer)
        world = World(monkeypatch, table, pool, {"vignetting": 1.0})
        members = [Member(c) for c in pool]
        scenes = fitted("irf_tail", "vignetting", fine=True), fitted("irf_tail", "vignetting")
        found, scene, coarse = world.holding().hold(members, *scenes, Held([], fitted(), fitted()))
        assert [m.accepted for m in found] == [True, False]
        assert (scene.names, (scene.fine, scene.anew)) == ({"irf_tail"}, made)
        assert coarse.names == {"irf_tail"}


def test_terms_must_predict_better_than_a_finer_scene(monkeypatch):
    for finer, names in ((60.0, {"irf_tail"}), (80.0, set())):
        table = {"fine": nats(finer), "irf_tail": nats(70.0), "fine+irf_tail": nats(70.0)}
        found = World(monkeypatch, table, [candidate("irf_tail")]).criticise()
        assert found.final.names == names
        assert [m.accepted for m in found.members] == [bool(names)]
        assert (found.again is None) is not names or names


@pytest.mark.parametrize(("rival", "named"), [(70.0, {"irf_tail"}), (59.0, set())])
def test_a_rival_may_predict_better_than_a_finer_scene(monkeypatch, rival, named):
    """Where the term in whose place it stands does not."""
    table = {"fine": nats(60.0), "afterpulsing": nats(55.0), "irf_tail": nats(rival)}
    table |= {"fine+afterpulsing": nats(40.0), "fine+anew+afterpulsing": nats(40.0)}
    rivals = {"afterpulsing": ["irf_tail"]}
    found = World(monkeypatch, table, [candidate("afterpulsing")], rivals=rivals).criticise()
    assert found.final.names == named
    assert {m.name for m in found.accepted} == named
    assert (found.again is not None) is bool(named)


@pytest.mark.parametrize(("free", "named"), [(70.0, {"free_time"}), (-3.0, set())])
def test_free_terms_are_asked_without_an_effect_that_predicts_worse_than_a_finer_scene(
    monkeypatch, free, named
):
    """It stands for something unknown, which explains nothing beside it, and leaves where that holds."""
    table = {"fine": nats(60.0), "irf_tail": nats(50.0), "free_time": nats(free)}
    table |= {"fine+irf_tail": nats(40.0), "fine+anew+irf_tail": nats(40.0)}
    both = ["free_time", "irf_tail"]
    table |= {"+".join([*built, *both]): nats(30.0) for built in ([], ["anew"], ["fine"], ["fine", "anew"])}
    pool = [candidate("irf_tail"), candidate("free_time", 50.0)]
    found = World(monkeypatch, table, pool).criticise()
    assert {m.name for m in found.accepted} == found.final.names == named
    assert [m.gone for m in found.members if m.name == "irf_tail"] == [bool(named)]


@pytest.mark.parametrize(("evidence", "named"), [(LEAST + 0.1, True), (LEAST - 0.1, False)])
def test_what_single_spots_have_over_their_neighbours_needs_no_share_of_the_misfit(
    monkeypatch, evidence, named
):
    pool = [candidate("wall_reflectance", 150.0), candidate("timing_jitter", evidence, 0.0)]
    table = {"timing_jitter": gaining(20.0), "wall_reflectance": gaining(40.0, seed=1)}
    found = World(monkeypatch, table, pool, misfit=10_000.0).criticise()
    assert names_of(found.accepted) == (["timing_jitter"] if named else [])


def test_what_single_spots_explain_is_asked_last(monkeypatch):
    """An effect that stood for it leaves then; one that stays is still there."""
    pool = [candidate("wall_reflectance"), candidate("irf_tail"), candidate("hot_spots")]
    table = {"wall_reflectance": nats(30.0), "irf_tail": nats(30.0), "hot_spots": nats(50.0)}
    table |= {"fine+hot_spots+irf_tail+wall_reflectance": nats(80.0)}
    found = World(monkeypatch, table, pool).criticise()
    assert {m.name: m.accepted for m in found.members} == {
        "wall_reflectance": False,
        "irf_tail": True,
        "hot_spots": True,
    }
    assert found.final.names == {"irf_tail", "hot_spots"}
    table |= {f"fine+hot_spots+{n}": nats(50.0) for n in ("irf_tail", "wall_reflectance")}
    table["fine+hot_spots+irf_tail+wall_reflectance"] = nats(57.0)
    found = World(monkeypatch, table, pool).criticise()
    assert names_of(found.accepted) == ["wall_reflectance", "irf_tail"], "hot spots make these worse"
    assert found.final.names == {"wall_reflectance", "irf_tail"}


def test_single_spots_that_lead_come_first(monkeypatch):
    """By themselves; what is asked for beside them comes after."""
    table = {"hot_spots": nats(50.0), "irf_tail": nats(20.0), "fine+hot_spots+irf_tail": nats(70.0)}
    pool = [candidate("hot_spots"), candidate("irf_tail")]
    world = World(monkeypatch, table, pool, beside={"irf_tail": {"hot_spots"}})
    found = world.criticise()
    assert names_of(found.accepted) == ["hot_spots", "irf_tail"]
    assert world.rebuilt[0] == ({"hot_spots"}, 4)


@pytest.mark.parametrize(("batches", "moved"), [(-50.0, False), (5.0, True)])
def test_single_spots_need_no_scene_that_moves(monkeypatch, batches, moved):
    """Batches may make a fine scene worse by more than single spots gain, which are solved for."""
    table = {"timing_jitter": nats(30.0), "on": nats(batches)}
    found = World(monkeypatch, table, [candidate("timing_jitter")]).criticise()
    assert (names_of(found.accepted), found.final.on) == (["timing_jitter"], moved)
    assert found.members[0].confirmed.gain.nats == pytest.approx(30.0), "both gone on with"


def test_less_than_nothing_is_a_share_of_itself(monkeypatch):
    """Where a scene without a term is at the noise already, and better than with it: minus one."""
    world = World(monkeypatch, {"irf_tail": nats(-3.0)}, [candidate("irf_tail")], misfit=-5.0)
    assert world.hold("irf_tail")[0]["irf_tail"].confirmed.explained == pytest.approx(-1.0)


def test_what_cannot_be_told_apart_is_a_group(monkeypatch):
    """A rival whose weight is above a twentieth; none and clear losers are not in it."""
    best = gaining(20.0)
    table = {
        "wall_reflectance": best,
        "pile_up": best - per_spot(3.0, 0.1, 2),
        "hum": best - per_spot(0.01, 1),
    }
    rivals = {"wall_reflectance": ["hum", "pile_up", "crosstalk"]}
    world = World(monkeypatch, table, [candidate("wall_reflectance")], rivals=rivals)
    monkeypatch.setattr(members, "MOST", 2.0)
    (member,) = world.criticise(replace(SETTINGS, odds=2.0)).accepted
    assert member.group.keys() == {"wall_reflectance", "hum"}
    assert next(iter(member.group)) == "wall_reflectance"
    assert sum(member.group.values()) == pytest.approx(1)
    assert {t.name for t in member.trials} == {"wall_reflectance", "hum", "pile_up", "none"}, "two rivals"


def test_a_rival_that_holds_beside_a_term_does_not_take_its_place(monkeypatch):
    """It waited until the term was in the model, was asked for again and came; it is there once."""
    table = {"wall_reflectance": nats(50.0), "vignetting": nats(60.0)}
    pool, rivals = [candidate(n) for n in table], {"wall_reflectance": ["vignetting"]}
    world = World(monkeypatch, table, pool, beside={"vignetting": {"wall_reflectance"}}, rivals=rivals)
    found = world.criticise()
    assert [m.name for m in found.accepted] == ["wall_reflectance", "vignetting"]
    assert {t.name for t in found.accepted[0].trials} == {"wall_reflectance", "none"}


def test_side_by_side_all_is_found_as_one_after_the_other(monkeypatch):
    """Scenes that are begun, and those without each of two terms that hold."""
    pool = [candidate("irf_tail", 50.0), candidate("hum", 40.0), candidate("pile_up", 0.0)]
    table = {"irf_tail": nats(50.0), "hum": nats(30.0), "fine": nats(5.0)}

    def found(processes: int) -> tuple[list[str], list[list[str]], list[tuple[str, float]]]:
        world = World(monkeypatch, table, pool, imitated=(("irf_tail",), ("hum", "pile_up")))
        what = world.criticise(CriticismSettings(processes=processes))
        gains = [(m.name, m.confirmed.gain.nats) for m in what.members if m.confirmed]
        return names_of(what.accepted), sorted(map(sorted, world.grown)), gains

    one = found(1)
    assert found(2) == one
    assert set(one[0]) == {"irf_tail", "hum"}
    for left in ("hum", "irf_tail"):
        assert [left] in one[1], "the other was left out, and what is left became fine"


def test_a_simpler_rival_takes_the_place_of_a_term(monkeypatch):
    """Where it gains as much; the others stay as they are."""
    table = {"wall_reflectance": nats(50.0), "vignetting": nats(49.0), "irf_tail": nats(60.0)}
    pool, rivals = (
        [candidate("irf_tail"), candidate("wall_reflectance")],
        {"wall_reflectance": ["vignetting"]},
    )
    world = World(monkeypatch, table, pool, {"vignetting": 77.0}, rivals=rivals)
    found = world.criticise()
    assert names_of(found.accepted) == ["irf_tail", "vignetting"]
    assert found.final.names == {"irf_tail", "vignetting"}
    member = found.members[1]
    assert (member.trial.name, member.trial.gain.nats) == ("vignetting", pytest.approx(49.0))
    assert (member.confirmed.evidence, member.confirmed.gain) == (77.0, member.trial.gain), "its own"
    assert list(member.group) == ["vignetting", "wall_reflectance"]


@pytest.mark.parametrize(("own", "named"), [(LEAST + 0.1, "vignetting"), (LEAST - 0.1, "wall_reflectance")])
def test_a_rival_must_hold_where_it_takes_the_place(monkeypatch, own, named):
    """By its own evidence, too; else the term stays, with what it was found to have, and the rival is left
    open.
    """
    table = {"wall_reflectance": nats(50.0), "vignetting": nats(49.0)}
    rivals = {"wall_reflectance": ["vignetting"]}
    world = World(monkeypatch, table, [candidate("wall_reflectance")], {"vignetting": own}, rivals=rivals)
    found = world.criticise()
    (member,) = found.accepted
    assert (member.name, found.final.names) == (named, {named})
    assert member.confirmed.evidence == (own if named == "vignetting" else 100.0)
    assert member.group.keys() == {"wall_reflectance", "vignetting"}
