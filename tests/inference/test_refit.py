"""Comparing fits on spots that they did not see, and choosing between them."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from inference_scenes import (
    BLOCK,
    FORWARD_MODE,
    candidate,
    capture_of,
    drawn,
    effect_of,
    fit_of,
    per_spot,
    raster,
    scattered,
    surfels,
    uneven,
)  # fmt: skip
from scipy import stats
from scipy.special import gammaln
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.criticise import (
    CriticismSettings,
    Trial,
    best_of_each,
    choose,
    group_of,
    needed,
    significant,
)
from nlos_lit.inference.joint_step import null_of, set_step
from nlos_lit.inference.refit import Comparison, compare, log_likelihood, refit_with, score
from nlos_lit.inference.screen import Candidate
from nlos_lit.model.parameters import BoundedParameter

SCAN = Scan.of(capture_of(scattered(12)))


def trial(name: str, likelihood: Tensor, gain: float, **options) -> Trial:
    return Trial(candidate(name, **options), None, Comparison(gain, 1.0, (gain - 2, gain + 2)), likelihood)


def test_comparison_by_hand():
    """Blocks gain 3, -1 and 4: six nats. Of a resampled sum of three the variance is three times that of the
    blocks.
    """
    before = torch.tensor([1.0, 1, 1, 1, 1, 1], dtype=torch.float64)
    after = before + torch.tensor([1.0, -1, 2, 4, 0.5, -0.5])
    found = compare(before, after, np.array([7, 3, 7, 9, 9, 9]))
    assert found.nats == pytest.approx(6)
    assert found.error == pytest.approx((3 * np.var([3, -1, 4])) ** 0.5, rel=0.15)
    assert -3 <= found.interval[0] < 0
    assert 10 < found.interval[1] <= 12
    assert compare(after, before, np.array([7, 3, 7, 9, 9, 9])).nats == pytest.approx(-6)


def test_comparison_is_paired_and_by_blocks():
    """What both have in common cancels; spots of one block are not independent."""
    common, gain = per_spot(0, 50, seed=3), per_spot(0.5, 1.0, seed=4)
    found = compare(common, common + gain, BLOCK)
    assert found.nats == pytest.approx(60)
    # Blocks gain 1.5 ± 3: the sum over forty has an error of 3 √40 = 19; single spots as units would say 11.
    assert found.error == pytest.approx(3 * 40**0.5, rel=0.12)
    low, high = stats.norm.interval(0.95, 60, found.error)
    assert found.interval == pytest.approx((low, high), abs=0.4 * found.error)
    even = compare(common, common + 0.5, BLOCK)
    assert even.interval == pytest.approx((60, 60))


def test_log_likelihood_and_scores_by_hand():
    scene = capture_of(scattered(6))
    model = surfels(scene)
    measured = drawn(model, Extension([]), scene)
    fit, spots = fit_of(model, measured), np.array([4, 1])
    expected = model.expected(torch.from_numpy(spots)).double().numpy()
    counts = measured.counts[spots, 6:].astype(float)
    ours = log_likelihood(fit, spots).numpy()
    assert ours == pytest.approx(
        (stats.poisson.logpmf(counts, expected) + gammaln(counts + 1)).sum(1), rel=1e-6
    )
    found = score(fit, spots)
    deviance = 2 * (
        stats.poisson.logpmf(counts, np.maximum(counts, 1e-12)) - stats.poisson.logpmf(counts, expected)
    )
    assert found.deviance_per_bin == pytest.approx(deviance.mean(), rel=1e-5)
    assert found.nmse == pytest.approx(((counts - expected) ** 2).sum() / (counts**2).sum(), rel=1e-5)
    assert found.nmse_noise_floor == pytest.approx(counts.sum() / (counts**2).sum(), rel=1e-5)


def test_a_step_moves_all_amplitudes_in_order():
    ripple = effect_of("tcspc_nonlinearity", SCAN, sine=0.02, period=7.0)
    set_step(ripple, torch.tensor([0.5, -2.0]))
    assert [round(ripple.value(n).item(), 5) for n in ("sine", "cosine", "period")] == [0.03, -0.04, 7.0]
    drift = effect_of("power_drift", SCAN)
    set_step(drift, torch.tensor([1.0, 2, 3, 4, 100]))
    assert drift.value("drift").tolist() == pytest.approx(
        [0.05, 0.1, 0.15, 0.2, 1.5]
    )  # the last kept within its bounds


def test_fewest_parameters_win_a_tie():
    """One parameter, half a nat behind thirty: the same within its error. Ten nats behind with little
    scatter: not.
    """
    best = per_spot(2.0, 0.5)
    wide = trial("wall_reflectance", best, 240)
    near = trial("vignetting", best - per_spot(0.02, 0.1, seed=1), 237.6)
    far = trial("time_offset", best - per_spot(0.1, 0.01, seed=2), 228)
    assert len(wide.candidate.step) > 5
    assert choose([wide, near, far], BLOCK) is near
    assert choose([wide, far], BLOCK) is wide
    # A hundredth of a large gain is no reason for more parameters.
    small = trial("vignetting", best - per_spot(0.03, 0.001, seed=1), 236.4)
    assert choose([wide, small], BLOCK) is small
    # Nor are spots that settle little, where the many fitted ones say more.
    assert (
        choose([replace(wide, predicted=100.0), replace(near, predicted=50.0), far], BLOCK).name
        == "wall_reflectance"
    )
    assert (
        choose([replace(wide, predicted=100.0), replace(near, predicted=99.0), far], BLOCK).name
        == "vignetting"
    )
    # A number a spot counts as two: width and share.
    jitter = trial("timing_jitter", best, 240)
    assert choose([wide, jitter, replace(near, likelihood=best - 1)], BLOCK) is jitter


def test_the_best_of_bad_rivals_is_chosen():
    """None gains anything, as can happen where a base is far off: it is the caller's to refuse."""
    worst, bad = (trial(n, per_spot(0, 0.5) - k, -120.0 * k) for n, k in (("irf_tail", 2), ("occlusion", 1)))
    assert choose([bad, worst], BLOCK) is bad


def test_group_has_what_the_capture_cannot_tell_apart():
    best = trial("irf_tail", per_spot(2.0, 0.5), 240)
    same = trial(
        "afterpulsing",
        best.likelihood - per_spot(0.02, 0.1, seed=1),
        237.6,
        direction=torch.tensor([1.0, 0, 0, 0]),
    )
    alike = trial(
        "ghost_pulse",
        best.likelihood - per_spot(0.8, 0.01),
        144,
        direction=-torch.tensor([0.6, 0.6, 0.4, 0.35]),
    )
    worse = trial("direct_leak", best.likelihood - per_spot(1.2, 0.01), 96)
    other = trial(
        "gate_edges", best.likelihood - per_spot(0.8, 0.01), 144, direction=torch.tensor([1.0, 0, 0, 0])
    )
    assert group_of(best, [best, same, alike, worse, other], BLOCK, 0.9) == ["afterpulsing", "ghost_pulse"]
    assert group_of(best, [best, same, alike, worse, other], BLOCK, 0.99) == ["afterpulsing"]


def test_significance_is_holms():
    """Level 1e-3 over four: 2e-4·4 passes, 5e-4·3 does not, nor what follows, though 6e-4·1 would."""
    settings = CriticismSettings()
    four = [("irf_tail", 2e-4), ("pile_up", 5e-4), ("vignetting", 5.5e-4), ("time_offset", 6e-4)]
    candidates = [candidate(name, p) for name, p in reversed(four)]
    assert [c.effect.name for c in significant(candidates, settings, 0.0)] == ["irf_tail"]
    candidates = [
        candidate(name, 2e-4 * k) for k, (name, _) in enumerate(four, 1)
    ]  # 8, 12, 12, 8: the second fails
    assert [c.effect.name for c in significant(candidates, settings, 0.0)] == ["irf_tail"]
    candidates = [
        candidate(name, 1e-4 * k) for k, (name, _) in enumerate(four, 1)
    ]  # 4, 6, 6, 4 in 1e-4: all pass
    assert len(significant(candidates, settings, 0.0)) == 4


def test_what_is_significant_must_gain_enough():
    """25 nats for what moves or scales the light, as the base's own errors do; 15 for all others; more of a
    rebuilt scene where little is retained.
    """
    settings = CriticismSettings()
    few = [
        candidate("vignetting", gain=26),
        candidate("power_drift", gain=24),
        candidate("time_offset", gain=40, retained=0.0025),
    ]
    assert [c.effect.name for c in significant(few, settings, 0.0)] == ["vignetting", "time_offset"]
    counted = [
        candidate("irf_tail", gain=16),
        candidate("pile_up", gain=14),
        candidate("higher_order_bounces", gain=16),
    ]
    assert [c.effect.name for c in significant(counted, settings, 0.0)] == [
        "irf_tail",
        "higher_order_bounces",
    ]
    assert needed(few[2], settings, 0.0) == 25
    assert needed(few[2], settings, 0.0, rebuilt=True) == pytest.approx(25 * 4)  # a quarter of WELL retained
    assert needed(few[2], settings, 6000.0, rebuilt=True) == pytest.approx(120)
    assert needed(few[0], settings, 1350.0) == pytest.approx(27)  # 2 % of the misfit
    assert significant(few + counted, settings, 2050.0) == []


def test_the_better_trial_of_an_effect_stands_for_it():
    nothing = torch.zeros(120)
    trials = [trial("irf_tail", nothing, 10), trial("pile_up", nothing, 30), trial("irf_tail", nothing, 50)]
    assert [(t.name, t.gain.nats) for t in best_of_each(trials)] == [("irf_tail", 50), ("pile_up", 30)]


def test_null_keeps_the_shape():
    tail = effect_of("irf_tail", SCAN, fraction=0.3, decay=0.11)
    copied = null_of(tail)
    assert copied.value("fraction").item() == 0
    assert copied.value("decay").item() == pytest.approx(0.11)
    assert tail.value("fraction").item() == pytest.approx(0.3)


@FORWARD_MODE
def test_a_refit_begins_at_the_step_and_leaves_the_fit_alone():
    scene = capture_of(raster(8))
    model, scan = surfels(scene, level=20.0), Scan.of(scene)
    measured = drawn(model, Extension([effect_of("vignetting", scan, strength=0.4)]), scene)
    fit = fit_of(model, measured)
    fit.settings = replace(fit.settings, visibility=False)
    before = copy.deepcopy(model.state_dict())
    one = Candidate(
        effect_of("vignetting", scan), 0, 0, 1, 0, torch.tensor([8.0]), torch.ones(1), {}, torch.ones(1)
    )
    again = refit_with(fit, [one], 15, seed=0)
    assert again.extension.effects[0].value("strength").item() == pytest.approx(0.4, abs=0.05)
    assert one.effect.value("strength").item() == 0
    assert not len(fit.extension.effects)
    assert all(
        torch.equal(value, before[name])
        for name, value in model.state_dict().items()
        if name != "_extra_state"
    )
    control = refit_with(fit, [], 15, seed=0)
    rows = np.arange(64)
    assert compare(log_likelihood(control, rows), log_likelihood(again, rows), rows).interval[0] > 0


@pytest.mark.parametrize(
    "name", [None, "afterpulsing", "direct_leak", "background_slope", "ambient_map", "gate_edges", "pile_up"]
)
def test_a_rebuild_begins_at_the_right_brightness(name):
    """Seeds have an intensity of 1, so that at first the background is all: what an effect makes of it is no
    light of the scene.
    """
    scene = capture_of(raster(12))
    values = {"gate_edges": {"start": 0.5, "end": 0.5, "width": 20.0}, "pile_up": {"detections": 0.1}}
    effects = [] if name is None else [uneven(effect_of(name, Scan.of(scene), **values.get(name, {})))]
    model = surfels(scene)
    fit = fit_of(model, drawn(model, Extension(effects), scene, 7), Extension(effects))
    true = model.laser_sensor.intensity().item()
    model.laser_sensor.intensity = BoundedParameter(1.0, 1e-3, 1e3, "counts m2")
    fit.match_energy()
    # Pile-up and the gate's edges take some of the light, which the start does not know of.
    assert model.laser_sensor.intensity().item() == pytest.approx(
        true, rel=0.35 if name in ("pile_up", "gate_edges") else 0.05
    )
