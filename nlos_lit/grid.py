"""Where a volume's voxels lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class VolumeGrid:
    """A regular grid of voxel centres; volumes on it are tensors ``[nz, nx, ny]``, slice by slice like the scan.

    Args:
        origin: ``(x, y, z)`` of the centre of voxel ``[0, 0, 0]``, m.
        pitch: ``(dx, dy, dz)`` spacing of voxel centres, m.
        shape: ``(nz, nx, ny)`` numbers of voxels.
    """

    origin: tuple[float, float, float]
    pitch: tuple[float, float, float]
    shape: tuple[int, int, int]

    @property
    def x(self) -> np.ndarray:
        return self.origin[0] + self.pitch[0] * np.arange(self.shape[1])

    @property
    def y(self) -> np.ndarray:
        return self.origin[1] + self.pitch[1] * np.arange(self.shape[2])

    @property
    def z(self) -> np.ndarray:
        return self.origin[2] + self.pitch[2] * np.arange(self.shape[0])

    @property
    def n_voxels(self) -> int:
        nz, nx, ny = self.shape
        return nz * nx * ny
