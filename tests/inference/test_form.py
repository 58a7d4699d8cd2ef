"""Whether what an effect explains has that effect's form."""

from __future__ import annotations

import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, surfels

from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.criticise import CriticismSettings, look
from nlos_lit.inference.discrepancy import counted, discrepancies, smooth
from nlos_lit.inference.form import Form, forms_of
from nlos_lit.inference.problem import build_problem
from nlos_lit.inference.screen import FOLDS, Projector, screen
from nlos_lit.inference.split import split_spots

pytestmark = FORWARD_MODE


@pytest.fixture(scope="module")
def scene():
    return capture_of(raster(20))


def problem_with(scene, inside: list[Effect], measured: list[Effect], factor: torch.Tensor | float = 1.0):
    """Counts with the effects ``measured``, times ``factor``, against a model with the effects ``inside``."""
    model, spots = surfels(scene), torch.arange(scene.n_spots)
    counts = torch.from_numpy(drawn(model, Extension(measured), scene, 3, factor).gated_counts())
    problem = build_problem(model, Extension(inside), spots, counts)
    return problem, Projector(problem)


def forms(
    scene, effect: Effect, measured: list[Effect], factor: torch.Tensor | float = 1.0
) -> dict[str, Form]:
    problem, projector = problem_with(scene, [effect], measured, factor)
    return {found.axis: found for found in forms_of(problem, projector, effect)}


def form(scene, effect: Effect, measured: list[Effect], factor: torch.Tensor | float = 1.0) -> Form:
    return forms(scene, effect, measured, factor)["time"]


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("irf_tail", {"fraction": 0.2, "decay": 0.2}),
        ("tcspc_nonlinearity", {"sine": 0.3, "period": 9.0}),
        ("vignetting", {"strength": 0.4}),
    ],
)
def test_a_true_effect_has_its_form(scene, name, values):
    effect = effect_of(name, Scan.of(scene), **values)
    found = form(scene, effect, [effect])
    assert not found.wrong
    assert abs(found.gain) < 10
    assert found.own > 100
    assert found.p_value > 1e-3


def test_own_is_half_the_squared_change(scene):
    effect = effect_of("vignetting", Scan.of(scene), strength=0.4)
    model, spots = surfels(scene), torch.arange(scene.n_spots)
    with_, without = (model.expected(spots, Extension(e)).double() for e in ([effect], []))
    found = form(scene, effect, [effect])
    assert found.own == pytest.approx(float(((with_ - without) ** 2 / with_).sum()) / 2, rel=1e-4)


def test_a_ripple_that_stands_for_a_gap_has_not(scene):
    """Five codes lose 60 %; of all ripples with half a period there, the one with the best strength is in the
    model.
    """
    factor = torch.ones(scene.n_spots, scene.gate[1] - scene.gate[0])
    factor[:, 20:25] = 0.4
    scan = Scan.of(scene)
    problem, projector = problem_with(scene, [], [], factor)
    ripple = effect_of("tcspc_nonlinearity", scan)
    found = screen(problem, projector, [ripple], torch.arange(scene.n_spots) % 6)[0]
    assert found.gain > 100, "it is tempting"
    ripple = found.effect
    ripple.set("sine", 0.02 * float(found.step[0]))
    ripple.set("cosine", 0.02 * float(found.step[1]))
    shape = form(scene, ripple, [], factor)
    assert shape.wrong
    assert shape.gain > shape.own
    assert shape.axis == "time"


def test_a_number_for_every_spot_has_no_common_strength(scene):
    assert forms(scene, effect_of("timing_jitter", Scan.of(scene)), []) == {}


def test_a_wall_that_is_dark_where_the_scene_is_bright_belongs_to_the_counting(scene):
    """A map with minus half the logarithm of the scene's own totals, smooth; its mirror image, which no
    detector makes; its own.
    """
    scan, model = Scan.of(scene), surfels(scene)
    wall = effect_of("wall_reflectance", scan)
    rate = model.expected(torch.arange(scene.n_spots)).sum(1).log()
    saturated = torch.linalg.lstsq(wall.functions, -0.5 * (rate - rate.mean())[:, None]).solution[:, 0]
    own = torch.zeros(len(saturated))
    own[:4] = torch.tensor([0.1, -0.2, 0.3, 0.1])
    for values, wrong in ((saturated, True), (-saturated, False), (own, False)):
        found = forms(scene, effect_of("wall_reflectance", scan, gain_map=values), [])
        assert found["rate"].wrong is wrong
        assert not found["time"].wrong
        assert (found["rate"].gain > 0.9 * found["rate"].own) is wrong
    assert found["rate"].own == pytest.approx(found["time"].own, rel=1e-5)
    assert "rate" not in forms(scene, effect_of("vignetting", scan, strength=0.3), []), "one number is no map"


def test_a_function_of_the_count_rate_says_more_than_any_effect_only_where_it_is_the_cause(scene):
    """A detector that loses counts where there are many, and a wall that is dark in places."""
    scan, model = Scan.of(scene), surfels(scene)
    total = model.expected(torch.arange(scene.n_spots)).sum(1, keepdim=True)
    values = torch.zeros(effect_of("wall_reflectance", scan).functions.shape[1])
    values[:4] = torch.tensor([0.1, -0.2, 0.3, 0.1])
    wall = effect_of("wall_reflectance", scan, gain_map=values)
    for inside, factor, rate in (([], 1 / (1 + 3 * (total / total.mean()) ** 2), True), ([wall], 1.0, False)):
        problem, projector = problem_with(scene, [], inside, factor)
        best = screen(problem, projector, [e(scan) for e in EFFECTS], torch.arange(scene.n_spots) % FOLDS)[0]
        assert best.effect.name == "wall_reflectance"
        assert (
            counted(discrepancies(problem, projector, scan)) > best.gain + CriticismSettings().least_gain
        ) is rate


def test_a_delay_that_neighbours_share_is_no_jitter(scene):
    """An offset that jumps in the middle of the scan, and one drawn for every spot alone."""
    scan = Scan.of(scene)
    own = torch.randn(scene.n_spots, generator=torch.Generator().manual_seed(1))
    for offset, shared in ((torch.where(scan.rank < 0, -1.0, 1.0), True), (own, False)):
        moved = effect_of("timing_jitter", scan, offset=0.015 * offset)
        problem, projector = problem_with(scene, [], [moved])
        jitter = effect_of("timing_jitter", scan)
        gain = screen(problem, projector, [jitter], torch.arange(scene.n_spots) % 6)[0].gain
        assert gain > 100
        found = discrepancies(problem, projector, scan, [jitter])
        assert smooth(found, "timing_jitter", gain) is shared
        assert (
            (found[0].of, found[0].axis) == ("timing_jitter", "scan")
            if shared
            else not smooth(found, "hot_spots", gain)
        )


def test_neighbours_are_compared_only_where_a_number_a_spot_is_asked_for(scene):
    """A base is wrong in places, too: shared delays flag nothing that nobody would have named."""
    scan, split = Scan.of(scene), split_spots(scene)
    jump = effect_of("timing_jitter", scan, offset=0.015 * torch.where(scan.rank < 0, -1.0, 1.0))
    for measured, asked in (([], {""}), ([jump], {"", "timing_jitter"})):
        model = surfels(scene)
        fit = fit_of(model, drawn(model, Extension(measured), scene, 3), train=split.fit)
        found = look(fit, split, scan, CriticismSettings(spots=len(split.fit)), 0)
        assert {d.of for d in found.discrepancies} == asked
