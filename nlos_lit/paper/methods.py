"""Surfaces of all systems on one capture, and how they are scored and compared.

The classical systems come with the best settings found with the truth in hand, ours as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data_modules.simulate import Mesh
from nlos_lit.baselines import reconstruct_directed
from nlos_lit.baselines.surface import front_points
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.io.meshes import poisson_mesh
from nlos_lit.io.points import Points, read_points
from nlos_lit.io.tables import Row
from nlos_lit.io.volumes import read_volume
from nlos_lit.metrics.geometry import GeometryErrors, geometry_errors
from nlos_lit.paper.record import CLASSICAL, Glance
from nlos_lit.paper.workspace import Arrays, Scene

THRESHOLDS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
FAINTEST = 0.2  # surfels below this share of the bright albedo are not drawn, meshed or scored


def possible(scene: Scene) -> list[str]:
    """Classical methods that can work on the capture."""
    return [name for name in CLASSICAL if scene.capture.confocal or name in ("bp", "fbp", "rsd")]


def options_of(method: str, scene: Scene, snrs: tuple[float, ...]) -> list[dict[str, Any]]:
    """Option sets to try: the scene's falloff, and the signal-to-noise parameter swept where there is one.

    Args:
        method: one of `CLASSICAL`.
        scene: whose falloff is taken.
        snrs: signal-to-noise parameters of the light-cone transforms.

    Returns:
        keyword arguments of the method, one dict a set.
    """
    if method in ("lct", "dlct"):
        return [{"snr": snr, "falloff": scene.falloff} for snr in snrs]
    return [{"falloff": scene.falloff}] if method == "fk" else [{}]


def classical_points(scene: Scene, method: str, snrs: tuple[float, ...]) -> tuple[Points, dict[str, float]]:
    """A method's surface at its best: the option set and threshold with the highest F-score.

    Args:
        scene: capture, volume and truth.
        method: one of `CLASSICAL`.
        snrs: signal-to-noise parameters that the light-cone transforms try.

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
    assert best is not None
    return best[1], best[2]


def known_truth(scene: Scene) -> SurfaceTruth:
    """The true surface of a scene that was simulated or rendered, and so has one."""
    assert scene.truth is not None
    return scene.truth


def errors_of(points: Points, scene: Scene) -> GeometryErrors:
    """Errors against the first true surface along z.

    Args:
        points: a reconstruction.
        scene: whose truth is known.

    Returns:
        the errors; points and truth are near each other within 2 cm in depth and one spot spacing sideways.
    """
    return geometry_errors(points, known_truth(scene), lateral_tolerance=scene.spacing)


def f_score(errors: GeometryErrors) -> float:
    """Harmonic mean of coverage and of the share of points near the truth; 0 where either is 0."""
    right = 1 - errors.off_truth if errors.points else 0.0
    return 2 * right * errors.coverage / (right + errors.coverage) if right + errors.coverage > 0 else 0.0


def run_points(folder: Path, refined: bool) -> Points:
    """The surface of a training.

    Args:
        folder: of the finished run.
        refined: take the surfels that are not faint, instead of all points of the phasor surface.

    Returns:
        points, m, in the world frame.
    """
    if not refined:
        return read_points(folder / "points.ply")
    points = read_points(folder / "refined" / "points.ply")
    return selected(points, points.albedo >= FAINTEST)


def front_of_run(folder: Path, scene: Scene) -> Points:
    """The maximum along z of a training's volume, taken as it is from the classical methods.

    Args:
        folder: of the finished run.
        scene: whose own threshold is taken.

    Returns:
        points, m, in the world frame.
    """
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
    """Some of the points.

    Args:
        points: N of them.
        keep: ``[N]`` True for those that stay.

    Returns:
        the points kept, in the same order.
    """
    intensity = None if points.intensity is None else points.intensity[keep]
    return Points(points.positions[keep], points.normals[keep], points.albedo[keep], intensity)


def mesh_of(points: Points, depth: int = 7) -> Mesh | None:
    """Poisson reconstruction of a surface.

    Args:
        points: with normals.
        depth: of the octree, see `poisson_mesh`.

    Returns:
        the mesh, with albedo 1; None where the points do not suffice.
    """
    mesh, _ = poisson_mesh(points, depth)
    if mesh is None:
        return None
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), np.asarray(1.0))


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


def to_keep(row: Mapping[str, float], chosen: Mapping[str, float] | None = None) -> dict[str, Any]:
    """A row as named numbers that `Workspace.kept` stores beside arrays; `kept_row` reads it back.

    Args:
        row: column → number.
        chosen: options that were chosen with the truth in hand.

    Returns:
        the same under names that say which is which.
    """
    return {f"row_{key}": value for key, value in row.items()} | {
        f"chosen_{key}": value for key, value in (chosen or {}).items()
    }


def kept_row(entry: Arrays) -> Row:
    """The row that `to_keep` stored among other arrays.

    Examples:
        >>> stored = to_keep({"coverage": 0.5}, {"snr": 0.1})
        >>> kept_row({name: np.array(value) for name, value in stored.items()})
        {'coverage': 0.5}
    """
    return {key.removeprefix("row_"): float(v) for key, v in entry.items() if key.startswith("row_")}


def kept_choice(entry: Arrays) -> str | None:
    """Options chosen with the truth in hand that `to_keep` stored, in words; None where there are none.

    Examples:
        >>> kept_choice({"chosen_threshold": np.array(0.2), "chosen_snr": np.array(0.01)})
        'threshold 0.2, snr 0.01'
    """
    chosen = {key.removeprefix("chosen_"): float(v) for key, v in entry.items() if key.startswith("chosen_")}
    return ", ".join(f"{key} {value:.3g}" for key, value in chosen.items()) or None


def glance_of(what: str, data: str, value: Mapping[str, float], higher: bool = False) -> Glance:
    """The comparison of all systems in one quantity.

    Args:
        what: the quantity with its unit.
        data: the capture.
        value: system → value, the systems named as in `CLASSICAL` and `OURS`.
        higher: more is better.

    Returns:
        the comparison; systems without a value are left out.
    """
    classical = {name: v for name, v in value.items() if name in CLASSICAL}
    ours = value["ours, phasor surface"], value["ours, refined"]
    return Glance(what, data, value.get("published system"), classical, *ours, higher)


def front_of_points(points: Points, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Albedo of the points summed over each cell of a lattice, seen from the wall.

    Args:
        points: a surface.
        x: ``[nx]`` centres of the cells, evenly spaced, m.
        y: ``[ny]`` the same along y.

    Returns:
        ``[nx, ny]``, 0 where there are no points.
    """
    place = [
        np.floor((points.positions[:, k] - axis[0]) / (axis[1] - axis[0]) + 0.5).astype(int)
        for k, axis in enumerate((x, y))
    ]
    inside = (place[0] >= 0) & (place[0] < len(x)) & (place[1] >= 0) & (place[1] < len(y))
    image = np.zeros((len(x), len(y)))
    np.add.at(image, (place[0][inside], place[1][inside]), points.albedo[inside])
    return image
