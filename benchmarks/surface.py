"""How near the noise the surface fit comes: real captures with and without effects, known scenes, seeds.

    python benchmarks/surface.py draw=0,1,2 seeds=3            # effect-free scenes of curved bodies
    python benchmarks/surface.py known=bunny,z data=DIR        # simulated and rendered, with the true surface
    python benchmarks/surface.py scene=su path=FILE seeds=3 effects=wall_reflectance,irf_tail
    python benchmarks/surface.py draw=1,2,9 surfels.bending=1 constant.surfels.outlines.DIM=0.2

Settings of the fit and constants of ``nlos_lit`` can be changed, to see how much hangs on them. Prints one
JSON line a fit. For drawn scenes the noise is the deviance of the same counts under the true expectation;
otherwise that of counts drawn from the fit. ``pictures=DIR`` also leaves an overview of each fit. One thread,
or ``threads=N``.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import binary_dilation

from data_modules.load import load_scene
from data_modules.simulate import draw_scene, simulate_capture
from data_modules.spots import heldout_mask
from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.capture.volume_grid import VolumeGrid, volume_grid
from nlos_lit.effects import build_effects
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.strengths import report
from nlos_lit.io.points import Points
from nlos_lit.metrics.geometry import geometry_errors
from nlos_lit.metrics.transients import poisson_deviance
from nlos_lit.model.build import PipelineSettings, build_pipeline
from nlos_lit.paper.figure7 import DARK, ON, separation
from nlos_lit.paper.methods import FAINTEST
from nlos_lit.paper.subjects import SIZES, bunny, with_geometry
from nlos_lit.paper.workspace import Subject, Workspace
from nlos_lit.report.surface_figures import FrontImage, overview
from nlos_lit.surfels.fit import SurfelSettings, score_spots
from nlos_lit.surfels.fitted import FittedSurfels, fit_surfels
from nlos_lit.training.configs import compose, settings_of
from nlos_lit.training.outcome import albedo_regions
from nlos_lit.training.shown import spot_residuals
from nlos_lit.training.surface_fitting import front

BEYOND = 2  # voxels around the image's letters within which albedo is still theirs


@dataclasses.dataclass
class Case:
    """A capture with its phasor image, and what is known of it."""

    name: str
    capture: Capture
    grid: VolumeGrid
    image: torch.Tensor
    expected: torch.Tensor | None = None
    truth: SurfaceTruth | None = None


def image_of(capture: Capture, grid: VolumeGrid, settings: PipelineSettings) -> torch.Tensor:
    """The phasor image at the start values."""
    phasor = build_pipeline(capture, grid, settings).phasor
    phasor.prepare(capture, phasor.plan(capture, 4 * 2**30))
    with torch.no_grad():
        return phasor().cpu()


def drawn(number: int) -> Case:
    """A random scene of the own simulator."""
    scene = draw_scene(number)
    capture, truth = scene.measure()
    expected, _ = simulate_capture(scene.mesh(), scene.scan, scene.sensor, None, detail=0.5)
    first, last = capture.gate
    means = torch.from_numpy(expected.counts[:, first:last].astype(np.float32))
    lowest = float(np.nanmin(truth.depth))
    grid = volume_grid(capture, depth=(max(0.1, lowest - 0.15), lowest + 1.0))
    image = image_of(capture, grid, PipelineSettings(0.1))
    surface = SurfaceTruth(truth.x, truth.y, truth.depth, truth.normal, truth.albedo)
    return Case(f"drawn {number}", capture, grid, image, means, surface)


def known(name: str, data: str) -> Case:
    """A subject of the paper's tables whose surface is known."""
    size = SIZES["full"]
    work = Workspace(Path("outputs/surface"), size.experiment, [Path(data)])
    every: list[Subject] = [bunny(work, size)] if name == "bunny" else with_geometry(work, size)
    scene = work.open(next(subject for subject in every if subject.name == name))
    image = image_of(scene.capture, scene.grid, PipelineSettings(scene.threshold))
    return Case(name, scene.capture, scene.grid, image, truth=scene.truth)


def real(name: str, path: str) -> Case:
    """A capture by its scene's configuration."""
    config = compose("train", [f"scene={name}", f"scene.path={path}"])
    capture, _ = load_scene(config["scene"], "data", 0)
    grid = volume_grid(capture, **config["scene"]["volume"])
    image = image_of(capture, grid, settings_of(PipelineSettings, config["model"], "model"))
    return Case(name, capture, grid, image)


def of_truth(points: Points, case: Case, cell: float) -> dict[str, Any]:
    """Errors of the bright surfels; albedo ratio and coverage of two halves where there are two albedos."""
    assert case.truth is not None
    bright = points.albedo >= FAINTEST
    kept = Points(*(part[bright] for part in (points.positions, points.normals, points.albedo)))
    regions = albedo_regions(case.truth)
    row = geometry_errors(kept, case.truth, lateral_tolerance=cell).to_dict()
    if regions is not None:
        whole = geometry_errors(points, case.truth, lateral_tolerance=cell, regions=regions)
        half = dataclasses.replace(case.truth, depth=np.where(regions[1], case.truth.depth, np.nan))
        row |= {"albedo_ratio": whole.albedo_ratio, "albedo_ratio_truth": whole.albedo_ratio_truth}
        row["coverage_dark"] = geometry_errors(points, half, lateral_tolerance=cell).coverage
    return row


def of_letters(found: FittedSurfels, case: Case) -> dict[str, float]:
    """By the phasor image: separation of letters and background, share of albedo beyond the letters."""
    seen = case.image.amax(0).sqrt().numpy()
    seen = np.clip(seen / np.quantile(seen, 0.99), 0, 1)
    letters, background = seen > ON, seen <= np.quantile(seen, DARK)
    points, (nx, ny) = found.points(), seen.shape
    (x, y, _), (dx, dy, _) = case.grid.origin, case.grid.pitch
    i, j = (
        np.round((points.positions[:, axis] - start) / pitch).astype(int)
        for axis, start, pitch in ((0, x, dx), (1, y, dy))
    )
    inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
    albedo = np.zeros((nx, ny))
    np.add.at(albedo, (i[inside], j[inside]), points.albedo[inside])
    beyond = ~binary_dilation(letters, iterations=BEYOND)
    return {
        "separation": separation(albedo, letters, background),
        "beyond_letters": float(albedo[beyond].sum() / albedo.sum()),
    }


def changed(options: dict[str, str]) -> dict[str, Any]:
    """Settings by ``surfels.NAME=VALUE``; constants by ``constant.MODULE.NAME=VALUE`` are set in place."""
    own = {
        name.removeprefix("surfels."): ast.literal_eval(value)
        for name, value in options.items()
        if name.startswith("surfels.")
    }
    for name, value in options.items():
        if name.startswith("constant."):
            module, constant = name.removeprefix("constant.").rsplit(".", 1)
            place = importlib.import_module(f"nlos_lit.{module}")
            getattr(place, constant)  # one that is there
            setattr(place, constant, ast.literal_eval(value))
    return own


def fit_rows(case: Case, options: dict[str, str]) -> None:
    """One line a seed."""
    settings = SurfelSettings(**changed(options))
    capture = case.capture
    block = 8 if capture.n_spots >= 4096 else 4
    mask, lit = heldout_mask(capture, block, 4), capture.gated_counts().any(1)
    held, train = np.flatnonzero(mask & lit), np.flatnonzero(~mask & lit)
    for seed in range(int(options.get("seeds", 1))):
        names = [e for e in options.get("effects", "").split(",") if e]
        extension = Extension(build_effects(names, Scan.of(capture)))
        began, clock = time.process_time(), time.perf_counter()
        found = fit_surfels(
            capture,
            case.image,
            case.grid,
            settings,
            train,
            extension=extension,
            seed=seed,
            scan_shapes=bool(names),
        )
        seconds, wall = time.process_time() - began, time.perf_counter() - clock
        spots = torch.from_numpy(held)
        scores = score_spots(found.model, capture, spots, extension)
        noise = scores.deviance_noise
        if case.expected is not None:
            counts = torch.from_numpy(capture.gated_counts()[held].astype(np.float32))
            noise = poisson_deviance(counts, case.expected[spots].clamp_min(1e-9)).mean().item()
        row = {
            "scene": case.name,
            "seed": seed,
            "changed": {name: v for name, v in options.items() if "." in name},
            "over_noise": scores.deviance_per_bin / noise,
            **dataclasses.asdict(scores),
            "surfels": len(found.model),
            "rounds": len(found.history),
            "cpu_seconds": seconds,
            "seconds": wall,
            "counts_per_spot": float(capture.gated_counts().sum() / capture.n_spots),
            "effects": report(extension.effects),
        }
        row |= (
            of_letters(found, case)
            if case.truth is None
            else of_truth(found.points(), case, float(case.grid.pitch[0]))
        )
        print(json.dumps(row), flush=True)
        if "pictures" in options:
            folder = Path(options["pictures"])
            folder.mkdir(parents=True, exist_ok=True)
            places, residuals = spot_residuals(
                capture,
                np.arange(capture.n_spots),
                lambda part, m=found.model, e=extension: m.expected(part, e),
            )
            image = FrontImage(case.image.amax(0).numpy(), case.grid.x, case.grid.y)
            figure = overview(image, front(found.model), places, residuals, f"{case.name}, seed {seed}")
            label = f"{case.name}_{'effects' if names else 'plain'}_{seed}".replace(" ", "_")
            figure.savefig(folder / f"{label}.png", dpi=60, bbox_inches="tight")


def main(arguments: list[str]) -> None:
    """Read ``name=value`` arguments and print the rows."""
    options = dict(argument.split("=", 1) for argument in arguments)
    torch.set_num_threads(int(options.get("threads", 1)))
    for number in options.get("draw", "").split(","):
        if number:
            fit_rows(drawn(int(number)), options)
    for name in options.get("known", "").split(","):
        if name:
            fit_rows(known(name, options["data"]), options)
    if "scene" in options:
        fit_rows(real(options["scene"], options["path"]), options)


if __name__ == "__main__":
    main(sys.argv[1:])
