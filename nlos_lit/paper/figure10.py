"""Figures 10 and 11: meshes of all systems against the true surface, distances both ways."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nlos_lit.io.points import Points
from nlos_lit.io.tables import Row
from nlos_lit.paper import plots
from nlos_lit.paper.methods import (
    OURS,
    THRESHOLDS,
    classical_points,
    errors_of,
    geometry_row,
    glance_of,
    kept_choice,
    kept_row,
    mesh_of,
    possible,
    to_keep,
)
from nlos_lit.paper.record import CLASSICAL, Evidence
from nlos_lit.paper.subjects import Size, bunny, with_geometry
from nlos_lit.paper.surface_distance import surface_distances, visible_sample
from nlos_lit.paper.trainings import own_training, published_training
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


def figure10(work: Workspace, size: Size) -> Evidence:
    """A mesh for every system; RMSE and Hausdorff distance from it to the truth and back.

    Args:
        work: where captures, trainings and distances are kept.
        size: of the experiments.

    Returns:
        a row a capture and system, maps of distances, the comparisons.
    """
    rows: list[Row] = []
    clouds, labels, glance = [], [], []
    for subject in [bunny(work, size), *with_geometry(work, size)]:
        scene = work.open(subject)
        runs = {"paper": published_training(work, subject), "ours": own_training(work, size, subject)}
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
            glance.append(glance_of(what, subject.short, value))
    columns = [*CLASSICAL, "published", "ours, phasor", "ours, front", "ours, refined"]
    return Evidence(
        "figure10",
        "Figures 10 and 11: geometry",
        "Dragon, Erato and Indonesian (renders of Chen et al.), 34 and SU; Hausdorff distance maps and RMSE "
        "against D-LCT, NeTF and Plack et al.; the RMSE counts reconstructed regions only. Its text gives no "
        "numbers of that figure.",
        "Meshes by Poisson reconstruction (Open3D), trimmed where there are no points. surface→truth: from "
        "points of the mesh to the true mesh; truth→surface: from true points that at least a tenth of the "
        "wall can see, so that missing regions count. The classical systems' threshold and signal-to-noise "
        f"parameter are the best of {len(THRESHOLDS)} × {len(size.snrs)} by F-score, chosen with the truth "
        "in "
        "hand; the published system and ours have one setting for all. Surfels below a fifth of the bright "
        "albedo are left out.",
        rows,
        {"distances": plots.clouds(clouds, labels, columns, 0.05)},
        {
            "distances": "True points that the wall sees, coloured by their distance to each system's mesh; "
            "–: no mesh, or the method needs a confocal scan."
        },
        glance,
        HIDDEN,
    )


def _can(name: str, scene: Scene) -> bool:
    return name in OURS or name in possible(scene)


def _compared(
    work: Workspace, size: Size, subject: Subject, scene: Scene, name: str, runs: dict[str, Path]
) -> Arrays:
    def compute() -> dict[str, Any]:
        if name in OURS:
            run, take = OURS[name]
            return compare_points(take(runs[run], scene), scene, size.samples)
        points, chosen = classical_points(scene, name, size.snrs)
        return compare_points(points, scene, size.samples) | to_keep({}, chosen)

    return work.kept(f"figure10/{subject.name}_{name.replace(', ', '_').replace(' ', '_')}", compute)


def compare_points(points: Points, scene: Scene, samples: int) -> dict[str, Any]:
    """Distances of the points' mesh and errors of the points, with the sampled clouds.

    Args:
        points: a reconstruction.
        scene: whose mesh and truth are known.
        samples: points sampled on each surface.

    Returns:
        the numbers as `to_keep` names them; ``truth`` ``[N, 3]`` true points that the wall sees (m, about
        `SHOWN`) and ``distance`` ``[N]`` of each to the points' mesh (m).
    """
    assert scene.mesh is not None
    wall = scene.capture.sensor if np.ptp(scene.capture.sensor, axis=0).max() > 0 else scene.capture.laser
    seen_from = wall[np.linspace(0, len(wall) - 1, 64).astype(int)]
    visible = visible_sample(scene.mesh, seen_from, samples)
    distances = surface_distances(mesh_of(points), scene.mesh, visible, samples)
    row = distances.summary(TOLERANCE) | geometry_row(errors_of(points, scene))
    few = slice(None, None, max(1, len(distances.truth) // SHOWN))
    return {
        **to_keep(row),
        "truth": distances.truth[few].astype(np.float32),
        "distance": distances.from_truth[few].astype(np.float32),
    }


def _row(entry: Arrays) -> Row:
    values = kept_row(entry)
    both = (values["RMSE surface→truth (mm)"] + values["RMSE truth→surface (mm)"]) / 2
    return {BOTH: both, **values, "chosen with the truth": kept_choice(entry)}


def _cloud(entry: Arrays | None) -> tuple[np.ndarray, np.ndarray] | None:
    return None if entry is None else (entry["truth"], entry["distance"])
