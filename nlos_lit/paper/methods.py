"""Surfaces of all systems on one capture: the classical ones with the best settings found by hand, ours as
they come.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from data_modules.simulate import Mesh
from nlos_lit.baselines import reconstruct_directed
from nlos_lit.baselines.surface import front_points
from nlos_lit.io.meshes import poisson_mesh
from nlos_lit.io.points import Points, read_points
from nlos_lit.io.volumes import read_volume
from nlos_lit.metrics.geometry import GeometryErrors, geometry_errors
from nlos_lit.paper.record import CLASSICAL, Row
from nlos_lit.paper.workspace import Scene

THRESHOLDS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
FAINTEST = 0.2  # surfels below this share of the bright albedo are not drawn, meshed or scored


def possible(scene: Scene) -> list[str]:
    """Classical methods that can work on the capture."""
    return [name for name in CLASSICAL if scene.capture.confocal or name in ("bp", "fbp", "rsd")]


def options_of(method: str, scene: Scene, snrs: tuple[float, ...]) -> list[dict[str, Any]]:
    """Option sets to try: the falloff as the scene has it, the signal-to-noise parameter swept where there is
    one.
    """
    if method in ("lct", "dlct"):
        return [{"snr": snr, "falloff": scene.falloff} for snr in snrs]
    return [{"falloff": scene.falloff}] if method == "fk" else [{}]


def classical_points(scene: Scene, method: str, snrs: tuple[float, ...]) -> tuple[Points, dict[str, float]]:
    """A method's surface at its best: of all option sets and thresholds the one with the highest F-score
    against the truth.

    The F-score is the harmonic mean of coverage and of the share of points near the truth.

    Returns:
        the points, and the threshold and options that were best.
    """
    best: tuple[float, Points, dict[str, float]] | None = None
    for options in options_of(method, scene, snrs):
        volume, field = reconstruct_directed(scene.capture, scene.grid, method, **options)
        for threshold in THRESHOLDS:
            points = front_points(
                volume.numpy(), scene.grid, threshold, None if field is None else field.numpy()
            )
            score = f_score(errors_of(points, scene))
            if best is None or score > best[0]:
                best = score, points, {"threshold": threshold, **options}
    return best[1], best[2]


def errors_of(points: Points, scene: Scene) -> GeometryErrors:
    """Errors against the first surface along z; points and truth are near each other within 2 cm in depth and
    one spot spacing.
    """
    return geometry_errors(points, scene.truth, lateral_tolerance=scene.spacing)


def f_score(errors: GeometryErrors) -> float:
    """Harmonic mean of coverage and of the share of points near the truth; 0 where either is 0."""
    right = 1 - errors.off_truth if errors.points else 0.0
    return 2 * right * errors.coverage / (right + errors.coverage) if right + errors.coverage > 0 else 0.0


def run_points(folder: Path, refined: bool) -> Points:
    """The surface of a training: all of the phasor surface's points, or the surfels that are not faint."""
    if not refined:
        return read_points(folder / "points.ply")
    points = read_points(folder / "refined" / "points.ply")
    return selected(points, points.albedo >= FAINTEST)


def front_of_run(folder: Path, scene: Scene) -> Points:
    """The maximum along z of a training's volume, as of the classical methods, at the scene's own threshold."""
    volume, grid, _ = read_volume(folder / "volume.h5")
    return front_points(volume, grid, scene.threshold)


# system → which training, and what of it
OURS: dict[str, tuple[str, Callable[[Path, Scene], Points]]] = {
    "published system": ("paper", lambda folder, _: run_points(folder, refined=False)),
    "ours, phasor surface": ("ours", lambda folder, _: run_points(folder, refined=False)),
    "ours, volume's front": ("ours", front_of_run),
    "ours, refined": ("ours", lambda folder, _: run_points(folder, refined=True)),
}


def selected(points: Points, keep: np.ndarray) -> Points:
    """The points of a mask ``[N]``."""
    intensity = None if points.intensity is None else points.intensity[keep]
    return Points(points.positions[keep], points.normals[keep], points.albedo[keep], intensity)


def mesh_of(points: Points, depth: int = 7) -> Mesh | None:
    """Poisson reconstruction; None where the points do not suffice."""
    mesh, _ = poisson_mesh(points, depth)
    return None if mesh is None else Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), 1.0)


def geometry_row(errors: GeometryErrors) -> Row:
    """Depth in mm, normals in degrees, shares."""
    return {
        "depth error, median (mm)": 1e3 * errors.depth_median_abs,
        "depth error, 95 % (mm)": 1e3 * errors.depth_p95_abs,
        "normal error, median (°)": errors.normal_median_deg,
        "coverage": errors.coverage,
        "off the truth": errors.off_truth,
        "F-score": f_score(errors),
    }


def front_of_points(points: Points, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """``[nx, ny]`` albedo of the points summed over each cell of a lattice."""
    place = [
        np.floor((points.positions[:, k] - axis[0]) / (axis[1] - axis[0]) + 0.5).astype(int)
        for k, axis in enumerate((x, y))
    ]
    inside = (place[0] >= 0) & (place[0] < len(x)) & (place[1] >= 0) & (place[1] < len(y))
    image = np.zeros((len(x), len(y)))
    np.add.at(image, (place[0][inside], place[1][inside]), points.albedo[inside])
    return image
