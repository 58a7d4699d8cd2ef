"""The surface of a run: seeded from its image, fitted by a Trainer, written to ``refined/``."""

from __future__ import annotations

import dataclasses
import logging
import math
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import archived
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import build_effects
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.strengths import bound_notes, report
from nlos_lit.io.files import write_depth
from nlos_lit.io.meshes import write_mesh
from nlos_lit.io.points import write_points
from nlos_lit.io.tensors import write_tensors
from nlos_lit.metrics.excess import Excess, excess_by_axis
from nlos_lit.model.build import normalisation
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.report import figures
from nlos_lit.report.style import save_figure
from nlos_lit.report.surface_figures import FrontImage
from nlos_lit.report.words import AXES
from nlos_lit.runtime.command_line import typed
from nlos_lit.surfels.fit import SurfelSettings
from nlos_lit.surfels.fitted import FittedSurfels, fitted_surfels
from nlos_lit.surfels.model import SurfelModel
from nlos_lit.surfels.start import seed_surfels
from nlos_lit.training.configs import settings_of
from nlos_lit.training.origin import sound
from nlos_lit.training.outcome import geometry_of
from nlos_lit.training.run_folder import Run
from nlos_lit.training.shown import shown_spots, transients_of
from nlos_lit.training.surface_fitting import SurfaceFitting, front

log = logging.getLogger(__name__)

TELLING = 0.02  # share of counting noise from which on a surface is said to miss something
SAID = 0.05  # share of the whole excess from which on an axis is named


def prepare_surface(run: Run, laser_sensor: LaserSensor | None = None) -> SurfaceFitting:
    """Surfels, with the run's effects, at the maxima of the run's image; nothing is fitted yet.

    Args:
        run: whose image is taken as it is.
        laser_sensor: whose response the fit starts from; None starts as :func:`seed_surfels` does.

    Returns:
        The module, on the CPU.

    Raises:
        UserError: the image holds no place that could be a surfel.
    """
    phasor = run.module.pipeline.phasor
    with torch.no_grad():
        intensity = phasor().cpu()
    fit = seed_surfels(
        run.capture,
        intensity,
        phasor.grid,
        settings_of(SurfelSettings, run.config["surfels"], "surfels"),
        run.data.train_spots,
        laser_sensor,
        run.extension,
        seed=run.config["seed"],
        scan_shapes=True,
    )
    log.info("%d surfels at the maxima of the image; %d batches and more", len(fit.model), fit.ahead)
    grid = phasor.grid
    image = FrontImage(intensity.amax(0).numpy(), grid.x, grid.y)
    module = SurfaceFitting(fit, normalisation(run.capture), image)
    module.origin = run.origin
    return module


def write_surface(run: Run, module: SurfaceFitting, place: Path, began: float) -> dict[str, Any]:
    """Write points, mesh, figures and model of a fitted surface.

    Args:
        run: the capture's.
        module: fitted, on the CPU; its albedos are normalised in place.
        place: folder, ``refined/`` of the run's.
        began: ``time.perf_counter()`` of when the surface was begun.

    Returns:
        The summary's entry: scores on all held-out spots, what they leave above noise (None without photon
        statistics), imaging parameters, effects and which of their numbers lie at a bound, geometry errors
        where truth is known.
    """
    capture, export = run.capture, run.config["export"]
    found = fitted_surfels(module.fit, run.data.heldout_spots, began)
    points = found.points()
    write_points(place / "points.ply", points)
    seen = front(found.model)
    write_depth(place / "depth.npy", seen.depth)
    mesh = write_mesh(place / "mesh.ply", points, depth=export["mesh_depth"])
    write_tensors(place / "surfels.pt", found.model.state_dict(), deflate=True)
    names = [effect.name for effect in found.extension.effects]
    write_tensors(place / "effects.pt", {"names": names, "state": found.extension.state_dict()})
    spots = shown_spots(capture.n_spots, export["transients"])
    shown = {
        "transients": transients_of(capture, spots, found.expected(torch.from_numpy(spots))),
        "surface": figures.surface_plot(points),
        "overview": module.overview(np.arange(capture.n_spots), f"{len(points)} surfels"),
    }
    for name, figure in shown.items():
        save_figure(figure, place / f"{name}.png")
    assert found.heldout is not None  # held-out spots were given
    excess = heldout_excess(run, found) if capture.is_counts else None
    note = None if excess is None else excess_note(excess, place.parent)
    bounds = bound_notes(found.extension.effects)
    for said in bounds if note is None else [note, *bounds]:
        log.info(said)
    return {
        "surfels": len(found.model),
        "heldout": dataclasses.asdict(found.heldout),
        "excess": None if excess is None else dataclasses.asdict(excess),
        "note": note,
        "at_bounds": bounds,
        "parameters": {
            name: {"value": value, "unit": unit} for name, (value, unit) in found.parameters.items()
        },
        "effects": report(found.extension.effects),
        "geometry": geometry_of(points, run),
        "seconds": found.seconds,
        "mesh": {"vertices": mesh.vertices, "triangles": mesh.triangles, "reason": mesh.reason},
        "depth_axes": {"x": _ends_of(seen.x), "y": _ends_of(seen.y)},
    }


def _ends_of(axis: np.ndarray) -> dict[str, float]:
    """First, last and number of evenly spaced centres, m."""
    return {"first": float(axis[0]), "last": float(axis[-1]), "cells": len(axis)}


def heldout_excess(run: Run, found: FittedSurfels) -> Excess:
    """What the held-out spots leave above counting noise, by axis.

    Args:
        run: the capture's, with photon statistics.
        found: the fitted surface.

    Returns:
        shares along the axes; the scan's stretches are the rows of its raster, √S where it has none.
    """
    capture, held = run.capture, run.data.heldout_spots
    observed, shape = capture.gated_observed(), capture.scan_shape
    rows = shape[0] if shape is not None and len(shape) == 2 else math.isqrt(capture.n_spots)
    index = torch.from_numpy(held)
    first, last = capture.gate
    return excess_by_axis(
        torch.from_numpy(capture.counts[held, first:last].astype(np.float64)),
        found.expected(index),
        [place[index] for place in Scan.of(capture).places],
        torch.from_numpy(capture.scan_order[held] * rows // capture.n_spots),
        None if observed is None else torch.from_numpy(observed[held]),
    )


def excess_note(excess: Excess, folder: Path) -> str | None:
    """One sentence on a surface that does not reach the noise; None on one that does, or that may.

    Args:
        excess: of the held-out spots.
        folder: of the run.

    Returns:
        by how much, along which two axes most of it lies, and what can be asked next.

    Examples:
        >>> found = Excess(0.07, 1.07, 0.01, {"time": 0.41, "wall": 0.22, "scan": 0.1, "rate": 0.0})
        >>> print(excess_note(found, Path("outputs/su")).replace(" (", "\\n(").replace("; ", ";\\n"))
        the fitted surface leaves 7 % more than counting noise
        (of it 41 % along the time axis, 22 % across the wall);
        python diagnose.py run=outputs/su asks what is missing
    """
    if excess.ratio <= 1 + max(TELLING, 3 * excess.error):
        return None
    words = AXES | {"level": "in the overall level"}
    most = sorted(excess.along, key=lambda name: -excess.along[name])[:2]
    where = [f"{100 * excess.along[name]:.0f} % {words[name]}" for name in most if excess.along[name] >= SAID]
    return (
        f"the fitted surface leaves {100 * (excess.ratio - 1):.0f} % more than counting noise "
        f"({'of it ' + ', '.join(where) if where else 'hardly any along time, wall, scan or rate'}); "
        f"{typed('diagnose')} {shlex.quote(f'run={folder}')} asks what is missing"
    )


def load_refined(folder: str | Path, capture: Capture) -> tuple[SurfelModel, Extension]:
    """Surfels and effects of a refined run; ``model.expected(spots, extension)`` are its expected counts.

    Args:
        folder: of the run.
        capture: the run's, as :func:`~nlos_lit.training.run_folder.open_run` gives it.

    Returns:
        The surfels with the response, and the effects fitted along.

    Raises:
        UserError: the run was not refined.
    """
    place = Path(folder) / "refined"
    for name in ("surfels.pt", "effects.pt"):
        if not (place / name).is_file():
            raise UserError(
                f"{folder} holds no refined surfels: refined/{name} is missing; "
                f"run {typed('train')} with refine=true, effects=[…] or model=surface"
            )
    with sound(place / "effects.pt"):
        saved = torch.load(archived(place / "effects.pt"), map_location="cpu", weights_only=True)
        extension = Extension(build_effects(saved["names"], Scan.of(capture)))
        extension.load_state_dict(saved["state"])
    with sound(place / "surfels.pt"):
        state = torch.load(archived(place / "surfels.pt", packed=True), map_location="cpu", weights_only=True)
        model = SurfelModel.from_state(capture, state)
    return model, extension
