"""Errors of reconstructed points against a known surface: depth, coverage, normals, ratio of two albedos."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.io.points import Points

# depth change per lattice cell, in cells, above which two cells are two surfaces and are not interpolated
STEEPEST = 4.0


@dataclass(frozen=True)
class GeometryErrors:
    """Lengths in metres, angles in degrees, shares in 0 … 1; NaN where nothing could be compared.

    ``compared`` of ``points`` have true surface at their (x, y); depth and normal errors are over those.
    ``depth_bias`` is the mean of estimate minus truth. ``coverage`` is the share of true cells with an
    estimated point near them, ``off_truth`` the share of estimated points with no true cell near them.
    """

    points: int
    compared: int
    depth_median_abs: float
    depth_p95_abs: float
    depth_bias: float
    coverage: float
    off_truth: float
    normal_median_deg: float
    normal_mean_deg: float
    normal_p95_deg: float
    albedo_ratio: float
    albedo_ratio_truth: float

    def to_dict(self) -> dict[str, float]:
        """The fields by name."""
        return dataclasses.asdict(self)


def geometry_errors(
    points: Points,
    truth: SurfaceTruth,
    depth_tolerance: float = 0.02,
    lateral_tolerance: float | None = None,
    regions: tuple[np.ndarray, np.ndarray] | None = None,
) -> GeometryErrors:
    """Compare points with the true surface seen along z.

    Args:
        points: the reconstruction.
        truth: the surface, in the same frame.
        depth_tolerance: a point and a cell are near each other within this depth, m …
        lateral_tolerance: … and within this distance in x and in y, m; None means one cell of the truth. Give
            the reconstruction's own point spacing where it is coarser, or coverage measures the spacing.
        regions: two boolean ``[nx, ny]`` masks A and B; the albedo ratio is mean(A) / mean(B), over the
            estimated points that are near the truth and whose nearest cell is in the region. Needs
            ``truth.albedo``. None gives NaN for both ratios.

    Returns:
        Errors, in metres, degrees and shares.

    Raises:
        ValueError: ``regions`` are given and the truth has no albedo.

    Examples:
        A plane at 1 m, met by two points 1 cm behind it; a third point lies beside it:

        >>> import numpy as np
        >>> axis = np.arange(3) * 0.1
        >>> towards = np.tile([0.0, 0.0, -1.0], (3, 1))
        >>> truth = SurfaceTruth(axis, axis, np.ones((3, 3)), normals=np.tile(towards, (3, 1, 1)))
        >>> places = np.array([[0.0, 0.0, 1.01], [0.1, 0.1, 1.01], [0.9, 0.0, 1.0]])
        >>> errors = geometry_errors(Points(places, towards, np.ones(3)), truth)
        >>> errors.points, errors.compared, round(errors.depth_bias, 4), errors.normal_median_deg
        (3, 2, 0.01, 0.0)
        >>> round(errors.off_truth, 4), round(errors.coverage, 4)  # every cell has a point next to it
        (0.3333, 1.0)
    """
    lateral = max(truth.cell) if lateral_tolerance is None else lateral_tolerance
    near_cells, near_points = _neighbours(points.positions, truth, lateral, depth_tolerance)
    depth, cells = depth_at(truth, points.positions[:, :2])
    seen = np.isfinite(depth)
    errors = points.positions[seen, 2] - depth[seen]
    angles = np.array([])
    if truth.normals is not None:
        cosines = (points.normals[seen] * _unit(truth.normals[tuple(cells[seen].T)])).sum(axis=1)
        angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    ratio, true_ratio = _albedo_ratios(
        points.albedo[seen & near_points], cells[seen & near_points], truth.albedo, regions
    )
    return GeometryErrors(
        points=len(points),
        compared=int(seen.sum()),
        depth_median_abs=_statistic(np.median, np.abs(errors)),
        depth_p95_abs=_statistic(_p95, np.abs(errors)),
        depth_bias=_statistic(np.mean, errors),
        coverage=float(near_cells.mean()),
        off_truth=_statistic(np.mean, ~near_points),
        normal_median_deg=_statistic(np.median, angles),
        normal_mean_deg=_statistic(np.mean, angles),
        normal_p95_deg=_statistic(_p95, angles),
        albedo_ratio=ratio,
        albedo_ratio_truth=true_ratio,
    )


def depth_at(truth: SurfaceTruth, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True depth at lateral places, and the nearest cells.

    Bilinear inside a smooth piece of surface; the nearest cell's depth at rims and across depth steps, where
    interpolation would invent a surface between two.

    Args:
        truth: the surface.
        xy: ``[N, 2]`` m.

    Returns:
        ``[N]`` depth, m, NaN beside the surface and the lattice; ``[N, 2]`` indices of the nearest cell,
        clipped to the lattice.

    Examples:
        >>> import numpy as np
        >>> axis = np.array([0.0, 0.1])
        >>> slope = SurfaceTruth(axis, axis, np.array([[1.0, 1.0], [1.2, 1.2]]))
        >>> depth, cells = depth_at(slope, np.array([[0.025, 0.0], [5.0, 0.0]]))
        >>> depth.round(6).tolist(), cells.tolist()
        ([1.05, nan], [[0, 0], [1, 0]])
    """
    shape = np.array(truth.depth.shape)
    place = (np.asarray(xy, dtype=np.float64) - [truth.x[0], truth.y[0]]) / truth.cell
    inside = ((place >= -0.5) & (place < shape - 0.5)).all(axis=1)
    cells = np.clip(np.floor(place + 0.5).astype(np.int64), 0, shape - 1)
    depth = truth.depth[tuple(cells.T)].astype(np.float64)
    low = np.clip(np.floor(place).astype(np.int64), 0, shape - 2)
    u, v = np.clip(place - low, 0, 1).T
    i, j = low.T
    corners = np.stack([truth.depth[i + di, j + dj] for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1))]).astype(
        np.float64
    )
    smooth = np.all(np.isfinite(corners), axis=0)
    smooth[smooth] = np.ptp(corners[:, smooth], axis=0) < STEEPEST * sum(truth.cell)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    depth[smooth] = (weights * corners)[:, smooth].sum(axis=0)
    return np.where(inside, depth, np.nan), cells


def depth_map(points: Points, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Median depth of the points in each cell of an evenly spaced lattice.

    Args:
        points: surface points.
        x: ``[nx]`` centres of cells, m.
        y: ``[ny]`` centres of cells, m.

    Returns:
        ``[nx, ny]`` m, NaN where there are no points.

    Examples:
        >>> import numpy as np
        >>> places = np.array([[0.0, 0.0, 1.0], [0.02, 0.0, 3.0], [0.1, 0.1, 2.0]])
        >>> points = Points(places, np.tile([0.0, 0.0, -1.0], (3, 1)), np.ones(3))
        >>> depth_map(points, np.array([0.0, 0.1]), np.array([0.0, 0.1])).tolist()
        [[2.0, nan], [nan, 2.0]]
    """
    centres = (np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    place = np.stack([(points.positions[:, k] - c[0]) / (c[1] - c[0]) for k, c in enumerate(centres)])
    i, j = np.floor(place + 0.5).astype(np.int64)
    inside = (i >= 0) & (i < len(x)) & (j >= 0) & (j < len(y))
    cell, z = (i * len(y) + j)[inside], points.positions[inside, 2]
    order = np.lexsort((z, cell))
    cell, z = cell[order], z[order]
    found, start, count = np.unique(cell, return_index=True, return_counts=True)
    depth = np.full(len(x) * len(y), np.nan)
    depth[found] = (z[start + (count - 1) // 2] + z[start + count // 2]) / 2
    return depth.reshape(len(x), len(y))


def _neighbours(
    positions: np.ndarray, truth: SurfaceTruth, lateral: float, depth: float
) -> tuple[np.ndarray, np.ndarray]:
    """Whether each true cell has a point near it, and each point a true cell.

    Near is inside the box ±lateral, ±lateral, ±depth around it.
    """
    i, j = np.nonzero(np.isfinite(truth.depth))
    scale = np.array([lateral, lateral, depth]) * (1 + 1e-9)
    cells = np.stack([truth.x[i], truth.y[j], truth.depth[i, j]], axis=1).astype(np.float64) / scale
    if not len(positions):
        return np.zeros(len(cells), dtype=bool), np.zeros(0, dtype=bool)
    estimates = positions / scale
    near_cells = cKDTree(estimates).query(cells, p=np.inf, distance_upper_bound=1)[0]
    near_points = cKDTree(cells).query(estimates, p=np.inf, distance_upper_bound=1)[0]
    return np.isfinite(near_cells), np.isfinite(near_points)


def _albedo_ratios(
    estimates: np.ndarray,
    cells: np.ndarray,
    truth: np.ndarray | None,
    regions: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[float, float]:
    if regions is None:
        return float("nan"), float("nan")
    if truth is None:
        raise ValueError("an albedo ratio needs the true albedo")
    estimated = [_statistic(np.mean, estimates[region[tuple(cells.T)]]) for region in regions]
    true = [_statistic(np.nanmean, truth[region]) for region in regions]
    ratio, true_ratio = (a / b if b != 0 else float("nan") for a, b in (estimated, true))
    return ratio, true_ratio


def _statistic(function: Callable[[np.ndarray], float], values: np.ndarray) -> float:
    return float(function(values)) if len(values) else float("nan")


def _p95(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.95))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
