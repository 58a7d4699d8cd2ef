"""Score tests on a linear Gaussian toy where the answer is known: 40 spots of 6 bins, seven columns of
nuisance.
"""

from __future__ import annotations

import copy
import math
from functools import lru_cache

import numpy as np
import pytest
import torch
from inference_scenes import capture_of, effect_of, problem_of, scattered
from scipy import stats
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.inference import screen as screening
from nlos_lit.inference.problem import Problem
from nlos_lit.inference.screen import FOLDS, Candidate, Projector, half_products, screen

SPOTS, BINS, DRAWS = 42, 6, 200
ROWS = SPOTS * BINS
SCAN = Scan.of(capture_of(scattered(SPOTS)))


def normal(*shape: int, seed: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape)).float()


def problem(residual: Tensor, nuisance: Tensor | None = None, prior: Tensor | None = None) -> Problem:
    x = normal(ROWS, 7, seed=1) if nuisance is None else nuisance
    return problem_of(torch.arange(SPOTS), torch.ones(SPOTS, BINS), x, residual, prior)


def columns(effect: Effect, strength: float = 10.0) -> Tensor:
    """``[N, k]``, its own for every shape, partly what nuisance can do."""
    k = sum(p.size for p in effect.amplitudes)
    shape = sum(float(effect.value(p.name).detach()) for p in effect.shapes)
    return strength / ROWS**0.5 * own_columns(k, 2 + int(1000 * shape))


@lru_cache
def own_columns(k: int, seed: int) -> Tensor:
    return normal(ROWS, k, seed=seed) + normal(ROWS, 7, seed=1)[:, :k]


@pytest.fixture(autouse=True)
def _known_columns(monkeypatch):
    monkeypatch.setattr(screening, "weighted_columns", lambda problem, effect, *_, **__: columns(effect))


FOLD = torch.arange(SPOTS) % FOLDS


def look(name: str, residual: Tensor) -> Candidate:
    whole = problem(residual)
    (candidate,) = screen(whole, Projector(whole), [effect_of(name, SCAN)], FOLD)
    return candidate


def residuals(truth: Tensor, seed: int) -> list[Tensor]:
    """Unit noise plus nuisance of any size plus ``truth`` ``[N]``."""
    base = normal(ROWS, 7, seed=1) @ (3 * normal(7, seed=seed))
    return [base + truth + normal(ROWS, seed=1000 * seed + d) for d in range(DRAWS)]


def test_projection_is_orthogonal_to_the_nuisance_and_moves_nothing_else():
    x, z = normal(ROWS, 7, seed=1), normal(ROWS, 3, seed=9)
    projector = Projector(problem(normal(ROWS, seed=2), x))
    off = projector.off(z)
    assert float((x.T @ off).abs().max()) < 1e-3 * float((x.T @ z).abs().max())
    assert float((off - (z - x @ torch.linalg.lstsq(x, z).solution)).abs().max()) < 1e-5
    assert torch.allclose(projector.off(off), off, atol=1e-5)
    mixture = x @ normal(7, 2, seed=5)
    assert float(projector.off(mixture).abs().max()) < 1e-4 * float(mixture.abs().max())
    assert torch.equal(projector.residual, projector.off(normal(ROWS, seed=2)[:, None])[:, 0])
    own = torch.linalg.lstsq(x, normal(ROWS, seed=2)[:, None]).solution[:, 0]
    assert torch.allclose(projector.own, own, atol=1e-5)


def test_a_prior_leaves_part_of_the_column():
    """One column x with precision 3: what is left of itself is x · 3/(xᵀx + 3)."""
    x = torch.full((ROWS, 1), 0.1)
    left = Projector(problem(torch.zeros(ROWS), x, torch.tensor([3.0]))).off(x)
    assert float(left[0]) == pytest.approx(0.1 * 3 / (ROWS * 0.01 + 3), rel=1e-4)


@pytest.mark.parametrize("columns", [1, 4, 6, 7])
def test_half_of_the_products_are_all(columns):
    x = normal(ROWS, columns, seed=21)
    assert torch.allclose(half_products(x, block=3), x.T @ x, rtol=1e-5, atol=1e-4)


def test_dependent_columns_do_not_break_the_projection():
    x = normal(ROWS, 7, seed=1)
    twice = torch.cat([x, x[:, :3], torch.zeros(ROWS, 1)], 1)
    z = normal(ROWS, 2, seed=9)
    assert torch.allclose(
        Projector(problem(z[:, 0], twice)).off(z), Projector(problem(z[:, 0], x)).off(z), atol=1e-3
    )


@pytest.fixture
def no_priors(monkeypatch):
    """Coefficients that are as free as their bounds."""
    monkeypatch.setattr(screening, "PRIOR_SCALES", (1e6,))


@pytest.mark.parametrize(("name", "k"), [("power_drift", 5), ("time_offset", 1)])
def test_statistic_of_nothing_is_chi_squared(name, k, no_priors):
    """Mean k and variance 2k within four standard errors; gains of nothing average to -½ Σ tr(F_b F₋b⁻¹) =
    -0.6 k.
    """
    found = [look(name, r) for r in residuals(torch.zeros(ROWS), seed=3)]
    statistics = np.array([c.statistic for c in found])
    assert abs(statistics.mean() - k) < 4 * math.sqrt(2 * k / DRAWS)
    assert statistics.var() == pytest.approx(2 * k, rel=4 * math.sqrt((2 + 12 / k) / DRAWS))
    assert stats.kstest([c.p_value for c in found], "uniform").pvalue > 1e-4
    gains = np.array([c.gain for c in found])
    assert gains.mean() < 0
    assert abs(gains.mean() + 0.6 * k) < 4 * gains.std() / math.sqrt(DRAWS) + 0.1 * k


def test_priors_cost_little_where_nothing_is_and_win_where_the_counts_say_little():
    """The statistic is that of free coefficients; the predicted gain is that of steps which the prior holds
    back.
    """
    draws = residuals(torch.zeros(ROWS), seed=3)
    found = [look("power_drift", r) for r in draws]
    assert np.mean([c.statistic for c in found]) == pytest.approx(5, abs=4 * math.sqrt(10 / DRAWS))
    assert -0.4 * 5 < np.mean([c.gain for c in found]) < 0
    assert all(c.effect.prior_scale in screening.PRIOR_SCALES for c in found)
    steps = torch.stack([c.step for c in found])
    z = Projector(problem(torch.zeros(ROWS))).off(columns(effect_of("power_drift", SCAN)))
    assert torch.all(
        steps.std(0)[3:] < 0.2 * torch.linalg.inv(z.T @ z).diagonal().sqrt()[3:]
    )  # the roughest two


def test_one_step_is_unbiased_and_its_error_right(no_priors):
    effect = effect_of("power_drift", SCAN)
    truth = torch.tensor([2.0, -1.0, 0.5, 0.0, 3.0])
    found = [look("power_drift", r) for r in residuals(columns(effect) @ truth, seed=4)]
    steps, errors = torch.stack([c.step for c in found]), found[0].error
    assert torch.all((steps.mean(0) - truth).abs() < 4 * errors / math.sqrt(DRAWS))
    assert torch.allclose(steps.std(0), errors, rtol=4 / math.sqrt(2 * DRAWS))
    z = Projector(problem(torch.zeros(ROWS))).off(columns(effect)).double()
    assert torch.allclose(errors.double(), torch.linalg.inv(z.T @ z).diagonal().sqrt(), rtol=1e-4)
    # The misfit it explains: ½ θᵀFθ nats, less what is paid for five numbers.
    worth = 0.5 * float(truth.double() @ (z.T @ z) @ truth.double())
    assert np.mean([c.gain for c in found]) == pytest.approx(worth - 0.6 * 5, rel=0.05)
    assert float(found[0].direction.norm()) == pytest.approx(1, abs=1e-5)
    assert float(found[0].direction @ (z.float() @ truth / (z.float() @ truth).norm())) > 0.98


def test_retained_information_is_what_the_base_leaves():
    """The column is √½ nuisance and √½ its own."""
    x = normal(ROWS, 7, seed=1)
    candidate = look("time_offset", normal(ROWS, seed=8))
    z = columns(effect_of("time_offset", SCAN))[:, 0]
    left = z - x @ torch.linalg.lstsq(x, z[:, None]).solution[:, 0]
    assert candidate.retained == pytest.approx(float((left**2).sum() / (z**2).sum()), rel=1e-3)
    beside = torch.linalg.lstsq(x, (normal(ROWS, seed=8) - z * candidate.step)[:, None]).solution[:, 0]
    assert torch.allclose(candidate.beside, beside, atol=1e-4)  # what the base does at the same time
    assert 0.4 < candidate.retained < 0.6


def test_p_value_pays_for_every_shape():
    """Many periods, a pair of columns each: the best of them alone would pass at a level of 5 % in most
    draws.
    """
    shapes = len(effect_of("tcspc_nonlinearity", SCAN).shape_grid())
    found = [look("tcspc_nonlinearity", r) for r in residuals(torch.zeros(ROWS), seed=5)]
    unpaid = np.array([stats.chi2.sf(c.statistic, 2) for c in found])
    assert [c.p_value for c in found] == pytest.approx(np.minimum(1, shapes * unpaid), rel=1e-6)
    assert np.mean(unpaid < 0.05) > 0.3
    assert np.mean([c.p_value < 0.05 for c in found]) < 0.05 + 4 * math.sqrt(0.05 * 0.95 / DRAWS)
    assert len({c.shape["period"] for c in found}) > shapes / 2


def test_the_right_shape_is_chosen_and_stays():
    grid = effect_of("irf_tail", SCAN).shape_grid()
    hidden = effect_of("irf_tail", SCAN, decay=grid[2]["decay"])
    candidate = look("irf_tail", 8 * columns(hidden)[:, 0] + normal(ROWS, seed=6))
    assert candidate.shape == grid[2]
    assert float(candidate.effect.value("decay").detach()) == pytest.approx(grid[2]["decay"])


def test_amplitudes_stay_in_their_bounds():
    """A tail's share cannot be negative: nothing is gained by light that is missing."""
    column = columns(effect_of("irf_tail", SCAN))[:, 0]
    candidate = look("irf_tail", -8 * column + 0.1 * normal(ROWS, seed=6))
    assert candidate.step.item() >= 0
    assert candidate.statistic < 1
    assert look("irf_tail", 8 * column).step.item() > 5
    full = look("irf_tail", 1000 * column)
    assert full.step.item() == pytest.approx(0.9 / 0.05)


def test_bounds_do_not_hide_a_smooth_field(monkeypatch):
    """Two columns that nearly cancel, pulled apart beyond their bounds: clipped, their balance is lost; held
    back, it is not.
    """
    common, tiny = normal(ROWS, seed=11), normal(ROWS, seed=12)
    five = torch.stack([common, common + 1e-3 * tiny, *normal(ROWS, 3, seed=13).unbind(1)], 1)
    monkeypatch.setattr(screening, "weighted_columns", lambda *_, **__: five)
    found = look("power_drift", 4 * common + 0.5 * tiny)
    assert found.step.abs().max() < 30
    worth = float((4 * Projector(problem(torch.zeros(ROWS))).off(common[:, None])).square().sum())
    assert found.statistic == pytest.approx(worth, rel=0.05)
    assert found.p_value < 1e-20


def test_many_shapes_are_ranked_before_they_are_projected(monkeypatch):
    """Of all periods only the 16 most promising are projected; the right one is among them."""
    monkeypatch.setattr(
        screening,
        "weighted_columns",
        lambda problem, effect, *_, **__: ripple(float(effect.value("period").detach())),
    )
    grid = effect_of("tcspc_nonlinearity", SCAN).shape_grid()
    assert len(grid) > 2 * screening.KEPT
    period = grid[29]["period"]
    whole = problem(ripple(period) @ torch.tensor([5.0, -3.0]) + normal(ROWS, seed=7))
    passes = []
    projector = Projector(whole)
    apart = projector.apart
    monkeypatch.setattr(projector, "apart", lambda z: passes.append(z.shape[1]) or apart(z))
    (candidate,) = screen(whole, projector, [effect_of("tcspc_nonlinearity", SCAN)], FOLD)
    assert passes == [2 * screening.KEPT]
    assert candidate.shape["period"] == period
    assert candidate.p_value == pytest.approx(len(grid) * stats.chi2.sf(candidate.statistic, 2), rel=1e-6)


def ripple(period: float) -> Tensor:
    phase = 2 * math.pi * torch.arange(ROWS) / period
    return torch.stack([phase.sin(), phase.cos()], 1)


def test_screening_ranks_by_gain():
    """Both effects' own columns; the truth holds the second's."""
    truth = columns(effect_of("power_drift", SCAN)) @ torch.tensor([4.0, -4.0, 4.0, -4.0, 4.0])
    whole = problem(truth + normal(ROWS, seed=11))
    found = screen(
        whole,
        Projector(whole),
        [effect_of(n, SCAN) for n in ("irf_tail", "power_drift", "time_offset")],
        FOLD,
    )
    assert found[0].effect.name == "power_drift"
    assert [c.gain for c in found] == sorted((c.gain for c in found), reverse=True)


def test_screening_leaves_the_effects_it_is_given_alone():
    given = [effect_of(n, SCAN) for n in ("irf_tail", "power_drift")]
    before = copy.deepcopy(given)
    whole = problem(columns(effect_of("irf_tail", SCAN))[:, 0] + normal(ROWS, seed=11))
    found = screen(whole, Projector(whole), given, FOLD)
    assert not {id(c.effect) for c in found} & {id(e) for e in given}
    for effect, old in zip(given, before, strict=True):
        assert effect.prior_scale == old.prior_scale
        for value, was in zip(effect.parameters(), old.parameters(), strict=True):
            assert torch.equal(value, was)


def test_per_spot_effects_are_tested_by_their_scatter(monkeypatch):
    """Column 1 at every bin of a spot, F = 6 a spot: δ ~ N(0, 1.5²) is seen as an excess of scatter, and no
    scatter as none.
    """
    monkeypatch.setattr(screening, "weighted_columns", lambda problem, effect, *_, **__: torch.ones(ROWS, 1))
    delta = 1.5 * normal(SPOTS, seed=12)
    truth = delta.repeat_interleave(BINS)
    nuisance = torch.zeros(ROWS, 1)
    nuisance[::7] = 1e-3
    whole = problem(truth + normal(ROWS, seed=13), nuisance)
    whole.model = type("Model", (), {"laser": torch.zeros(SPOTS + 3, 3)})()
    whole.spots = torch.arange(SPOTS) + 2
    jitter = effect_of("timing_jitter", SCAN)
    (found,) = screen(whole, Projector(whole), [jitter], FOLD)
    assert jitter.width == 0, "the effect that was given is left alone"
    assert found.effect.width == pytest.approx(1.5, rel=0.3)
    assert found.statistic == pytest.approx(2 * found.gain)
    assert found.p_value == pytest.approx(stats.chi2.sf(found.statistic, 1), rel=1e-6)
    assert found.step.shape == (SPOTS + 3,)
    assert torch.equal(found.step[[0, 1, SPOTS + 2]], torch.zeros(3))
    assert np.corrcoef(found.step[2:-1], delta)[0, 1] > 0.95
    assert found.error[5].item() == pytest.approx(6**-0.5, rel=1e-4)
    assert torch.isnan(found.error[0])
    calm = problem(0.8 * normal(ROWS, seed=14), nuisance)
    calm.model = type("Model", (), {"laser": torch.zeros(SPOTS, 3)})()
    (nothing,) = screen(calm, Projector(calm), [effect_of("timing_jitter", SCAN)], FOLD)
    assert nothing.statistic < 1
    assert nothing.p_value > 0.3
