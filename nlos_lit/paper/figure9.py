"""Figure 9: real scenes, everything that a run recovers of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlos_lit.io.points import Points
from nlos_lit.io.tables import Row
from nlos_lit.io.volumes import read_volume
from nlos_lit.metrics.geometry import depth_map
from nlos_lit.paper import plots
from nlos_lit.paper.methods import run_points
from nlos_lit.paper.record import Evidence
from nlos_lit.paper.subjects import Size, real_scenes
from nlos_lit.paper.trainings import own_training, summary
from nlos_lit.paper.workspace import Workspace


def figure9(work: Workspace, size: Size) -> Evidence:
    """Volume, albedo, depth and normals of real scenes, before and after the refinement.

    Args:
        work: where captures and trainings are kept.
        size: of the experiments.

    Returns:
        a row a capture, and the images.
    """
    rows: list[Row] = []
    grid, labels, ends = [], [], []
    for subject in real_scenes(work, size):
        scene = work.open(subject)
        folder = own_training(work, size, subject)
        found = summary(folder)
        held, refined = found["heldout"], found["refined"]
        value = {name: entry["value"] for name, entry in found["parameters"].items()}
        rows.append(
            {
                "capture": subject.short,
                "NMSE before": held["nmse"]["initial"],
                "NMSE after": held["nmse"]["final"],
                "NMSE refined": refined["heldout"]["nmse"],
                "NMSE of noise": held["nmse"]["noise_floor"],
                "deviance/bin refined": refined["heldout"]["deviance_per_bin"],
                "deviance/bin of noise": refined["heldout"]["deviance_noise"],
                "λ (cm)": 200 * np.pi / value["omega_pf"],
                "σ_pf (cm)": 100 * value["sigma_pf"],
                "surfels": refined["surfels"],
                "mesh triangles": found["mesh"]["triangles"],
                "seconds": found["seconds"]["total"],
            }
        )
        grid.append(_row(folder, scene.grid.x, scene.grid.y))
        labels.append(subject.label.split(",")[0])
        ends.append(scene.extent)
    columns = [
        "volume",
        "albedo",
        "points, by depth",
        "normals",
        "refined: albedo",
        "refined: depth",
        "refined: normals",
    ]
    return Evidence(
        "figure9",
        "Figure 9: real scenes",
        "SU (confocal), 44i and NLOS (one detector): albedo, points and normals. Pictures only.",
        "Real captures; one training each with the default settings of its scene, 100 iterations; then "
        "refined. 44i and NLOS are not at hand: the 4 of the same laboratory and kind of scan stands for "
        "them.",
        rows,
        {"scenes": plots.images(grid, labels, columns, ends, side=1.9)},
        {
            "scenes": "As seen from the wall. Normals: red to the right, green up, blue to the wall. "
            "Albedo scaled to "
            "its 98th percentile."
        },
    )


def _row(folder: Path, x: np.ndarray, y: np.ndarray) -> list[plots.Image]:
    volume = read_volume(folder / "volume.h5")[0].max(0)
    cells = [plots.Image(volume)]
    for refined in (False, True):
        points = run_points(folder, refined)
        limits = plots.limits_of(points.positions[:, 2], 0.02, 0.98) if len(points) else (0.0, 1.0)
        depth = plots.Image(depth_map(points, x, y), "depth", limits)
        cells += [_of_points(points, points.albedo, x, y), depth, normals_image(points, x, y)]
    return cells


def _of_points(points: Points, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> plots.Image:
    white = float(np.quantile(values, 0.98)) if len(values) else 1.0
    return plots.Image(cell_median(points, values, x, y) / max(white, 1e-12), "albedo", (0, 1))


def cell_median(points: Points, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Median over the points in each cell of a lattice.

    Args:
        points: N of them.
        values: ``[N]`` what the median is taken of.
        x: ``[nx]`` centres of the cells, evenly spaced, m.
        y: ``[ny]`` the same along y.

    Returns:
        ``[nx, ny]``, NaN where there are no points.
    """
    carried = Points(np.column_stack([points.positions[:, :2], values]), points.normals, points.albedo)
    return depth_map(carried, x, y)


def normals_image(points: Points, x: np.ndarray, y: np.ndarray) -> plots.Image:
    """Colours of a normal map in the wall's view; grey where there is nothing.

    Args:
        points: with normals.
        x: ``[nx]`` centres of the cells, evenly spaced, m.
        y: ``[ny]`` the same along y.

    Returns:
        an ``rgb`` image: red to the right, green up, blue to the wall.
    """
    signs = (-1, 1, -1)
    channels = [cell_median(points, sign * points.normals[:, axis], x, y) for axis, sign in enumerate(signs)]
    colours = 0.5 + 0.5 * np.stack(channels, axis=2)
    return plots.Image(np.where(np.isfinite(colours), np.clip(colours, 0, 1), 0.85), "rgb")
