"""What a self-calibration shows of itself: a few transients, the surface they see, figures of its state."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.functional.march import trilinear
from nlos_lit.io.points import Points
from nlos_lit.report import figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nlos_lit.model.pipeline import Pipeline

GOLDEN = 0.6180339887498949  # its multiples fill the unit interval evenly


def shown_spots(n_spots: int, count: int) -> np.ndarray:
    """Spots spread over the scan along a golden-ratio sequence: no row or column is favoured.

    Args:
        n_spots: S, of the scan.
        count: how many are wanted, K.

    Returns:
        ``[K]`` rows of the capture in rising order, fewer where several fall on the same.

    Examples:
        >>> shown_spots(100, 3)
        array([23, 61, 85])
    """
    return np.unique(((np.arange(1, count + 1) * GOLDEN) % 1.0 * n_spots).astype(np.int64))


def scanned_points(capture: Capture) -> np.ndarray:
    """``[S, 3]`` wall points that the scan moves, m: the laser's where one sensor point serves all spots."""
    return capture.laser if capture.kind == "single_sensor" else capture.sensor


def spot_labels(capture: Capture, spots: np.ndarray) -> list[str]:
    """Where each spot is on the wall, for panels of transients.

    Args:
        capture: the measurement.
        spots: ``[K]`` rows of it.

    Returns:
        K labels with x and y in m, of the laser points where one sensor point serves all spots.
    """
    scanned, name = scanned_points(capture), "laser" if capture.kind == "single_sensor" else "spot"
    return [f"{name} at x = {scanned[s, 0]:.2f}, y = {scanned[s, 1]:.2f} m" for s in spots]


def transients_of(capture: Capture, spots: np.ndarray, expected: torch.Tensor) -> Figure:
    """Measured and expected transients of a few spots over path length.

    Args:
        capture: the measurement.
        spots: ``[K]`` rows of it.
        expected: ``[K, T_gate]`` counts.

    Returns:
        a figure with a panel a spot.
    """
    path = capture.path_gate[0] + (np.arange(expected.shape[1]) + 0.5) * capture.bin_length
    measured, observed = capture.gated_counts()[spots], capture.gated_observed()
    return figures.transients_plot(
        measured, expected.cpu().numpy(), path, spot_labels(capture, spots),
        observed=None if observed is None else observed[spots],
    )  # fmt: skip


def spot_residuals(
    capture: Capture, spots: np.ndarray, expected: Callable[[torch.Tensor], torch.Tensor], block: int = 256
) -> tuple[np.ndarray, np.ndarray]:
    """What each scanned wall point counted beyond the expected, over all bins that were recorded.

    Args:
        capture: the measurement.
        spots: ``[K]`` rows of it; those at the same scanned point are taken together.
        expected: ``[B, T_gate]`` expected counts of spots ``[B]``.
        block: spots at once.

    Returns:
        ``[N, 2]`` x and y of the points, m, and ``[N]`` the residual in standard deviations of its counting
        noise, 0 where nothing is expected.
    """
    observed = capture.gated_observed()
    first, last = capture.gate
    totals = []
    for part in np.split(spots, range(block, len(spots), block)):
        seen = 1.0 if observed is None else observed[part]
        mu = expected(torch.from_numpy(part)).double().cpu().numpy()
        totals.append(
            np.stack([(capture.counts[part, first:last] * seen).sum(1), (mu * seen).sum(1)], axis=1)
        )
    places, row = np.unique(scanned_points(capture)[spots, :2], axis=0, return_inverse=True)
    counted, meant = np.zeros((2, len(places)))
    for sums, column in zip((counted, meant), np.concatenate(totals).T, strict=True):
        np.add.at(sums, row, column)
    return places, np.divide(counted - meant, np.sqrt(meant), out=np.zeros_like(meant), where=meant > 0)


@torch.no_grad()
def run_figures(pipeline: Pipeline, capture: Capture, spots: np.ndarray) -> dict[str, Figure]:
    """Figures of the present state of a run.

    Args:
        pipeline: the run's, its phasor field prepared.
        capture: what is fitted.
        spots: ``[K]`` spots whose transients and surface are shown.

    Returns:
        ``volume``, ``albedo``, ``transients``, ``kernel``, ``laser_sensor`` and ``surface`` → figure.
    """
    index = torch.from_numpy(spots).to(pipeline.sensor.device)
    rendering = pipeline(index)
    grid = pipeline.phasor.grid
    volume, albedo = rendering.intensity.cpu().numpy(), rendering.albedo.cpu().numpy()
    sensor = pipeline.laser_sensor
    psi = sensor.kernel().cpu().numpy()
    threshold = pipeline.geometry.threshold
    return {
        "volume": figures.volume_projections(volume, grid, threshold=threshold, title="intensity"),
        "albedo": figures.albedo_projection(albedo, volume >= threshold, grid),
        "transients": transients_of(capture, spots, rendering.expected),
        "kernel": figures.kernel_plot(float(pipeline.phasor.omega_pf()), float(pipeline.phasor.sigma_pf())),
        "laser_sensor": figures.laser_sensor_plot(
            psi, capture.bin_length, first=-sensor.lead * capture.bin_length
        ),
        "surface": figures.surface_plot(surface_points(pipeline, capture, spots)),
    }


@torch.no_grad()
def first_volume(pipeline: Pipeline) -> Figure:
    """The volume as it is before the first iteration."""
    phasor = pipeline.phasor
    title, threshold = "intensity before the first iteration", pipeline.geometry.threshold
    return figures.volume_projections(phasor().cpu().numpy(), phasor.grid, threshold=threshold, title=title)


@torch.no_grad()
def surface_points(pipeline: Pipeline, capture: Capture, spots: np.ndarray, block: int = 16) -> Points:
    """The surface seen from the scanned wall points of some spots.

    Where one sensor point serves all spots, the laser points look in its stead: the volume can be seen from
    anywhere.

    Args:
        pipeline: the run's, its phasor field prepared.
        capture: what is fitted.
        spots: ``[K]`` rows of the capture.
        block: spots at once.

    Returns:
        Points, normals and albedos in world coordinates, m.
    """
    volume = pipeline.phasor()
    albedo = pipeline.albedo(volume)
    end = "laser" if capture.kind == "single_sensor" else "sensor"
    origins, normals = getattr(pipeline, end), getattr(pipeline, f"{end}_normal")
    parts: list[tuple[np.ndarray, ...]] = []
    for first in range(0, len(spots), block):
        index = torch.from_numpy(spots[first : first + block]).to(pipeline.sensor.device)
        surface = pipeline.surface(volume, origins[index], normals[index])
        met = surface.normal.any(1)  # off the CPU there are rows to spare, without a normal
        point, normal = surface.point[met], surface.normal[met]
        values = trilinear(albedo, point, pipeline.geometry.lattice)
        parts.append(tuple(t.cpu().numpy().astype(np.float64) for t in (point, normal, values)))
    return Points(*(np.concatenate(column) for column in zip(*parts, strict=True)))
