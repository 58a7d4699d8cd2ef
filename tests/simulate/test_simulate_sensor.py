"""The sensor model against numerical convolution, SciPy's distribution and statistics of the counts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import exponnorm

from data_modules.simulate.sensor import (
    SensorModel,
    direct_pulse_counts,
    draw_counts,
    respond,
    response_cdf,
    response_kernel,
)
from nlos_lit.capture.errors import UserError


def moments(sigma, kappa, b):
    kernel, first = response_kernel(sigma, kappa, b)
    t = b * (first + np.arange(len(kernel)))
    mean = (kernel * t).sum()
    return kernel.sum(), mean, (kernel * (t - mean) ** 2).sum()


@pytest.mark.parametrize(("sigma", "kappa"), [(0.012, 60.0), (0.02, 15.0), (0.01, 500.0)])
def test_kernel_has_the_mean_and_variance_of_the_response_and_the_bin(sigma, kappa):
    b = 0.008
    total, mean, variance = moments(sigma, kappa, b)
    assert total == pytest.approx(1, abs=1e-12)
    assert mean == pytest.approx(1 / kappa, rel=1e-3)
    assert variance == pytest.approx(sigma**2 + 1 / kappa**2 + b**2 / 12, rel=1e-3)


@pytest.mark.parametrize(("sigma", "kappa"), [(0.01, 60.0), (0.001, 20.0), (0.03, 200.0)])
def test_cdf_is_scipys_exponentially_modified_gaussian(sigma, kappa):
    t = np.linspace(-0.1, 0.5, 601)
    reference = exponnorm.cdf(t, 1 / (kappa * sigma), scale=sigma)
    assert response_cdf(t, sigma, kappa) == pytest.approx(reference, abs=1e-9)


def test_cdf_is_the_convolution_worked_out_numerically():
    sigma, kappa, t = 0.01, 40.0, 0.013
    delay = (np.arange(5000) + 0.5) * 1e-4  # exponential delays up to 0.5 m, 2e-9 of them longer
    gauss = 0.5 * (1 + np.array([math.erf(v) for v in (t - delay) / (sigma * math.sqrt(2))]))
    numeric = (kappa * np.exp(-kappa * delay) * gauss).sum() * 1e-4
    assert response_cdf(t, sigma, kappa) == pytest.approx(numeric, abs=1e-6)


@pytest.mark.parametrize(("sigma", "kappa"), [(1e-9, 60.0), (0.01, 1e9), (0.5, 1e5), (1e-9, 1e-3)])
def test_extreme_responses_stay_finite_and_monotonic(sigma, kappa):
    f = response_cdf(np.linspace(-20, 20, 4001), sigma, kappa)
    assert np.isfinite(f).all()
    assert np.diff(f).min() > -1e-12
    assert f[0] == pytest.approx(0, abs=1e-12)


def test_limits_are_a_pure_gaussian_a_pure_exponential_and_nothing():
    t = np.array([-0.02, 0.0, 0.013, 0.05])
    assert response_cdf(t, 0.01, np.inf) == pytest.approx(
        [0.5 * math.erfc(-v / 0.01 / math.sqrt(2)) for v in t], abs=1e-15
    )
    assert response_cdf(t, 0.0, 60.0) == pytest.approx(
        [0, 0, 1 - math.exp(-0.78), 1 - math.exp(-3)], abs=1e-15
    )
    assert response_cdf(t, 0.01, 1e7) == pytest.approx(response_cdf(t, 0.01, np.inf), abs=1e-4)
    assert response_cdf(t, 1e-8, 60.0) == pytest.approx(response_cdf(t, 0.0, 60.0), abs=1e-3)
    h = np.array([[0.0, 3.0, 1.0, 0.0, 7.0]])
    assert respond(h, SensorModel(sigma=0.0, kappa=np.inf), 0.01) == pytest.approx(h, abs=1e-14)


def test_response_is_causal_convolution_at_the_right_bin():
    h = np.zeros((2, 120))
    h[0, 30], h[1, 50] = 2.0, 1.0
    sensor = SensorModel(sigma=0.004, kappa=50.0)
    seen = respond(h, sensor, 0.01)
    edges = 0.01 * (np.arange(121) - 30.5)
    assert seen[0] == pytest.approx(2 * np.diff(exponnorm.cdf(edges, 1 / 0.2, scale=0.004)), abs=1e-12)
    assert seen[1, 20:] == pytest.approx(seen[0, :100] / 2, abs=1e-14)


def test_direct_pulse_sits_at_path_zero():
    sensor = SensorModel(sigma=0.01, kappa=50.0, direct_counts=1000.0)
    pulse = direct_pulse_counts(sensor, 0.01, 300, -0.5)
    t = -0.5 + 0.01 * (np.arange(300) + 0.5)
    assert pulse.sum() == pytest.approx(1000, rel=1e-9)
    assert (pulse * t).sum() / 1000 == pytest.approx(1 / 50, rel=1e-3)


def test_counts_have_poisson_mean_and_variance_and_repeat_with_their_seed():
    expected = np.tile([0.3, 4.0, 90.0], (40_000, 1))
    counts = draw_counts(expected, 7)
    assert counts.dtype == np.uint16
    assert np.array_equal(counts, draw_counts(expected, 7))
    assert not np.array_equal(counts, draw_counts(expected, 8))
    # Four standard errors: sqrt(λ/n) of the mean, about sqrt((2λ² + λ)/n) of the variance.
    mean, n = expected[0], len(expected)
    assert (np.abs(counts.mean(axis=0) - mean) < 4 * np.sqrt(mean / n)).all()
    assert (np.abs(counts.var(axis=0) - mean) < 4 * np.sqrt((2 * mean**2 + mean) / n)).all()


@pytest.mark.parametrize(
    "bad", [{"sigma": -1.0}, {"kappa": 0.0}, {"mean_counts": 0.0}, {"background": -0.1}, {"sigma": np.nan}]
)
def test_impossible_sensors_are_refused(bad):
    with pytest.raises(UserError, match="sigma"):
        SensorModel(**bad)
