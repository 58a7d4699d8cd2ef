"""Comparing fits on spots that they did not see, and choosing between them."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from criticism_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, scattered, surfels
from scipy import stats
from scipy.special import gammaln
from torch import Tensor

from nlos_lit.criticism import criticise as loop
from nlos_lit.criticism import needless
from nlos_lit.criticism.criticise import (
    CriticismSettings,
    Findings,
    Look,
    Trial,
    Turn,
    best_of_each,
    choose,
    criticise,
    group_of,
    needed,
    significant,
)
from nlos_lit.criticism.form import Form
from nlos_lit.criticism.joint_step import null_of, set_step
from nlos_lit.criticism.needless import drop_needless
from nlos_lit.criticism.refit import Comparison, compare, log_likelihood, refit_with, score
from nlos_lit.criticism.screen import Candidate
from nlos_lit.criticism.steps import Steps
from nlos_lit.effects import Extension, Scan

SCAN = Scan.of(capture_of(scattered(12)))
BLOCK = np.repeat(np.arange(40), 3)


def candidate(name: str, p_value: float = 1e-9, gain: float = 100.0, retained: float = 0.5, direction: Tensor | None = None):
    effect = effect_of(name, SCAN)
    size = sum(p.size for p in effect.amplitudes)
    direction = torch.ones(4) / 2 if direction is None else direction
    return Candidate(effect, 2 * gain, p_value, retained, gain, torch.zeros(size), torch.ones(size), {}, direction)


def trial(name: str, likelihood: Tensor, gain: float, **options) -> Trial:
    return Trial(candidate(name, **options), None, Comparison(gain, 1.0, (gain - 2, gain + 2)), likelihood)


def per_spot(mean: float, scatter: float, seed: int = 0) -> Tensor:
    """Log-likelihoods of 120 spots that are ``mean`` each on average, exactly, and scatter from block to block."""
    values = np.repeat(np.random.default_rng(seed).standard_normal(40), 3)
    return torch.from_numpy(mean + scatter * (values - values.mean()) / values.std())


def test_comparison_by_hand():
    """Blocks gain 3, -1 and 4: six nats. Of a resampled sum of three the variance is three times that of the blocks."""
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
    assert ours == pytest.approx((stats.poisson.logpmf(counts, expected) + gammaln(counts + 1)).sum(1), rel=1e-6)
    found = score(fit, spots)
    deviance = 2 * (stats.poisson.logpmf(counts, np.maximum(counts, 1e-12)) - stats.poisson.logpmf(counts, expected))
    assert found.deviance_per_bin == pytest.approx(deviance.mean(), rel=1e-5)
    assert found.nmse == pytest.approx(((counts - expected) ** 2).sum() / (counts**2).sum(), rel=1e-5)
    assert found.nmse_noise == pytest.approx(counts.sum() / (counts**2).sum(), rel=1e-5)


def test_a_step_moves_all_amplitudes_in_order():
    ripple = effect_of("tcspc_nonlinearity", SCAN, sine=0.02, period=7.0)
    set_step(ripple, torch.tensor([0.5, -2.0]))
    assert [round(ripple.value(n).item(), 5) for n in ("sine", "cosine", "period")] == [0.03, -0.04, 7.0]
    drift = effect_of("power_drift", SCAN)
    set_step(drift, torch.tensor([1.0, 2, 3, 4, 100]))
    assert drift.value("drift").tolist() == pytest.approx([0.05, 0.1, 0.15, 0.2, 1.5])  # the last kept within its bounds


def test_fewest_parameters_win_a_tie():
    """One parameter, half a nat behind thirty: the same within its error. Ten nats behind with little scatter: not."""
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
    assert choose([replace(wide, predicted=100.0), replace(near, predicted=50.0), far], BLOCK).name == "wall_reflectance"
    assert choose([replace(wide, predicted=100.0), replace(near, predicted=99.0), far], BLOCK).name == "vignetting"
    # A number a spot counts as two: width and share.
    jitter = trial("timing_jitter", best, 240)
    assert choose([wide, jitter, replace(near, likelihood=best - 1)], BLOCK) is jitter


def test_the_best_of_bad_rivals_is_chosen():
    """None gains anything, as can happen where a base is far off: it is the caller's to refuse."""
    worst, bad = (trial(n, per_spot(0, 0.5) - k, -120.0 * k) for n, k in (("irf_tail", 2), ("occlusion", 1)))
    assert choose([bad, worst], BLOCK) is bad


def test_group_has_what_the_capture_cannot_tell_apart():
    best = trial("irf_tail", per_spot(2.0, 0.5), 240)
    same = trial("afterpulsing", best.likelihood - per_spot(0.02, 0.1, seed=1), 237.6, direction=torch.tensor([1.0, 0, 0, 0]))
    alike = trial("ghost_pulse", best.likelihood - per_spot(0.8, 0.01), 144, direction=-torch.tensor([0.6, 0.6, 0.4, 0.35]))
    worse = trial("direct_leak", best.likelihood - per_spot(1.2, 0.01), 96)
    other = trial("gate_edges", best.likelihood - per_spot(0.8, 0.01), 144, direction=torch.tensor([1.0, 0, 0, 0]))
    assert group_of(best, [best, same, alike, worse, other], BLOCK, 0.9) == ["afterpulsing", "ghost_pulse"]
    assert group_of(best, [best, same, alike, worse, other], BLOCK, 0.99) == ["afterpulsing"]


def test_significance_is_holms():
    """Level 1e-3 over four: 2e-4·4 passes, 5e-4·3 does not, and nothing after it does, though 6e-4·1 would."""
    settings = CriticismSettings()
    four = [("irf_tail", 2e-4), ("pile_up", 5e-4), ("vignetting", 5.5e-4), ("time_offset", 6e-4)]
    candidates = [candidate(name, p) for name, p in reversed(four)]
    assert [c.effect.name for c in significant(candidates, settings, 0.0)] == ["irf_tail"]
    candidates = [candidate(name, 2e-4 * k) for k, (name, _) in enumerate(four, 1)]  # 8, 12, 12, 8: the second fails
    assert [c.effect.name for c in significant(candidates, settings, 0.0)] == ["irf_tail"]
    candidates = [candidate(name, 1e-4 * k) for k, (name, _) in enumerate(four, 1)]  # 4, 6, 6, 4 in 1e-4: all pass
    assert len(significant(candidates, settings, 0.0)) == 4


def test_what_is_significant_must_gain_enough():
    settings = CriticismSettings()
    few = [candidate("irf_tail", gain=26), candidate("pile_up", gain=24), candidate("time_offset", gain=40, retained=0.0025)]
    assert [c.effect.name for c in significant(few, settings, 0.0)] == ["irf_tail"]
    assert needed(few[2], settings, 0.0) == pytest.approx(25 * 2)  # a quarter of WELL retained: twice as much
    assert needed(few[0], settings, 1350.0) == pytest.approx(27)  # 2 % of the misfit
    assert significant(few, settings, 1350.0) == []


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
    one = Candidate(effect_of("vignetting", scan), 0, 0, 1, 0, torch.tensor([8.0]), torch.ones(1), {}, torch.ones(1))
    again = refit_with(fit, [one], 15, seed=0)
    assert again.extension.effects[0].value("strength").item() == pytest.approx(0.4, abs=0.05)
    assert one.effect.value("strength").item() == 0
    assert not len(fit.extension.effects)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items() if name != "_extra_state")
    control = refit_with(fit, [], 15, seed=0)
    rows = np.arange(64)
    assert compare(log_likelihood(control, rows), log_likelihood(again, rows), rows).interval[0] > 0


class FakeFit:
    """Stands for a fit: its log-likelihood is a table's entry for its effects."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.extension = Extension([effect_of(n, SCAN) for n in names])

    def copy(self, extension: Extension, seed: int) -> FakeFit:
        return FakeFit(tuple(e.name for e in extension.effects))

    def run(self, *_, **__) -> None:
        pass

    @property
    def names(self) -> frozenset[str]:
        return frozenset(e.name for e in self.extension.effects)


SPLIT = SimpleNamespace(select=np.arange(120), fit=np.arange(300), block=BLOCK)


def with_table(monkeypatch, table: dict[str, float]) -> None:
    """``table``: what each effect is worth, nats a spot, with some scatter."""
    monkeypatch.setattr(needless, "refit_with", lambda fit, *_: fit)

    def likelihood(fit: FakeFit, spots: np.ndarray) -> Tensor:
        return per_spot(0, 1) + sum(per_spot(table[n], 0.1) for n in sorted(fit.names))

    monkeypatch.setattr(needless, "log_likelihood", likelihood)


def test_needless_effects_are_dropped(monkeypatch):
    with_table(monkeypatch, {"irf_tail": 2.0, "afterpulsing": 0.001, "pile_up": -0.5})
    said = []
    steps = Steps(lambda text, *_: said.append(text))
    kept = drop_needless(FakeFit(("irf_tail", "afterpulsing", "pile_up")), SPLIT, 60, 0, steps)
    assert kept.names == {"irf_tail"}
    without = [text for text in said if "without" in text]
    assert len(without) == 5  # three, then two; a single effect was compared with none when it was accepted


def test_needed_effects_stay(monkeypatch):
    with_table(monkeypatch, {"irf_tail": 2.0, "pile_up": 0.3})
    fit = FakeFit(("irf_tail", "pile_up"))
    assert drop_needless(fit, SPLIT, 60, 0, Steps()) is fit


def test_the_loop_ends_with_nothing_or_with_enough(monkeypatch):
    """Each turn accepts the next effect: at most ``most``, then one last look; dropped ones no longer count as accepted."""
    names = ["irf_tail", "pile_up", "vignetting", "gate_edges"]
    rest = [SimpleNamespace(axis="time")]

    def turn(fit, rebuild, split, scan, s, seed, steps, latest) -> Turn:
        k = len(fit.extension.effects)
        if k == len(accepting):
            return Turn([], [], [], None, [])
        accepted = Trial(candidate(accepting[k]), FakeFit(tuple(accepting[: k + 1])), Comparison(9, 1, (7, 11)), torch.zeros(120))
        return Turn([], [], [accepted], accepted, [])

    monkeypatch.setattr(loop, "turn", turn)
    monkeypatch.setattr(loop, "look", lambda *_: Look([], rest, None))

    def drop(fit: FakeFit, *_: object) -> FakeFit:
        return FakeFit(tuple(n for n in accepting if n in fit.names and n != "pile_up"))

    monkeypatch.setattr(loop, "drop_needless", drop)
    accepting = names
    found = criticise(FakeFit(()), None, SPLIT, SCAN, CriticismSettings(most=3), 0)
    assert [t.accepted and t.accepted.name for t in found.turns] == ["irf_tail", "pile_up", "vignetting", None]
    assert [t.accepted.name for t in found.accepted] == ["irf_tail", "vignetting"]
    assert found.left is rest
    accepting = []
    found = criticise(FakeFit(()), None, SPLIT, SCAN, CriticismSettings(), 0)
    assert isinstance(found, Findings)
    assert found.accepted == []
    assert len(found.turns) == 1


def test_an_effect_of_the_wrong_form_is_taken_back(monkeypatch):
    """The tail stays, the ripple after it goes, and what is left is what was left before the ripple."""
    wrong = Form("tcspc_nonlinearity", 900.0, 1000.0, 1800.0, 0.0)
    names = ["irf_tail", "tcspc_nonlinearity"]
    asked = []

    def turn(fit, rebuild, split, scan, s, seed, steps, latest) -> Turn:
        asked.append(latest)
        k = len(fit.extension.effects)
        if k == 2:
            return Turn([], ["after the ripple"], [], None, [], form=wrong)
        accepted = Trial(candidate(names[k]), FakeFit(tuple(names[: k + 1])), Comparison(9, 1, (7, 11)), torch.zeros(120))
        return Turn([], [f"with {k} effects"], [accepted], accepted, [])

    monkeypatch.setattr(loop, "turn", turn)
    monkeypatch.setattr(loop, "drop_needless", lambda fit, *_: fit)
    found = criticise(FakeFit(()), None, SPLIT, SCAN, CriticismSettings(), 0)
    assert asked == ["", *names]
    assert [t.accepted.name for t in found.accepted] == ["irf_tail"]
    assert found.left == ["with 1 effects"]
    assert found.wrong is wrong
    # The last that may be accepted is looked at just so.
    monkeypatch.setattr(loop, "look", lambda *_: Look([], ["after the ripple"], None, wrong))
    found = criticise(FakeFit(()), None, SPLIT, SCAN, CriticismSettings(most=2), 0)
    assert ([t.accepted.name for t in found.accepted], found.left) == (["irf_tail"], ["with 1 effects"])
