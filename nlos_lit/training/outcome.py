"""What a finished run leaves in its folder, and how to load what it refined."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.effects import build_effects
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.strengths import report
from nlos_lit.io.files import whole_file, write_json
from nlos_lit.io.meshes import write_mesh
from nlos_lit.io.points import Points, write_points
from nlos_lit.io.volumes import write_volume
from nlos_lit.metrics.geometry import depth_map, geometry_errors
from nlos_lit.report import figures
from nlos_lit.report.style import save_figure
from nlos_lit.runtime.progress import planes_progress
from nlos_lit.surfels.fit import SurfelSettings
from nlos_lit.surfels.fitted import fit_surfels
from nlos_lit.surfels.model import SurfelModel
from nlos_lit.training.callbacks import History
from nlos_lit.training.configs import settings_of
from nlos_lit.training.run_folder import Run
from nlos_lit.training.shown import run_figures, shown_spots, spot_labels, surface_points
from nlos_lit.training.summary import build_summary

log = logging.getLogger(__name__)


def albedo_regions(truth: SurfaceTruth) -> tuple[np.ndarray, np.ndarray] | None:
    """Masks ``[nx, ny]`` of the bright and the dark half of the true albedos; None where all are equal."""
    if truth.albedo is None:
        return None
    seen = np.isfinite(truth.albedo) & (truth.albedo > 0)
    low, high = truth.albedo[seen].min(), truth.albedo[seen].max()
    if high - low < 1e-3:
        return None
    bright = seen & (truth.albedo > (low + high) / 2)
    return bright, seen & ~bright


def refine_run(run: Run, folder: Path) -> dict[str, Any]:
    """Fit surfels, with the run's effects, to the training spots, starting from the run's image.

    Args:
        run: fitted.
        folder: of the run; points, mesh, figures and model go to ``refined/`` in it.

    Returns:
        The summary's entry: scores on all held-out spots, imaging parameters, effects, geometry errors where
        truth is known.

    Raises:
        UserError: the image holds no place that could be a surfel.
    """
    module, capture, place = run.module, run.capture, folder / "refined"
    grid = module.pipeline.phasor.grid
    with torch.no_grad():
        intensity = module.pipeline.phasor().cpu()
    settings = settings_of(SurfelSettings, run.config["surfels"], "surfels")
    with planes_progress("refining surfels") as progress:
        refined = fit_surfels(
            capture,
            intensity,
            grid,
            settings,
            run.data.train_spots,
            extension=run.extension,
            progress=progress,
            seed=run.config["seed"],
            heldout_spots=run.data.heldout_spots,
            scan_shapes=True,
        )
    points = refined.points()
    write_points(place / "points.ply", points)
    mesh = write_mesh(place / "mesh.ply", points, depth=run.config["export"]["mesh_depth"])
    with whole_file(place / "surfels.pt") as temporary:
        torch.save(refined.model.state_dict(), temporary)
    with whole_file(place / "effects.pt") as temporary:
        names = [effect.name for effect in refined.extension.effects]
        torch.save({"names": names, "state": refined.extension.state_dict()}, temporary)
    spots = shown_spots(capture.n_spots, run.config["export"]["transients"])
    path = capture.path_gate[0] + (np.arange(capture.gate[1] - capture.gate[0]) + 0.5) * capture.bin_length
    with torch.no_grad():
        rendered = refined.expected(torch.from_numpy(spots)).numpy()
    shown = figures.transients_plot(
        capture.gated_counts()[spots], rendered, path, spot_labels(capture, spots)
    )
    save_figure(shown, place / "transients.png")
    save_figure(figures.surface_plot(points), place / "surface.png")
    assert refined.heldout is not None  # held-out spots were given
    return {
        "surfels": len(refined.model),
        "heldout": dataclasses.asdict(refined.heldout),
        "parameters": {
            name: {"value": value, "unit": unit} for name, (value, unit) in refined.parameters.items()
        },
        "effects": report(refined.extension.effects),
        "geometry": _geometry(points, run),
        "seconds": refined.seconds,
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
                "run train.py with refine=true or effects=[…]"
            )
    saved = torch.load(place / "effects.pt", map_location="cpu", weights_only=True)
    extension = Extension(build_effects(saved["names"], Scan.of(capture)))
    extension.load_state_dict(saved["state"])
    model = SurfelModel.from_state(
        capture, torch.load(place / "surfels.pt", map_location="cpu", weights_only=True)
    )
    return model, extension


def _geometry(points: Points, run: Run) -> dict[str, float] | None:
    if run.truth is None or len(points) == 0:
        return None
    spacing = float(np.abs(run.module.pipeline.phasor.grid.pitch[:2]).max())
    return geometry_errors(
        points, run.truth, lateral_tolerance=spacing, regions=albedo_regions(run.truth)
    ).to_dict()


def write_results(
    run: Run, history: History, folder: Path, total_seconds: float, refined: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Write volume, points, mesh, figures and ``summary.json``.

    Args:
        run: fitted and scored.
        history: of its iterations.
        folder: where to.
        total_seconds: since the command began.
        refined: the summary's entry of :func:`refine_run`; None where the run was not refined.

    Returns:
        The summary.
    """
    module, capture, config = run.module, run.capture, run.config
    pipeline = module.pipeline
    with torch.no_grad():
        volume = pipeline.phasor()
        albedo = pipeline.albedo(volume)
    grid = pipeline.phasor.grid
    write_volume(folder / "volume.h5", volume.cpu().numpy(), grid, albedo=albedo.cpu().numpy())
    points = surface_points(module, capture, shown_spots(capture.n_spots, config["export"]["spots"]))
    write_points(folder / "points.ply", points)
    mesh = write_mesh(folder / "mesh.ply", points, depth=config["export"]["mesh_depth"])
    if mesh.reason:
        log.warning("mesh.ply: %s", mesh.reason)
    geometry = _geometry(points, run)
    shown = run_figures(module, capture, shown_spots(capture.n_spots, config["export"]["transients"]))
    if geometry is not None and run.truth is not None:
        x, y = run.truth.x, run.truth.y
        shown["depth_error"] = figures.depth_error_map(depth_map(points, x, y), run.truth.depth, x, y)
    parameters = module.imaging_parameters()
    loss = {
        name.removeprefix("loss/"): values
        for name, values in history.values.items()
        if name.startswith("loss/")
    }
    track = {
        name.removeprefix("parameters/"): v
        for name, v in history.values.items()
        if name.startswith("parameters/")
    }
    if loss:
        shown["loss"] = figures.loss_plot(loss)
        shown["parameters"] = figures.parameter_plot(
            track, {name: entry["unit"] for name, entry in parameters.items()}
        )
    for name, figure in shown.items():
        save_figure(figure, folder / "figures" / f"{name}.png")
    first, last = module.scores["initial"], module.scores["final"]
    summary = build_summary(
        scene=config["scene"]["name"],
        seed=config["seed"],
        loss=(first["loss"], last["loss"]),
        nmse=(first["nmse"], last["nmse"], last["nmse_noise_floor"]),
        deviance_per_bin=(first["deviance_per_bin"], last["deviance_per_bin"], last["deviance_noise"]),
        parameters={name: (entry["value"], entry["unit"]) for name, entry in parameters.items()},
        seconds=(
            run.setup_seconds,
            float(np.median(history.seconds)) if history.seconds else float("nan"),
            total_seconds,
        ),
        geometry=geometry,
        refined=refined,
        transient_mse={
            "train": {"initial": first["train_mse"], "final": last["train_mse"]},
            "heldout": {"initial": first["mse"], "final": last["mse"]},
        },
        sparsity={"initial": first["sparsity"], "final": last["sparsity"]},
        iterations=len(history.seconds),
        ablation=config["ablation"]["name"],
        optimised=module.optimised,
        estimated_memory_bytes=run.estimated_bytes,
        mesh={"vertices": mesh.vertices, "triangles": mesh.triangles, "reason": mesh.reason},
        capture={
            "kind": capture.kind,
            "spots": capture.n_spots,
            "bins": capture.n_bins,
            "provenance": capture.provenance,
        },
    )
    write_json(folder / "summary.json", summary)
    return summary
