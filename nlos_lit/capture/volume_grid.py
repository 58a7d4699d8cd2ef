"""Where the voxels of an imaged volume lie, and which light paths lead through them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import scan_geometry
from nlos_lit.capture.errors import CaptureError, UserError


@dataclass(frozen=True)
class VolumeGrid:
    """A regular grid of voxel centres, in the capture's frame.

    Volumes on it are tensors ``[nz, nx, ny]``: planes of equal depth, each ordered like the scan.

    Args:
        origin: ``(x, y, z)`` of the centre of voxel ``[0, 0, 0]``, m.
        pitch: ``(dx, dy, dz)`` spacing of voxel centres, m.
        shape: ``(nz, nx, ny)`` numbers of voxels.

    Examples:
        >>> grid = VolumeGrid(origin=(0.0, 0.0, 0.5), pitch=(0.1, 0.1, 0.25), shape=(3, 2, 2))
        >>> grid.z.tolist(), grid.n_voxels
        ([0.5, 0.75, 1.0], 12)
    """

    origin: tuple[float, float, float]
    pitch: tuple[float, float, float]
    shape: tuple[int, int, int]

    @property
    def x(self) -> np.ndarray:
        """``[nx]`` x of the voxel centres, m."""
        return self.origin[0] + self.pitch[0] * np.arange(self.shape[1])

    @property
    def y(self) -> np.ndarray:
        """``[ny]`` y of the voxel centres, m."""
        return self.origin[1] + self.pitch[1] * np.arange(self.shape[2])

    @property
    def z(self) -> np.ndarray:
        """``[nz]`` z of the voxel centres, m."""
        return self.origin[2] + self.pitch[2] * np.arange(self.shape[0])

    @property
    def n_voxels(self) -> int:
        """Number V of voxels."""
        nz, nx, ny = self.shape
        return nz * nx * ny


def volume_grid(
    capture: Capture,
    *,
    depth: tuple[float, float],
    depth_pitch: float | None = None,
    upsample: int = 1,
    lateral: tuple[int, int] | None = None,
) -> VolumeGrid:
    """The voxels to image through a capture's wall.

    Laterally they are the scan's lattice, made finer and extended on request; a scan that is no lattice gets
    √S × √S voxels over the rectangle of its wall points.

    Args:
        capture: what was measured; gives the lattice and the time window.
        depth: nearest and farthest voxel plane, m from the wall.
        depth_pitch: spacing of planes, m; None takes half a bin length, which is one bin of path there and
            back.
        upsample: voxels per lattice step.
        lateral: numbers of voxels along x and y, centred on the scan; None covers the scan.

    Returns:
        The grid; ``origin[2]`` is the wall's z plus the nearest depth.

    Raises:
        UserError: impossible numbers, or the spots lie on one line.
        CaptureError: the volume lies outside the time window.

    Examples:
        >>> import numpy as np
        >>> x, y = np.meshgrid([0.0, 0.1], [0.0, 0.1], indexing="ij")
        >>> wall = np.stack([x.ravel(), y.ravel(), np.zeros(4)], axis=1)
        >>> up = np.tile([0.0, 0.0, 1.0], (4, 1))
        >>> capture = Capture(np.ones((4, 100)), wall, wall, up, up, bin_length=0.02, scan_shape=(2, 2))
        >>> grid = volume_grid(capture, depth=(0.5, 0.7), depth_pitch=0.05, upsample=2)
        >>> grid.shape, grid.pitch
        ((5, 4, 4), (0.05, 0.05, 0.05))
    """
    near, far = (float(v) for v in depth)
    if not 0 < near < far:
        raise UserError(
            f"the volume's depth must satisfy 0 < nearest < farthest; found [{near:g}, {far:g}] m"
        )
    pitch_z = capture.bin_length / 2 if depth_pitch is None else float(depth_pitch)
    if pitch_z <= 0 or upsample < 1:
        raise UserError(f"the depth pitch ({pitch_z:g} m) and upsample ({upsample}) must be positive")
    nz = max(2, math.floor((far - near) / pitch_z + 1e-6) + 1)
    geometry = scan_geometry(capture)
    first: tuple[float, ...]
    steps: tuple[float, ...]
    if geometry is not None:
        lattice = geometry.lattice
        first, steps, counts = lattice.origin, lattice.pitch, lattice.shape
    else:
        low, high = (
            np.minimum(capture.sensor, capture.laser).min(0),
            np.maximum(capture.sensor, capture.laser).max(0),
        )
        side = max(2, round(math.sqrt(capture.n_spots)))
        steps = tuple(float((high[a] - low[a]) / (side - 1)) for a in (0, 1))
        first, counts = tuple(float(v) for v in low), (side, side)
        if min(steps) <= 0:
            raise UserError("the spots lie on one line; a volume needs spots spread over the wall in x and y")
    fine_x, fine_y = (s / upsample for s in steps)
    nx, ny = (int(n) for n in lateral) if lateral is not None else (n * upsample for n in counts)
    skip_x, skip_y = ((w - (n - 1) * upsample - 1) // 2 for w, n in zip((nx, ny), counts, strict=True))
    origin = (first[0] - skip_x * fine_x, first[1] - skip_y * fine_y, first[2] + near)
    grid = VolumeGrid(origin, (fine_x, fine_y, pitch_z), (nz, nx, ny))
    path_range(capture, grid)
    return grid


def path_range(capture: Capture, grid: VolumeGrid) -> tuple[float, float]:
    """Shortest and longest optical path from laser through any voxel centre to sensor.

    Args:
        capture: gives the wall points and the gate.
        grid: voxels; the bounds are those of the box that holds their centres.

    Returns:
        Lower and upper bound of the path lengths, m.

    Raises:
        CaptureError: no such path falls inside the capture's gate, so nothing of the volume was measured, or
            the volume holds points of the wall.
    """
    lower = np.array([min(axis[0], axis[-1]) for axis in (grid.x, grid.y, grid.z)])
    upper = np.array([max(axis[0], axis[-1]) for axis in (grid.x, grid.y, grid.z)])
    shortest, longest = 0.0, 0.0
    for points in (capture.laser, capture.sensor):
        below, above = lower - points, points - upper
        shortest = shortest + np.linalg.norm(np.maximum(np.maximum(below, above), 0), axis=1)
        longest = longest + np.linalg.norm(np.maximum(np.abs(below), np.abs(above)), axis=1)
    first, last = capture.path_gate
    shortest, longest = float(np.min(shortest)), float(np.max(longest))
    if shortest == 0:
        wall = np.concatenate([capture.laser[:, 2], capture.sensor[:, 2]])
        raise CaptureError(
            f"the volume (z = {grid.z.min():.3g} to {grid.z.max():.3g} m) holds points of the wall, which "
            f"lie at z = {wall.min():.3g} to {wall.max():.3g} m: begin deeper (scene.volume.depth), or turn "
            "the positions so that the wall lies near z = 0"
        )
    if shortest >= last or longest <= first:
        raise CaptureError(
            f"the volume (depth {grid.z.min():.3g} to {grid.z.max():.3g} m, light paths {shortest:.3g} to "
            f"{longest:.3g} m) lies outside the capture's time window (paths {first:.3g} to {last:.3g} m); "
            f"move the volume (scene.volume.depth, within about {max(first, 0) / 2:.3g} to {last / 2:.3g} m) "
            f"or the gate, or check the bin width ({capture.bin_width_ps:.3g} ps)"
        )
    return shortest, longest
