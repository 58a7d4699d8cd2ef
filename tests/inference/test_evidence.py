"""The evidence of a term, by hand and against dense algebra; the pool on linear problems."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inference_scenes import capture_of, effect_of, problem_of, scattered
from scipy import stats
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.tcspc_nonlinearity import waves_at
from nlos_lit.inference import evidence as evidence_module
from nlos_lit.inference import pool, screening
from nlos_lit.inference.assemble import _rms_of, _screened
from nlos_lit.inference.candidates import Candidate, Shape
from nlos_lit.inference.evidence import (
    UNEVENNESS,
    VARIANCES,
    Evidence,
    Projector,
    best_evidence,
    evidence,
    half_products,
    prior_deviations,
)
from nlos_lit.inference.per_spot import neighbours
from nlos_lit.inference.problem import Problem
from nlos_lit.inference.screening import screen

SPOTS, BINS, DRAWS = 42, 6, 200
ROWS = SPOTS * BINS
SCAN = Scan.of(capture_of(scattered(SPOTS)))
TRUTH = torch.tensor([2.0, -1.0, 0.5, 0.0, 3.0] + [0.0] * 18)  # a drift's coefficients
BLOCK = torch.arange(SPOTS)


def normal(*shape: int, seed: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape)).float()


def best(u: float) -> float:
    """Nats of one coefficient of ``u`` standard deviations, where τ is as the counts want it."""
    return 0.5 * (u**2 - 1 - math.log(u**2))


def one(
    scores: list[float],
    information: list[float],
    deviation: float = 1.0,
    bounds: tuple[float, float] | None = None,
) -> Evidence:
    """One column, one spot of one bin in each block, with these scores and information."""
    f = torch.tensor(information)
    z = f.sqrt()[:, None, None]
    residual = torch.tensor(scores)[:, None] / f.sqrt()[:, None]
    limits = None if bounds is None else tuple(torch.tensor([b]).double() for b in bounds)
    blocks, unit = torch.arange(len(f)), torch.tensor([deviation]).double()
    return evidence(z, z.flatten(0, 1), residual.flatten(), blocks, unit, limits)


def test_one_coefficient_by_hand():
    """Information 15 and a score of 4 standard deviations: τ² = (16 - 1)/15 = 1, and ½(16 - 1 - ln 16) nats;
    the mean is 15/16 of the estimate.
    """
    found = one([4 * 15**0.5], [15.0])
    assert found.nats == pytest.approx(0.5 * (15 - math.log(16)), rel=1e-6)
    assert found.scale == pytest.approx(1)
    assert found.step.item() == pytest.approx(15 / 16 * 4 / 15**0.5, rel=1e-6)
    assert found.error.item() == pytest.approx(15**-0.5, rel=1e-6)
    assert (found.retained, found.scatter) == (pytest.approx(1), 1)


@pytest.mark.parametrize("u", [2.5, -5.0, 30.0])
def test_evidence_grows_with_the_square_of_the_score(u):
    """Whatever the unit; τ is tried so finely that 0.02 nats are lost at most."""
    for information, deviation in ((7.0, 1.0), (7e4, 0.01), (0.07, 10.0)):
        found = one([u * information**0.5], [information], deviation)
        assert best(u) - 0.02 < found.nats < best(u) + 1e-5
        shrunk = 1 / (1 + 1 / (found.scale**2 * information * deviation**2))
        assert found.step.item() == pytest.approx(shrunk * u / information**0.5, rel=1e-5)
        assert found.error.item() == pytest.approx(information**-0.5, rel=1e-5)


def test_several_coefficients_are_a_gaussian_process(monkeypatch):
    """Against the marginal likelihood of the counts themselves, with covariance I + τ²ZCZᵀ, and its mean.

    One block and one part of it: nothing scatters.
    """
    monkeypatch.setattr(evidence_module, "SEGMENTS", 1)
    z = normal(ROWS, 4, seed=1) * torch.tensor([1.0, 0.3, 2.0, 0.1])
    z[:, 3] += z[:, 0]
    deviation = torch.tensor([1.0, 3.0, 0.1, 0.5]).double()
    residual = z @ torch.tensor([0.5, -1.0, 0.1, 0.2]) + normal(ROWS, seed=2)
    found = evidence(
        z.view(SPOTS, BINS, -1),
        z,
        residual,
        torch.zeros(SPOTS, dtype=torch.long),
        deviation,
    )
    assert found.scatter == 1
    wide = z.double().numpy() * deviation.numpy()
    r = residual.double().numpy()

    def nats(variance: float) -> float:
        return stats.multivariate_normal.logpdf(r, cov=np.eye(ROWS) + variance * wide @ wide.T)

    tried = [nats(v) for v in VARIANCES]
    assert found.nats == pytest.approx(max(tried) - nats(0.0), rel=1e-4)
    variance = VARIANCES[int(np.argmax(tried))]
    assert found.scale**2 == pytest.approx(variance)
    mean = variance * wide.T @ np.linalg.solve(np.eye(ROWS) + variance * wide @ wide.T, r)
    assert found.step.numpy() == pytest.approx(mean * deviation.numpy(), rel=1e-3)
    alone = z.double().square().sum(0).rsqrt().numpy()
    assert found.error.numpy() == pytest.approx(alone, rel=1e-3)


def test_coefficients_keep_within_their_bounds():
    """Information 4 and a score of 16 ask for 4. No more than 1.5 allowed, that is what is taken: it is worth
    1.5·16 - ½·1.5²·4 nats, less what τ costs.
    """
    free = one([16.0], [4.0])
    assert one([16.0], [4.0], bounds=(0.0, 9.0)).nats == free.nats
    bound = one([16.0], [4.0], bounds=(0.0, 1.5))
    assert bound.step.item() == pytest.approx(1.5)
    costs = [0.5 * 1.5**2 / v + 0.5 * math.log(1 + v * 4) for v in VARIANCES]
    assert bound.nats == pytest.approx(1.5 * 16 - 0.5 * 1.5**2 * 4 - min(costs), abs=0.05)
    assert one([16.0], [4.0], deviation=0.1, bounds=(0.0, 1.5)).step.item() == pytest.approx(1.5)
    nothing = one([-16.0], [4.0], bounds=(0.0, 9.0))
    assert (nothing.nats, nothing.scale, nothing.step.item()) == (0, 0, 0)


def test_no_score_is_no_evidence():
    found = one([0.0, 0.0], [4.0, 9.0])
    assert (found.nats, found.scale, found.step.item()) == (0, 0, 0)
    assert found.error.item() == pytest.approx(13**-0.5)


def test_blocks_that_contradict_each_other_take_the_evidence():
    """Information 50 in each of two blocks, and scores of 60 in all: alike, they are 6 standard deviations.
    60 and 0 are 30 off the common coefficient each, which is a scatter of 2·30²/100 = 18, and leaves √2
    standard deviations, with an error √18 times as large.
    """
    alike, apart = one([30.0, 30.0], [50.0, 50.0]), one([60.0, 0.0], [50.0, 50.0])
    assert alike.nats == pytest.approx(best(6), abs=0.02)
    assert (alike.scatter, alike.error.item()) == (1, pytest.approx(0.1))
    assert apart.scatter == pytest.approx(18, rel=0.01)
    assert apart.nats == pytest.approx(best(2**0.5), abs=0.02)
    assert apart.error.item() == pytest.approx(0.1 * 18**0.5, rel=0.01)


def test_deviations_are_those_of_the_prior():
    """In stored units, whatever scale the prior has at present; a noticeable step where there is none."""
    drift = effect_of("power_drift", SCAN)
    p = drift.declared["drift"]
    drift.prior_scale = 0.1
    assert prior_deviations(drift).tolist() == pytest.approx([d / p.scale for d in p.prior], rel=1e-5)
    assert prior_deviations(effect_of("time_offset", SCAN)).tolist() == [1]
    assert prior_deviations(effect_of("free_rate", SCAN)).tolist() == pytest.approx([10.0] * 10)


def test_bounds_are_steps_from_the_null():
    """In stored units; a fraction cannot be less than 0."""
    for name in ("irf_tail", "retroreflection", "power_drift"):
        effect = effect_of(name, SCAN)
        low, high = effect.step_bounds()
        p = effect.amplitudes[0]
        assert float(low[0]) == pytest.approx((p.lower - p.null) / p.scale)
        assert float(high[0]) == pytest.approx((p.upper - p.null) / p.scale)
        assert len(low) == len(high) == sum(p.size for p in effect.amplitudes)
    assert float(effect_of("irf_tail", SCAN).step_bounds()[0]) == 0


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


def test_a_prior_leaves_part_of_the_column():
    """One column x with precision 3: what is left of itself is x · 3/(xᵀx + 3)."""
    x = torch.full((ROWS, 1), 0.1)
    left = Projector(problem(torch.zeros(ROWS), x, torch.tensor([3.0]))).off(x)
    assert float(left[0]) == pytest.approx(0.1 * 3 / (ROWS * 0.01 + 3), rel=1e-4)
    assert float(left[ROWS]) == pytest.approx(-(3**0.5) * ROWS * 0.01 / (ROWS * 0.01 + 3), rel=1e-4)


def test_a_prior_counts_once():
    """Against the marginal likelihood of counts with covariance I + XP⁻¹Xᵀ: its score and information."""
    x, z, r = normal(ROWS, 5, seed=1), normal(ROWS, 2, seed=3), normal(ROWS, seed=2)
    z += 0.5 * x[:, :2]
    precision = torch.tensor([0.1, 3.0, 50.0, 400.0, 10.0])
    projector = Projector(problem(r, x, precision))
    off = projector.off(z).double()
    wide = torch.eye(ROWS).double() + (x / precision @ x.T).double()
    assert torch.allclose(off.T @ off, z.T.double() @ torch.linalg.solve(wide, z.double()), rtol=1e-4)
    score = z.T.double() @ torch.linalg.solve(wide, r.double())
    assert torch.allclose(off.T @ projector.residual.double(), score, atol=1e-3)


def marginal(r: Tensor, x: Tensor, wide: list[tuple[Tensor, float]]) -> float:
    """Log marginal likelihood of counts, up to a constant: flat over ``x``, and a random effect for each of
    ``wide`` with its deviation.
    """
    cov = torch.eye(ROWS).double() + sum(u**2 * (w @ w.T).double() for w, u in wide)
    inverse = torch.linalg.inv(cov)
    x, r = x.double(), r.double()
    free = inverse - inverse @ x @ torch.linalg.solve(x.T @ inverse @ x, x.T @ inverse)
    return float(-0.5 * r @ free @ r - 0.5 * torch.logdet(cov) - 0.5 * torch.logdet(x.T @ inverse @ x))


UNEVEN_ROWS = normal(ROWS, 20, seed=31)


@pytest.mark.parametrize("number", [0, 3])
def test_terms_are_taken_off_like_nuisance(number):
    """A projector beside some terms says what one does that had them among its nuisance from the start."""
    x, t, z, r = (
        normal(ROWS, 5, seed=1),
        normal(ROWS, number, seed=4),
        normal(ROWS, 2, seed=6),
        normal(ROWS, seed=2),
    )
    r, z = r + UNEVEN_ROWS @ (0.2 * normal(20, seed=3)) + 2 * t.sum(1), z + t.sum(1, keepdim=True)
    prior, precision = torch.tensor([0.0, 3.0, 0.0, 0.0, 50.0]), torch.tensor([0.5, 4.0, 100.0])[:number]
    first = Projector(problem(r, x, prior, UNEVEN_ROWS))
    beside = first.beside(first.free(t), precision)
    whole = Projector(problem(r, torch.cat([x, t], 1), torch.cat([prior, precision]), UNEVEN_ROWS))
    assert beside.width == whole.width
    assert torch.allclose(beside.levels, whole.levels, atol=1e-3)
    off, same = beside.even(beside.free(first.free(z)), beside.width), whole.off(z)
    assert torch.allclose(off.T @ off, same.T @ same, rtol=1e-4)
    assert torch.allclose(off.T @ beside.residual, same.T @ whole.residual, rtol=1e-4, atol=1e-3)
    other = first.beside(first.free(t), precision, first.left[:, 0] + first.free(z)[:, 0])
    moved = Projector(problem(r + z[:, 0], torch.cat([x, t], 1), torch.cat([prior, precision]), UNEVEN_ROWS))
    assert torch.allclose(off.T @ other.residual_at(0), same.T @ moved.residual_at(0), rtol=1e-3, atol=1e-2)


def test_unevenness_is_what_the_counts_ask_for():
    """Against the marginal likelihood of the counts; left is what a prior of that width leaves."""
    x, w, r = normal(ROWS, 5, seed=1), UNEVEN_ROWS, normal(ROWS, seed=2)
    r = r + w @ (0.2 * normal(20, seed=3))
    projector = Projector(problem(r, x, uneven=w))
    nats = [marginal(r, x, [(w, u)]) for u in UNEVENNESS]
    assert projector.width == int(np.argmax(nats))
    assert 0.1 < UNEVENNESS[projector.width] < 0.4
    assert projector.levels.numpy() == pytest.approx(np.array(nats) - max(nats), abs=2e-3)
    precision = torch.cat([torch.zeros(5), torch.full((20,), UNEVENNESS[projector.width] ** -2.0)])
    known, z = Projector(problem(r, torch.cat([x, w], 1), precision)), normal(ROWS, 2, seed=5)
    assert torch.allclose(projector.off(z), known.off(z), atol=1e-4)
    assert torch.allclose(projector.residual, known.residual, atol=1e-4)


def test_a_term_is_held_against_a_scene_that_is_as_uneven_without_it(monkeypatch):
    """Twenty patches do the same: best τ and u together, less the best u alone, and u is then smaller."""
    monkeypatch.setattr(evidence_module, "SEGMENTS", 1)
    x, w = normal(ROWS, 5, seed=1), UNEVEN_ROWS
    z = w.sum(1, keepdim=True)
    r = 0.15 * z[:, 0] + w @ (0.02 * normal(20, seed=3)) + normal(ROWS, seed=2)
    projector, unit = Projector(problem(r, x, uneven=w)), torch.ones(1).double()
    one = torch.zeros(SPOTS, dtype=torch.long)
    found = best_evidence(projector, z.view(SPOTS, BINS, 1), projector.freed(z), one, unit)
    assert found.scatter == 1
    alone = max(marginal(r, x, [(w, u)]) for u in UNEVENNESS)
    some = range(0, len(VARIANCES), 2)
    both = {
        (k, j): marginal(r, x, [(w, UNEVENNESS[k]), (z, VARIANCES[j] ** 0.5)])
        for k in range(24)
        for j in some
    }
    width, _ = max(both, key=lambda at: both[at])
    assert found.nats == pytest.approx(max(both.values()) - alone, abs=0.1)
    assert found.nats > 10
    assert (
        projector.width_beside(projector.free(z), projector.along(projector.free(z)), unit)
        == width
        < projector.width
    )


def test_patches_that_differ_leave_no_evidence_for_what_they_share():
    """The same sum over patches, but each patch its own: that is what a scene does."""
    w, unit = UNEVEN_ROWS, torch.ones(1).double()
    z = w.sum(1, keepdim=True)
    found = []
    for own in (0.0, 0.3):
        each = own * normal(20, seed=3)
        r = w @ (each - each.mean() + 0.05) + normal(ROWS, seed=2)
        projector = Projector(problem(r, normal(ROWS, 5, seed=1), uneven=w))
        found.append(best_evidence(projector, z.view(SPOTS, BINS, 1), projector.freed(z), BLOCK, unit).nats)
    assert found[0] > 4 * found[1]
    assert found[1] < 2


def test_a_misfit_of_the_scene_lies_where_its_light_falls():
    """A term that acts on the dark third of the bins alone, on all alike, or on the lit ones."""
    whole, unit = problem(normal(ROWS, seed=2), normal(ROWS, 2, seed=1)), torch.ones(1).double()
    whole.lit = (torch.arange(BINS) >= BINS // 3).float().repeat(SPOTS)
    projector = Projector(whole)
    for z, lit in ((1 - whole.lit, 0.0), (torch.ones(ROWS), 2 / 3), (whole.lit, 1.0)):
        column = z.view(ROWS, 1)
        found = best_evidence(projector, column.view(SPOTS, BINS, 1), projector.freed(column), BLOCK, unit)
        assert found.lit == pytest.approx(lit, abs=0.03)


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


def test_a_fit_with_infinite_sensitivities_cannot_be_criticised():
    x = normal(ROWS, 2, seed=1)
    x[3, 1] = float("inf")
    with pytest.raises(ValueError, match="not finite"):
        Projector(problem(torch.zeros(ROWS), x))


def problem(
    residual: Tensor,
    nuisance: Tensor | None = None,
    prior: Tensor | None = None,
    uneven: Tensor | None = None,
) -> Problem:
    x = normal(ROWS, 7, seed=1) if nuisance is None else nuisance
    return problem_of(torch.arange(SPOTS), torch.ones(SPOTS, BINS), x, residual, prior, uneven)


def columns(effect: Effect, strength: float = 10.0) -> Tensor:
    """``[N, k]``, its own for every shape, partly what nuisance can do."""
    k = sum(p.size for p in effect.amplitudes)
    shape = sum(float(effect.value(p.name).detach()) for p in effect.shapes)
    return strength / ROWS**0.5 * own_columns(k, 2 + int(1000 * shape))


@lru_cache
def own_columns(k: int, seed: int) -> Tensor:
    own, shared = normal(ROWS, k, seed=seed), normal(ROWS, 7, seed=1)[:, :k]
    own[:, : shared.shape[1]] += shared
    return own


def stand_in(monkeypatch: pytest.MonkeyPatch, columns: Callable[..., Tensor]) -> None:
    """For the columns of effects, at the shape that they have, and at each of several."""

    def at_each(problem: Problem, effect: Effect, shapes: list[Shape]) -> Iterator[Tensor]:
        for shape in shapes:
            effect.set_all(shape)
            yield columns(problem, effect)

    for module in (pool, screening):
        monkeypatch.setattr(module, "weighted_columns", columns)
    monkeypatch.setattr(screening, "columns_at", at_each)


@pytest.fixture
def known(monkeypatch):
    stand_in(monkeypatch, lambda problem, effect, *_, **__: columns(effect))


def look(name: str, residual: Tensor) -> Candidate:
    effect = RIPPLE if name == "ripple" else effect_of(name, SCAN)
    (candidate,) = screen(problem(residual), [effect], BLOCK)
    return candidate


class _Ripple(Effect):
    """Of many periods."""

    name = "ripple"

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        periods = tuple((1 / np.linspace(1 / 29, 1 / 2.2, 38)).tolist())
        waves = tuple(Parameter(name, "1", 0.0, 0.02, -0.7, 0.7) for name in ("sine", "cosine"))
        return (*waves, Parameter("period", "bins", None, 0.01, 2.0, 50.0, grid=periods, log=True))

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        raise NotImplementedError


RIPPLE = _Ripple(SCAN)


def residuals(truth: Tensor, seed: int) -> list[Tensor]:
    """Unit noise plus nuisance of any size plus ``truth`` ``[N]``."""
    base = normal(ROWS, 7, seed=1) @ (3 * normal(7, seed=seed))
    return [base + truth + normal(ROWS, seed=1000 * seed + d) for d in range(DRAWS)]


@pytest.mark.parametrize("name", ["time_offset", "irf_tail", "power_drift", "hum"])
def test_counts_alone_seldom_give_evidence(name, known):
    """A mean Bayes factor of 1 lets one draw in e⁴ = 55 pass 4 nats; with τ where it is largest it is still
    no more than that, whether there are one, five or many coefficients, and many shapes.
    """
    found = np.array([look(name, r).evidence for r in residuals(torch.zeros(ROWS), seed=3)])
    assert found.max() > -10
    assert (found > 4).mean() <= math.exp(-4)
    assert np.exp(found).mean() < 3


def test_one_step_is_unbiased_and_its_error_right(known):
    effect = effect_of("power_drift", SCAN)
    truth = TRUTH
    found = [look("power_drift", r) for r in residuals(columns(effect) @ truth, seed=4)]
    steps = torch.stack([c.step for c in found])[:, :5]  # rougher ones are shrunk towards nothing
    truth = truth[:5]
    z = Projector(problem(torch.zeros(ROWS))).off(columns(effect)).double()
    errors = torch.linalg.inv(z.T @ z).diagonal().sqrt().float()[:5]
    assert torch.all((steps.mean(0) - truth).abs() < 4 * errors / math.sqrt(DRAWS) + 0.02 * truth.abs())
    assert torch.allclose(steps.std(0), errors, rtol=4 / math.sqrt(2 * DRAWS))
    ratio = torch.stack([c.error for c in found])[:, :5] * z.square().sum(0).sqrt().float()[:5]
    assert torch.all(ratio >= 0.999), "errors are no smaller than counts alone leave them, others being known"
    assert torch.all(ratio.mean(0) < 1.2)
    assert min(c.evidence for c in found) > 100


def test_what_the_base_can_imitate_has_no_evidence(monkeypatch):
    """The nuisance explains the residual as well, however large it is."""
    x = normal(ROWS, 7, seed=1)
    stand_in(monkeypatch, lambda *_, **__: 10 * x[:, :1] + 5 * x[:, 3:4])
    for name in ("time_offset", "irf_tail"):
        found = look(name, 30 * x[:, 0] + 30 * x[:, 3] + normal(ROWS, seed=8))
        assert found.evidence < 0.5
        assert found.retained < 1e-4


def test_retained_information_is_what_the_base_leaves(known):
    """The column is √½ nuisance and √½ its own."""
    x = normal(ROWS, 7, seed=1)
    z = columns(effect_of("time_offset", SCAN))[:, 0]
    left = z - x @ torch.linalg.lstsq(x, z[:, None]).solution[:, 0]
    found = look("time_offset", normal(ROWS, seed=8))
    assert found.retained == pytest.approx(float((left**2).sum() / (z**2).sum()), rel=1e-3)
    assert 0.4 < found.retained < 0.6


def test_every_shape_that_could_have_been_counts(monkeypatch):
    """One of many periods has evidence: its Bayes factor over their number. Two alike: twice as much. None
    between them has any.
    """
    grid = RIPPLE.shape_grid()
    right = {grid[29]["period"]}

    def ripple(problem: Problem, effect: Effect, *_: object, **__: object) -> Tensor:
        period = float(effect.value("period").detach())
        known = any(period == pytest.approx(of_grid) for of_grid in right)
        return own_columns(2, 5 if known else 100 + int(1e4 * period)) * 10 / ROWS**0.5

    stand_in(monkeypatch, ripple)
    truth = own_columns(2, 5) @ torch.tensor([3.0, -4.0]) * 10 / ROWS**0.5 + normal(ROWS, seed=7)
    alone = look("ripple", truth)
    assert alone.shape["period"] == grid[29]["period"]
    assert float(alone.effect.value("period").detach()) == pytest.approx(grid[29]["period"])
    whole, z = problem(truth), own_columns(2, 5) * 10 / ROWS**0.5
    projector = Projector(whole)
    nats = evidence(
        z.view(SPOTS, BINS, -1),
        projector.off(z),
        projector.residual,
        BLOCK,
        prior_deviations(alone.effect),
    ).nats
    assert alone.evidence == pytest.approx(nats - math.log(len(grid)), abs=1e-3)
    right.add(grid[20]["period"])
    assert look("ripple", truth).evidence == pytest.approx(alone.evidence + math.log(2), abs=1e-3)


def widths_of_bins(residual: Tensor) -> Candidate:
    """Bins of unequal width in the 58 bins of each of 42 spots, where 9 counts are expected."""
    bins = torch.arange(*SCAN.gate).float()
    rows = len(BLOCK) * len(bins)

    def at_each(problem: Problem, effect: Effect, shapes: list[Shape]) -> Iterator[Tensor]:
        for shape in shapes:
            effect.set_all(shape)
            yield 3 * 0.02 * waves_at(bins, effect.value("period").detach()).repeat(len(BLOCK), 1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(screening, "columns_at", at_each)
        patch.setattr(screening, "weighted_columns", lambda p, e: next(at_each(p, e, [{}])))
        x = normal(rows, 7, seed=1)
        whole = problem_of(BLOCK, torch.full((len(BLOCK), len(bins)), 9.0), x, residual)
        (candidate,) = screen(whole, [effect_of("tcspc_nonlinearity", SCAN)], BLOCK)
    return candidate


def test_counts_alone_seldom_make_bins_of_unequal_width():
    """As of other effects, though only likely periods are tried of those that count."""
    rows = len(BLOCK) * (SCAN.gate[1] - SCAN.gate[0])
    found = np.array([widths_of_bins(normal(rows, seed=k)).evidence for k in range(DRAWS)])
    assert found.max() > -10
    assert (found > 4).mean() <= math.exp(-4)
    assert np.exp(found).mean() < 3


def test_a_pattern_of_random_widths_is_one_effect():
    """It has most of the nats that its bins have, as a sine of the same size has, and its period is found."""
    bins, widths = torch.arange(*SCAN.gate), normal(13, seed=3)
    widths = (widths - widths.mean()) / widths.std(correction=0)
    noise = normal(len(BLOCK) * len(bins), seed=5)
    sine = 2**0.5 * torch.sin(2 * math.pi * bins / 13)
    found = {
        name: widths_of_bins(3 * 0.2 * shape.repeat(len(BLOCK)) + noise)
        for name, shape in (("pattern", widths[bins % 13]), ("sine", sine))
    }
    told = 0.5 * (3 * 0.2) ** 2 * len(noise)
    for candidate in found.values():
        assert candidate.shape["period"] == pytest.approx(13, abs=0.1)
        assert 0.7 * told < candidate.evidence < told + 60
        assert candidate.retained > 0.95


def ripple(period: float, rows: int = ROWS) -> Tensor:
    """That begins anew after so many rows."""
    phase = 2 * math.pi * (torch.arange(ROWS) % rows) / period
    return torch.stack([phase.sin(), phase.cos()], 1)


def test_many_shapes_are_ranked_before_they_are_projected(monkeypatch):
    """Of all periods only the 16 most promising are projected; the right one is among them."""
    stand_in(monkeypatch, lambda problem, effect, *_: ripple(float(effect.value("period").detach())))
    grid = RIPPLE.shape_grid()
    assert len(grid) > 2 * screening.KEPT
    period = grid[29]["period"]
    passes, free = [], Projector.free
    monkeypatch.setattr(Projector, "free", lambda self, z: passes.append(z.shape[1]) or free(self, z))
    found = look("ripple", ripple(period) @ torch.tensor([5.0, -3.0]) + normal(ROWS, seed=7))
    # Unevenness, the residual, then all columns at once, and those on both sides of the best, thrice.
    assert passes == [0, 1, 2 * screening.KEPT, 4, 4, 4]
    assert found.shape["period"] == period


def test_shapes_between_those_of_the_grid_are_tried_where_a_term_is_strong_enough_to_tell(monkeypatch):
    """A ripple of a period that the grid does not have: the nearest of the grid leaves much of it."""
    stand_in(
        monkeypatch,
        lambda problem, effect, *_: ripple(float(effect.value("period").detach()), 44),
    )
    grid = [shape["period"] for shape in RIPPLE.shape_grid()]
    period = 0.7 * grid[4] + 0.3 * grid[5]
    truth, noise = ripple(period, 44) @ torch.tensor([1.0, -0.6]), normal(ROWS, seed=7)
    found = look("ripple", truth + noise)
    assert found.shape["period"] == pytest.approx(period, abs=0.2 * abs(grid[4] - grid[5]))
    for strength in (0.5, 0.1, 0.03):
        loud = look("ripple", strength * truth + noise)
        on_grid = min(abs(loud.shape["period"] - p) for p in grid) < 1e-6
        assert on_grid == (loud.loud - math.log(len(grid)) < screening.CLOSER)
    monkeypatch.setattr(screening, "HALVINGS", 0)
    coarse = look("ripple", truth + noise)
    assert coarse.shape["period"] == grid[4]
    assert found.evidence > 1.02 * coarse.evidence


def test_terms_are_projected_together(monkeypatch, known):
    """No more than some columns at a time, and each term gets its own again."""
    given = [effect_of(n, SCAN) for n in ("irf_tail", "power_drift", "time_offset", "gate_edges")]
    truth = columns(given[1]) @ (2 * TRUTH) + normal(ROWS, seed=11)
    together = screen(problem(truth), given, BLOCK)
    monkeypatch.setattr(screening, "TOGETHER", 1)
    apart = screen(problem(truth), given, BLOCK)
    assert together[0].name == "power_drift"
    assert [c.evidence for c in together] == sorted((c.evidence for c in together), reverse=True)
    assert [c.name for c in together] == [c.name for c in apart]
    assert [c.evidence for c in together] == pytest.approx([c.evidence for c in apart], abs=1e-3)


ALIKE = {
    "irf_tail": ([1.0, 0.0, 0.0], 0),
    "afterpulsing": ([0.9, 0.1, 0.0], 0),
    "pile_up": ([0.0, 0.0, 1.0], 0),
    "vignetting": ([0.0, 0.0, 0.0], 1),
    "free_rate": ([1.0, 0.0, 0.0], 9),
}


@pytest.fixture
def alike(monkeypatch) -> list[Candidate]:
    """What is asked for of terms some of which leave the same traces, as ``ALIKE`` says; the wide one can do
    what the first does and more.
    """
    traces = normal(ROWS, 3, seed=21)

    def made(problem, effect, *_, **__) -> Tensor:
        shares, more = ALIKE[effect.name]
        own = (traces @ torch.tensor(shares))[:, None] if any(shares) else normal(ROWS, 1, seed=30)
        return torch.cat([own, normal(ROWS, more, seed=31)], 1) if len(shares) and any(shares) else own

    stand_in(monkeypatch, made)
    return traces


def taken(
    strengths: list[float], traces: Tensor, room: int, unknown: float = 0.0, effects: bool = True
) -> list[tuple[str, list[str]]]:
    more = unknown * normal(ROWS, 9, seed=31).sum(1)
    whole = problem(traces @ torch.tensor(strengths) + more + normal(ROWS, seed=2))
    projector = Projector(whole)
    found = screen(whole, [effect_of(n, SCAN) for n in ALIKE], BLOCK, projector)
    told = pool.together(whole, projector, BLOCK, found, 5.0, room, effects)
    return [(t.candidate.name, [c.name for c in t.rivals]) for t in told]


def test_terms_are_asked_for_beside_those_that_were_taken(alike):
    """The first leaves nothing for what looks like it, which is its rival; the other is asked for as before.
    A free term is taken only where no effect is, or none may be; where it is asked for more than the first
    effect it is a rival of that.
    """
    assert taken([2.0, 0.0, 1.0], alike, 9) == [("irf_tail", ["free_rate", "afterpulsing"]), ("pile_up", [])]
    assert taken([2.0, 0.0, 1.0], alike, 1) == [("irf_tail", ["free_rate", "afterpulsing"])]
    assert taken([0.0, 0.0, 2.0], alike, 9) == [("pile_up", [])]
    assert taken([2.0, 0.0, 1.0], alike, 0) == []
    assert taken([0.0, 0.0, 0.0], alike, 9) == []
    (first, rivals), (second, fewer) = taken([2.0, 0.0, 1.0], alike, 9, 0.5)
    assert "free_rate" not in (first, second)
    assert rivals[0] == "free_rate"
    assert "free_rate" not in fewer
    for strengths, effects in (([2.0, 0.0, 1.0], False), ([0.0, 0.0, 0.0], True)):
        assert taken(strengths, alike, 9, 0.5, effects) == [("free_rate", [])]


def test_a_look_alike_waits_until_the_first_is_in_the_model(alike, monkeypatch):
    """Both are asked for, also beside each other; what is left of the second may be an error of the first."""
    monkeypatch.setitem(ALIKE, "time_offset", ([0.9, 0.1, 0.0], 0))
    monkeypatch.delitem(ALIKE, "afterpulsing")
    for second, more in ((0.0, ["free_rate"]), (-1.0, [])):
        found = taken([2.0, second, 1.0], alike, 9)
        assert found == [("irf_tail", [*more, "time_offset"]), ("pile_up", [])]


@pytest.mark.parametrize("same", [False, True])
def test_what_is_the_same_in_such_a_scan_comes_never_beside_it(alike, monkeypatch, same):
    """Two exponentials of one scene's leak would else be two names of one cause; it is the first rival."""
    for name, shares in (("direct_leak", [1.0, 0.0, 0.2]), ("direct_tail", [0.0, 1.0, 0.0])):
        monkeypatch.setitem(ALIKE, name, (shares, 0))
    other = "direct_leak" if same else ""
    monkeypatch.setattr(type(effect_of("direct_tail", SCAN)), "same_as", lambda *_: other)
    for name in ("irf_tail", "afterpulsing", "free_rate"):
        monkeypatch.delitem(ALIKE, name)
    found = dict(taken([3.0, 1.0, 0.0], alike, 9))
    assert found["direct_leak"] == ["direct_tail"] * same
    assert ("direct_tail" in found) is not same


def asked_beside(name: str, scan: Scan, monkeypatch, only: list[str] | None = None) -> list[str]:
    """Names of what is asked for beside a fit that has one effect."""
    names = list[str]()
    monkeypatch.setattr(pool, "problem_of", lambda *_: (None, BLOCK))
    monkeypatch.setattr(pool, "Projector", lambda problem: None)
    monkeypatch.setattr(pool, "together", lambda *_: [])
    monkeypatch.setattr(pool, "screen", lambda p, effects, *_: names.extend(e.name for e in effects) or [])
    pool.ask(SimpleNamespace(extension=Extension([effect_of(name, scan)])), None, scan, 9, 0, only=only)
    return names


@pytest.mark.parametrize(("kind", "asked"), [("confocal", False), ("single", True)])
def test_what_a_fit_has_by_another_name_is_not_asked_for(monkeypatch, kind, asked):
    names = asked_beside("direct_leak", Scan.of(capture_of(scattered(SPOTS), kind)), monkeypatch)
    assert ("direct_tail" in names) is asked
    assert "direct_leak" not in names
    assert "irf_tail" in names


def test_what_is_asked_for_by_name_is_asked_whatever_the_fit_has(monkeypatch):
    """A further capture may be confocal where the first, whose names are open, was not."""
    assert asked_beside("direct_leak", SCAN, monkeypatch, ["direct_tail"]) == ["direct_tail"]


def test_a_term_with_a_prior_keeps_its_scale(known):
    effect = effect_of("power_drift", SCAN)
    truth = columns(effect) @ TRUTH + normal(ROWS, seed=5)
    found = look("power_drift", truth)
    ratio = found.step / prior_deviations(effect).float()
    assert found.effect.prior_scale in VARIANCES**0.5
    assert found.effect.prior_scale == pytest.approx(float(ratio.square().mean().sqrt()), rel=0.5)
    assert look("power_drift", torch.zeros(ROWS)).effect.prior_scale == 1


def test_screening_leaves_the_effects_it_is_given_alone(known):
    given = [effect_of(n, SCAN) for n in ("irf_tail", "power_drift")]
    before = copy.deepcopy(given)
    whole = problem(columns(effect_of("irf_tail", SCAN))[:, 0] + normal(ROWS, seed=11))
    found = screen(whole, given, BLOCK)
    assert not {id(c.effect) for c in found} & {id(e) for e in given}
    for effect, old in zip(given, before, strict=True):
        assert effect.prior_scale == old.prior_scale
        for value, was in zip(effect.parameters(), old.parameters(), strict=True):
            assert torch.equal(value, was)


def wall(spots: int) -> SimpleNamespace:
    """Spots in rows of six."""
    places = torch.stack([torch.arange(spots) % 6, torch.arange(spots) // 6, torch.zeros(spots)], 1).float()
    return SimpleNamespace(laser=places, sensor=places)


def test_per_spot_effects_are_tested_by_their_scatter(monkeypatch):
    """Column 1 at every bin of a spot, F = 6 a spot, 48/9 where the mean of eight neighbours is taken off:
    δ ~ N(0, 1.5²) is seen as an excess of scatter, and no scatter as none, nor what is smooth over the wall.
    """
    stand_in(monkeypatch, lambda problem, effect, *_, **__: torch.ones(ROWS, 1))
    delta = 1.5 * normal(SPOTS, seed=12)
    nuisance = 1e-6 * normal(ROWS, 2, seed=13)
    wide = problem(delta.repeat_interleave(BINS) + normal(ROWS, seed=14), nuisance)
    wide.spots = torch.arange(SPOTS) + 2
    wide.model = wall(SPOTS + 3)
    (found,) = screen(wide, [effect_of("timing_jitter", SCAN)], BLOCK)
    assert found.effect.width == pytest.approx(1.5, rel=0.3)
    information = 48 / 9 / found.scatter
    grown = 1 + information * found.effect.width**2
    each = Projector(wide).residual.view(SPOTS, BINS).mean(1).double()
    score = information * (each - each[neighbours(wide.model, wide.spots)].mean(1))
    by_hand = 0.5 * (found.effect.width**2 * score**2 / grown - math.log(grown)).sum()
    assert found.evidence == pytest.approx(float(by_hand), rel=1e-3)
    assert found.evidence > 15
    assert found.step.shape == (SPOTS + 3,)
    assert torch.equal(found.step[[0, 1, SPOTS + 2]], torch.zeros(3))
    assert np.corrcoef(found.step[2:-1], delta)[0, 1] > 0.9
    assert found.error[5].item() == pytest.approx(information**-0.5, rel=1e-4)
    assert torch.isnan(found.error[0])
    assert found.lit == 0, "no misfit of a scene differs from spot to spot"
    slope = wall(SPOTS).laser.sum(1).repeat_interleave(BINS)
    calm = problem(0.8 * normal(ROWS, seed=14) + 0.3 * slope, nuisance)
    calm.model = wall(SPOTS)
    (nothing,) = screen(calm, [effect_of("timing_jitter", SCAN)], BLOCK)
    assert nothing.evidence < 0.5


@pytest.mark.parametrize(
    ("name", "lit"),
    [("timing_jitter", 0.0), ("free_spot_gain", 0.0), ("hot_spots", 2 / 3), ("spot_gate", 2 / 3)],
)
def test_only_what_single_spots_have_over_their_neighbours_is_no_misfit(monkeypatch, name, lit):
    """Delays and gains of single spots; what is rare may be the scene's where that sends light."""
    stand_in(monkeypatch, lambda problem, effect, *_, **__: torch.ones(ROWS, 1))
    whole = problem(normal(ROWS, seed=14), 1e-6 * normal(ROWS, 2, seed=13))
    whole.model, whole.lit = wall(SPOTS), (torch.arange(BINS) >= BINS // 3).float().repeat(SPOTS)
    (found,) = screen(whole, [effect_of(name, SCAN)], BLOCK)
    assert found.lit == pytest.approx(lit)


def test_a_misfit_that_changes_along_time_holds_a_map_to_account():
    """One coefficient for each of three blocks, which follows any of them. What is wrong in a block's first
    quarter alone scatters between its parts; what scales all of a block does not.
    """
    block = torch.arange(12) // 4
    z = torch.nn.functional.one_hot(block).float()[:, None, :].expand(-1, 8, -1).contiguous()
    whole = 3.0 * torch.tensor([1.0, -1.0, 0.5])[block][:, None].expand(-1, 8)
    early = whole * 4 * (torch.arange(8) < 2)
    unit = torch.ones(3).double()
    found = [evidence(z, z.flatten(0, 1), r.flatten(), block, unit) for r in (whole, early)]
    assert (found[0].scatter, found[0].nats) == (1, pytest.approx(found[0].loud))
    assert found[1].loud == pytest.approx(found[0].loud, rel=1e-5)
    assert found[1].scatter > 50
    assert found[1].nats < found[0].nats / 50


def test_scatter_of_a_spots_own_coefficient_by_hand():
    """Four parts of information 2 with scores 2 a + n: left are the n off their mean."""
    column = torch.ones(3, 8)
    noise = torch.tensor([1.0, -1.0, 1.0, -1.0])
    residual = (torch.tensor([5.0, 0.0, -2.0])[:, None] + 2 * noise).repeat_interleave(2, 1)
    assert screening.spot_scatter(column, residual) == pytest.approx(4 * 2 * 4 / 3)
    assert screening.spot_scatter(column, torch.full((3, 8), 7.0)) == 1


def test_scatter_of_a_spots_own_coefficient_is_that_of_counts():
    assert screening.spot_scatter(normal(400, 30, seed=3).abs(), normal(400, 30, seed=4)) == pytest.approx(
        1, abs=0.1
    )


@pytest.mark.parametrize("name", ["power_drift", "time_offset", "irf_tail"])
def test_what_is_as_strong_as_its_limit_is_asked_for_in_nine_of_ten(name, known):
    """All coefficients of a field are alike, up or down. A tail only adds, and has two parts and a shape."""
    effect, least, found = effect_of(name, SCAN), 8.4, list[bool]()
    (p, *_), size = effect.amplitudes, sum(a.size for a in effect.amplitudes)
    looked = look(name, residuals(torch.zeros(ROWS), seed=5)[0])
    told, draws = _screened(looked, least).detectable, 15 if effect.shapes else 50
    limit = told["rms"] / _rms_of(effect, p) if p.size > 1 else told[p.name] / p.scale
    for seed in range(6, 12):  # of the scores, and of the directions of a field
        coefficients = torch.zeros(size)
        coefficients[: p.size] = limit * (normal(p.size, seed=seed).sign() if p.size > 1 else 1)
        drawn = residuals(columns(effect) @ coefficients, seed)[:draws]
        found += [look(name, r).evidence > least for r in drawn]
    assert 0.8 < np.mean(found) < 0.97
