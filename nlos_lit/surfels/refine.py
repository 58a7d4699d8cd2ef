"""Refinement: surfels seeded from the phasor image and fitted to the raw counts by Poisson likelihood.

The phasor image has the wavelength's resolution, the counts know depth far better. docs/refine.md tells what
each step brought.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.hooks import NOTHING, Hooks
from nlos_lit.io.points import Points
from nlos_lit.metrics.transients import Scores, transient_scores
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.runtime.memory import check_machine
from nlos_lit.surfels.effect_start import choose_shapes
from nlos_lit.surfels.fit import Progress, RefineSettings, SurfelFit
from nlos_lit.surfels.growth import rank_one, score, start_response, volume_maxima
from nlos_lit.surfels.model import Lateral, SurfelModel

BYTES_PER_PATH = 160  # peak of forward and backward pass, measured
RESERVE = 0.4  # maxima down to this share of the floor are kept in reserve for growth


@dataclass(frozen=True)
class Refined:
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


def refine(
    capture: Capture,
    intensity: Tensor,
    grid: VolumeGrid,
    settings: RefineSettings,
    train_spots: np.ndarray,
    laser_sensor_start: LaserSensor | None = None,
    extension: Extension | None = None,
    progress: Progress | None = None,
    seed: int = 0,
    heldout_spots: np.ndarray | None = None,
    scan_shapes: bool = False,
) -> Refined:
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

    Returns:
        the fitted model, scores and history.

    Raises:
        UserError: shapes disagree, or no place of the image is significant in the counts.
        MemoryBudgetError: a step does not fit the free memory.
    """
    began = time.perf_counter()
    if tuple(intensity.shape) != tuple(grid.shape):
        raise UserError(
            f"the image has shape {tuple(intensity.shape)}, its grid {tuple(grid.shape)}; "
            "give the grid it was imaged on"
        )
    train = torch.as_tensor(np.asarray(train_spots), dtype=torch.long)
    extension = Extension([]) if extension is None else extension
    fit = _seeded(
        capture, intensity.detach().cpu().float(), grid, settings, train, laser_sensor_start, extension, seed
    )
    if scan_shapes and any(effect.shapes for effect in extension.effects):
        history = _run_scanning_shapes(fit, progress)
    else:
        history = fit.run(settings.rounds, progress)
    history += fit.converge(progress)
    model = fit.model
    normalise_albedo(model)
    held = torch.as_tensor(np.asarray([] if heldout_spots is None else heldout_spots), dtype=torch.long)
    scores = score_spots(model, capture, held, extension) if len(held) else None
    response = model.laser_sensor.named_children()
    parameters = {name: (p().item(), p.unit) for name, p in response if isinstance(p, BoundedParameter)}
    return Refined(model, extension, fit, scores, parameters, history, time.perf_counter() - began)


def _run_scanning_shapes(fit: SurfelFit, progress: Progress | None) -> list[dict[str, float]]:
    """A first round, the shapes, then all other rounds (at least one)."""
    s = fit.settings
    later = max(1, s.rounds - 1)
    total = s.steps * (2 + later + 1)

    def told(before: int) -> Progress | None:
        return None if progress is None else lambda done, _: progress(before + done, total)

    history = fit.run(1, told(0))
    choose_shapes(fit.model, fit.extension, fit.train[fit.tested], fit.counts[fit.tested])
    return history + fit.run(later, told(2 * s.steps), grow_first=True, settle=False)


@torch.no_grad()
def score_spots(model: SurfelModel, capture: Capture, spots: Tensor, hooks: Hooks = NOTHING) -> Scores:
    """Scores of some spots with their noise levels.

    Args:
        model: fitted surfels.
        capture: whose gated counts are compared.
        spots: ``[S]`` rows of the capture.
        hooks: effects that act on the expected counts.

    Returns:
        means over the spots' gated bins.
    """
    first, last = capture.gate
    counts = torch.from_numpy(capture.counts[spots.numpy(), first:last].astype(np.float32))
    return transient_scores(counts, model.expected(spots, hooks))


def _seeded(
    capture: Capture,
    intensity: Tensor,
    grid: VolumeGrid,
    settings: RefineSettings,
    train: Tensor,
    start: LaserSensor | None,
    extension: Extension,
    seed: int,
) -> SurfelFit:
    """Surfels at the significant maxima of the image, with a response that matches the energy."""
    s = settings
    first, last = capture.gate
    counts = torch.from_numpy(capture.counts[train.numpy(), first:last].astype(np.float32))
    if counts.sum() == 0:
        raise UserError(
            "the training spots hold no counts inside the gate; check the gate and the held-out spots"
        )
    widest, bins = max(abs(p) for p in grid.pitch[:2]), capture.bin_length
    subdivide = s.subdivide or (2 if widest > 6 * bins else 1)
    points = s.quadrature or int(np.clip(math.ceil(widest / subdivide * 0.55 / bins), 1, 8))
    dx, dy = (p / subdivide for p in grid.pitch[:2])
    x, y = (o - (subdivide - 1) / 2 * p for o, p in zip(grid.origin[:2], (dx, dy), strict=True))
    lateral = Lateral((x, y), (dx, dy), (grid.shape[1] * subdivide, grid.shape[2] * subdivide))
    sensor = start_response(capture, counts, start)
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(train), generator=generator)
    tested = order[: s.test_spots]
    candidates, value = volume_maxima(intensity, grid, RESERVE * s.floor, s.per_cell, lateral)
    null = rank_one(counts)[tested]
    scores = score(candidates, capture, lateral.pitch, 1, sensor, counts[tested], null, train[tested])
    significance = scores.significance * math.sqrt(len(train) / len(tested))
    keep = (significance > s.significance) & (value >= s.floor)
    if int(keep.sum()) > s.max_seeds:
        keep &= significance >= significance.topk(s.max_seeds).values[-1]
    if not keep.any():
        raise UserError(
            f"none of the image's {len(value)} maxima is significant in the counts: the capture may hold "
            "only noise, or scene.volume.depth or the gate misses the hidden scene "
            "(surfels.significance sets the level)"
        )
    best = significance.topk(min(s.max_seeds, len(significance))).indices
    seeds = candidates.take(keep)
    step_bytes = int(keep.sum()) * points**2 * min(s.batch, len(train)) * BYTES_PER_PATH
    smaller = "take fewer surfels (surfels.max_seeds) or fewer spots a step (surfels.batch)"
    check_machine(step_bytes + 8 * counts.numel(), "one refinement step", smaller)
    model = SurfelModel(
        capture,
        centre=seeds.centre,
        normal=seeds.normal,
        albedo=value[keep] / value[keep].mean(),
        lateral=lateral,
        laser_sensor=sensor,
        quadrature=points,
    )
    fit = SurfelFit(
        model, capture, grid, counts, train, s, candidates.take(best), extension, generator, order
    )
    fit.match_energy()
    return fit


@torch.no_grad()
def normalise_albedo(model: SurfelModel) -> None:
    """Only albedo × intensity is known: the 98th percentile of the albedos becomes 1."""
    albedo = model.albedo()
    white = float(torch.quantile(albedo, 0.98))
    sensor = model.laser_sensor
    value = sensor.intensity().item() * white
    sensor.intensity = BoundedParameter(value, value * 1e-3, value * 1e3, "counts m2")
    model.set_albedo(albedo / white)
