"""Distances between a reconstructed mesh and the true one, both ways, so that missing regions count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_modules.simulate import Mesh
from data_modules.simulate.visibility import Occluder


@dataclass(frozen=True)
class Distances:
    """Two clouds of sampled points and their distances to the other surface, m.

    Args:
        points: ``[N, 3]`` on the reconstruction; ``to_truth`` ``[N]``.
        truth: ``[M, 3]`` on the visible truth; ``from_truth`` ``[M]``.
    """

    points: np.ndarray
    to_truth: np.ndarray
    truth: np.ndarray
    from_truth: np.ndarray

    def summary(self, tolerance: float) -> dict[str, float]:
        """RMSE, largest and 95th percentile in mm both ways; share of the truth nearer than a tolerance.

        Args:
            tolerance: m.

        Returns:
            column → value; NaN and 0 where there is no reconstruction.

        Examples:
            >>> cloud, away = np.zeros((2, 3)), np.array([0.03, 0.04])
            >>> found = Distances(cloud, away, cloud, away).summary(tolerance=0.035)
            >>> round(found["RMSE surface→truth (mm)"], 3), found["truth within 35 mm"]
            (35.355, 0.5)
        """
        entries = {}
        for name, values in (("surface→truth", self.to_truth), ("truth→surface", self.from_truth)):
            known = len(values) > 0
            entries[f"RMSE {name} (mm)"] = 1e3 * float(np.sqrt(np.mean(values**2))) if known else float("nan")
            entries[f"95 % {name} (mm)"] = 1e3 * float(np.quantile(values, 0.95)) if known else float("nan")
            entries[f"Hausdorff {name} (mm)"] = 1e3 * float(values.max()) if known else float("nan")
        covered = float(np.mean(self.from_truth < tolerance)) if len(self.from_truth) else 0.0
        return {**entries, f"truth within {1e3 * tolerance:.0f} mm": covered}


def sample(mesh: Mesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over a mesh's area.

    Args:
        mesh: with some area.
        count: number of points.
        seed: of the draw.

    Returns:
        ``[count, 3]`` points, m, and ``[count]`` the face of each.
    """
    rng = np.random.default_rng(seed)
    area = np.linalg.norm(mesh.face_vectors, axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    a, b, c = np.moveaxis(mesh.corners[face], 1, 0)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), face


def visible_sample(mesh: Mesh, wall: np.ndarray, count: int, share: float = 0.1, seed: int = 0) -> np.ndarray:
    """Points of a mesh whose front enough of the wall can see.

    Args:
        mesh: the surface, which hides what is behind it.
        wall: ``[W, 3]`` wall points, m.
        count: points sampled before those unseen are left out.
        share: of the wall points that must see a point.
        seed: of the draw.

    Returns:
        ``[N, 3]`` points, m, N ≤ ``count``.
    """
    points, face = sample(mesh, count, seed)
    normals = mesh.face_vectors[face]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    occluder = Occluder(mesh)
    clear = points + 1e-4 * normals
    seen = np.zeros(len(points))
    for place in wall:
        front = ((place - points) * normals).sum(axis=1) > 0
        seen[front] += ~occluder.blocked(clear[front], np.broadcast_to(place, (int(front.sum()), 3)))
    return points[seen >= share * len(wall)]


def distance_to(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Distance of points to the nearest point of a mesh's faces.

    Args:
        mesh: the surface.
        points: ``[N, 3]``, m.

    Returns:
        ``[N]``, m.
    """
    import open3d as o3d

    tensor = o3d.core.Tensor.from_numpy
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    return scene.compute_distance(tensor(points.astype(np.float32))).numpy().astype(np.float64)


def surface_distances(
    surface: Mesh | None, truth: Mesh, visible: np.ndarray, count: int = 20_000, seed: int = 0
) -> Distances:
    """Compare a reconstruction with the truth, both ways.

    Args:
        surface: the reconstruction; None where there is none, which leaves both lists of distances empty.
        truth: all of the true surface, which distances of the reconstruction are taken to.
        visible: ``[M, 3]`` points of the truth that can be seen, from which distances to the reconstruction
            are taken.
        count: points sampled on the reconstruction.
        seed: of the draw.

    Returns:
        the sampled points and their distances.
    """
    if surface is None:
        nothing = np.zeros((0, 3))
        return Distances(nothing, np.zeros(0), visible[:0], np.zeros(0))
    points, _ = sample(surface, count, seed)
    return Distances(points, distance_to(truth, points), visible, distance_to(surface, visible))
