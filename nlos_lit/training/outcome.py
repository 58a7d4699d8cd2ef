"""What a finished run leaves in its folder."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.io.files import write_depth, write_json
from nlos_lit.io.meshes import write_mesh
from nlos_lit.io.points import Points, read_points, write_points
from nlos_lit.io.volumes import write_volume
from nlos_lit.metrics.geometry import depth_map, geometry_errors
from nlos_lit.report import figures
from nlos_lit.report.style import save_figure
from nlos_lit.training.callbacks import History
from nlos_lit.training.explored import RAYED_SPOTS, SPOTS, Scene, facts_of, keep, kept_mesh, view_of
from nlos_lit.training.run_folder import Run
from nlos_lit.training.shown import run_figures, shown_spots, surface_points
from nlos_lit.training.summary import build_summary
from nlos_lit.training.surface_fitting import SurfaceFitting

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


def geometry_of(points: Points, run: Run) -> dict[str, float] | None:
    """Errors of surface points against the run's truth.

    Args:
        points: of the surface.
        run: whose truth and grid are taken.

    Returns:
        as :func:`~nlos_lit.metrics.geometry.geometry_errors`; None where no truth is known or there are no
        points.
    """
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
        refined: the summary's entry of the surface; None where none was fitted.

    Returns:
        The summary.

    Raises:
        UserError: the fit ended in NaN or infinite scores or voxels.
    """
    module, capture, config = run.module, run.capture, run.config
    pipeline = module.pipeline
    heldout = heldout_scores(module.scores["initial"], module.scores["final"], capture)
    with torch.no_grad():
        volume = pipeline.phasor()
        albedo = pipeline.albedo(volume)
    grid = pipeline.phasor.grid
    write_volume(folder / "volume.h5", volume.cpu().numpy(), grid, albedo=albedo.cpu().numpy())
    points = surface_points(pipeline, capture, shown_spots(capture.n_spots, config["export"]["spots"]))
    write_points(folder / "points.ply", points)
    write_depth(folder / "depth.npy", depth_map(points, grid.x, grid.y))
    mesh = write_mesh(folder / "mesh.ply", points, depth=config["export"]["mesh_depth"])
    if mesh.reason:
        log.warning("mesh.ply: %s", mesh.reason)
    geometry = geometry_of(points, run)
    shown = run_figures(pipeline, capture, shown_spots(capture.n_spots, config["export"]["transients"]))
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
        **heldout,
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
        changed=run.origin["changed"],
        ablation=config["ablation"]["name"],
        optimised=module.optimised,
        estimated_memory_bytes=run.estimated_bytes,
        mesh={"vertices": mesh.vertices, "triangles": mesh.triangles, "reason": mesh.reason},
        capture=_capture_entry(capture),
    )
    write_json(folder / "summary.json", summary)
    return summary


def write_surface_summary(
    run: Run,
    module: SurfaceFitting,
    history: History,
    folder: Path,
    total_seconds: float,
    refined: dict[str, Any],
) -> dict[str, Any]:
    """Write ``summary.json`` of a run that fitted the surface alone.

    Args:
        run: the capture's.
        module: fitted and scored.
        history: of its batches.
        folder: where to.
        total_seconds: since the command began.
        refined: the summary's entry of the surface.

    Returns:
        The summary: scores and loss (Poisson deviance per bin) are the surface's.
    """
    first, last, config = module.scores["initial"], module.scores["final"], run.config
    per_batch = float(np.median(history.seconds)) if history.seconds else float("nan")
    summary = build_summary(
        scene=config["scene"]["name"],
        seed=config["seed"],
        loss=(first["loss"], last["loss"]),
        **heldout_scores(first, last, run.capture),
        parameters={name: (q["value"], q["unit"]) for name, q in module.imaging_parameters().items()},
        seconds=(run.setup_seconds, per_batch, total_seconds),
        geometry=refined["geometry"],
        refined=refined,
        transient_mse={
            "train": {"initial": first["train_mse"], "final": last["train_mse"]},
            "heldout": {"initial": first["mse"], "final": last["mse"]},
        },
        iterations=len(history.seconds),
        ablation=config["ablation"]["name"],
        estimated_memory_bytes=run.estimated_bytes,
        capture=_capture_entry(run.capture),
    )
    write_json(folder / "summary.json", summary)
    return summary


def explore_results(run: Run, folder: Path, summary: dict[str, Any], surface: SurfaceFitting | None) -> None:
    """Write ``view.npz`` and ``explore.html`` of a finished run.

    Args:
        run: fitted.
        folder: with its other results.
        summary: what ``summary.json`` holds.
        surface: fitted; None where none was.
    """
    phasor = run.module.pipeline.phasor
    with torch.no_grad():
        volume = phasor().cpu().numpy()
    if surface is None:
        models, _ = run.module.explored()
        clouds, mesh = {"points": read_points(folder / "points.ply")}, folder / "mesh.ply"
    else:
        models, scene = surface.explored()
        clouds, mesh = dict(scene.clouds), folder / "refined" / "mesh.ply"
    said = told_results(summary, folder)
    keep(
        folder,
        view_of(
            run.capture,
            models,
            Scene(clouds, kept_mesh(mesh), (volume, phasor.grid)),
            facts_of(run.config["scene"], run.capture, "finished", said),
            RAYED_SPOTS if surface is None else SPOTS,
        ),
    )


def told_results(summary: dict[str, Any], folder: Path) -> list[str]:
    """What came out, in sentences: the errors first, the next command last.

    Args:
        summary: of the run.
        folder: of the run.

    Returns:
        two or three sentences.
    """
    nmse, refined = summary["heldout"]["nmse"], summary["refined"]
    error = nmse["final"] if refined is None else refined["heldout"]["nmse"]
    noise = nmse["noise_floor"] if refined is None else refined["heldout"]["nmse_noise_floor"]
    best = f"; counting noise alone would give {noise:.4f}" if math.isfinite(noise) else ""
    by = "" if refined is None else f", by {refined['surfels']} surfels"
    change = f"from {nmse['initial']:.4f} to {error:.4f}"
    said = [f"On spots that nothing was fitted to, the error (NMSE) went {change}{by}{best}."]
    if refined is None:
        said.append("Next: the same with refine=true fits a surface to the raw counts.")
    elif refined["note"] is not None:
        said.append(f"{refined['note'][:1].upper()}{refined['note'][1:]}.")
    else:
        said.append("The fitted surface is at the noise, as far as these counts can say.")
    return said


def heldout_scores(
    first: dict[str, float], last: dict[str, float], capture: Capture
) -> dict[str, tuple[float, float, float]]:
    """Scores of the held-out spots before and after a fit, and what counting noise would give.

    Args:
        first: before the first iteration, as :meth:`~nlos_lit.training.capture_fit.CaptureFit.all_scores`.
        last: after the last one.
        capture: that was fitted; expected values have no counting noise, it is NaN.

    Returns:
        ``nmse`` and ``deviance_per_bin``, three numbers each.

    Raises:
        UserError: a score after the fit is NaN or infinite.
    """
    broken = [name for name, value in last.items() if not math.isfinite(value)]
    if broken:
        raise UserError(
            f"the fit has left the numbers ({', '.join(broken)} NaN or infinite), which is no result: lower "
            "optimizer.rates, or look for damaged values in the capture"
        )
    noisy = 1.0 if capture.is_counts else math.nan
    return {
        "nmse": (first["nmse"], last["nmse"], noisy * last["nmse_noise_floor"]),
        "deviance_per_bin": (
            first["deviance_per_bin"], last["deviance_per_bin"], noisy * last["deviance_noise"],
        ),
    }  # fmt: skip


def _capture_entry(capture: Capture) -> dict[str, Any]:
    return {
        "kind": capture.kind,
        "spots": capture.n_spots,
        "bins": capture.n_bins,
        "provenance": capture.provenance,
    }
