"""From expected radiance to photon counts: laser-sensor response, exposure, background and Poisson
statistics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import fftconvolve
from scipy.special import erfcx, ndtr

from nlos_lit.capture.errors import UserError

GAUSS_REACH = 8.0  # σ on either side, 1e-15 of the energy beyond
TAIL_REACH = 36.0  # lengths 1/κ of the exponential, 2e-16 beyond
SPOT_BLOCK = 256  # spots convolved at a time, to bound the memory


@dataclass(frozen=True)
class SensorModel:
    """Laser pulse and detector as one, and how long it looks.

    Args:
        sigma: standard deviation of the Gaussian jitter, m of path; 0 for none.
        kappa: decay rate of the exponential tail, 1/m of path; infinite for none.
        background: expected counts per bin from ambient light and dark counts.
        mean_counts: third-bounce counts a spot inside the window, averaged over the scan: sets the exposure.
        direct_counts: counts a spot of the first bounce at path 0, with the same response (confocal scans
            only).

    Raises:
        UserError: a negative number, or κ or the mean counts are zero.
    """

    sigma: float = 0.009
    kappa: float = 60.0
    background: float = 0.1
    mean_counts: float = 1500.0
    direct_counts: float = 0.0

    def __post_init__(self) -> None:
        finite = (self.sigma, self.background, self.mean_counts, self.direct_counts)
        if not (np.isfinite(finite).all() and min(finite) >= 0 and self.mean_counts > 0 and self.kappa > 0):
            raise UserError(
                f"sigma, background and direct_counts must be >= 0, kappa and mean_counts > 0; found {self}"
            )

    @property
    def reach(self) -> tuple[float, float]:
        """How far the response reaches before and after a photon's true path length, m."""
        return GAUSS_REACH * self.sigma, GAUSS_REACH * self.sigma + TAIL_REACH / self.kappa


def response_cdf(t: np.ndarray, sigma: float, kappa: float) -> np.ndarray:
    """Share of an exponential ⊛ Gaussian that arrives before path ``t``.

    F(t) = Φ(t/σ) - exp(κ²σ²/2 - κt) Φ(t/σ - κσ), written with erfcx where exp and Φ would over- and
    underflow.
    """
    t = np.asarray(t, dtype=np.float64)
    if sigma == 0:
        return (t >= 0).astype(np.float64) if np.isinf(kappa) else -np.expm1(-kappa * np.maximum(t, 0))
    if np.isinf(kappa):
        return ndtr(t / sigma)
    z = t / sigma - kappa * sigma
    scaled = 0.5 * erfcx(-np.minimum(z, 0) / np.sqrt(2)) * np.exp(-0.5 * (t / sigma) ** 2)
    plain = np.exp(np.minimum(kappa * sigma * (kappa * sigma / 2 - t / sigma), 0)) * ndtr(z)
    return ndtr(t / sigma) - np.where(z < 0, scaled, plain)


def response_kernel(sigma: float, kappa: float, bin_length: float) -> tuple[np.ndarray, int]:
    """The response integrated over bins, for a photon due at the centre of bin 0.

    Returns:
        kernel ``[K]`` with sum 1, mean 1/κ and variance σ² + 1/κ² + bin²/12 (in path, counted from bin centre
        0, for responses wider than a bin), and the bin of its first entry (≤ 0).
    """
    before, after = SensorModel(sigma, kappa).reach
    first, last = -int(np.ceil(before / bin_length)) - 1, int(np.ceil(after / bin_length)) + 1
    edges = (np.arange(first, last + 2) - 0.5) * bin_length
    return np.diff(response_cdf(edges, sigma, kappa)), first


def respond(transients: np.ndarray, sensor: SensorModel, bin_length: float) -> np.ndarray:
    """Transients ``[S, T]`` as the sensor sees them, same bins; each bin's light is taken to arrive at its
    centre.
    """
    kernel, first = response_kernel(sensor.sigma, sensor.kappa, bin_length)
    seen = np.empty_like(transients)
    for start in range(0, len(transients), SPOT_BLOCK):
        block = slice(start, start + SPOT_BLOCK)
        full = fftconvolve(transients[block], kernel[None], axes=1)
        seen[block] = np.maximum(
            full[:, -first : -first + transients.shape[1]], 0
        )  # the FFT leaves ±1e-17 where there is nothing
    return seen


def direct_pulse(sensor: SensorModel, bin_length: float, n_bins: int, t_start: float) -> np.ndarray:
    """``[T]`` expected counts of the first bounce, due at path 0."""
    edges = t_start + bin_length * np.arange(n_bins + 1)
    return sensor.direct_counts * np.diff(response_cdf(edges, sensor.sigma, sensor.kappa))


def draw_counts(expected: np.ndarray, seed: int) -> np.ndarray:
    """Poisson counts of ``expected`` in the smallest unsigned type; the same seed gives the same counts."""
    counts = np.random.default_rng(seed).poisson(expected)
    return counts.astype(np.uint16 if counts.max() <= np.iinfo(np.uint16).max else np.uint32)
