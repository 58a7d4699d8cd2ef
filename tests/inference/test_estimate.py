"""Parameters of accepted effects and their errors, against dense algebra and by hand; what the diagnosis
makes of them.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, scattered, surfels
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.assemble import _screened, alternatives, judge, weighed
from nlos_lit.inference.criticise import CriticismSettings, Findings, Trial, Turn
from nlos_lit.inference.discrepancy import Discrepancy
from nlos_lit.inference.form import Form
from nlos_lit.inference.problem import build_problem, weighted_columns
from nlos_lit.inference.refit import Comparison
from nlos_lit.inference.screen import Candidate
from nlos_lit.inference.toys import Null
from nlos_lit.inference.uncertainty import Uncertainty
from nlos_lit.surfels.fit import SurfelFit

SCAN = Scan.of(capture_of(scattered(12)))


def known(effects: list[Effect], covariance: Tensor) -> Uncertainty:
    found = object.__new__(Uncertainty)
    found.effects, found.covariance, found.fitted = effects, covariance.double(), 0.75
    return found


def test_delta_method_by_hand():
    """Amplitude √(sine² + cosine²) of 3 and 4 steps of 0.02: slopes 0.02 · (0.6, 0.8); period P = e^{0.01
    raw}: slope 0.01 P.

    Small errors, so that nothing bends.
    """
    ripple = effect_of("tcspc_nonlinearity", SCAN, sine=0.06, cosine=0.08, period=10.0)
    slope = effect_of("background_slope", SCAN, slope=0.2)
    covariance = torch.diag(torch.tensor([9.0, 1.0, 4.0, 0.25]))
    covariance[1, 2] = covariance[2, 1] = -1.0
    covariance *= 1e-5
    found = known([slope, ripple], covariance).parameters(ripple)
    variance = 1e-5 * 0.02**2 * (0.36 * 1 + 0.64 * 4 + 2 * 0.6 * 0.8 * -1)
    assert found["amplitude"].value == pytest.approx(0.1, rel=1e-3)
    assert found["amplitude"].stderr == pytest.approx(variance**0.5, rel=3e-3)
    assert found["period"].stderr == pytest.approx(1e-5**0.5 * 0.01 * 10 * 0.5, rel=3e-3)
    assert (found["amplitude"].unit, found["period"].unit) == ("1", "bins")
    own = known([slope, ripple], covariance).parameters(slope)
    assert own["slope"].value == pytest.approx(0.2)
    assert own["slope"].stderr == pytest.approx(1e-5**0.5 * 0.05 * 3, rel=1e-3)


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
    assert found.stderr == pytest.approx(scale * ((45**0.5 - 3) ** 2 / 9 + 0.01) ** 0.5, rel=1e-3)


def test_a_parameter_that_comes_back_elsewhere_is_unsure():
    """Errors of 0.3 from the counts, and of 0.4 from a fit from new seeds."""
    slope, again = (effect_of("background_slope", SCAN, slope=value) for value in (0.2, -0.2))
    scale = slope.declared["slope"].scale
    known_slope = known([slope], torch.tensor([[(0.3 / scale) ** 2]]))
    assert known_slope.parameters(slope)["slope"].stderr == pytest.approx(0.3, rel=1e-4)
    assert known_slope.parameters(slope, again)["slope"].stderr == pytest.approx(0.5, rel=1e-4)


def test_a_width_is_as_certain_as_its_spots_are_many():
    """Jitter of 8 solved spots of 12: σ/√16."""
    offset = torch.zeros(12)
    offset[:8] = 0.01 * torch.tensor([1.0, -1, 1, -1, 1, -1, 1, -1])
    jitter = effect_of("timing_jitter", SCAN, offset=offset)
    found = known([], torch.zeros(0, 0)).parameters(jitter)["sigma"]
    assert found.value == pytest.approx(0.01, rel=1e-3)
    assert found.stderr == pytest.approx(0.01 / 4, rel=1e-3)


def test_hot_spots_are_counted_for_the_whole_scan():
    """Nine of 2 counts a bin among the fitted three quarters: twelve ± √9/0.75; their level is 2."""
    extra = torch.zeros(12)
    extra[:9] = 2.0
    found = known([], torch.zeros(0, 0)).parameters(effect_of("hot_spots", SCAN, extra=extra))
    assert (found["number"].value, found["number"].stderr) == (pytest.approx(12), pytest.approx(4))
    assert (found["level"].value, found["level"].stderr) == (pytest.approx(2), pytest.approx(2 / 18**0.5))


def accepted_fit(factor: float = 1.0, seed: int | None = 0) -> tuple[SurfelFit, Tensor, Tensor]:
    """64 spots in 16 blocks with a gain and pile-up at their true values; counts drawn, or exactly expected
    with no seed.
    """
    scene = capture_of(raster(8))
    model, scan = surfels(scene, level=40.0), Scan.of(scene)
    extension = Extension(
        [effect_of("vignetting", scan, strength=0.3), effect_of("pile_up", scan, detections=0.3)]
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


def dense(fit: SurfelFit, spots: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Effects' block of the inverse of the whole information matrix; their columns and the residual off the
    nuisance.
    """
    problem = build_problem(fit.model, fit.extension, spots, fit.counts, with_effects=False)
    z = torch.cat([weighted_columns(problem, e) for e in fit.extension.effects], 1).double()
    x = problem.nuisance.double()
    both = torch.cat([x, z], 1)
    information = both.T @ both
    information += torch.diag(torch.cat([problem.prior.double(), torch.zeros(2)]))
    inverse = torch.linalg.inv(information)[-2:, -2:]
    lean = torch.linalg.solve(
        information[:-2, :-2], x.T @ torch.cat([z, problem.residual.double()[:, None]], 1)
    )
    off = torch.cat([z, problem.residual.double()[:, None]], 1) - x @ lean
    return inverse, off[:, :2], off[:, 2]


@FORWARD_MODE
def test_covariance_is_the_inverse_of_the_whole_information():
    fit, spots, block = accepted_fit(seed=None)
    found = Uncertainty(fit, spots, fit.counts, block)
    inverse, _, _ = dense(fit, spots)
    assert torch.allclose(found.covariance, inverse, rtol=2e-3)
    estimate = found.parameters(fit.extension.effects[1])["detections"]
    assert estimate.value == pytest.approx(0.3, rel=1e-5)
    assert estimate.stderr == pytest.approx(0.05 * float(inverse[1, 1]) ** 0.5, rel=1e-3)


@FORWARD_MODE
def test_misfit_between_blocks_widens_the_errors():
    """Huber's sandwich on counts whose patches are brighter and darker than the model."""
    fit, spots, block = accepted_fit(factor=0.1)
    found = Uncertainty(fit, spots, fit.counts, block)
    inverse, z, residual = dense(fit, spots)
    by_block = torch.stack(
        [(z * residual[:, None]).view(64, -1, 2)[block == b].sum((0, 1)) for b in range(16)]
    )
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
    """Two hundred draws: one-step estimates scatter as the reported errors say, around the truth."""
    fit, spots, block = accepted_fit(seed=None)
    found = Uncertainty(fit, spots, fit.counts, block)
    _, z, _ = dense(fit, spots)
    expected = fit.counts.double()
    drawn_counts = np.random.default_rng(1).poisson(expected.numpy(), (200, *expected.shape))
    residuals = torch.from_numpy((drawn_counts - expected.numpy()) / np.sqrt(expected.numpy())).reshape(
        200, -1
    )
    steps = residuals @ z @ torch.linalg.inv(z.T @ z)
    error = found.covariance.diagonal().sqrt()
    assert torch.all((steps.std(0) / error - 1).abs() < 4 / 400**0.5)
    assert torch.all(steps.mean(0).abs() < 4 * error / 200**0.5)


def findings(
    gains: list[float], left: list[Discrepancy], had: list[Discrepancy] = (), predicted: float = 0.0
) -> Findings:
    """Effects accepted with ``gains`` nats on 64 select spots, what is left, and a small fit.

    ``had``: what the base left. ``predicted``: nats, by each effect's screening.
    """
    names = ["irf_tail", "pile_up"][: len(gains)]
    effects = [effect_of(n, SCAN) for n in names]
    final = SimpleNamespace(extension=Extension(effects), model=range(12), counts=torch.zeros(160, 58))
    turns = [
        Turn(
            [],
            had,
            [],
            Trial(
                Candidate(e, 0, 0, 0, predicted, None, None, {}, None), None, Comparison(g, 1, (0, 0)), None
            ),
            [],
        )
        for e, g in zip(effects, gains, strict=True)
    ]
    return Findings(final, final, [*turns, Turn([], left, [], None, [])])


SPLIT = SimpleNamespace(fit=np.arange(160), select=np.arange(64))


def discrepancy(axis: str, gain: float, p: float = 1e-9) -> Discrepancy:
    return Discrepancy(axis, gain, 2 * gain, 40, p)


def test_what_is_left_is_flagged_or_not():
    calm = [
        discrepancy("time", 20),
        discrepancy("wall", 3),
        discrepancy("scan", 90, p=3e-4),
        discrepancy("rate", -5),
    ]
    said = judge(findings([], calm), SPLIT, CriticismSettings())
    assert not said.unexplained.significant  # time gains too little; scan's p-value is 1.2e-3 over four axes
    assert said.unexplained.axis == "scan"
    loud = [discrepancy("time", 30), discrepancy("wall", 200), *calm[2:]]
    said = judge(findings([], loud), SPLIT, CriticismSettings())
    assert said.unexplained.significant
    assert (said.unexplained.axis, said.unexplained.statistic) == ("wall", 400)
    assert not said.dominates, "nothing was named"


@pytest.mark.parametrize(
    ("axis", "gain", "said"), [("time", 200, "wall"), ("time", 20, "time"), ("rate", 200, "rate")]
)
def test_what_was_taken_back_is_unexplained_where_most_was_left(axis, gain, said):
    """Beside 200 nats along the wall, or nothing; a map that follows the count rate says so itself."""
    found = findings([], [discrepancy("wall", gain)])
    taken_back = Turn([], [], [], None, [], form=Form("specular_lobe", 900.0, 1000.0, 1800.0, 0.0, axis))
    left = judge(
        Findings(found.base, found.final, [*found.turns, taken_back]), SPLIT, CriticismSettings()
    ).unexplained
    assert left.significant
    assert left.axis == said


def test_names_fall_where_more_is_left_than_they_explain():
    """32 + 32 nats on 64 select spots are one a spot; of 160 tested ones 70 nats are left, or 90."""
    for gain, dominates in ((70, False), (90, True)):
        said = judge(findings([32.0, 32.0], [discrepancy("time", gain)]), SPLIT, CriticismSettings())
        assert said.unexplained.significant
        assert said.dominates is dominates
    # Half as many spots tested: what is left counts twice.
    assert judge(
        findings([32.0, 32.0], [discrepancy("time", 50)]), SPLIT, CriticismSettings(spots=80)
    ).dominates
    # Names must explain three quarters: three times as much.
    assert judge(
        findings([32.0, 32.0], [discrepancy("time", 60)]), SPLIT, CriticismSettings(explained=0.75)
    ).dominates


def test_names_fall_where_they_leave_much_of_their_own_kind():
    """Two effects, predicted to gain 100 nats each on 160 tested spots, that gained ten times as much as they
    left.
    """
    left = [discrepancy("scan", 100), discrepancy("time", 40)]
    for scan, dominates in (
        (270, True),
        (330, False),
        (180, False),
    ):  # leave 37, 30 %; only 80 of 400 nats are of this kind
        had = [discrepancy("time", 500), discrepancy("scan", scan)]
        said = judge(
            findings([320.0, 320.0], left, had, 100.0 if scan > 200 else 200.0), SPLIT, CriticismSettings()
        )
        assert said.unexplained.axis == "scan"
        assert said.dominates is dominates
    # Delays that neighbours share are another kind than gains, on the same axis.
    had = [Discrepancy("scan", 270, 540, 64, 0.0, "timing_jitter"), discrepancy("scan", 90)]
    assert not judge(findings([320.0, 320.0], left, had, 100.0), SPLIT, CriticismSettings()).dominates


def test_toys_speak_against_what_theory_lets_pass():
    """A tail of statistic 30: theory says 1e-6, toys of 25 ± 5 say 0.16. What theory had not asked for they
    cannot take back.
    """
    found = Candidate(effect_of("irf_tail", SCAN), 30.0, 1e-6, 0.4, 12.0, None, None, {}, None)
    assert weighed(found, None, 1e-3) == (1e-6, False)
    p, feigned = weighed(found, Null(40, {"irf_tail": (25.0, 25.0)}, []), 1e-3)
    assert p == pytest.approx(0.159, abs=0.01)
    assert feigned
    assert weighed(found, Null(40, {"irf_tail": (2.0, 4.0)}, []), 1e-3) == (1e-6, False)
    rebuilt = Candidate(effect_of("specular_lobe", SCAN), 3.0, 0.4, 0.4, 12.0, None, None, {}, None)
    assert weighed(rebuilt, Null(40, {"specular_lobe": (3.0, 4.0)}, []), 1e-3)[1] is False


def test_what_is_needed_beside_an_effect_is_no_other_name_for_it():
    def turn(name: str, group: list[str]) -> Turn:
        accepted = Trial(
            Candidate(effect_of(name, SCAN), 0, 0, 0, 0, None, None, {}, None),
            None,
            Comparison(1, 1, (0, 0)),
            None,
        )
        return Turn([], [], [], accepted, group)

    both = [turn("afterpulsing", ["ambient_map", "irf_tail"]), turn("ambient_map", ["afterpulsing"])]
    assert [alternatives(t, both) for t in both] == [["irf_tail"], []]


def test_screened_in_units_of_the_parameters():
    tail = effect_of("irf_tail", SCAN, decay=0.11)
    found = _screened(
        Candidate(
            tail, 30.0, 1e-6, 0.4, 12.0, torch.tensor([2.0]), torch.tensor([0.3]), {"decay": 0.11}, None
        ),
        None,
    )
    assert found.one_step["fraction"] == pytest.approx(0.1)
    assert found.detectable["fraction"] == pytest.approx(
        5 * 0.05 * 0.3
    )  # statistic 25 = five standard errors
    assert (found.degrees, found.shape) == (1, {"decay": 0.11})
    retro = effect_of("retroreflection", SCAN)
    found = _screened(
        Candidate(retro, 9.0, 0.1, 0.4, 1.0, torch.tensor([-1.0, 0.5]), torch.ones(2), {}, None), None
    )
    scale = {p.name: p.scale for p in retro.amplitudes}
    assert found.one_step == pytest.approx(
        {"falloff": 4 - scale["falloff"], "cosine": 1 + 0.5 * scale["cosine"]}
    )
    drift = effect_of("power_drift", SCAN)
    null = Null(40, {"power_drift": (10.0, 20.0)}, [])
    candidate = Candidate(
        drift, 30.0, 1e-6, 0.4, 12.0, torch.tensor([1.0, 2, 0, 2, 0]), torch.full((5,), 0.2), {}, None
    )
    found = _screened(candidate, null)
    assert found.one_step["drift"] == pytest.approx(0.05 * (9 / 5) ** 0.5)
    assert found.p_value == pytest.approx(null.p_value(candidate))
    assert found.expected == 10, "toys show twice its degrees of freedom"
    hot = effect_of("hot_spots", SCAN)
    error = torch.tensor([float("nan"), 2.0, 2.0])
    found = _screened(Candidate(hot, 9.0, 0.1, 1.0, 1.0, torch.zeros(3), error, {}, None), None)
    assert (found.degrees, found.expected, found.one_step) == (2, 2, {})
    assert found.detectable["extra"] == pytest.approx(5 * hot.declared["extra"].scale * 2)
