"""How well rendered transients explain measured counts."""

from __future__ import annotations

import torch
from torch import Tensor


def nmse(measured: Tensor, rendered: Tensor) -> Tensor:
    """``Σ(H - H_R)²/ΣH²`` over all elements."""
    measured, rendered = measured.double(), rendered.double()
    return ((measured - rendered) ** 2).sum() / (measured**2).sum()


def nmse_noise_floor(measured: Tensor) -> Tensor:
    """What :func:`nmse` gives for the true expectation under Poisson noise: ``ΣVar(H)/ΣH² ≈ ΣH/ΣH²``."""
    measured = measured.double()
    return measured.sum() / (measured**2).sum()


def poisson_deviance(counts: Tensor, expected: Tensor) -> Tensor:
    """``2(k ln(k/μ) - k + μ)`` elementwise; μ must be positive where k is."""
    counts, expected = counts.double(), expected.double()
    return 2 * (torch.xlogy(counts, counts / expected.clamp_min(1e-300)) - counts + expected)


def expected_deviance(expected: Tensor, seed: int = 0) -> Tensor:
    """Mean Poisson deviance per bin of counts drawn from ``expected`` itself: the pure-noise level of the fit's own model."""
    generator = torch.Generator(device=expected.device).manual_seed(seed)
    drawn = torch.poisson(expected.double(), generator=generator)
    return poisson_deviance(drawn, expected).mean()
