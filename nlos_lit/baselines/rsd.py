"""Plain phasor-field imaging with the default virtual illumination of Liu et al.; nothing is fitted.

Liu, Bauer, Velten, *Phasor field diffraction based reconstruction for fast non-line-of-sight imaging
systems*, Nature Communications 11, 1645 (2020).
"""

from __future__ import annotations

import math

import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import spot_spacing
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.model.phasor import PhasorImaging


def rsd(
    capture: Capture,
    grid: VolumeGrid,
    *,
    wavelength: float | None = None,
    cycles: float = 4.0,
    power: float = 2.0,
    depth_exponent: float = 0.0,
) -> torch.Tensor:
    """Intensity ``z^q |u|^p``, unit maximum, for a virtual pulse of ``cycles`` wavelengths.

    Args:
        capture: of any kind.
        grid: where to reconstruct; on the scan's lattice it is much faster.
        wavelength: λ, m; None takes four spot spacings, as Liu et al. recommend at least two.
        cycles: σ_pf = cycles·λ/6, so that ±3 σ hold that many wavelengths.
        power: p of the intensity; the paper's Eq. 2 has 2.
        depth_exponent: q of the intensity.

    Returns:
        ``[nz, nx, ny]`` float32 in 0 … 1.

    Raises:
        CaptureError: the volume lies outside the gate.
    """
    imaging = _imaging(capture, grid, wavelength, cycles, power, depth_exponent)
    imaging.prepare(capture, imaging.plan(capture, 2**62))
    with torch.no_grad():
        return imaging()


def rsd_bytes(capture: Capture, grid: VolumeGrid) -> int:
    """Bytes that :func:`rsd` takes with default options.

    Args:
        capture: of any kind.
        grid: where to reconstruct.

    Returns:
        Bytes, beyond the capture's counts.

    Raises:
        CaptureError: the volume lies outside the gate.
    """
    return _imaging(capture, grid, None, 4.0, 2.0, 0.0).plan(capture, 2**62).total_bytes


def _imaging(
    capture: Capture,
    grid: VolumeGrid,
    wavelength: float | None,
    cycles: float,
    power: float,
    depth_exponent: float,
) -> PhasorImaging:
    length = wavelength if wavelength is not None else 4 * spot_spacing(capture)
    omega, sigma = 2 * math.pi / length, cycles * length / 6
    # The stored basis holds this one illumination: bounds within a thousandth.
    return PhasorImaging(
        grid,
        BoundedParameter(omega, omega / 1.001, omega * 1.001, "rad/m"),
        BoundedParameter(sigma, sigma / 1.001, sigma * 1.001, "m"),
        power=power,
        depth_exponent=depth_exponent,
    )
