"""Figures 10 and 11: meshes of all systems against the true surface, distances both ways."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nlos_lit.io.points import Points
from nlos_lit.paper import plots
from nlos_lit.paper.methods import (
    OURS,
    THRESHOLDS,
    classical_points,
    errors_of,
    geometry_row,
    mesh_of,
    possible,
)
from nlos_lit.paper.record import CLASSICAL, Evidence, Glance, Row
from nlos_lit.paper.subjects import Size, bunny, with_geometry
from nlos_lit.paper.surface_distance import Distances, surface_distances, visible_sample
from nlos_lit.paper.trainings import full_model
from nlos_lit.paper.workspace import Arrays, Scene, Subject, Workspace

TOLERANCE = 0.02  # m
HIDDEN = (
    "95 % surface→truth (mm)",
    "95 % truth→surface (mm)",
    "depth error, 95 % (mm)",
    "coverage",
    "off the truth",
)
SHOWN = 4000  # points of a cloud that are drawn
BOTH = "RMSE, mean of both ways (mm)"


def trainings(work: Workspace, size: Size, subject: Subject) -> dict[str, Path]:
    """The published system's and our training on a subject."""
    paper = work.train(f"{subject.name}_paper", subject, "model=paper")
    ours = (
        full_model(work, size)
        if subject.name == "bunny"
        else work.train(subject.name, subject, "refine=true")
    )
    return {"paper": paper, "ours": ours}


def figure10(work: Workspace, size: Size) -> Evidence:
    """A mesh by Poisson reconstruction for every system, RMSE and Hausdorff distance from it to the truth and
    back.
    """
    rows: list[Row] = []
    clouds, labels, glance = [], [], []
    for subject in [bunny(work, size), *with_geometry(work, size)]:
        scene = work.open(subject)
        runs = trainings(work, size, subject)
        found = {
            name: _compared(work, size, subject, scene, name, runs)
            for name in (*CLASSICAL, *OURS)
            if _can(name, scene)
        }
        rows += [{"capture": subject.short, "system": name, **_row(entry)} for name, entry in found.items()]
        clouds.append([_cloud(found.get(name)) for name in (*CLASSICAL, *OURS)])
        labels.append(subject.name)
        by_name = {row["system"]: row for row in rows if row["capture"] == subject.short}
        for what in (BOTH, "normal error, median (°)"):
            value = {name: row[what] for name, row in by_name.items()}
            glance.append(_glance(what, subject, value))
    shown = plots.clouds(
        clouds, labels, [*CLASSICAL, "published", "ours, phasor", "ours, front", "ours, refined"], 0.05
    )
    return Evidence(
        "figure10",
        "Figures 10 and 11: geometry",
        "Dragon, Erato and Indonesian (renders of Chen et al.), 34 and SU; Hausdorff distance maps and RMSE against D-LCT, NeTF "
        "and Plack et al.; the RMSE counts reconstructed regions only. Its text gives no numbers of that figure.",
        "Meshes by Poisson reconstruction (Open3D), trimmed where there are no points. surface→truth: from points of the mesh to "
        "the true mesh; truth→surface: from true points that at least a tenth of the wall can see, so that missing regions "
        f"count. The classical systems' threshold and signal-to-noise parameter are the best of {len(THRESHOLDS)} × "
        f"{len(size.snrs)} by F-score, chosen with the truth in hand; the published system and ours have one setting for all. "
        "Surfels below a fifth of the bright albedo are left out.",
        rows,
        {"distances": shown},
        {"distances": "True points that the wall sees, coloured by their distance to each system's mesh; –: no mesh, or the method "
         "needs a confocal scan."},
        glance,
        HIDDEN,
    )  # fmt: skip


def _can(name: str, scene: Scene) -> bool:
    return name in OURS or name in possible(scene)


def _compared(
    work: Workspace, size: Size, subject: Subject, scene: Scene, name: str, runs: dict[str, Path]
) -> Arrays:
    def compute() -> dict[str, Any]:
        chosen: dict[str, float] = {}
        if name in OURS:
            run, take = OURS[name]
            points = take(runs[run], scene)
        else:
            points, chosen = classical_points(scene, name, size.snrs)
        return compare_points(points, scene, size.samples) | {
            f"chosen_{key}": value for key, value in chosen.items()
        }

    return work.kept(f"figure10/{subject.name}_{name.replace(', ', '_').replace(' ', '_')}", compute)


def compare_points(points: Points, scene: Scene, samples: int) -> dict[str, Any]:
    """Distances of the points' mesh and errors of the points, with the sampled clouds."""
    wall = scene.capture.sensor if np.ptp(scene.capture.sensor, axis=0).max() > 0 else scene.capture.laser
    seen_from = wall[np.linspace(0, len(wall) - 1, 64).astype(int)]
    visible = visible_sample(scene.mesh, seen_from, samples)
    distances: Distances = surface_distances(mesh_of(points), scene.mesh, visible, samples)
    entries = {f"row_{key}": value for key, value in distances.summary(TOLERANCE).items()}
    entries |= {f"row_{key}": value for key, value in geometry_row(errors_of(points, scene)).items()}
    few = slice(None, None, max(1, len(distances.truth) // SHOWN))
    return {
        **entries,
        "truth": distances.truth[few].astype(np.float32),
        "distance": distances.from_truth[few].astype(np.float32),
    }


def _row(entry: Arrays) -> Row:
    values = {
        key.removeprefix("row_"): float(value) for key, value in entry.items() if key.startswith("row_")
    }
    both = (values["RMSE surface→truth (mm)"] + values["RMSE truth→surface (mm)"]) / 2
    chosen = ", ".join(
        f"{key.removeprefix('chosen_')} {float(v):.3g}"
        for key, v in entry.items()
        if key.startswith("chosen_")
    )
    return {BOTH: both, **values, "chosen with the truth": chosen or None}


def _cloud(entry: Arrays | None) -> tuple[np.ndarray, np.ndarray] | None:
    return None if entry is None else (entry["truth"], entry["distance"])


def _glance(what: str, subject: Subject, value: dict[str, float]) -> Glance:
    classical = {name: v for name, v in value.items() if name in CLASSICAL}
    return Glance(
        what,
        subject.short,
        value["published system"],
        classical,
        value["ours, phasor surface"],
        value["ours, refined"],
    )
