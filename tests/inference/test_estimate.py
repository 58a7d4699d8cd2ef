"""Parameters of accepted effects and their errors, against dense algebra and by hand; what the diagnosis
makes of them.
"""

from __future__ import annotations

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, scattered, surfels
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference import tested
from nlos_lit.inference.advise import plans
from nlos_lit.inference.assemble import _screened, assemble, shape_of, visible_score
from nlos_lit.inference.candidates import Candidate, Pool
from nlos_lit.inference.evidence import (
    UNEVENNESS,
    Projector,
    best_evidence,
    prior_deviations,
)
from nlos_lit.inference.heldout import Comparison
from nlos_lit.inference.members import Confirmed, Findings, Member, Trial
from nlos_lit.inference.own import own_evidence
from nlos_lit.inference.problem import Problem, build_problem, weighted_columns
from nlos_lit.inference.residuals import SIDE
from nlos_lit.inference.result import Likely
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.inference.split import split_spots
from nlos_lit.inference.toys import Null
from nlos_lit.inference.uncertainty import UNLIKE, Uncertainty
from nlos_lit.surfels.fit import SurfelFit

SCAN = Scan.of(capture_of(scattered(12)))


def known(effects: list[Effect], covariance: Tensor) -> Uncertainty:
    found = object.__new__(Uncertainty)
    found.effects, found.covariance, found.fitted = effects, covariance.double(), 0.75
    return found


def test_delta_method_by_hand():
    """Widths √((sine² + cosine²)/2) rms of 3 and 4 steps of 0.02, whose overtones are sure: slopes 0.02/√2 ·
    (0.6, 0.8); period P = e^{0.01 raw}: slope 0.01 P.

    Small errors, so that nothing bends; 58 bins are no whole number of periods, but nearly.
    """
    ripple = effect_of("tcspc_nonlinearity", SCAN, sine=0.06, cosine=0.08, period=9.667)
    slope = effect_of("background_slope", SCAN, slope=0.2)
    covariance = torch.diag(torch.tensor([9.0, 1.0, 1.0, 4.0] + [0.0] * 14 + [0.25]))
    covariance[2, 3] = covariance[3, 2] = -1.0
    covariance *= 1e-5
    found = known([slope, ripple], covariance).parameters(ripple)
    variance = 1e-5 * 0.02**2 / 2 * (0.36 * 1 + 0.64 * 4 + 2 * 0.6 * 0.8 * -1)
    assert found["rms"].value == pytest.approx(0.1 / 2**0.5, rel=1e-3)
    assert found["rms"].stderr == pytest.approx(UNLIKE * variance**0.5, rel=0.01)
    assert found["period"].stderr == pytest.approx(UNLIKE * 1e-5**0.5 * 0.01 * 9.667 * 0.5, rel=3e-3)
    assert (found["rms"].unit, found["period"].unit) == ("1", "bins")
    own = known([slope, ripple], covariance).parameters(slope)
    assert own["slope"].value == pytest.approx(0.2)
    assert own["slope"].stderr == pytest.approx(UNLIKE * 1e-5**0.5 * 0.05 * 3, rel=1e-3)


def test_the_length_of_a_vector_is_unsure_where_its_largest_component_is():
    """Coefficients (0, 3) steps with errors 2 and 0.1 steps: over three errors the length goes from 3 to √(9
    + 36).
    """
    drift = effect_of("power_drift", SCAN)
    scale = drift.declared["drift"].scale
    values = torch.zeros(drift.declared["drift"].size)
    values[1] = 3 * scale
    drift.set("drift", values)
    covariance = torch.zeros(len(values), len(values))
    covariance[0, 0], covariance[1, 1] = 4.0, 0.01
    found = known([drift], covariance).parameters(drift)["rms"]
    assert found.value == pytest.approx(3 * scale, rel=1e-3)
    assert found.stderr == pytest.approx(UNLIKE * scale * ((45**0.5 - 3) ** 2 / 9 + 0.01) ** 0.5, rel=1e-3)


def test_what_is_quick_makes_the_whole_unsure_and_not_the_rest():
    """A tail of 0.1, of which 0.2 ± 0.05 are quick, and the more the larger it is, so that 0.08 are slow;
    how quickly they decay is not known at all, which is no more than their bounds allow.
    """
    tail = effect_of("irf_tail", SCAN, fraction=0.1, quick=0.2)
    whole, quick, late = (tail.declared[name] for name in ("fraction", "quick", "quick_decay"))
    together = torch.tensor([0.1 * 0.05 / 0.8 / whole.scale, 0.0, 0.05 / quick.scale, 0.0])
    covariance = together[:, None] * together + torch.diag(torch.tensor([1e-12, 1e-6, 1e-12, 1e4]))
    found = known([tail], covariance).parameters(tail)
    assert found["fraction"].stderr == pytest.approx(UNLIKE * 0.1 * 0.05 / 0.8, rel=1e-3)
    assert found["quick"].stderr == pytest.approx(UNLIKE * 0.05, rel=1e-3)
    assert found["slow"].stderr < 0.2 * found["fraction"].stderr
    assert found["quick_decay"].stderr == pytest.approx(UNLIKE * (late.upper - late.grid[0]) / 3, rel=1e-3)


def test_a_parameter_that_comes_back_elsewhere_is_unsure():
    """Errors of 0.3 from the counts, and of 0.4 from a fit from new seeds."""
    slope, again = (effect_of("background_slope", SCAN, slope=value) for value in (0.2, -0.2))
    scale = slope.declared["slope"].scale
    known_slope = known([slope], torch.diag(torch.tensor([(0.3 / scale) ** 2, 1e-6])))
    assert known_slope.parameters(slope)["slope"].stderr == pytest.approx(UNLIKE * 0.3, rel=1e-4)
    assert known_slope.parameters(slope, again)["slope"].stderr == pytest.approx(UNLIKE * 0.5, rel=1e-4)


def test_what_a_misfit_may_add_is_three_errors_of_how_much_there_is():
    """A tail of 0.2, four steps of 0.05 with an error of 0.1: ½ · 40² = 800 nats. Of these 18 are 0.15 of it,
    three times 0.01; its decay is as sure as before. What has less nats than that may be none, or twice.
    """
    tail = effect_of("irf_tail", SCAN, fraction=0.2)
    covariance = torch.diag(torch.tensor([0.01, 1e-6, 0.01, 1e-6]))
    by_counts, found, more = (known([tail], covariance).parameters(tail, None, m) for m in (0, 18, 2000))
    assert by_counts["fraction"].stderr == pytest.approx(UNLIKE * 0.005, rel=1e-3)
    assert found["fraction"].stderr == pytest.approx(UNLIKE * (0.005**2 + 0.01**2) ** 0.5, rel=0.01)
    assert found["decay"].stderr == pytest.approx(by_counts["decay"].stderr, rel=1e-6)
    assert more["fraction"].stderr == pytest.approx(UNLIKE * (0.005**2 + (0.2 / 3) ** 2) ** 0.5, rel=0.01)


def test_a_width_is_as_certain_as_its_spots_are_many():
    """Jitter of 8 solved spots of 12: σ/√16."""
    offset = torch.zeros(12)
    offset[:8] = 0.01 * torch.tensor([1.0, -1, 1, -1, 1, -1, 1, -1])
    jitter = effect_of("timing_jitter", SCAN, offset=offset)
    found = known([], torch.zeros(0, 0)).parameters(jitter)["sigma"]
    assert found.value == pytest.approx(0.01, rel=1e-3)
    assert found.stderr == pytest.approx(UNLIKE * 0.01 / 4, rel=1e-3)


def test_hot_spots_are_counted_for_the_whole_scan():
    """Three of 2 counts a bin among the fitted three quarters: four ± √3/0.75; their level is 2."""
    extra = torch.zeros(12)
    extra[:3] = 2.0
    found = known([], torch.zeros(0, 0)).parameters(effect_of("hot_spots", SCAN, extra=extra))
    number, level = found["number"], found["level"]
    assert (number.value, number.stderr) == (pytest.approx(4), pytest.approx(UNLIKE * 3**0.5 / 0.75))
    assert (level.value, level.stderr) == (pytest.approx(2), pytest.approx(UNLIKE * 2 / 6**0.5))


def test_a_mean_of_unlike_spots_is_as_uncertain_as_they_scatter():
    """Of 20, 2, 2 and 2 counts a bin the mean is 6.5 ± 4.5, the standard error of a mean of four."""
    extra = torch.zeros(12)
    extra[:4] = torch.tensor([20.0, 2.0, 2.0, 2.0])
    effect = effect_of("hot_spots", SCAN, extra=extra)
    found = known([], torch.zeros(0, 0)).parameters(effect)["level"]
    assert (found.value, found.stderr) == (pytest.approx(6.5), pytest.approx(UNLIKE * 4.5))
    assert torch.equal(effect.value("extra").reshape(-1), extra)


def accepted_fit(factor: float = 1.0, seed: int | None = 0) -> tuple[SurfelFit, Tensor, Tensor]:
    """64 spots in 16 blocks with a background that slopes and pile-up at their true values; counts drawn, or
    exactly expected with no seed.
    """
    scene = capture_of(raster(8))
    model, scan = surfels(scene, level=40.0), Scan.of(scene)
    extension = Extension(
        [effect_of("background_slope", scan, slope=0.3), effect_of("pile_up", scan, detections=0.3)]
    )
    spots, block = torch.arange(64), torch.arange(64) // 16 * 4 + torch.arange(64) % 8 // 2
    patches = (
        1 + factor * torch.from_numpy(np.random.default_rng(9).standard_normal(16)).float()[block][:, None]
    )
    measured = drawn(model, extension, scene, seed or 0, patches if factor != 1.0 else 1.0)
    fit = fit_of(model, measured, extension)
    if seed is None:
        fit.counts = model.expected(spots, extension)
    return fit, spots, block


def width(problem: Problem) -> float:
    """How uneven patches look; no matter how it is found, errors are those of a scene that is so uneven."""
    projector = Projector(problem)
    return float(UNEVENNESS[projector.width])


def dense(fit: SurfelFit, spots: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Effects' block of the inverse of the whole information matrix; their columns and the residual off the
    nuisance, the rows of its prior below the others; and what the prior lets the counts do.
    """
    problem = build_problem(fit.model, fit.extension, spots, fit.counts, with_effects=False)
    z = torch.cat([weighted_columns(problem, e) for e in fit.extension.effects], 1).double()
    prior = torch.cat([problem.prior, torch.full((problem.uneven.shape[1],), width(problem) ** -2)]).double()
    held = prior > 0
    below = torch.diag(prior.sqrt())[held]
    columns = torch.cat([problem.nuisance, problem.uneven], 1).double()
    x = torch.cat([columns, below])
    own = torch.cat([z, problem.residual.double()[:, None]], 1)
    own = torch.cat([own, torch.zeros(len(below), own.shape[1], dtype=own.dtype)])
    both, k = torch.cat([x, own[:, :-1]], 1), z.shape[1]
    information = both.T @ both
    inverse = torch.linalg.inv(information)[-k:, -k:]
    off = own - x @ torch.linalg.solve(information[:-k, :-k], x.T @ own)
    may = columns[:, held] * prior[held].rsqrt()
    return inverse, off[:, :-1], off[:, -1], may


@FORWARD_MODE
def test_covariance_is_the_inverse_of_the_whole_information():
    fit, spots, block = accepted_fit(seed=None)
    found = Uncertainty(fit, spots, fit.counts, block)
    inverse, *_ = dense(fit, spots)
    # Tilts of single surfels are nearly dependent, and products are in single precision.
    assert torch.allclose(found.covariance, inverse, rtol=5e-3)
    estimate = found.parameters(fit.extension.effects[1])["detections"]
    assert estimate.value == pytest.approx(0.3, rel=1e-5)
    assert estimate.stderr == pytest.approx(UNLIKE * 0.05 * float(inverse[-1, -1]) ** 0.5, rel=1e-3)


@FORWARD_MODE
def test_misfit_between_blocks_widens_the_errors():
    """Huber's sandwich on counts whose patches are brighter and darker than the model."""
    fit, spots, block = accepted_fit(factor=0.1)
    found = Uncertainty(fit, spots, fit.counts, block)
    inverse, z, residual, _ = dense(fit, spots)
    score, rows = z * residual[:, None], fit.counts.numel()
    by_block = [score[:rows].view(64, -1, 3)[block == b].sum((0, 1)) for b in range(16)]
    by_block = torch.cat([torch.stack(by_block), score[rows:]])
    robust = inverse @ (by_block.T @ by_block) @ inverse
    grown = (robust.diagonal() / inverse.diagonal()).clamp_min(1).sqrt()
    assert float(grown.max()) > 2
    assert torch.allclose(found.covariance, inverse * grown[:, None] * grown[None], rtol=0.02)
    calm, _, _ = accepted_fit()
    assert torch.all(
        Uncertainty(calm, spots, calm.counts, block).covariance.diagonal() < 2.5 * inverse.diagonal()
    )


@FORWARD_MODE
def test_errors_are_those_of_repeated_measurements():
    """Two hundred draws of the counts, and of what patches of the scene may do: one-step estimates scatter as
    the reported errors say, around the truth.
    """
    fit, spots, block = accepted_fit(seed=None)
    found = Uncertainty(fit, spots, fit.counts, block)
    inverse, z, _, may = dense(fit, spots)
    expected, rng = fit.counts.double(), np.random.default_rng(1)
    drawn_counts = rng.poisson(expected.numpy(), (200, *expected.shape))
    residuals = torch.from_numpy((drawn_counts - expected.numpy()) / np.sqrt(expected.numpy()))
    done = torch.from_numpy(rng.standard_normal((200, may.shape[1]))) @ may.T
    steps = (residuals.reshape(200, -1) + done) @ z[: len(may)] @ inverse
    error = found.covariance.diagonal().sqrt()
    assert torch.all((steps.std(0) / error - 1).abs() < 4 / 400**0.5)
    assert torch.all(steps.mean(0).abs() < 4 * error / 200**0.5)


def found_candidate(name: str, scan: Scan, evidence: float, step: Tensor | float = 0.0) -> Candidate:
    effect = effect_of(name, scan)
    size = sum(p.size for p in effect.amplitudes)
    steps = torch.full((size,), step) if isinstance(step, float) else step
    return Candidate(effect, evidence, 0.4, 1.5, {}, steps, torch.full((size,), 0.1), evidence)


@pytest.fixture(scope="module")
def findings():
    """A tail and a free map, accepted beside a rival each, and what the pool says before and after."""
    scene = capture_of(raster(16), scan_shape=(16, 16))
    scan, model = Scan.of(scene), surfels(scene, level=10.0)
    tail, free = effect_of("irf_tail", scan, fraction=0.2), effect_of("free_wall", scan)
    free.set("field", 0.05 * torch.ones(free.declared["field"].size))
    extension = Extension([tail, free])
    measured = drawn(model, extension, scene)
    split = split_spots(measured)
    base, final = (fit_of(model, measured, e, split.fit) for e in (Extension([]), extension))
    nothing = torch.zeros(len(split.select))

    def trial(name: str, evidence: float, gain: float, weight: float) -> Trial:
        one = found_candidate(name, scan, evidence)
        other = fit_of(model, measured, Extension([effect_of(name, scan), free]), split.fit)
        fit = final if name in ("irf_tail", "free_wall") else other
        return Trial(one, fit, nothing, Comparison(gain, 1.0, (gain - 2, gain + 2)), weight)

    def kept(evidence: float) -> Confirmed:
        return Confirmed(evidence, 8.0, Comparison(40.0, 1.0, (38, 42)), 1.0)

    first = [
        found_candidate(n, scan, e)
        for n, e in (("irf_tail", 500.0), ("afterpulsing", 400.0), ("free_wall", 90.0), ("free_time", 4.0))
    ]
    won, second = trial("irf_tail", 500.0, 250.0, 0.6), trial("free_wall", 90.0, 60.0, 0.9)
    rival, beside = trial("afterpulsing", 400.0, 290.0, 0.2), trial("free_wall", 90.0, 80.0, 0.1)
    control = Trial(None, base, nothing, Comparison(1.0, 1.0, (-1, 3)), 0.1)
    group = {"irf_tail": 0.6, "afterpulsing": 0.2, "free_wall": 0.2}
    members = [
        Member(first[0], first[1:3], kept(450.0), True, [won, rival, beside, control], group),
        Member(first[2], (), kept(80.0), True, [second, control], {"free_wall": 1.0}),
        Member(first[1], (), kept(2.0), gone=True),
    ]
    return Findings(base, final, 8.0, [Pool(first, []), Pool(first[3:], [])], members), measured, split, scan


def diagnosed(findings, null: Null | None = None):
    found, measured, split, scan = findings
    return assemble(measured, found, split, scan, CriticismSettings(spots=48), null, "x", 9.0, 3)


@FORWARD_MODE
def test_what_is_said_of_accepted_terms(findings):
    found, said = findings[0], diagnosed(findings)
    (tail,), (free,) = said.effects, said.unknown
    # Six and two tenths remain when the map, which was accepted beside, is no rival, nor is none.
    assert tail.weights == pytest.approx({"irf_tail": 0.75, "afterpulsing": 0.25})
    assert tail.confusable_with == ["afterpulsing"]
    assert set(tail.advised) == {plan.name for plan in plans(findings[1])}
    assert free.advised == {}, "nothing else may be meant"
    assert "background" in tail.split_by
    assert said.groups == [["irf_tail", "afterpulsing"]]
    assert (tail.evidence, tail.axis, tail.shape) == (450, "", None)
    assert tail.parameters["fraction"].value == pytest.approx(0.2)
    _, measured, split, _ = findings
    photons, bins = measured.gated_counts()[split.select].sum(), len(split.select) * 58
    gain = tail.heldout_gain
    assert gain.nats_per_photon == pytest.approx(250 / photons)
    assert gain.ci95 == pytest.approx((248 / photons, 252 / photons))
    assert gain.deviance_per_bin_after == pytest.approx(said.extended.deviance_per_bin)
    assert gain.deviance_per_bin_before - gain.deviance_per_bin_after == pytest.approx(500 / bins)
    assert (free.name, free.axis, free.weights) == ("free_wall", "wall", {"free_wall": 1.0})
    assert free.shape.values.shape == (SIDE, SIDE)
    assert (said.unexplained.significant, said.unexplained.axis, said.unexplained.evidence) == (
        True,
        "wall",
        80,
    )
    assert [s.name for s in said.screened] == ["irf_tail", "afterpulsing", "free_wall", "free_time"]
    assert said.needed == 8
    assert said.likely == [], "what does not hold predicts nothing much better"
    last = found.members[2]
    better = dataclasses.replace(last.confirmed, explained=0.38, evidence=220.0, needed=671.0)
    told = dataclasses.replace(
        found, members=[*found.members[:2], dataclasses.replace(last, confirmed=better, gone=False)]
    )
    assert diagnosed((told, *findings[1:])).likely == [Likely("afterpulsing", 40.0, 1.0, 0.38, 220.0, 671.0)]


@FORWARD_MODE
def test_a_number_at_its_bound_is_in_the_notes(findings):
    found = copy.deepcopy(findings[0])
    assert diagnosed((found, *findings[1:])).notes == []
    found.final.extension.effects[0].set("decay", 1e9)
    (note,) = diagnosed((found, *findings[1:])).notes
    assert note.startswith("decay of irf_tail is ")


@FORWARD_MODE
def test_without_an_unknown_term_the_likeliest_axis_is_told(findings):
    """Of the last pool, which does not make it significant."""
    found, *rest = findings
    only = Extension([found.final.extension.effects[0]])
    fit = fit_of(found.final.model, rest[0], only, rest[1].fit)
    calm = dataclasses.replace(found, final=fit, members=found.members[:1])
    said = diagnosed((calm, *rest))
    assert [e.name for e in said.effects] == ["irf_tail"]
    assert said.unknown == []
    left = said.unexplained
    assert (left.significant, left.axis, left.evidence) == (False, "time", 4)
    # The map is no longer accepted, and so is a rival again.
    assert set(said.effects[0].weights) == {"irf_tail", "afterpulsing", "free_wall"}


@FORWARD_MODE
def test_own_evidence_is_that_of_the_term_left_out(findings):
    """As if the model had all else, and the counts were asked for it from where its absence leaves them."""
    found, measured, split, _ = findings
    fit = fit_of(found.final.model, measured, found.final.extension, split.fit)
    names = ["irf_tail", "free_wall"]
    asked, _ = own_evidence(fit, split, 48, 3, names, lambda lit, lost: lit)
    assert own_evidence(fit, split, 48, 3, names, lambda lit, lost: -math.inf)[1] == names
    rows = tested.tested_rows(fit, split, 48, 3)
    spots, block = torch.from_numpy(split.fit[rows]), torch.from_numpy(split.block[split.fit[rows]])
    for effect in fit.extension.effects:
        problem = build_problem(fit.model, fit.extension, spots, fit.counts[rows], without=effect)
        z = weighted_columns(problem, effect)
        at = getattr(effect, f"raw_{effect.amplitudes[0].name}").detach()
        projector = Projector(dataclasses.replace(problem, residual=problem.residual + z @ at))
        own = (prior_deviations(effect), effect.step_bounds())
        nats = best_evidence(projector, z.view(48, 58, -1), projector.freed(z), block, *own)
        many = math.log(len(effect.shape_grid()))
        assert asked[effect.name] == (
            pytest.approx(nats.nats - many, rel=1e-3),
            pytest.approx(nats.lit, rel=1e-3),
            0,
        )
    assert asked["irf_tail"][0] > 20


@FORWARD_MODE
def test_spots_that_lose_all_have_no_more_evidence_than_counts_that_they_lost():
    """Also where the gate is said to let nothing pass, and three counts came before it."""
    scene = capture_of(raster(16), scan_shape=(16, 16))
    scan, model = Scan.of(scene), surfels(scene, level=10.0)
    gate, spots = effect_of("spot_gate", scan, start=30.0), torch.arange(5, 256, 20)
    gate.set("lost", torch.zeros(256).index_fill(0, spots, 1.0))
    measured = drawn(model, Extension([gate]), scene)
    split = split_spots(measured)
    late = np.intersect1d(spots.numpy(), split.fit)
    measured.counts[late[:3], 25] += 1
    fit = fit_of(model, measured, Extension([gate]), split.fit)
    nats = own_evidence(fit, split, 256, 3, ["spot_gate"], lambda lit, lost: 0.0)[0]["spot_gate"][0]
    first = scan.gate[0]
    with torch.no_grad():
        lost = float(model.expected(torch.from_numpy(late), Extension([]))[:, : 30 - first].sum())
    assert len(late) > 5
    assert 0.2 * lost < nats < lost


@FORWARD_MODE
def test_who_has_too_little_leaves_and_the_others_are_asked_again(findings):
    """A free term along time does what the tail does: neither has much beside the other; it leaves first."""
    found, measured, split, scan = findings
    tail, free = effect_of("irf_tail", scan, fraction=0.2), effect_of("free_time", scan)
    fit = fit_of(found.final.model, measured, Extension([tail, free]), split.fit)
    single = fit_of(found.final.model, measured, Extension([tail]), split.fit)
    names = ["irf_tail", "free_time"]

    def own(fit, names, bar):
        return own_evidence(fit, split, 48, 3, names, bar)

    more = 1e6  # than any has, so that none leaves
    both = {
        n: (nats, taken) for n, (nats, _, taken) in own(fit, names, lambda _, lost: lost - more)[0].items()
    }
    alone = own(single, ["irf_tail"], lambda _, lost: 1 + lost)[0]
    # Its scatter beside nothing counts as its own.
    assert both["irf_tail"][1] > 0.98 * (alone["irf_tail"][0] - both["irf_tail"][0])
    assert alone["irf_tail"][1] == 1
    bar = (both["irf_tail"][0] + alone["irf_tail"][0]) / 2
    asked, left = own(fit, names, lambda *_: bar)
    assert left == ["irf_tail"]
    assert asked["free_time"] == (both["free_time"][0], bar, 0)
    assert both["irf_tail"][0] < bar < alone["irf_tail"][0]
    assert asked["irf_tail"] == (pytest.approx(alone["irf_tail"][0], rel=0.02), bar, 0), (
        "as without the other"
    )
    none, left = own(fit, names, lambda *_: 2 * alone["irf_tail"][0])
    assert (left, none["irf_tail"][0]) == ([], both["irf_tail"][0]), "it leaves, too"


@FORWARD_MODE
def test_what_the_last_model_has_without_a_name_is_in_the_notes(findings):
    found, measured, split, scan = findings
    sure = Confirmed(3.0, 8.0, Comparison(9.0, 2.0, (5, 13)), 1.0)
    for weight, told in ((0.96, True), (0.94, False)):
        kept = Member(found_candidate("ghost_pulse", scan, 9.0), (), dataclasses.replace(sure, weight=weight))
        more = dataclasses.replace(found, members=[*found.members, kept])
        said = diagnosed((more, measured, split, scan))
        assert any("and not named" in n and "delayed pulse" in n for n in said.notes) is told
        assert said.along == ["ghost_pulse"] * told


@FORWARD_MODE
def test_the_chance_is_that_of_toys_or_of_theory(findings):
    found, *others = findings
    assert diagnosed(findings).chance == pytest.approx(0.01 * math.exp(8 - 500))
    weak = [dataclasses.replace(c, evidence=4.0) for c in found.pools[0].candidates]
    pools = [dataclasses.replace(found.pools[0], candidates=weak), *found.pools[1:]]
    said = diagnosed((dataclasses.replace(found, pools=pools), *others))
    over = max(e.evidence - e.needed for e in [*said.effects, *said.unknown])
    assert over > 0
    assert said.chance == pytest.approx(0.01 * math.exp(-over)), "asked for beside other terms"
    said = diagnosed(findings, Null([600.0, 3.0, 1.0]))
    assert (said.chance, said.toys) == (0.5, 3)


def test_what_would_be_seen():
    """½(u² - 1 - ln u²) nats at u standard deviations; nine of ten cases add 1.28."""
    for nats in (0.5, 8.3, 100.0):
        u = visible_score(nats)
        assert 0.5 * (u**2 - 1 - math.log(u**2)) == pytest.approx(nats, rel=1e-6)


def test_screened_in_units_of_the_parameters():
    tail = effect_of("irf_tail", SCAN, decay=0.11)
    found = _screened(
        Candidate(tail, 30.0, 0.4, 1.0, {"decay": 0.11}, torch.tensor([2.0]), torch.tensor([0.3]), 30.0), 8.3
    )
    assert found.one_step["fraction"] == pytest.approx(0.1)
    visible = visible_score(8.3 + math.log(len(tail.shape_grid()))) + 1.2816
    assert found.detectable["fraction"] == pytest.approx(visible * 0.05 * 0.3)
    assert (found.degrees, found.shape, found.evidence) == (1, {"decay": 0.11}, 30)
    retro = effect_of("retroreflection", SCAN)
    step = torch.tensor([-1.0, 0.5, 2.0])
    found = _screened(Candidate(retro, 9.0, 0.4, 1.0, {}, step, torch.ones(3), 9.0), 8.3)
    scale = {p.name: p.scale for p in retro.amplitudes}
    assert found.one_step == pytest.approx(
        {
            "falloff": 4 - scale["falloff"],
            "cosine": 1 + 0.5 * scale["cosine"],
            "entrance": 2 * scale["entrance"],
        }
    )
    drift = effect_of("power_drift", SCAN)
    found = _screened(
        Candidate(drift, 30.0, 0.4, 1.0, {}, 2 * torch.ones(23), torch.full((23,), 0.2), 30.0), 8.3
    )
    assert found.one_step["drift"] == pytest.approx(0.05 * 2)
    # k coefficients that are alike need a k-th of the evidence each; those that nothing settles say nothing.
    k = drift.declared["drift"].size
    visible = visible_score(8.3 / k) + 1.2816 / k**0.5
    rms = float(drift.functions.square().sum(1).mean()) ** 0.5
    assert k > 5
    for known in (k, 5):
        error = torch.full((k,), 0.2)
        error[known:] = 1e6
        found = _screened(Candidate(drift, 30.0, 0.4, 1.0, {}, 2 * torch.ones(k), error, 30.0), 8.3)
        by_hand = visible * 0.05 * 0.2 * (k / known) ** 0.5 * rms
        assert found.detectable == {"rms": pytest.approx(by_hand, rel=0.1)}
    hot = effect_of("hot_spots", SCAN)
    error = torch.tensor([float("nan"), 2.0, 2.0])
    found = _screened(Candidate(hot, 9.0, 1.0, 1.0, {}, torch.zeros(3), error, 9.0), 8.3)
    assert (found.degrees, found.one_step) == (2, {})
    visible = visible_score(8.3) + 1.2816
    assert found.detectable["extra"] == pytest.approx(visible * hot.declared["extra"].scale * 2)


def test_shapes_of_free_terms_by_hand():
    """One coefficient each, and what it does along its axis."""
    scene = capture_of(raster(16), scan_order=np.arange(256))
    scan = Scan.of(scene)

    def shape(name: str, k: int, value: float):
        effect = effect_of(name, scan)
        values = torch.zeros(effect.declared["field"].size)
        values[k] = value
        effect.set("field", values)
        return effect, shape_of(effect, scan)

    _, time = shape("free_time", 10, 0.3)
    assert (time.axis, time.unit, len(time.edges), len(time.values)) == ("time", "1", 59, 58)
    assert np.flatnonzero(time.values).tolist() == [10]
    assert time.values.max() == pytest.approx(0.3)
    _, late = shape("free_scan_delay", 1, 0.01)  # one wave, of mean square 1, seen in stretches of four spots
    assert (late.axis, late.unit, len(late.edges), len(late.values)) == ("scan", "m", 65, 64)
    passed = (np.arange(64) + 0.5) / 64
    wave = 0.01 * 2**0.5 * np.cos(2 * np.pi * passed)
    assert np.sign(late.values[0]) * late.values == pytest.approx(wave, abs=3e-4)
    _, rate = shape("free_rate", 0, 0.2)
    assert rate.edges[[0, -1]] == pytest.approx(scan.mean_counts * np.exp([-2, 2]))
    assert rate.values.tolist() == pytest.approx([0.2, *[0.0] * 9])
    lines, wall = shape("free_lines", 0, 0.2)  # the first rows of x
    assert wall.values.shape == (SIDE, SIDE)
    assert wall.edges[0] == pytest.approx(-0.3)
    assert wall.edges_y[-1] == pytest.approx(0.35)
    assert np.nanmax(wall.values[SIDE // 2 :]) == 0
    assert np.nanmean(wall.values[0]) == pytest.approx(0.2)
    assert lines.values().shape == (256,)
    _, both = shape("free_response_scan", 1, 0.1)
    assert both.axis == "time×scan"
    assert both.values.shape == (len(both.edges) - 1, len(both.edges_y) - 1)
    assert np.abs(both.values[0]).max() > 0
    later = np.broadcast_to(-both.values[0] / 15, both.values[8:].shape)
    assert both.values[8:] == pytest.approx(later, rel=1e-4), "the first sixteenth of the scan, less the mean"
