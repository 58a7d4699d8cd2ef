"""A triangle mesh through the reconstructed points: Poisson surface reconstruction (Kazhdan and Hoppe 2013)
by Open3D.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from nlos_lit.io.files import whole_file
from nlos_lit.io.points import Points, grey_levels

if TYPE_CHECKING:
    import open3d

MIN_POINTS = 50


@dataclass(frozen=True)
class MeshReport:
    """What became of the mesh: sizes, or the sentence that says why there is none."""

    vertices: int = 0
    triangles: int = 0
    reason: str | None = None


def poisson_mesh(
    points: Points, depth: int = 8, trim: float = 1.5
) -> tuple[open3d.geometry.TriangleMesh | None, MeshReport]:
    """Poisson surface through oriented points, grey by albedo, without what the method invents where there
    are no points.

    Poisson surfaces are closed: behind an open surface they bulge away from the data. The lowest so many per
    cent of the sampling density do not single that out (the bulge held 6 to 26 % of the vertices in
    examples), the distance to the points does.

    Args:
        points: at least 50 distinct ones; normals decide inside and outside.
        depth: octree depth; the finest cell is 2^-depth of the points' extent.
        trim: vertices farther from every point than this many typical spacings (median distance to the 6th
            neighbour) go.

    Returns:
        The mesh and its report; None and the reason where there is nothing to mesh, which is no error.
    """
    distinct = len(np.unique(points.positions.astype(np.float32), axis=0))
    if distinct < MIN_POINTS:
        return None, MeshReport(
            reason=f"{distinct} distinct surface points are too few for a mesh, which needs {MIN_POINTS}"
        )
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.positions))
    cloud.normals = open3d.utility.Vector3dVector(points.normals)
    try:
        mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=depth, n_threads=1
        )
    except RuntimeError as error:
        return None, MeshReport(reason=f"Open3D's Poisson reconstruction failed: {error}")
    tree = cKDTree(points.positions)
    spacing = np.median(tree.query(points.positions, k=7)[0][:, 6])
    distance, nearest = tree.query(np.asarray(mesh.vertices))
    grey = grey_levels(points.albedo)[nearest]
    mesh.vertex_colors = open3d.utility.Vector3dVector(np.repeat(grey[:, None], 3, axis=1))
    mesh.remove_vertices_by_mask(distance > trim * spacing)
    mesh.remove_unreferenced_vertices()
    if not len(mesh.triangles):
        return None, MeshReport(
            reason="no part of the Poisson surface lies near the points; their normals do not agree"
        )
    mesh.compute_vertex_normals()
    return mesh, MeshReport(len(mesh.vertices), len(mesh.triangles))


def write_mesh(path: Path | str, points: Points, depth: int = 8, trim: float = 1.5) -> MeshReport:
    """Binary PLY of ``poisson_mesh``; where there is none nothing is written and the report says why."""
    mesh, report = poisson_mesh(points, depth, trim)
    if mesh is not None:
        import open3d

        with whole_file(path) as partial:
            if not open3d.io.write_triangle_mesh(str(partial), mesh):
                raise OSError(f"Open3D could not write {path}")
    return report
