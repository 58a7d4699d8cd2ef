"""A pipeline for a capture: sizes, start values and bounds worked out from the scan and the settings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import spot_spacing
from nlos_lit.capture.background import quietest_level
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
BRIGHT = 0.999999  # just below 1, so that single hot bins do not set the scale


@dataclass(frozen=True)
class PipelineSettings:
    """Everything about the model that is not the capture.

    These are the defaults; ``conf/model`` holds what its profiles change (docs/model.md says why).

    Args:
        threshold: share of the largest intensity below which a ray meets no surface.
        rays: n of the n × n rays of a spot (the paper's batch: 32 spots × 40 000 rays).
        step_bins: spacing of ray samples in bins of path there and back (1: half a bin length).
        beta: of the softargmax along a ray, see :class:`~nlos_lit.model.geometry.ImplicitGeometry`.
        fine: samples a step around a ray's largest sample; 1: none, depth is then quantised to half a bin.
        relative_beta: ``beta`` acts on intensities relative to the ray's largest.
        power: of the field in I = z^depth_exponent |u|^power / max, see
            :class:`~nlos_lit.model.phasor.PhasorImaging`.
        depth_exponent: of the depth z in the same.
        wavelength: default wavelength λ, m; None takes four spot spacings.
        wavelength_start: factor on λ that gives the start of 2π/Ω_pf.
        sigma_start: factor on 4λ/6 that gives the start of σ_pf.
        wavelength_range: bounds of 2π/Ω_pf, as factors on its start.
        sigma_range: bounds of σ_pf, as factors on its start.
        albedo: ``free``, one value a voxel, or ``residual``, clamp(mask (I + δ), 0, 1).
        albedo_start: start value of the former.
        splat_sigma: standard deviation of a path's Gaussian in time, bins.
        conserve_energy: each path's splat sums to its energy; else its peak is one (Sec. 4.3).
        subtract_splat: σ_ls is the physical width, the splat's is taken out of Ψ; else Ψ comes on top of the
            splat (Eq. 9).
        jitter_fwhm_ps: start of σ_ls, as full width at half maximum, ps.
        decay_per_bin: start of κ_s, 1/bin.
        background_start: start of η_s as a fraction of the normalisation; None takes the quietest sixteenth
            of the gate.
        basis_tolerance: relative error of the virtual spectrum in the stored basis.
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
    wavelength_range: tuple[float, float] = (0.6667, 2.0)
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
    """Submodules with start values as in the paper and its code.

    ``pipeline.phasor.prepare`` and :func:`match_energy` come next.

    Args:
        capture: what is fitted.
        grid: the volume.
        settings: of the model.

    Returns:
        The simulated measurement of the capture's spots.

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
    mean = torch.from_numpy(capture.mean_transient()[slice(*capture.gate)])
    background = quietest_level(mean) if s.background_start is None else s.background_start * scale
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


def normalisation(capture: Capture) -> float:
    """Counts that the loss counts as 1: the ``BRIGHT`` quantile of the gated bins that were recorded.

    Args:
        capture: what is fitted.

    Returns:
        Counts a bin, above 0.

    Raises:
        UserError: the gate holds no photons to speak of.
    """
    values, observed = capture.gated_counts(), capture.gated_observed()
    values = values.reshape(-1) if observed is None else values[observed]
    above = values.size - min(values.size - 1, int(BRIGHT * values.size))
    peaks = np.maximum.reduceat(values, np.arange(0, values.size, 1024))
    if above < len(peaks):  # what lies below that many peaks is not among that many bins either
        values = values[values >= np.partition(peaks, -above)[-above]]
    scale = float(np.partition(values, -above)[-above])
    if scale == 0:
        first, last = capture.gate
        raise UserError(
            f"the gate [{first}, {last}) holds no photons; the counts lie in other bins, "
            "so set the gate to theirs"
        )
    return scale


@torch.no_grad()
def match_energy(pipeline: Pipeline, capture: Capture, spots: torch.Tensor) -> None:
    """Set I_l so that rendered and measured energy agree at the start.

    Args:
        pipeline: its phasor field prepared; changed in place.
        capture: what is fitted.
        spots: ``[S]`` rows of it that are compared.

    Raises:
        UserError: no ray of these spots meets the threshold.
    """
    sensor = pipeline.laser_sensor
    rendering = pipeline(spots)
    measured = torch.from_numpy(capture.gated_counts()[spots.cpu().numpy()]).to(rendering.expected)
    background = sensor.background()
    observed = pipeline.observed_at(spots)
    seen = torch.ones_like(measured) if observed is None else observed.to(measured)
    rendered = ((rendering.expected - background) * seen).sum() / sensor.intensity()
    if rendered <= 0:
        raise UserError(
            "the first image has no surface that rays from the wall could meet: lower model.threshold, "
            "or check scene.volume.depth and the wall size"
        )
    excess = ((measured - background) * seen).sum().clamp_min(1e-3 * measured.sum())
    sensor.set_intensity(float(excess / rendered))
