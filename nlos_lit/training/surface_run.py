"""The surface of a run: seeded from its image, fitted by a Trainer, written to ``refined/``."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import build_effects
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.strengths import report
from nlos_lit.io.files import whole_file
from nlos_lit.io.meshes import write_mesh
from nlos_lit.io.points import write_points
from nlos_lit.model.build import normalisation
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.report import figures
from nlos_lit.report.style import save_figure
from nlos_lit.report.surface_figures import front_view
from nlos_lit.surfels.fit import SurfelSettings
from nlos_lit.surfels.fitted import fitted_surfels
from nlos_lit.surfels.model import SurfelModel
from nlos_lit.surfels.start import seed_surfels
from nlos_lit.training.configs import settings_of
from nlos_lit.training.outcome import geometry_of
from nlos_lit.training.run_folder import Run
from nlos_lit.training.shown import shown_spots, transients_of
from nlos_lit.training.surface_fitting import SurfaceFitting, front

log = logging.getLogger(__name__)


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
    return SurfaceFitting(fit, normalisation(run.capture))


def write_surface(run: Run, module: SurfaceFitting, place: Path, began: float) -> dict[str, Any]:
    """Write points, mesh, figures and model of a fitted surface.

    Args:
        run: the capture's.
        module: fitted, on the CPU; its albedos are normalised in place.
        place: folder, ``refined/`` of the run's.
        began: ``time.perf_counter()`` of when the surface was begun.

    Returns:
        The summary's entry: scores on all held-out spots, imaging parameters, effects, geometry errors where
        truth is known.
    """
    capture, export = run.capture, run.config["export"]
    found = fitted_surfels(module.fit, run.data.heldout_spots, began)
    points = found.points()
    write_points(place / "points.ply", points)
    mesh = write_mesh(place / "mesh.ply", points, depth=export["mesh_depth"])
    with whole_file(place / "surfels.pt") as temporary:
        torch.save(found.model.state_dict(), temporary)
    with whole_file(place / "effects.pt") as temporary:
        names = [effect.name for effect in found.extension.effects]
        torch.save({"names": names, "state": found.extension.state_dict()}, temporary)
    spots = shown_spots(capture.n_spots, export["transients"])
    shown = {
        "transients": transients_of(capture, spots, found.expected(torch.from_numpy(spots))),
        "surface": figures.surface_plot(points),
        "front": front_view(*front(found.model), title=f"{len(points)} surfels"),
    }
    for name, figure in shown.items():
        save_figure(figure, place / f"{name}.png")
    assert found.heldout is not None  # held-out spots were given
    return {
        "surfels": len(found.model),
        "heldout": dataclasses.asdict(found.heldout),
        "parameters": {
            name: {"value": value, "unit": unit} for name, (value, unit) in found.parameters.items()
        },
        "effects": report(found.extension.effects),
        "geometry": geometry_of(points, run),
        "seconds": found.seconds,
        "mesh": {"vertices": mesh.vertices, "triangles": mesh.triangles, "reason": mesh.reason},
    }


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
        if not (place / name).exists():
            raise UserError(
                f"{folder} holds no refined surfels: refined/{name} is missing; "
                "run train.py with refine=true, effects=[…] or model=surface"
            )
    saved = torch.load(place / "effects.pt", map_location="cpu", weights_only=True)
    extension = Extension(build_effects(saved["names"], Scan.of(capture)))
    extension.load_state_dict(saved["state"])
    model = SurfelModel.from_state(
        capture, torch.load(place / "surfels.pt", map_location="cpu", weights_only=True)
    )
    return model, extension
