"""Which points of a mesh see which points of the wall, by Open3D's ray-casting scene."""

from __future__ import annotations

import numpy as np

from data_modules.simulate.mesh import Mesh


class Occluder:
    """A mesh that blocks rays.

    Args:
        mesh: what stands in the way, both sides of every face.
    """

    def __init__(self, mesh: Mesh) -> None:
        import open3d as o3d

        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(mesh.vertices.astype(np.float32)), self._tensor(mesh.faces.astype(np.uint32))
        )

    def blocked(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Whether something lies between two points; both should be clear of the surface.

        Args:
            start: ``[N, 3]`` points, m.
            end: ``[N, 3]`` points, m.

        Returns:
            ``[N]`` True where the way is blocked.
        """
        rays = np.empty((len(start), 6), dtype=np.float32)
        rays[:, :3] = start
        rays[:, 3:] = end - start
        return self._scene.test_occlusions(self._tensor(rays), tnear=0.0, tfar=1.0).numpy()

    def first_hit(
        self, start: np.ndarray, direction: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First surface met along a ray.

        Args:
            start: ``[N, 3]`` points, m.
            direction: ``[N, 3]`` vectors of any length.

        Returns:
            distance ``[N]`` in units of ``direction`` (infinite where nothing is met), face index ``[N]`` and
            barycentric weights ``[N, 3]`` of the face's corners (meaningless where nothing is met).
        """
        hit = self._scene.cast_rays(
            self._tensor(np.concatenate([start, direction], axis=1).astype(np.float32))
        )
        uv = hit["primitive_uvs"].numpy().astype(np.float64)
        weights = np.concatenate([1 - uv.sum(axis=1, keepdims=True), uv], axis=1)
        return hit["t_hit"].numpy(), hit["primitive_ids"].numpy().astype(np.int64), weights
