"""Triangle meshes of the hidden scene: loading, joining, and splitting into small patches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlos_lit.capture.errors import UserError


@dataclass(frozen=True)
class Mesh:
    """A diffuse surface.

    Args:
        vertices: ``[V, 3]`` positions, m, in the capture's frame (wall near z = 0, scene at z > 0).
        faces: ``[F, 3]`` vertex indices; the outward normal follows the right-hand rule.
        albedo: ``[V]`` diffuse reflectance in [0, 1], linear across each face. A scalar is spread over all
            vertices. Sharp steps need their own vertices on each side: see `from_face_albedo`.

    Raises:
        UserError: shapes disagree, coordinates are not finite, a face names a vertex that is not there,
            albedo outside [0, 1].

    Examples:
        >>> corners = np.array([[0, 0, 1], [0, 1, 1], [1, 1, 1], [1, 0, 1]])
        >>> square = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.asarray(0.5))
        >>> square.area, square.albedo.tolist()
        (1.0, [0.5, 0.5, 0.5, 0.5])
        >>> square.face_vectors.tolist()  # towards the wall
        [[0.0, 0.0, -0.5], [0.0, 0.0, -0.5]]
    """

    vertices: np.ndarray
    faces: np.ndarray
    albedo: np.ndarray

    def __post_init__(self) -> None:
        vertices = np.asarray(self.vertices, dtype=np.float64)
        faces = np.asarray(self.faces, dtype=np.int64)
        if any(a.ndim != 2 or a.shape[1] != 3 or len(a) == 0 for a in (vertices, faces)):
            raise UserError(
                f"a mesh needs vertices [V, 3] and faces [F, 3]; found {vertices.shape} and {faces.shape}"
            )
        if not np.isfinite(vertices).all():
            raise UserError("the mesh has vertices that are NaN or infinite")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise UserError(
                f"the mesh's faces name vertices {faces.min()} … {faces.max()} but there are {len(vertices)}"
            )
        albedo = np.broadcast_to(np.asarray(self.albedo, dtype=np.float64), (len(vertices),))
        if not ((albedo >= 0) & (albedo <= 1)).all():
            raise UserError(f"albedo must lie in [0, 1]; found {albedo.min():g} … {albedo.max():g}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        object.__setattr__(self, "albedo", albedo.copy())

    @classmethod
    def from_face_albedo(cls, vertices: np.ndarray, faces: np.ndarray, face_albedo: np.ndarray) -> Mesh:
        """A mesh of constant albedo on each face; no two faces share a vertex afterwards.

        Args:
            vertices: ``[V, 3]`` positions, m.
            faces: ``[F, 3]`` vertex indices.
            face_albedo: ``[F]`` reflectance in [0, 1].

        Returns:
            a mesh of 3F vertices.
        """
        corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)].reshape(-1, 3)
        return cls(corners, np.arange(len(corners)).reshape(-1, 3), np.repeat(face_albedo, 3))

    @property
    def corners(self) -> np.ndarray:
        """``[F, 3, 3]`` the three corners of each face, m."""
        return self.vertices[self.faces]

    @property
    def face_vectors(self) -> np.ndarray:
        """``[F, 3]`` area times outward unit normal, m²."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a) / 2

    @property
    def area(self) -> float:
        """Total area, m²."""
        return float(np.linalg.norm(self.face_vectors, axis=1).sum())

    @property
    def volume(self) -> float:
        """Volume inside a closed mesh, m³, by the divergence theorem; negative where normals point inside."""
        return float((self.corners.mean(axis=1) * self.face_vectors).sum() / 3)

    def moved(self, offset: tuple[float, float, float]) -> Mesh:
        """The same mesh shifted by ``offset``, m."""
        return Mesh(self.vertices + np.asarray(offset), self.faces, self.albedo)

    def flipped(self) -> Mesh:
        """The same mesh facing the other way."""
        return Mesh(self.vertices, self.faces[:, ::-1], self.albedo)


def join(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces),
        np.concatenate([mesh.albedo for mesh in meshes]),
    )


def load_mesh(path: str | Path, albedo: float = 1.0) -> Mesh:
    """Read an OBJ, PLY, STL, OFF or glTF mesh in metres, in the capture's frame.

    Vertex colours, where the file has them, become the albedo (mean of red, green and blue).

    Args:
        path: of the file.
        albedo: of a file without vertex colours.

    Returns:
        the mesh.

    Raises:
        UserError: the file is missing or holds no triangles.
    """
    import open3d as o3d

    path = Path(path)
    if not path.is_file():
        raise UserError(f"there is no mesh file {path}; give an OBJ or PLY file")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        read = o3d.io.read_triangle_mesh(path)
    if not read.has_triangles():
        raise UserError(
            f"{path} holds no triangles that can be read; give an OBJ or PLY file of a triangle mesh"
        )
    coloured = read.has_vertex_colors()
    values = np.asarray(read.vertex_colors).mean(axis=1) if coloured else np.asarray(albedo)
    return Mesh(np.asarray(read.vertices), np.asarray(read.triangles), values)


def subdivide(mesh: Mesh, longest_edge: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    """Halve faces at their longest edge until none is longer than allowed.

    Area and shape stay exactly the same.

    Args:
        mesh: any mesh; faces without area are dropped.
        longest_edge: allowed edge length ``[F]`` of faces whose centroids ``[F, 3]`` it is given, m.

    Returns:
        a mesh whose neighbouring faces may meet in the middle of an edge, which a sum over faces does not
        mind.
    """
    scale = np.ptp(mesh.vertices, axis=0).max()
    faces = mesh.faces[np.linalg.norm(mesh.face_vectors, axis=1) > 1e-14 * scale**2]
    vertices, albedo, done = mesh.vertices, mesh.albedo, []
    while len(faces):
        corners = vertices[faces]
        # Edge i joins corners i and i + 1.
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        longest = edges.argmax(axis=1)
        split = edges.max(axis=1) > longest_edge(corners.mean(axis=1))
        done.append(faces[~split])
        order = (longest[split, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[split], order, axis=1).T
        # Neighbours that split the same edge share the new vertex: vertices are what costs time later.
        key, shared = np.unique(np.minimum(a, b) * len(vertices) + np.maximum(a, b), return_inverse=True)
        ends = np.stack(np.divmod(key, len(vertices)))
        middle = len(vertices) + shared
        vertices = np.concatenate([vertices, vertices[ends].mean(axis=0)])
        albedo = np.concatenate([albedo, albedo[ends].mean(axis=0)])
        faces = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return Mesh(vertices, np.concatenate(done), albedo)
