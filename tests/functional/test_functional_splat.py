"""The splat: energy, ripple, centroid, variance, edges of the window."""

from __future__ import annotations

import literal
import pytest
import torch

from nlos_lit.functional.splat import gaussian_splat, splat_variance

PHASE = torch.arange(200, dtype=torch.float64) / 200


def splat(times, sigma, normalise=True, bins=40):
    """One path of energy 1 per row."""
    times = torch.as_tensor(times, dtype=torch.float64)
    rows = torch.arange(len(times))
    return gaussian_splat(
        torch.ones(len(times), dtype=torch.float64), times, rows, len(times), bins, sigma, normalise
    )


def test_by_hand():
    """σ = 1/√2 at the centre of bin 5: weights 1, e⁻¹, e⁻⁴, e⁻⁹ by distance; half-way between two bins they
    share alike.
    """
    found = splat([5.5, 6.0], 0.5**0.5, normalise=False)
    weights = torch.exp(-(torch.arange(4, dtype=torch.float64) ** 2))
    assert torch.allclose(found[0, 5:9], weights, rtol=1e-12)
    assert torch.allclose(found[0, 2:6].flip(0), weights, rtol=1e-12)
    assert found[1, 5] == pytest.approx(found[1, 6].item())
    assert found[1].argmax().item() in (5, 6)


@pytest.mark.parametrize("sigma", [0.2, 0.425, 0.62, 1.3, 3.0])
def test_energy_is_conserved_under_sub_bin_shifts(sigma):
    total = splat(20 + PHASE, sigma).sum(1)
    assert (total - 1).abs().max() < 1e-12
    single = gaussian_splat(torch.ones(200), (20 + PHASE).float(), torch.arange(200), 200, 40, sigma)
    assert (single.sum(1) - 1).abs().max() < 1e-6


@pytest.mark.parametrize(("sigma", "ripple"), [(0.62, 1.02e-3), (0.425, 5.66e-2)])
def test_ripple_of_the_unit_peak_gaussian(sigma, ripple):
    """2 e^{-2π²σ²} by Poisson summation: ±0.1 % at the paper's 0.62, ±5.7 % at 0.425."""
    total = splat(20 + PHASE, sigma, normalise=False).sum(1)
    found = (total.max() - total.min()) / 2 / total.mean()
    assert found.item() == pytest.approx(ripple, rel=0.01)


@pytest.mark.parametrize(("sigma", "worst"), [(0.425, 6.4e-2), (0.62, 2.44e-3), (1.3, 0)])
def test_centroid(sigma, worst):
    """Off by up to 4πσ² e^{-2π²σ²} (Poisson summation): 0.064 bin at σ = 0.425, 0.0024 at 0.62; beyond, by
    the cut at 4.5σ.
    """
    centres = torch.arange(40, dtype=torch.float64) + 0.5
    error = ((splat(20 + PHASE, sigma) @ centres) - 20 - PHASE).abs().max().item()
    assert error == pytest.approx(worst, rel=0.01, abs=2e-5)


@pytest.mark.parametrize("sigma", [0.1, 0.425, 0.62, 1.0, 2.0, 4.0])
def test_splat_variance(sigma):
    assert splat_variance(sigma) == pytest.approx(literal.splat_variance(sigma), rel=1e-3)
    centres = torch.arange(80, dtype=torch.float64) + 0.5
    arrival = (40 + PHASE)[:, None]
    spread = (splat(40 + PHASE, sigma, bins=80) * (centres - arrival) ** 2).sum(1).mean().item()
    assert splat_variance(sigma) == pytest.approx(spread, rel=1e-3)


def test_paths_leave_the_window_without_reaching_other_spots():
    times = torch.tensor([-0.2, 9.9, -50.0, 60.0, 4.5])
    found = gaussian_splat(torch.ones(5), times, torch.tensor([0, 0, 1, 1, 2]), 3, 10, 0.62)
    whole = gaussian_splat(torch.ones(2), times[:2] + 20, torch.tensor([0, 0]), 1, 50, 0.62)[0, 20:30]
    assert torch.allclose(found[0], whole, atol=1e-7)
    assert found[1].abs().max() == 0
    assert found[2].sum() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("sigma", [0.02, 0.005])
def test_a_very_narrow_gaussian_falls_into_the_nearest_bin(sigma):
    found = gaussian_splat(
        torch.tensor([2.0, 3.0]), torch.tensor([5.01, 6.9]), torch.tensor([0, 0]), 1, 10, sigma
    )
    assert torch.allclose(found[0, 5:7], torch.tensor([2.0, 3.0]), atol=1e-6)


def test_gradients():
    generator = torch.manual_seed(0)
    energy = torch.rand(6, dtype=torch.float64, generator=generator, requires_grad=True)
    time = (torch.rand(6, dtype=torch.float64, generator=generator) * 12 - 1).requires_grad_()
    spot = torch.tensor([0, 1, 1, 0, 2, 1])
    for normalise in (True, False):
        assert torch.autograd.gradcheck(
            lambda e, t, n=normalise: gaussian_splat(e, t, spot, 3, 10, 0.62, n), (energy, time)
        )
