"""From expected radiance to photon counts: response, exposure, background and Poisson statistics."""

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
    """Share of the response, an exponential ⊛ Gaussian, that arrives before a path length.

    F(t) = Φ(t/σ) - exp(κ²σ²/2 - κt) Φ(t/σ - κσ), written with erfcx where exp and Φ would over- and
    underflow.

    Args:
        t: path lengths after the true one, m, any shape.
        sigma: σ, standard deviation of the Gaussian, m; 0 for none.
        kappa: κ, decay rate of the exponential, 1/m; infinite for none.

    Returns:
        shares in [0, 1], in the shape of ``t``.

    Examples:
        >>> response_cdf(np.array([-1.0, 0.0, np.log(2.0)]), sigma=0.0, kappa=1.0).round(9).tolist()
        [0.0, 0.0, 0.5]
        >>> float(response_cdf(np.array(0.0), sigma=0.01, kappa=np.inf))
        0.5
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

    Args:
        sigma: standard deviation of the Gaussian jitter, m of path.
        kappa: decay rate of the exponential tail, 1/m.
        bin_length: optical path of one bin, m.

    Returns:
        kernel ``[K]`` with sum 1, mean 1/κ and variance σ² + 1/κ² + bin²/12 (in path, counted from bin centre
        0, for responses wider than a bin), and the bin of its first entry (≤ 0).

    Examples:
        An exponential of decay length 1 over bins of 1, due at the centre of bin 0:

        >>> kernel, first = response_kernel(0.0, 1.0, 1.0)
        >>> kernel[-first : 2 - first].round(6).tolist()  # 1 - exp(-1/2), exp(-1/2) - exp(-3/2)
        [0.393469, 0.3834]
        >>> round(float(kernel.sum()), 9)
        1.0
    """
    before, after = SensorModel(sigma, kappa).reach
    first, last = -int(np.ceil(before / bin_length)) - 1, int(np.ceil(after / bin_length)) + 1
    edges = (np.arange(first, last + 2) - 0.5) * bin_length
    return np.diff(response_cdf(edges, sigma, kappa)), first


def respond(transients: np.ndarray, sensor: SensorModel, bin_length: float) -> np.ndarray:
    """Transients as the sensor sees them, in the same bins.

    Each bin's light is taken to arrive at its centre.

    Args:
        transients: ``[S, T]`` expected light.
        sensor: its response; exposure and background are not applied.
        bin_length: optical path of one bin, m.

    Returns:
        ``[S, T]``; what the response carries beyond the last bin is lost.
    """
    kernel, first = response_kernel(sensor.sigma, sensor.kappa, bin_length)
    seen = np.empty_like(transients)
    for start in range(0, len(transients), SPOT_BLOCK):
        block = slice(start, start + SPOT_BLOCK)
        full = fftconvolve(transients[block], kernel[None], axes=1)
        # The FFT leaves ±1e-17 where there is nothing.
        seen[block] = np.maximum(full[:, -first : -first + transients.shape[1]], 0)
    return seen


def direct_pulse_counts(sensor: SensorModel, bin_length: float, n_bins: int, t_start: float) -> np.ndarray:
    """Expected counts of the first bounce, due at path 0.

    Args:
        sensor: its response and ``direct_counts``.
        bin_length: optical path of one bin, m.
        n_bins: number of bins T.
        t_start: path length at the start of bin 0, m.

    Returns:
        ``[T]`` counts a bin of every spot.

    Examples:
        >>> plain = SensorModel(sigma=0.0, kappa=np.inf, direct_counts=100.0)
        >>> direct_pulse_counts(plain, bin_length=0.5, n_bins=4, t_start=-1.25).tolist()
        [0.0, 0.0, 100.0, 0.0]
    """
    edges = t_start + bin_length * np.arange(n_bins + 1)
    return sensor.direct_counts * np.diff(response_cdf(edges, sensor.sigma, sensor.kappa))


def draw_counts(expected: np.ndarray, seed: int) -> np.ndarray:
    """Poisson counts, in the smallest unsigned type that holds them.

    Args:
        expected: counts, any shape.
        seed: the same seed gives the same counts.

    Returns:
        uint16 or uint32, in the shape of ``expected``.

    Examples:
        >>> expected = np.full((2, 3), 4.0)
        >>> bool((draw_counts(expected, seed=1) == draw_counts(expected, seed=1)).all())
        True
        >>> draw_counts(np.array([0.0, 1e5]), seed=0).dtype
        dtype('uint32')
    """
    counts = np.random.default_rng(seed).poisson(expected)
    return counts.astype(np.uint16 if counts.max() <= np.iinfo(np.uint16).max else np.uint32)
