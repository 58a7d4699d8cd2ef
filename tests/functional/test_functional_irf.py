"""The laser-sensor response against scipy, mpmath's arbitrary precision and sums by hand."""

from __future__ import annotations

import literal
import mpmath
import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE
from scipy.stats import exponnorm

from nlos_lit.functional.irf import convolve_time, emg_cdf, response

SHAPES = [1e-4, 1e-2, 0.3, 1.0, 5.0, 40.0, 1e3, 1e4]  # κσ
DOUBLE = torch.float64


def times(sigma: float, kappa: float) -> np.ndarray:
    """Both tails of the Gaussian, and far into the exponential's."""
    near = np.linspace(-9, 9, 61) * sigma
    return np.unique(
        np.concatenate([near, np.geomspace(1e-3, 40, 30) / kappa, -np.geomspace(1e-3, 30, 12) * sigma])
    )


def exact_cdf(t: float, sigma: float, kappa: float) -> mpmath.mpf:
    with mpmath.workdps(60):
        t, sigma, kappa = mpmath.mpf(t), mpmath.mpf(sigma), mpmath.mpf(kappa)
        tail = mpmath.erfc(-(t / sigma - kappa * sigma) / mpmath.sqrt(2)) / 2
        return (
            mpmath.erfc(-t / sigma / mpmath.sqrt(2)) / 2
            - mpmath.exp(-kappa * t + (kappa * sigma) ** 2 / 2) * tail
        )


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sigma", [0.03, 1.0, 25.0])
def test_cdf_is_scipys(shape, sigma):
    kappa = shape / sigma
    t = times(sigma, kappa)
    found = emg_cdf(
        torch.from_numpy(t), torch.tensor(sigma, dtype=DOUBLE), torch.tensor(kappa, dtype=DOUBLE)
    ).numpy()
    expected = exponnorm.cdf(t, 1 / shape, scale=sigma)
    assert np.abs(found - expected).max() < 1e-9
    assert (np.diff(found) > -1e-12).all()


@pytest.mark.parametrize("shape", SHAPES)
def test_cdf_and_gradients_are_exact(shape):
    """Value and both derivatives against 60 digits; derivatives in units of what they change by over one σ
    and one 1/κ.
    """
    sigma, kappa = 0.7, shape / 0.7
    s, k = (torch.tensor(v, dtype=DOUBLE, requires_grad=True) for v in (sigma, kappa))
    for t in times(sigma, kappa)[::6]:
        value = emg_cdf(torch.tensor([t], dtype=DOUBLE), s, k)[0]
        by_sigma, by_kappa = torch.autograd.grad(value, (s, k))
        assert value.item() == pytest.approx(float(exact_cdf(t, sigma, kappa)), abs=1e-12)
        step = mpmath.mpf(10) ** -20
        with mpmath.workdps(60):
            high, low = (exact_cdf(t, mpmath.mpf(sigma) * (1 + d), kappa) for d in (step, -step))
            assert by_sigma.item() * sigma == pytest.approx(float((high - low) / (2 * step)), abs=1e-9)
            high, low = (exact_cdf(t, sigma, mpmath.mpf(kappa) * (1 + d)) for d in (step, -step))
            assert by_kappa.item() * kappa == pytest.approx(float((high - low) / (2 * step)), abs=1e-9)


def test_no_nan_anywhere():
    t = torch.cat(
        [
            -torch.logspace(-6, 6, 60, dtype=DOUBLE),
            torch.zeros(1, dtype=DOUBLE),
            torch.logspace(-6, 6, 60, dtype=DOUBLE),
        ]
    )
    for sigma in (1e-3, 0.1, 1.0, 30.0, 1e3):
        for kappa in (1e-6, 1e-2, 1.0, 50.0, 1e4):
            s, k = (torch.tensor(v, dtype=DOUBLE, requires_grad=True) for v in (sigma, kappa))
            value = emg_cdf(t, s, k)
            gradients = torch.autograd.grad(value.sum(), (s, k))
            assert torch.isfinite(value).all()
            assert all(torch.isfinite(g) for g in gradients), (sigma, kappa)
            assert (value >= 0).all()
            assert (value <= 1).all()


@pytest.mark.parametrize(("sigma", "kappa"), [(0.8, 1.7), (1.0, 50.0), (2.5, 0.2), (6.0, 30.0)])
def test_response_moments(sigma, kappa):
    """Sum 1, mean 1/κ, variance σ² + 1/κ² + 1/12: a bin's width adds its own."""
    lead, bins = 60, 400
    kernel = response(torch.tensor(sigma), torch.tensor(kappa), bins, lead).double()
    lag = torch.arange(bins, dtype=DOUBLE) - lead
    assert kernel.sum().item() == pytest.approx(1, abs=1e-5)
    mean = (kernel * lag).sum().item()
    assert mean == pytest.approx(1 / kappa, abs=1e-4)
    variance = (kernel * (lag - mean) ** 2).sum().item()
    assert variance == pytest.approx(sigma**2 + 1 / kappa**2 + 1 / 12, rel=2e-3)


@pytest.mark.parametrize(("sigma", "kappa"), [(1e-3, 1e3), (0.05, 0.3), (0.05, 50.0), (20.0, 0.5)])
def test_response_keeps_the_energy_however_narrow_or_wide(sigma, kappa):
    kernel = response(torch.tensor(sigma), torch.tensor(kappa), 400, 150)
    assert kernel.double().sum().item() == pytest.approx(1, abs=1e-5)
    assert (kernel >= 0).all()


@pytest.mark.parametrize(("sigma", "kappa"), [(0.3, 2.0), (0.9, 0.35), (3.0, 1.2)])
def test_response_is_the_sampled_convolution(sigma, kappa):
    found = response(torch.tensor(sigma), torch.tensor(kappa), 90, 20)
    expected = literal.psi(torch.tensor(sigma, dtype=DOUBLE), torch.tensor(kappa, dtype=DOUBLE), -20, 69)
    assert literal.relative(found, expected) < 2e-4


def test_response_by_hand():
    """Without jitter: nothing before the arrival, 1 - e^{-κ/2} in its own bin, then a geometric decay."""
    kernel = response(torch.tensor(1e-3), torch.tensor(0.8), 12, 3)
    own = 1 - np.exp(-0.4)
    expected = [0, 0, 0, own] + [np.exp(-0.8 * (k - 0.5)) * (1 - np.exp(-0.8)) for k in range(1, 9)]
    assert np.allclose(kernel.numpy(), expected, atol=2e-3)


@pytest.mark.parametrize(("bins", "length", "lead"), [(50, 21, 6), (50, 50, 0), (7, 30, 20), (31, 1, 0)])
def test_convolve_time_is_numpys(bins, length, lead):
    rng = np.random.default_rng(bins)
    transients, kernel = rng.random((3, bins)), rng.random(length)
    found = convolve_time(torch.from_numpy(transients), torch.from_numpy(kernel), lead).numpy()
    expected = np.stack([np.convolve(row, kernel)[lead : lead + bins] for row in transients])
    assert np.allclose(found, expected, atol=1e-12)


@FORWARD_MODE
def test_derivatives_of_the_convolution_are_exact():
    gen = torch.Generator().manual_seed(0)
    light, kernel = torch.rand(3, 12, generator=gen, dtype=DOUBLE), torch.rand(5, generator=gen, dtype=DOUBLE)
    inputs = (light.requires_grad_(), kernel.requires_grad_())
    assert torch.autograd.gradcheck(lambda a, b: convolve_time(a, b, 2), inputs, check_forward_ad=True)
