"""A triangle mesh through the reconstructed points: Poisson surface reconstruction by Open3D.

Kazhdan and Hoppe, *Screened Poisson surface reconstruction*, ACM Trans. Graph. 32(3), 29 (2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from nlos_lit.io.files import whole_file
from nlos_lit.io.gltf import write_glb
from nlos_lit.io.points import Points, grey_levels
from nlos_lit.io.views import Mesh

if TYPE_CHECKING:
    import open3d

MIN_POINTS = 50


@dataclass(frozen=True)
class MeshReport:
    """What became of the mesh.

    Args:
        vertices: how many there are.
        triangles: how many there are.
        reason: the sentence that says why there is no mesh; None where there is one.
    """

    vertices: int = 0
    triangles: int = 0
    reason: str | None = None


def poisson_mesh(
    points: Points, depth: int = 8, trim: float = 1.5
) -> tuple[open3d.geometry.TriangleMesh | None, MeshReport]:
    """Poisson surface through oriented points, without what the method invents where there are none.

    Vertices are grey by the albedo of the nearest point.

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
    """Write the mesh of :func:`poisson_mesh` as binary PLY, and beside it as binary glTF.

    Where there is none nothing is written.

    Args:
        path: PLY file, written whole or not at all; the glTF file has the suffix ``.glb``.
        points: as for :func:`poisson_mesh`.
        depth: as for :func:`poisson_mesh`.
        trim: as for :func:`poisson_mesh`.

    Returns:
        Sizes, or why there is no mesh.

    Raises:
        OSError: Open3D could not write the file.

    Examples:
        >>> import tempfile
        >>> few = Points(np.array([[0.0, 0.0, 0.5]]), np.array([[0.0, 0.0, -1.0]]), np.array([0.5]))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_mesh(f"{folder}/mesh.ply", few).reason
        '1 distinct surface points are too few for a mesh, which needs 50'
    """
    mesh, report = poisson_mesh(points, depth, trim)
    if mesh is not None:
        import open3d

        with whole_file(path) as partial:
            if not open3d.io.write_triangle_mesh(partial, mesh):
                raise OSError(f"Open3D could not write {path}")
        write_glb(Path(path).with_suffix(".glb"), _plain(mesh))
    return report


def read_mesh(path: Path | str, most: int) -> Mesh | None:
    """A mesh that :func:`write_mesh` wrote, with few triangles.

    Garland and Heckbert, *Surface simplification using quadric error metrics*, SIGGRAPH 1997, by Open3D.

    Args:
        path: PLY file.
        most: triangles that are kept.

    Returns:
        The mesh; None where there is no file.
    """
    if not Path(path).is_file():
        return None
    import open3d

    mesh = open3d.io.read_triangle_mesh(Path(path))
    return _plain(mesh.simplify_quadric_decimation(most) if len(mesh.triangles) > most else mesh)


def _plain(mesh: open3d.geometry.TriangleMesh) -> Mesh:
    grey = np.asarray(mesh.vertex_colors)[:, 0]
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), grey)
