"""Free terms: what each coefficient does, and whether the pool finds each where it is planted, and the named
effect where that is.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from inference_scenes import BIN, FORWARD_MODE, GATE, capture_of, drawn, effect_of, raster, surfels, uneven

from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE, FREE_NAMES, TAILS, tails_of, time_bands
from nlos_lit.effects.scan_pieces import bands
from nlos_lit.inference import tested
from nlos_lit.inference.candidates import Candidate
from nlos_lit.inference.evidence import by_width, prior_deviations
from nlos_lit.inference.problem import build_problem
from nlos_lit.inference.screening import screen

SIDE = 16
SCENE = capture_of(raster(SIDE))
SCAN = Scan.of(SCENE)
SPOTS = torch.arange(SIDE**2)


def with_one(name: str, k: int, value: float) -> Effect:
    effect = effect_of(name, SCAN)
    values = torch.zeros(effect.declared["field"].size)
    values[k] = value
    effect.set("field", values)
    return effect


def test_names_are_unlike_those_of_the_registry():
    assert len(FREE_NAMES) == len(FREE)
    assert not FREE_NAMES & set(EFFECTS.names)
    axes = {term.axis for term in FREE}
    assert axes == {"time", "wall", "scan", "rate", "time×scan", "time×wall", "spot"}


@pytest.mark.parametrize("term", FREE, ids=lambda t: t.name)
def test_the_null_changes_nothing_and_the_rest_does(term):
    model = surfels(SCENE)
    effect = term(SCAN)
    before = model.expected(SPOTS)
    assert torch.allclose(model.expected(SPOTS, Extension([effect])), before, rtol=3e-5)
    assert effect.penalty() == 0
    assert not torch.allclose(model.expected(SPOTS, Extension([uneven(effect)])), before, rtol=1e-2)
    if not effect.per_spot:
        assert effect.quantities()["rms"].value > 0
        precision = effect.precision()
        assert torch.all(precision > 0)
        if term.axis == "scan":  # k half waves: an octave of them has the same variance
            halves = range(1, min(30, len(precision) // 2) + 1)  # few splines do not follow the finest ones
            found = (precision / precision[0])[: len(halves)]
            assert found.tolist() == pytest.approx(halves, rel=1e-3)
        else:
            assert len(set(precision.tolist())) == 1, "every coefficient has the same prior deviation"


def test_bands_by_hand():
    assert bands(torch.tensor([0.0, 0.24, 0.26, 0.99, 1.0]), 4).argmax(1).tolist() == [0, 0, 1, 3, 3]
    for most, bins in ((40, 2), (58, 1), (256, 1), (57, 2), (12, 5)):
        time = time_bands(SCAN, most)
        assert time.shape == (GATE[1], -(-58 // bins))
        assert not time[: GATE[0]].any()
        assert torch.equal(time[GATE[0] :].sum(1), torch.ones(58))
        assert time[GATE[0] :].argmax(1).tolist() == [k // bins for k in range(58)]


@pytest.mark.parametrize("name", ["free_wall", "free_scan", "free_rate", "free_time"])
def test_factors_of_counts_by_hand(name):
    """Coefficient 3 multiplies counts by e to the 0.1 times its function, for light and background alike."""
    effect, expected = with_one(name, 3, 0.1), 1 + torch.rand(256, 64)
    if name == "free_rate":  # ten knots from e⁻² to e² of the mean: the fourth lies at -2 + 3·4/9
        rate = (expected.sum(1) / SCAN.mean_counts).log()
        function = (1 - ((rate + 2) * 9 / 4 - 3).abs()).clamp_min(0)[:, None]
        expected = expected * torch.exp(torch.linspace(-1.9, 1.9, 256))[:, None] * SCAN.mean_counts / 96
        rate = (expected.sum(1) / SCAN.mean_counts).log()
        function = (1 - ((rate + 2) * 9 / 4 - 3).abs()).clamp_min(0)[:, None]
        assert function.max() > 0.9
    elif name == "free_time":
        function = effect.functions[:, 3]
        assert function.nonzero()[:, 0].tolist() == [GATE[0] + 3]
    else:
        function = effect.functions[:, 3:4]
        assert effect.functions.square().mean(0).tolist() == pytest.approx([1.0] * 63, rel=1e-4)
        assert effect.functions.mean(0).abs().max() < 1e-4
    found = effect.counting(expected, SPOTS)
    assert torch.allclose(found, expected * torch.exp(0.1 * function), rtol=1e-5)


def test_factors_of_lines_by_hand():
    """Coefficient 3 multiplies the scene's light in the fourth of 24 stripes; the background stays."""
    effect, signal = with_one("free_lines", 3, 0.1), 1 + torch.rand(256, 64)
    stripe = (SCAN.laser[:, 0] - SCAN.laser[:, 0].min()) / 0.8 * 24
    dark = stripe.long().eq(3).float()[:, None]
    assert dark.sum() == SIDE
    assert torch.allclose(effect.gain(signal, SPOTS), signal * torch.exp(0.1 * dark), rtol=1e-5)
    assert effect.hooks == {"gain"}


@pytest.mark.parametrize("name", ["free_scan_background", "free_wall_background"])
def test_factors_of_the_background_by_hand(name):
    effect, background = with_one(name, 2, 0.4), torch.full((256, 64), 3.0)
    found = effect.background(background, SPOTS)
    assert torch.allclose(found, 3 * torch.exp(0.4 * effect.functions[:, 2:3]).expand(-1, 64))
    assert "counting" not in effect.hooks


@pytest.mark.parametrize("name", ["free_scan_delay", "free_wall_delay"])
def test_delays_by_hand(name):
    """Two centimetres are a bin."""
    effect = with_one(name, 2, BIN)
    found = effect.time(torch.ones(256, 5, 4), None, SPOTS)
    assert torch.allclose(found, 1 + BIN * effect.functions[:, 2, None, None].expand(-1, 5, 4))
    assert effect.amplitudes[0].scale == pytest.approx(BIN)


def test_changes_of_the_response_by_hand():
    """A tail takes 1 and gives (1 - e^{-1/τ}) e^{-t/τ}."""
    changes = tails_of(400)
    for k, tail in enumerate(TAILS):
        share = 1 - np.exp(-1 / tail)
        assert not changes[k, :200, 200].any()
        assert changes[k, 200:203, 200].tolist() == pytest.approx(
            [share - 1, share * np.exp(-1 / tail), share * np.exp(-2 / tail)], rel=1e-4
        )
    assert changes[:, :, 10].sum(1).abs().max() < 1e-3, "energy is kept"
    signal = torch.zeros(256, 64)
    signal[:, 20] = 100.0
    effect = with_one("free_response_scan", 0, 0.1)  # the first stretch, the shortest tail
    found, mine = effect.gain(signal, SPOTS).detach(), SCAN.rank < -1 + 2 / 16
    share = 1 - np.exp(-1 / TAILS[0])
    for spots, size in ((mine, 10 * 15 / 16), (~mine, -10 / 16)):  # nothing is the same at all spots
        assert found[spots][0, 19] == 0
        assert found[spots][0, 20:22].tolist() == pytest.approx(
            [100 + size * (share - 1), max(0, size * share * np.exp(-1 / TAILS[0]))], rel=1e-4
        )
    assert effect.values().detach()[mine][0, GATE[0]] == pytest.approx(0.1 * 15 / 16 * (share - 1))
    assert effect.values().detach().mean(0).abs().max() < 1e-8


@pytest.mark.parametrize("name", ["free_width_scan", "free_width_wall"])
def test_widths_by_hand(name):
    """A pulse gets wider by the variance f where f is positive, and keeps its energy and its place; where it
    is negative, a pulse of 16 squared bins gets narrower by as much.
    """
    effect = with_one(name, 1, 1.0)
    signal = 100 * torch.exp(-0.5 * (torch.arange(64) - 30.0) ** 2 / 16).expand(256, -1)
    found, f = effect.gain(signal, SPOTS).detach().double(), effect.values().detach().double()
    bins = torch.arange(64).double()
    assert torch.allclose(found.sum(1), signal.sum(1).double(), rtol=1e-5)
    middle = (found @ bins) / found.sum(1)
    assert torch.allclose(middle, torch.full_like(middle, 30.0), atol=1e-3)
    variance = (found * (bins - middle[:, None]) ** 2).sum(1) / found.sum(1)
    assert float(f.min()) < -1
    assert float(f.max()) > 1
    assert torch.allclose(variance - 16, f, atol=0.02)


def test_single_spots_by_hand():
    effect = with_one("free_spot_gain", 7, 0.2)
    found = effect.counting(torch.ones(256, 64), SPOTS).detach()
    assert torch.nonzero(found[:, 0] != 1)[:, 0].tolist() == [7]
    assert found[7, 0] == pytest.approx(np.exp(0.2))
    effect.width = 3.0
    assert effect.quantities()["rms"].value == pytest.approx(0.15)


RIVALS = ("time_drift", "timing_jitter", "time_offset", "power_drift", "wall_reflectance", "ambient_map")
RIVALS += (
    "vignetting",
    "background_slope",
    "hot_spots",
    "pile_up",
)  # those whose columns are soon worked out


def planted(effect: Effect, seed: int, *rivals: str) -> list[Candidate]:
    """What free terms and some of the registry are worth about counts that are drawn with an effect."""
    names = {*FREE_NAMES, *RIVALS, effect.name, *rivals}
    model = surfels(SCENE, level=4.0)
    measured = drawn(model, Extension([effect]), SCENE, seed)
    problem = build_problem(model, Extension([]), SPOTS, torch.from_numpy(measured.gated_counts()))
    return screen(problem, [e(SCAN) for e in [*EFFECTS, *FREE] if e.name in names], SPOTS // 32)


def rough(name: str, size: float) -> Effect:
    """Random coefficients, so that f is ``size`` on average."""
    effect = effect_of(name, SCAN)
    p = effect.declared["field"]
    values = 0.1 * p.scale * torch.from_numpy(np.random.default_rng(3).standard_normal(p.size)).float()
    if "_scan" in name and "response" not in name:
        values[: p.size // 2] = 0  # a drift is smoother
    effect.set("field", values)
    effect.set("field", values * size / float(effect.values().detach().square().mean().sqrt()))
    return effect


SIZES = {"free_scan_delay": 0.2 * BIN, "free_wall_delay": 0.2 * BIN, "free_scan_background": 0.3}
SIZES |= {"free_wall_background": 0.3, "free_response_scan": 0.01, "free_response_wall": 0.01}
SIZES |= {"free_width_scan": 0.6, "free_width_wall": 0.6}


@FORWARD_MODE
@pytest.mark.parametrize("name", [term.name for term in FREE])
def test_what_is_planted_is_asked_for_first(name):
    """A random shape along the axis, which no effect of the registry has."""
    found = planted(rough(name, SIZES.get(name, 0.1)), seed=1)
    assert found[0].name == name, [(c.name, round(c.evidence)) for c in found[:4]]
    assert found[0].evidence > 50


NAMED = {
    "power_drift": ({"drift": 0.05}, "free_scan"),
    "wall_reflectance": ({"gain_map": 0.2}, "free_wall"),  # more than patches may look uneven
    "time_drift": ({"drift": 0.055 * BIN}, "free_scan_delay"),
    "ambient_map": ({"level_map": 0.2}, "free_wall_background"),
    "irf_tail": ({"fraction": 0.1}, "free_time"),
    "background_slope": ({"slope": 0.3}, "free_time"),
    "pile_up": ({"detections": 0.1}, "free_rate"),
    "hum": ({"cosine": 0.3}, "free_scan_background"),
    "tcspc_nonlinearity": ({"sine": 0.05}, "free_time"),
}


@FORWARD_MODE
@pytest.mark.parametrize("name", NAMED)
def test_a_named_effect_has_more_evidence_than_the_free_term_along_its_axis(name):
    """Where its own coefficients are, the smoothest two of them that are not zero."""
    values, free = NAMED[name]
    effect = effect_of(name, SCAN)
    for p in effect.amplitudes:
        if p.name not in values:
            continue
        coefficients = torch.zeros(p.size)
        coefficients[:2] = values[p.name] * torch.tensor([1.0, -0.5])[: p.size]
        effect.set(p.name, coefficients[0] if p.size == 1 else coefficients)
        values = {}
    assert not values, "no such parameter"
    found = {c.name: c.evidence for c in planted(effect, seed=2)}
    assert found[name] > found[free], sorted(found.items(), key=lambda kv: -kv[1])[:4]
    assert found[name] > 20


@FORWARD_MODE
@pytest.mark.parametrize(("half_periods", "asked"), [(8, True), (40, False)])
def test_a_power_that_swings_is_not_called_a_drift(half_periods, asked):
    drift = effect_of("power_drift", SCAN)
    values = torch.zeros(drift.declared["drift"].size)
    values[half_periods - 1] = 0.1
    drift.set("drift", values)
    found = {c.name: c for c in planted(drift, seed=2)}
    assert found["free_scan"].evidence > 50
    assert (found["power_drift"].evidence > 50) is asked
    if not asked:
        assert found["power_drift"].evidence == found["power_drift"].loud == 0


@pytest.mark.parametrize("half_periods", [5, 60])
def test_what_swings_is_followed_through_gaps(half_periods):
    """Spots that were not fitted, nine in a row after eighteen that were: a width for each octave of
    frequencies follows a quick wave there to less than half of the error that one for all leaves, and a slow
    one as well.
    """
    scan = Scan.of(capture_of(raster(24)))
    term = effect_of("free_scan", scan)
    place = torch.empty(576).double()
    place[scan.rank.argsort()] = torch.arange(576.0).double()
    wave = 0.1 * torch.sin(torch.pi * half_periods * place / 576 + 0.7)
    wave -= wave.mean()
    noise = 0.03 * torch.from_numpy(np.random.default_rng(4).standard_normal(576))
    functions = term.functions.double() * torch.tensor(term.declared["field"].prior).double()
    seen = (place.long() // 9) % 3 != 1
    score = functions[seen].T @ (wave + noise)[seen] / 0.03**2
    information = functions[seen].T @ functions[seen] / 0.03**2
    errors = []
    for octave in (torch.zeros_like(term.width_of), term.width_of):
        mean, relative = by_width(score, information, octave, 1.0)
        errors.append(float((functions @ mean - wave)[~seen].square().mean().sqrt()))
    assert errors[1] < (0.5 if half_periods == 60 else 1.0) * errors[0]
    assert errors[1] < 0.03
    right = term.width_of == int(np.log2(half_periods))
    assert relative[right].min() > relative[~right].max()


def test_a_width_of_some_coefficients_is_the_priors():
    """Twice as wide: a quarter of the penalty."""
    term = with_one("free_scan", 40, 0.1)
    before = float(term.penalty().detach())
    term.relative[term.width_of == term.width_of[40]] = 2.0
    assert float(term.penalty().detach()) == pytest.approx(before / 4)
    assert prior_deviations(term).tolist() == pytest.approx(
        prior_deviations(effect_of("free_scan", SCAN)).tolist()
    ), "evidence is that of what was likely beforehand"


@FORWARD_MODE
def test_a_ripple_is_begun_with_a_width_of_its_own():
    ripple = with_one("free_scan", 39, 0.1)
    found = {c.name: c for c in planted(ripple, seed=2)}
    relative, octave = found["free_scan"].effect.relative, ripple.width_of
    assert relative[octave == octave[39]].min() > 3 * relative[octave != octave[39]].max()


@FORWARD_MODE
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_scene_that_moves_is_told_from_a_time_zero_that_drifts(axis):
    """Along x, y or z, by a function that swings six times; along the others it is asked for less widely."""
    motion = effect_of("scene_motion", SCAN)
    values = torch.zeros(motion.declared["motion"].size)
    values[3 * 11 + axis] = 0.3 * BIN
    motion.set("motion", values)
    found = {c.name: c for c in planted(motion, seed=2)}
    drift, moved = found["time_drift"], found["scene_motion"]
    assert moved.evidence > drift.evidence + 8, (moved.evidence, drift.evidence)
    relative = moved.effect.relative.view(-1, 3)[0]
    assert relative[axis] > relative.sum() - relative[axis]
    assert moved.step.view(-1, 3)[11, axis].item() == pytest.approx(0.6, rel=0.3)


@FORWARD_MODE
def test_a_time_zero_that_drifts_is_told_from_a_scene_that_moves():
    drift = effect_of("time_drift", SCAN)
    values = torch.zeros(drift.declared["drift"].size)
    values[11] = 0.1 * BIN
    drift.set("drift", values)
    found = {c.name: c.evidence for c in planted(drift, 2, "scene_motion")}
    assert found["time_drift"] > found["scene_motion"] > 20, found


def test_rows_are_a_fixed_choice_of_the_fitted_ones():
    class Split:
        fit = np.arange(100, 200)

    rows = tested.tested_rows(None, Split, 30, seed=3)
    assert np.array_equal(rows, np.unique(rows))
    assert len(rows) == 30
    assert rows[0] >= 0
    assert rows[-1] < 100
    assert np.array_equal(rows, tested.tested_rows(None, Split, 30, seed=3))
    assert not np.array_equal(rows, tested.tested_rows(None, Split, 30, seed=4))
    assert np.array_equal(tested.tested_rows(None, Split, 1000, seed=3), np.arange(100))


def test_a_changed_response_is_differentiated_where_it_is():
    """Changes of the response at single spots add up at the null alone: elsewhere each coefficient has a
    derivative of its own.
    """
    term = effect_of("free_response_wall", Scan.of(capture_of(raster(16))))
    assert term.factors(torch.arange(3)) is not None
    term.set("field", 0.1)
    assert term.factors(torch.arange(3)) is None
