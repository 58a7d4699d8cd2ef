"""Figure 8: albedo apart from geometry, on the two-albedo scene."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np

from nlos_lit.baselines import reconstruct
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.io.points import Points, read_points
from nlos_lit.io.tables import Row
from nlos_lit.metrics.geometry import depth_at, depth_map, geometry_errors
from nlos_lit.paper import plots
from nlos_lit.paper.methods import errors_of, geometry_row, known_truth, run_points
from nlos_lit.paper.record import Evidence, Glance
from nlos_lit.paper.subjects import Size, bunny
from nlos_lit.paper.trainings import full_model, published_training
from nlos_lit.paper.workspace import Scene, Workspace
from nlos_lit.training.outcome import albedo_regions


def figure8(work: Workspace, size: Size) -> Evidence:
    """Two albedos: the ratio that is found, and errors of the geometry on either half.

    Args:
        work: where captures and trainings are kept.
        size: of the experiments.

    Returns:
        a row a system and half, albedo and depth as images, the comparison of the ratio.
    """
    subject = bunny(work, size)
    scene = work.open(subject)
    truth = known_truth(scene)
    folder, published = full_model(work, size), published_training(work, subject)
    systems: dict[str, Points] = {
        "published system": run_points(published, refined=False),
        "ours, phasor surface": run_points(folder, refined=False),
        "ours, refined": run_points(folder, refined=True),
    }
    bright, dark = _halves(truth)
    rows: list[Row] = []
    for name, points in systems.items():
        # Leaving faint surfels out would lift the mean of the dark half.
        every = read_points(folder / "refined" / "points.ply") if name == "ours, refined" else points
        ratio = geometry_errors(every, truth, lateral_tolerance=scene.spacing, regions=(bright, dark))
        for half, mask in (("albedo 1.0", bright), ("albedo 0.3", dark)):
            errors = errors_of(on_half(points, truth, mask), _half(scene, mask))
            row = {
                "system": name,
                "half": half,
                "albedo ratio (true 3.33)": ratio.albedo_ratio,
                **geometry_row(errors),
            }
            rows.append({**row, "depth bias (mm)": 1e3 * errors.depth_bias})
    for method in ("lct", "fk") if scene.capture.confocal else ():
        kept = work.kept(f"figure8_{method}", partial(_front, scene, method))
        ratio_of_image = _image_ratio(kept["front"], scene)
        rows.append(
            {"system": f"{method} (its intensity as albedo)", "albedo ratio (true 3.33)": ratio_of_image}
        )
    x, y = truth.x, truth.y
    ends = (x[0], x[-1], y[0], y[-1])
    assert truth.albedo is not None
    limits = plots.limits_of(truth.depth)
    depths = [truth.depth, *(depth_map(p, scene.grid.x, scene.grid.y) for p in systems.values())]
    grid = [
        [plots.Image(truth.albedo, "albedo", (0, 1)), *(_albedo_image(p, scene) for p in systems.values())],
        [plots.Image(depth, "depth", limits) for depth in depths],
    ]
    shown = plots.images(grid, ["albedo", "depth"], ["truth", *systems], [ends, ends], side=2.3)
    off = {row["system"]: abs(np.log(row["albedo ratio (true 3.33)"] * 0.3)) for row in rows}
    return Evidence(
        "figure8",
        "Figure 8: albedo apart from geometry",
        "Two-albedo Bunny (1.0 and 0.3): the optimised albedo shows both halves, the geometry none of it. No "
        "numbers.",
        f"{subject.label}. Mean albedo of points near the truth in the upper over that in the lower half; "
        "depth and normals on each half apart. If geometry followed albedo, the two halves would differ in "
        "depth bias.",
        rows,
        {"albedo": shown},
        {
            "albedo": "Albedo (scaled to its 98th percentile) and depth from the wall: truth, published "
            "system, ours, ours refined."
        },
        [
            Glance(
                "albedo ratio: |ln(found / true)|",
                subject.short,
                off["published system"],
                {name.split()[0]: value for name, value in off.items() if "intensity" in name},
                off["ours, phasor surface"],
                off["ours, refined"],
            ),
        ],
    )


def on_half(points: Points, truth: SurfaceTruth, mask: np.ndarray) -> Points:
    """Points over one part of the true surface.

    Args:
        points: a reconstruction.
        truth: the true surface.
        mask: ``[nx, ny]`` True in the truth's cells that belong to the part.

    Returns:
        the points whose nearest cell of the truth lies in ``mask``.
    """
    _, cell = depth_at(truth, points.positions[:, :2])
    keep = mask[tuple(cell.T)]
    return Points(points.positions[keep], points.normals[keep], points.albedo[keep])


def _halves(truth: SurfaceTruth) -> tuple[np.ndarray, np.ndarray]:
    regions = albedo_regions(truth)
    assert regions is not None
    return regions


def _half(scene: Scene, mask: np.ndarray) -> Scene:
    whole = known_truth(scene)
    return dataclasses.replace(
        scene, truth=dataclasses.replace(whole, depth=np.where(mask, whole.depth, np.nan))
    )


def _front(scene: Scene, method: str) -> dict[str, np.ndarray]:
    volume = reconstruct(scene.capture, scene.grid, method, falloff=scene.falloff)
    return {"front": volume.max(0).values.numpy()}


def _image_ratio(front: np.ndarray, scene: Scene) -> float:
    x, y = np.meshgrid(scene.grid.x, scene.grid.y, indexing="ij")
    truth = known_truth(scene)
    depth, cell = depth_at(truth, np.stack([x.ravel(), y.ravel()], axis=1))
    known = np.isfinite(depth)
    value = front.ravel()[known]
    bright, dark = (mask[tuple(cell[known].T)] for mask in _halves(truth))
    return float(value[bright].mean() / value[dark].mean())


def _albedo_image(points: Points, scene: Scene) -> plots.Image:
    """Mean albedo of the points in each cell."""
    x, y = scene.grid.x, scene.grid.y
    carried = Points(np.column_stack([points.positions[:, :2], points.albedo]), points.normals, points.albedo)
    image = depth_map(carried, x, y)
    white = np.quantile(points.albedo, 0.98) if len(points) else 1.0
    return plots.Image(image / max(white, 1e-12), "albedo", (0, 1))
