"""Surfels fitted to the raw counts by Poisson likelihood, and what they predict.

The phasor image has the wavelength's resolution, the counts know depth far better. docs/surface.md tells what
each step brought.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects.extension import Extension
from nlos_lit.io.points import Points
from nlos_lit.metrics.transients import Scores
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.surfels.fit import Progress, SurfelFit, SurfelSettings, score_spots
from nlos_lit.surfels.model import SurfelModel
from nlos_lit.surfels.start import seed_surfels


@dataclass(frozen=True)
class FittedSurfels:
    """A fitted surfel model.

    ``heldout``: scores of the held-out spots that were given, None where there were none. ``history``: one
    entry a round.
    """

    model: SurfelModel
    extension: Extension
    fit: SurfelFit
    heldout: Scores | None
    parameters: dict[str, tuple[float, str]]
    history: list[dict[str, float]]
    seconds: float

    def expected(self, spots: Tensor) -> Tensor:
        """``[S, T_gate]`` expected counts."""
        return self.model.expected(spots, self.extension)

    def points(self) -> Points:
        return self.model.points()


def fit_surfels(
    capture: Capture,
    intensity: Tensor,
    grid: VolumeGrid,
    settings: SurfelSettings,
    train_spots: np.ndarray,
    laser_sensor_start: LaserSensor | None = None,
    extension: Extension | None = None,
    progress: Progress | None = None,
    seed: int = 0,
    heldout_spots: np.ndarray | None = None,
    scan_shapes: bool = False,
    judge_spots: np.ndarray | None = None,
) -> FittedSurfels:
    """Fit surfels and response to the counts of the training spots.

    Args:
        capture: raw counts and scan.
        intensity: ``[nz, nx, ny]`` phasor image on ``grid``.
        grid: of the image.
        settings: of the fit.
        train_spots: ``[N]`` rows of the capture.
        laser_sensor_start: start values of the response; None takes 1.2 bins and 0.7 per bin.
        extension: physical effects fitted along with the surfels, in place.
        progress: called with (steps done, of how many).
        seed: of batches and tested spots.
        heldout_spots: ``[N']`` rows whose counts are only scored at the end; None scores nothing.
        scan_shapes: after a first round start the extension's scanned parameters where the counts ask for
            them, instead of where they are; costs one round more.
        judge_spots: ``[J]`` see :func:`~nlos_lit.surfels.start.seed_surfels`.

    Returns:
        the fitted model, scores and history.

    Raises:
        UserError: shapes disagree, or no place of the image is significant in the counts.
        MemoryBudgetError: a step does not fit the free memory.
    """
    began = time.perf_counter()
    given = (capture, intensity, grid, settings, train_spots, laser_sensor_start, extension)
    fit = seed_surfels(*given, seed=seed, scan_shapes=scan_shapes, judge_spots=judge_spots)
    fit.finish(progress)
    return fitted_surfels(fit, heldout_spots, began)


def fitted_surfels(fit: SurfelFit, heldout_spots: np.ndarray | None, began: float) -> FittedSurfels:
    """The result of a finished fit; its albedos are normalised in place.

    Args:
        fit: finished, on any device.
        heldout_spots: ``[N']`` rows whose counts are scored; None scores nothing.
        began: ``time.perf_counter()`` of when the work began.

    Returns:
        model, scores and history.
    """
    model = fit.model
    normalise_albedo(model)
    held = torch.as_tensor(np.asarray([] if heldout_spots is None else heldout_spots), dtype=torch.long)
    scores = score_spots(model, fit.capture, held, fit.extension) if len(held) else None
    response = model.laser_sensor.named_children()
    parameters = {name: (p().item(), p.unit) for name, p in response if isinstance(p, BoundedParameter)}
    seconds = time.perf_counter() - began
    return FittedSurfels(model, fit.extension, fit, scores, parameters, fit.history, seconds)


@torch.no_grad()
def normalise_albedo(model: SurfelModel) -> None:
    """Only albedo × intensity is known: the 98th percentile of the albedos becomes 1."""
    albedo = model.albedo()
    white = float(torch.quantile(albedo, 0.98))
    sensor = model.laser_sensor
    sensor.set_intensity(sensor.intensity().item() * white)
    model.set_albedo(albedo / white)
