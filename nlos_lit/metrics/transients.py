"""How well rendered transients explain measured counts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Scores:
    """How well transients are explained, and what the truth itself would score.

    Args:
        deviance_per_bin: mean Poisson deviance of a bin.
        deviance_noise: of counts drawn from the rendering itself, see :func:`expected_deviance`.
        nmse: see :func:`nmse`.
        nmse_noise_floor: see :func:`nmse_noise_floor`.
    """

    deviance_per_bin: float
    deviance_noise: float
    nmse: float
    nmse_noise_floor: float


def transient_scores(counts: Tensor, expected: Tensor, observed: Tensor | None = None) -> Scores:
    """All scores of rendered transients.

    Args:
        counts: ``[S, T]`` measured photon counts.
        expected: ``[S, T]`` rendered counts, positive where ``counts`` are.
        observed: ``[S, T]`` bool, the bins that were recorded; the others are left out. None: all.

    Returns:
        scores with their noise levels.

    Examples:
        >>> import torch
        >>> seen = torch.tensor([True, True, False])
        >>> transient_scores(torch.tensor([3.0, 4.0, 0.0]), torch.tensor([3.0, 3.0, 7.0]), seen).nmse
        0.04
    """
    if observed is not None:
        counts, expected = counts[observed], expected[observed]
    return Scores(
        deviance_per_bin=poisson_deviance(counts, expected).mean().item(),
        deviance_noise=expected_deviance(expected).item(),
        nmse=nmse(counts, expected).item(),
        nmse_noise_floor=nmse_noise_floor(counts).item(),
    )


def nmse(measured: Tensor, rendered: Tensor) -> Tensor:
    """Normalised mean squared error ``Σ(H - H_R)²/ΣH²`` over all elements.

    Args:
        measured: H, of any shape.
        rendered: H_R, of the same shape and unit.

    Returns:
        A float64 scalar; 0 is perfect, an empty rendering scores 1.

    Examples:
        >>> import torch
        >>> nmse(torch.tensor([3.0, 4.0]), torch.tensor([3.0, 3.0]))
        tensor(0.0400, dtype=torch.float64)
    """
    measured, rendered = measured.double(), rendered.double()
    return ((measured - rendered) ** 2).sum() / (measured**2).sum()


def nmse_noise_floor(measured: Tensor) -> Tensor:
    """What :func:`nmse` gives for the true expectation under Poisson noise: ``ΣVar(H)/ΣH² ≈ ΣH/ΣH²``.

    Args:
        measured: photon counts H, of any shape.

    Returns:
        A float64 scalar.

    Examples:
        >>> import torch
        >>> nmse_noise_floor(torch.tensor([3.0, 4.0]))
        tensor(0.2800, dtype=torch.float64)
    """
    measured = measured.double()
    return measured.sum() / (measured**2).sum()


def poisson_deviance(counts: Tensor, expected: Tensor) -> Tensor:
    """Poisson deviance ``2(k ln(k/μ) - k + μ)`` of each count.

    Args:
        counts: photon counts k, of any shape.
        expected: μ, of the same shape; must be positive where ``counts`` are.

    Returns:
        float64 of that shape, nonnegative; about 1 on average where μ explains many counts.

    Examples:
        >>> import torch
        >>> poisson_deviance(torch.tensor([0.0, 4.0, 4.0]), torch.tensor([1.5, 4.0, 1.0]))
        tensor([3.0000, 0.0000, 5.0904], dtype=torch.float64)
    """
    counts, expected = counts.double(), expected.double()
    return 2 * (torch.xlogy(counts, counts / expected.clamp_min(1e-300)) - counts + expected)


def expected_deviance(expected: Tensor, terms: int = 60) -> Tensor:
    """Mean Poisson deviance of counts drawn from ``expected`` itself: the level of pure noise.

    ``2 E[k ln(k/μ)]``, summed over k < ``terms`` on a table in ln μ for μ < 20 (error below 1e-4), 1 + 1/(6μ)
    + 1/(6μ²) beyond.

    Args:
        expected: μ, of any shape.
        terms: of the sum.

    Returns:
        A float64 scalar, the mean over all elements.

    Examples:
        >>> import torch
        >>> [round(expected_deviance(torch.tensor([mu])).item(), 3) for mu in (0.01, 1.0, 100.0)]
        [0.092, 1.147, 1.002]
    """
    mu = torch.exp(torch.linspace(math.log(1e-6), math.log(20.0), 2000, dtype=torch.float64))
    k = torch.arange(terms, dtype=torch.float64)[:, None]
    weight = torch.exp(k * mu.log() - mu - torch.lgamma(k + 1))
    table = (2 * (weight * (torch.xlogy(k, k) - k * mu.log())).sum(0)).to(expected.device)
    value = expected.double().clamp_min(1e-6)
    place = (value.clamp_max(20.0).log() - math.log(1e-6)) / (math.log(20.0) - math.log(1e-6)) * (len(mu) - 1)
    low = place.floor().long().clamp(0, len(mu) - 2)
    small = table[low] + (place - low) * (table[low + 1] - table[low])
    return torch.where(value < 20, small, 1 + 1 / (6 * value) + 1 / (6 * value**2)).mean()
