"""Where the surfels of a scene begin: at the significant maxima of the phasor image."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.capture.wall_blocks import wall_blocks
from nlos_lit.effects.extension import Extension
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.runtime.memory import check_machine
from nlos_lit.surfels.fit import PATCHES, SurfelFit, SurfelSettings, plan_from_seeds
from nlos_lit.surfels.growth import rank_one, score, start_response, volume_maxima
from nlos_lit.surfels.model import Lateral, SurfelModel, points_along

BYTES_PER_PATH = 160  # peak of forward and backward pass, measured
BYTES_KEPT = 24  # of a path while albedos are solved for: six numbers
WIDEST = 4.0  # bins of path that a surfel's side spans at most
ASIDE = 10  # one of so many training spots judges how fine surfels are to be
RESERVE = 0.02  # maxima down to this share of the floor may be bodies that are missing
BODIES = 3  # rounds that may follow, before which such are begun


def seed_surfels(
    capture: Capture,
    intensity: Tensor,
    grid: VolumeGrid,
    settings: SurfelSettings,
    train_spots: np.ndarray,
    laser_sensor_start: LaserSensor | None = None,
    extension: Extension | None = None,
    seed: int = 0,
    scan_shapes: bool = False,
    judge_spots: np.ndarray | None = None,
) -> SurfelFit:
    """Surfels at the significant maxima of an image, with a response that matches the energy.

    Args:
        capture: raw counts and scan.
        intensity: ``[nz, nx, ny]`` phasor image on ``grid``.
        grid: of the image.
        settings: of the fit.
        train_spots: ``[N]`` rows of the capture.
        laser_sensor_start: start values of the response; None takes 1.2 bins and 0.7 per bin.
        extension: physical effects fitted along with the surfels, in place.
        seed: of batches and tested spots.
        scan_shapes: after a first round start the extension's scanned parameters where the counts ask for
            them, instead of where they are; costs one round more.
        judge_spots: ``[J]`` rows that are not trained, by which it is judged how fine the surfels are to be.
            None sets patches of the wall with a tenth of the training spots aside for it, where that is asked
            (``settings.more``).

    Returns:
        a fit with all its rounds ahead.

    Raises:
        UserError: shapes disagree, or no place of the image is significant in the counts.
        MemoryBudgetError: a step does not fit the free memory.
    """
    if tuple(intensity.shape) != tuple(grid.shape):
        raise UserError(
            f"the image has shape {tuple(intensity.shape)}, its grid {tuple(grid.shape)}; "
            "give the grid it was imaged on"
        )
    s, extension = settings, Extension([]) if extension is None else extension
    intensity = intensity.detach().cpu().float()
    apart = _apart(capture, train_spots, seed, s.more) if judge_spots is None else (train_spots, judge_spots)
    train, judged = (torch.as_tensor(np.asarray(rows), dtype=torch.long) for rows in apart)
    first, last = capture.gate
    counts = torch.from_numpy(capture.counts[train.numpy(), first:last].astype(np.float32))
    if counts.sum() == 0:
        raise UserError(
            "the training spots hold no counts inside the gate; check the gate and the held-out spots"
        )
    (x, y, _), (dx, dy, _), (_, nx, ny) = grid.origin, grid.pitch, grid.shape
    lateral = Lateral((x, y), (dx, dy), (nx, ny))
    sensor = start_response(capture, counts, laser_sensor_start)
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(train), generator=generator)
    tested = order[: s.test_spots]
    candidates, value = volume_maxima(intensity, grid, RESERVE * s.floor, s.per_cell, lateral)
    null = rank_one(counts)[tested]
    asked = (counts[tested] / null - 1, 1 / null)
    scores = score(candidates, capture, lateral.pitch, 1, sensor, asked, train[tested], extension)
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
    model = SurfelModel(
        capture,
        centre=seeds.centre,
        normal=seeds.normal,
        albedo=value[keep] / value[keep].mean(),
        lateral=lateral,
        laser_sensor=sensor,
    )
    widest = float(model.cell.max()) / capture.bin_length  # bins
    parts = s.subdivide or math.ceil(widest / WIDEST)
    points = s.quadrature or points_along(float(model.cell.max()) / parts, capture.bin_length)
    a_spot = len(model) * (parts * points) ** 2  # paths
    step_bytes = a_spot * max(min(s.batch, len(train)) * BYTES_PER_PATH, len(tested) * BYTES_KEPT)
    smaller = "take fewer surfels (surfels.max_seeds) or fewer spots (surfels.batch, surfels.test_spots)"
    check_machine(step_bytes + 8 * counts.numel(), "one step of the surface fit", smaller)
    reserve = candidates.take(best)
    fit = SurfelFit(model, capture, grid, counts, train, s, reserve, extension, generator, order, judged)
    fit.match_energy()
    scan_shapes = scan_shapes and any(effect.shapes for effect in extension.effects)
    fit.schedule(plan_from_seeds(s, parts, scan_shapes), s.more, BODIES)
    return fit


def _apart(capture: Capture, spots: np.ndarray, seed: int, more: int) -> tuple[np.ndarray, np.ndarray]:
    """Training spots, and those of them that are set aside where rounds may follow those of the plan.

    These are patches of the wall: what imitates the misfit of the spots around one pays there, too.
    """
    number = len(spots) // ASIDE if more else 0
    block = wall_blocks(capture, PATCHES)[spots]
    order = np.random.default_rng(seed).permutation(PATCHES**2)
    mixed = spots[np.argsort(order[block], kind="stable")]
    return np.sort(mixed[number:]), np.sort(mixed[:number])
