"""One random number a spot: how wide they scatter, how many there are, and which spots have them."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, surfels
from scipy import integrate

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.asking import misfit_of
from nlos_lit.inference.heldout import log_likelihood
from nlos_lit.inference.per_spot import (
    best_width,
    coefficients,
    factors,
    neighbours,
    own_part,
    solve,
    sparse,
    spot_scores,
)

pytestmark = FORWARD_MODE


def scores(delta: np.ndarray, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Scores and information of spots with coefficients ``delta``, some measured twenty times better than
    others.
    """
    rng = np.random.default_rng(seed)
    information = rng.uniform(0.5, 10, len(delta))
    return torch.from_numpy(
        information * delta + np.sqrt(information) * rng.standard_normal(len(delta))
    ), torch.from_numpy(information)


@pytest.mark.parametrize("positive", [False, True])
def test_factors_are_the_integral_over_the_coefficient(positive):
    """Against quadrature of the prior times exp(δs - ½Fδ²)."""
    width, share = 0.7, 0.1 if positive else 1.0
    for s, f in ((2.0, 3.0), (-1.5, 0.4), (6.0, 5.0), (0.0, 1.0)):

        def density(d: float, s: float = s, f: float = f) -> float:
            prior = (
                math.exp(-0.5 * (d / width) ** 2) / math.sqrt(2 * math.pi) / width * (2 if positive else 1)
            )
            return prior * math.exp(d * s - 0.5 * f * d * d)

        integral = integrate.quad(density, 0 if positive else -8, 8)[0]
        ours = factors(torch.tensor([s]).double(), torch.tensor([f]).double(), width, share, positive)
        assert ours.item() == pytest.approx(math.log(1 - share + share * integral), rel=1e-6)


def test_width_of_a_normal_scatter():
    for width in (0.3, 1.0, 4.0):
        gain, found, share = best_width(
            *scores(width * np.random.default_rng(1).standard_normal(800), seed=2), False
        )
        assert found == pytest.approx(
            width, rel=0.12
        )  # its own scatter is 1/√1600 … 10 % (where it is below the noise)
        assert share == 1.0
        assert gain > 10


def test_width_and_share_of_a_sparse_one():
    rng = np.random.default_rng(3)
    delta = np.where(rng.random(3000) < 0.03, 8 * np.abs(rng.standard_normal(3000)), 0.0)
    gain, width, share = best_width(*scores(delta, seed=4), True)
    assert width == pytest.approx(8, rel=0.35)
    assert share == 0.03
    assert gain > 100


def test_pure_noise_has_no_width():
    """It gains less than half a nat on average, as a number on the edge of its range does (½ χ² half of the
    time).
    """
    for positive in (False, True):
        gains = [best_width(*scores(np.zeros(300), seed=k), positive)[0] for k in range(30)]
        assert min(gains) >= 0
        assert np.mean(gains) < 0.6
    assert best_width(torch.zeros(5), torch.ones(5), False) == (0.0, 0.0, 1.0)


def test_coefficients_are_posterior_means():
    s, f = torch.tensor([4.0, -4.0, 7.0]), torch.tensor([2.0, 2.0, 4.0])
    # σ = ½: σ²s/(1 + σ²F)
    assert coefficients(s, f, 0.5, False).tolist() == pytest.approx([1 / 1.5, -1 / 1.5, 1.75 / 2])
    # Sparse: 4/√2 = 2.8 and 7/2 = 3.5 standard deviations do not stand out; 7.1/2 does.
    assert coefficients(s, f, 0.5, True).tolist() == [0, 0, 0]
    assert coefficients(s + 0.1, f, 0.5, True).tolist() == pytest.approx([0, 0, 7.1 / 4])


def test_solve_finds_the_hot_spots_and_no_others():
    scene = capture_of(raster(8))
    model, scan = surfels(scene, level=2.0), Scan.of(scene)
    spots = torch.arange(64)
    hot = {5: 4.0, 17: 2.0, 40: 6.0}
    truth = torch.zeros(64)
    truth[list(hot)] = torch.tensor(list(hot.values()))
    true = effect_of("hot_spots", scan, extra=truth)
    measured = drawn(model, Extension([true]), scene, seed=1)
    effect = effect_of("hot_spots", scan)
    assert sparse(effect)
    train = spots[spots != 17]  # nobody looks there
    counts = torch.from_numpy(measured.gated_counts())
    solve(model, Extension([effect]), effect, train, counts[train])
    found = effect.value("extra").detach()
    assert torch.nonzero(found)[:, 0].tolist() == [5, 40]
    for spot in (5, 40):
        expected = model.expected(torch.tensor([spot]), Extension([true]))
        error = float((1 / expected).sum() ** -0.5)
        assert abs(float(found[spot]) - hot[spot]) < 4 * error
    # Newton steps have come to rest at what the spots have over their neighbours.
    score, information, _ = spot_scores(model, Extension([effect]), effect, train, counts[train])
    own = effect.raw_extra.detach()[train].double()
    around, its = own_part(score + information * own, information, neighbours(model, train), own)
    left = (around - its * own)[(train == 5) | (train == 40)]
    assert bool((left.abs() < 0.05 * its[(train == 5) | (train == 40)].sqrt()).all())
    assert 0.01 <= effect.share <= 0.1


def test_solve_finds_every_spots_delay_and_their_width():
    scene = capture_of(raster(8))
    model, scan = surfels(scene, level=40.0), Scan.of(scene)
    delays = 0.02 * torch.from_numpy(np.random.default_rng(2).standard_normal(64)).float()
    measured = drawn(model, Extension([effect_of("timing_jitter", scan, offset=delays)]), scene, seed=3)
    effect = effect_of("timing_jitter", scan)
    assert not sparse(effect)
    train = torch.arange(0, 64, 2)
    counts = torch.from_numpy(measured.gated_counts())
    solve(model, Extension([effect]), effect, train, counts[train])
    found = effect.value("offset").detach()
    assert torch.equal(found[1::2], torch.zeros(32))
    assert np.corrcoef(found[::2], delays[::2])[0, 1] > 0.99
    assert effect.width * 0.02 == pytest.approx(0.02, rel=0.35)


def test_several_scenes_can_be_solved_at_once():
    """Numbers of single spots come by forward mode, whose levels torch counts for all threads together."""
    scene = capture_of(raster(8))
    model, scan = surfels(scene, level=40.0), Scan.of(scene)
    measured, spots = torch.from_numpy(scene.gated_counts()), torch.arange(64)

    def score() -> torch.Tensor:
        effect = effect_of("timing_jitter", scan)
        return spot_scores(model, Extension([effect]), effect, spots, measured)[0]

    alone = score()
    with ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(score) for _ in range(40)]
        assert all(torch.allclose(job.result(), alone, rtol=1e-4) for job in jobs)


def test_unseen_spots_still_say_whether_the_width_is_right():
    """Log-likelihood of spots that were not solved: marginal over their coefficients, so that jitter gains
    without knowing any.
    """
    scene = capture_of(raster(8))
    model, scan = surfels(scene, level=40.0), Scan.of(scene)
    delays = 0.02 * torch.from_numpy(np.random.default_rng(2).standard_normal(64)).float()
    effect = effect_of("timing_jitter", scan)
    effect.width = 1.0
    for true, better in ((delays, True), (0 * delays, False)):
        measured = drawn(model, Extension([effect_of("timing_jitter", scan, offset=true)]), scene, seed=4)
        values = [
            log_likelihood(fit_of(model, measured, e), np.arange(64)).sum()
            for e in (Extension([effect]), Extension([]))
        ]
        assert bool(values[0] > values[1] + 20) is better
        assert bool(values[0] < values[1]) is not better


def test_what_no_fit_can_know_is_no_misfit():
    """Jitter of 3 bins at spots that were not solved: a misfit of the model without it, but not with it."""
    scene = capture_of(raster(8))
    model, scan, spots = surfels(scene, level=40.0), Scan.of(scene), np.arange(64)
    delays = 3 * scan.bin_length * torch.from_numpy(np.random.default_rng(2).standard_normal(64)).float()
    measured = drawn(model, Extension([effect_of("timing_jitter", scan, offset=delays)]), scene, seed=4)
    effect = effect_of("timing_jitter", scan)
    without, with_it = fit_of(model, measured), fit_of(model, measured, Extension([effect]))
    nothing = misfit_of(fit_of(model, drawn(model, Extension([]), scene, seed=4)), spots, 64)
    assert misfit_of(without, spots, 64) > nothing + 200
    assert abs(misfit_of(with_it, spots, 64) - nothing) < 0.1 * (misfit_of(without, spots, 64) - nothing)
    assert not effect.value("offset").any(), "it is asked of a copy"


def test_neighbours_are_the_nearest_on_the_wall():
    """In a row of ten, the eight nearest of each, itself not among them; of few spots, all others."""
    places = torch.zeros(10, 3)
    places[:, 0] = torch.arange(10.0) ** 1.01
    model = SimpleNamespace(laser=places, sensor=torch.zeros(10, 3))
    near = neighbours(model, torch.arange(10))
    assert near.shape == (10, 8)
    for k in range(10):
        assert set(near[k].tolist()) == set(range(10)) - {k, 9 if k < 5 else 0}
    assert neighbours(model, torch.tensor([3, 5, 8])).sort(1).values.tolist() == [[1, 2], [0, 2], [0, 1]]
    assert neighbours(model, torch.tensor([3])).shape == (1, 0)
    same = SimpleNamespace(laser=torch.zeros(12, 3), sensor=torch.zeros(12, 3))
    near = neighbours(same, torch.arange(12))
    assert not (near == torch.arange(12)[:, None]).any()


def test_what_is_smooth_over_the_wall_is_no_spots_own():
    """Delays of 0.5 that are each spot's own, on a slope of many times that: their width is found, and the
    slope is left. What is known of the neighbours makes the width right, where it was √(9/8) too large.
    """
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.arange(32.0), np.arange(32.0), indexing="ij")
    places = torch.from_numpy(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1))
    model = SimpleNamespace(laser=places, sensor=places)
    own = torch.from_numpy(0.5 * rng.standard_normal(1024))
    whole = own + places[:, 0] + 0.05 * places[:, 1] ** 2
    information = torch.full((1024,), 25.0, dtype=torch.float64)
    score = information * (whole + 0.2 * torch.from_numpy(rng.standard_normal(1024)))
    near = neighbours(model, torch.arange(1024))
    inner = ((x > 1) & (x < 30) & (y > 1) & (y < 30)).ravel()
    noise = 0.2 * (9 / 8) ** 0.5
    for known, width, other in ((None, 0.5 * (9 / 8) ** 0.5, 0.5 / 8**0.5), (own, 0.5, 0.0)):
        s, f = own_part(score, information, near, known)
        found = best_width(s[inner], f[inner], False)[1]
        assert found == pytest.approx(width, rel=0.05)
        delays = coefficients(s, f, found, False)[inner]
        expected = 0.5 / (0.5**2 + noise**2 + other**2) ** 0.5
        assert np.corrcoef(delays, own[inner])[0, 1] == pytest.approx(expected, abs=0.02)
