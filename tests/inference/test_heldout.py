"""Comparing fits on spots that they did not see, and how far these leave open which is best."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from inference_scenes import (
    BLOCK,
    capture_of,
    drawn,
    effect_of,
    fit_of,
    per_spot,
    raster,
    scattered,
    surfels,
    uneven,
)
from scipy import stats
from scipy.special import gammaln

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.heldout import compare, log_likelihood, score, weights
from nlos_lit.model.parameters import BoundedParameter


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


def test_weights_of_one_block_are_posterior_shares():
    """Two nats apart: 1 to e². What both lack does not matter."""
    first = torch.tensor([-500.0, -300.0], dtype=torch.float64)
    found = weights([first, first - 1, first - 200], np.array([5, 5]))
    assert found == pytest.approx([1 / (1 + math.exp(-2)), math.exp(-2) / (1 + math.exp(-2)), 0], abs=1e-9)


def test_a_near_tie_stays_open_and_a_clear_winner_does_not():
    """One nat apart, where blocks scatter by 3: either may be best. 120 nats apart: one is."""
    first = per_spot(2.0, 5.0)
    near, far = first - per_spot(1 / 120, 1.0, seed=1), first - per_spot(1.0, 1.0, seed=2)
    shares = weights([first, near, far], BLOCK)
    assert sum(shares) == pytest.approx(1)
    assert 0.05 < shares[1] < shares[0] < 0.95
    assert shares[2] < 1e-3
    assert weights([far, first], BLOCK) == pytest.approx([0, 1], abs=1e-3)
    assert weights([first, first, first], BLOCK) == pytest.approx([1 / 3] * 3)
    # The same nats, but the same in all blocks: nothing is left open.
    assert weights([first, first - 0.1], BLOCK)[1] < 1e-3


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
