"""A pipeline for a capture: sizes, start values and bounds worked out from the scan and the settings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import spot_spacing
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.model.albedo import FreeAlbedo, ResidualAlbedo
from nlos_lit.model.geometry import ImplicitGeometry
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.model.phasor import PhasorImaging
from nlos_lit.model.pipeline import Pipeline
from nlos_lit.model.renderer import TransientRenderer

FWHM = 2 * math.sqrt(2 * math.log(2))  # full width at half maximum of a unit Gaussian
SPEED_M_PER_PS = 299_792_458e-12


@dataclass(frozen=True)
class PipelineSettings:
    """Everything about the model that is not the capture; conf/model documents the profiles.

    Args:
        threshold: intensity below which a ray meets no surface.
        rays: n of the n × n rays of a spot.
        step_bins: spacing of ray samples in bins of path there and back (1: half a bin length).
        beta, fine, relative_beta: of the softargmax, see :class:`~nlos_lit.model.geometry.ImplicitGeometry`.
        power, depth_exponent: of the intensity, see :class:`~nlos_lit.model.phasor.PhasorImaging`.
        wavelength: default wavelength λ in m; None takes four spot spacings.
        wavelength_start, sigma_start: factors on λ and on 4λ/6 that give the start of 2π/Ω_pf and σ_pf.
        wavelength_range, sigma_range: bounds, as factors on the start values.
        albedo: "free" or "residual"; albedo_start for the former.
        splat_sigma, conserve_energy, subtract_splat: see renderer and laser-sensor model.
        jitter_fwhm_ps, decay_per_bin: start of σ_ls (as FWHM) and κ_s.
        background_start: start of η_s as a fraction of the normalisation; None estimates it from the capture.
    """

    threshold: float
    rays: int = 200
    step_bins: float = 1.0
    beta: float = 1e3
    fine: int = 4
    relative_beta: bool = True
    power: float = 1.0
    depth_exponent: float = 2.0
    wavelength: float | None = None
    wavelength_start: float = 0.8
    sigma_start: float = 1.2
    wavelength_range: tuple[float, float] = (2 / 3, 2.0)
    sigma_range: tuple[float, float] = (0.33, 1.5)
    albedo: str = "free"
    albedo_start: float = 0.5
    splat_sigma: float = 0.62
    conserve_energy: bool = True
    subtract_splat: bool = True
    jitter_fwhm_ps: float = 40.0
    decay_per_bin: float = 5.0
    background_start: float | None = None
    basis_tolerance: float = 1e-4


def build_pipeline(capture: Capture, grid: VolumeGrid, settings: PipelineSettings) -> Pipeline:
    """Submodules with start values as in the paper and its code; call ``pipeline.phasor.prepare`` and
    ``match_energy`` next.

    Raises:
        UserError: a setting is impossible.
    """
    s = settings
    if not 0 < s.threshold < 1:
        raise UserError(f"the intensity threshold must lie between 0 and 1; found {s.threshold}")
    if s.rays < 4:
        raise UserError(f"rays is the side of the ray grid and must be at least 4; found {s.rays}")
    if s.albedo not in ("free", "residual"):
        raise UserError(f"albedo must be 'free' or 'residual'; found {s.albedo!r}")
    wavelength = s.wavelength or 4 * spot_spacing(capture)
    start = wavelength * s.wavelength_start
    omega = 2 * math.pi / start
    sigma = s.sigma_start * 4 * wavelength / 6
    phasor = PhasorImaging(
        grid,
        BoundedParameter(omega, omega / s.wavelength_range[1], omega / s.wavelength_range[0], "rad/m"),
        BoundedParameter(sigma, sigma * s.sigma_range[0], sigma * s.sigma_range[1], "m"),
        power=s.power,
        depth_exponent=s.depth_exponent,
        tolerance=s.basis_tolerance,
    )
    bin_length, n_bins = capture.bin_length, capture.gate[1]
    geometry = ImplicitGeometry(
        grid,
        rays=s.rays,
        threshold=s.threshold,
        step=s.step_bins * bin_length / 2,
        beta=s.beta,
        fine=s.fine,
        relative=s.relative_beta,
    )
    albedo = (
        FreeAlbedo(grid.shape, s.albedo_start)
        if s.albedo == "free"
        else ResidualAlbedo(grid.shape, s.threshold)
    )
    renderer = TransientRenderer(
        n_bins=n_bins,
        bin_length=bin_length,
        t_start=capture.t_start,
        rays=s.rays**2,
        splat_sigma=s.splat_sigma,
        conserve_energy=s.conserve_energy,
    )
    smallest = LaserSensor.smallest_sigma(s.splat_sigma) if s.subtract_splat else 0.05
    jitter = max(s.jitter_fwhm_ps / FWHM * SPEED_M_PER_PS / bin_length, 1.05 * smallest)
    scale = normalisation(capture)
    background = (
        s.background_start * scale if s.background_start is not None else estimate_background(capture)
    )
    background = min(max(background, 2e-6 * scale), 0.5 * scale)
    laser_sensor = LaserSensor(
        bin_length=bin_length,
        n_bins=n_bins,
        sigma_ls=BoundedParameter(
            jitter * bin_length, smallest * bin_length, max(20.0, 4 * jitter) * bin_length, "m"
        ),
        kappa_s=BoundedParameter(s.decay_per_bin / bin_length, 0.01 / bin_length, 50.0 / bin_length, "1/m"),
        intensity=BoundedParameter(scale, scale * 1e-9, scale * 1e9, "counts m2"),
        background=BoundedParameter(background, 1e-6 * scale, scale, "counts/bin"),
        splat_sigma=s.splat_sigma if s.subtract_splat else None,
    )
    return Pipeline(capture, phasor, geometry, albedo, renderer, laser_sensor)


def normalisation(capture: Capture, quantile: float = 0.999999) -> float:
    """Counts that the loss counts as 1: the quantile of the gated bins.

    Raises:
        UserError: the gate holds no photons to speak of.
    """
    values = capture.gated_counts().reshape(-1)
    rank = min(values.size - 1, int(quantile * values.size))
    scale = float(np.partition(values, rank)[rank])
    if scale == 0:
        first, last = capture.gate
        raise UserError(
            f"the gate [{first}, {last}) holds no photons; the counts lie in other bins, so set the gate to theirs"
        )
    return scale


def estimate_background(capture: Capture) -> float:
    """Counts per bin that are there without the scene: the lowest mean over a sixteenth of the gate, all
    spots together.
    """
    mean = capture.gated_counts().mean(axis=0, dtype=np.float64)
    width = max(1, len(mean) // 16)
    smooth = np.convolve(mean, np.ones(width) / width, mode="valid")
    return float(smooth.min())


@torch.no_grad()
def match_energy(pipeline: Pipeline, capture: Capture, spots: torch.Tensor) -> None:
    """Set I_l so that rendered and measured energy agree over ``spots`` at the start.

    Raises:
        UserError: no ray of these spots meets the threshold.
    """
    sensor = pipeline.laser_sensor
    rendering = pipeline(spots)
    measured = torch.from_numpy(capture.gated_counts()[spots.cpu().numpy()]).to(rendering.expected)
    background = sensor.background()
    rendered = (rendering.expected - background).sum() / sensor.intensity()
    if rendered <= 0:
        raise UserError(
            "the first image has no surface that rays from the wall could meet: lower model.threshold, "
            "or check scene.volume.depth and the wall size"
        )
    excess = (measured - background).sum().clamp_min(1e-3 * measured.sum())
    old = sensor.intensity
    value = float(excess / rendered)
    sensor.intensity = BoundedParameter(value, value * 1e-3, value * 1e3, old.unit).to(
        rendering.expected.device
    )
