"""From a volume to surface points: the largest value of every column, its depth between planes, a normal."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.points import Points

# Change of depth from one column to the next, in columns, above which they are not one surface.
STEEPEST = 4.0


def front_points(
    volume: np.ndarray,
    grid: VolumeGrid,
    threshold: float,
    field: np.ndarray | None = None,
    smooth: float = 1.0,
) -> Points:
    """One point a column whose maximum reaches ``threshold`` of the volume's.

    Args:
        volume: ``[nz, nx, ny]``, nonnegative.
        grid: where its voxels lie.
        threshold: share of the volume's maximum.
        field: ``[3, nz, nx, ny]`` vectors along the surface's normal, where the method gives them; None takes
            normals from the depths of neighbouring columns …
        smooth: … after a Gaussian of this many columns.

    Returns:
        Points with the volume's value, relative to its maximum, as albedo and intensity; none where the
        volume is empty. The depth is the vertex of the parabola through the largest value and its two
        neighbours.

    Examples:
        >>> import numpy as np
        >>> volume = np.zeros((5, 1, 2))
        >>> volume[1:4, 0, 0] = [1.0, 2.0, 1.0]
        >>> grid = VolumeGrid((0.0, 0.0, 0.5), (0.1, 0.1, 0.1), (5, 1, 2))
        >>> points = front_points(volume, grid, threshold=0.5)
        >>> points.positions.round(6).tolist(), points.normals.tolist()
        ([[0.0, 0.0, 0.7]], [[0.0, 0.0, -1.0]])
    """
    peak = float(volume.max())
    if not peak > 0:
        return Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    best = volume.argmax(axis=0)
    value = np.take_along_axis(volume, best[None], 0)[0]
    depth = grid.z[0] + grid.pitch[2] * (best + _vertex(volume, best))
    seen = value >= threshold * peak
    if field is None:
        normals = _normals_of_depth(depth, seen, grid.pitch, smooth)
    else:
        normals = np.take_along_axis(field, np.broadcast_to(best, (3, 1, *best.shape)), 1)[:, 0]
    normals = np.moveaxis(normals, 0, -1)[seen].astype(np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 0.0, -1.0])
    x, y = np.meshgrid(grid.x, grid.y, indexing="ij")
    level = value[seen] / peak
    return Points(np.stack([x[seen], y[seen], depth[seen]], axis=1), normals, level, level)


def _vertex(volume: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Where in ±½ planes the parabola through a maximum and its neighbours is largest; 0 at the ends."""
    last = len(volume) - 1
    if last < 2:
        return np.zeros(best.shape)
    inner = np.clip(best, 1, last - 1)
    low, middle, high = (
        np.take_along_axis(volume, (inner + step)[None], 0)[0].astype(np.float64) for step in (-1, 0, 1)
    )
    curvature = low - 2 * middle + high
    curved = (curvature < 0) & (inner == best)
    return np.where(curved, np.clip((low - high) / (2 * np.where(curved, curvature, 1)), -0.5, 0.5), 0.0)


def _normals_of_depth(
    depth: np.ndarray, seen: np.ndarray, pitch: tuple[float, float, float], smooth: float
) -> np.ndarray:
    """``[3, nx, ny]`` (∂z/∂x, ∂z/∂y, -1) of the smoothed depths of seen columns.

    It points straight to the wall where a column stands alone.
    """
    weight = gaussian_filter(seen.astype(np.float64), smooth) if smooth else seen.astype(np.float64)
    blurred = gaussian_filter(np.where(seen, depth, 0), smooth) if smooth else np.where(seen, depth, 0)
    surface = np.where(seen, blurred / np.maximum(weight, 1e-12), np.nan)
    slopes = [_slope(surface, axis, abs(pitch[axis])) * np.sign(pitch[axis]) for axis in (0, 1)]
    return np.stack([*slopes, np.full(depth.shape, -1.0)])


def _slope(surface: np.ndarray, axis: int, pitch: float) -> np.ndarray:
    """Mean slope to the neighbours on either side that belong to the same surface; 0 where there is none."""
    step = np.diff(surface, axis=axis) / pitch
    step = np.where(np.abs(step) < STEEPEST, step, np.nan)
    edge = np.full_like(np.take(surface, [0], axis), np.nan)
    before, after = np.concatenate([edge, step], axis), np.concatenate([step, edge], axis)
    count = np.isfinite(before).astype(int) + np.isfinite(after)
    return np.where(count > 0, (np.nan_to_num(before) + np.nan_to_num(after)) / np.maximum(count, 1), 0.0)
