"""Where the laser and the sensor point: a plan for a scan of a planar wall at z = 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlos_lit.capture.errors import UserError

KINDS = ("confocal", "single", "exhaustive")


def wall_grid(nx: int, ny: int, width: float, height: float) -> np.ndarray:
    """Centres of the cells of a wall around the origin, in the plane z = 0.

    Args:
        nx: cells along x.
        ny: cells along y.
        width: extent of the wall along x, m.
        height: extent along y, m.

    Returns:
        ``[nx, ny, 3]`` points, m.

    Examples:
        >>> wall_grid(2, 1, 1.0, 1.0).tolist()
        [[[-0.25, 0.0, 0.0]], [[0.25, 0.0, 0.0]]]
    """
    x = width * ((np.arange(nx) + 0.5) / nx - 0.5)
    y = height * ((np.arange(ny) + 0.5) / ny - 0.5)
    return np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((nx, ny))], axis=2)


@dataclass(frozen=True)
class ScanPlan:
    """How a planar wall is scanned and how time is binned.

    Args:
        kind: ``confocal``; ``single`` (one point fixed, the other scans the grid); ``exhaustive`` (every pair
            of grid points).
        nx, ny: grid points along x and y.
        width: extent of the scanned wall along x, m.
        height: along y; None means ``width``.
        bin_length: optical path of one bin, m (0.0096 m is 32 ps).
        n_bins: number of bins.
        t_start: path length at the start of bin 0, m.
        fixed: what stands still in a single scan, ``laser`` or ``sensor``.
        fixed_point: (x, y) of it, m.
        gate: bins that may be fitted, half-open; None means all, or those after the direct pulse where there
            is one.
        wall_albedo: reflectance of the wall.

    Raises:
        UserError: an unknown kind of scan, or a number that is not positive.

    Examples:
        >>> plan = ScanPlan("single", nx=2, ny=1, fixed_point=(0.1, 0.2))
        >>> plan.scan_shape, plan.extent_y
        ((2, 1), 1.0)
        >>> laser, sensor = plan.points()
        >>> laser.tolist()
        [[0.1, 0.2, 0.0], [0.1, 0.2, 0.0]]
        >>> sensor.tolist()
        [[-0.25, 0.0, 0.0], [0.25, 0.0, 0.0]]
    """

    kind: str = "confocal"
    nx: int = 32
    ny: int = 32
    width: float = 1.0
    height: float | None = None
    bin_length: float = 0.0096
    n_bins: int = 256
    t_start: float = 0.0
    fixed: str = "laser"
    fixed_point: tuple[float, float] = (0.0, 0.0)
    gate: tuple[int, int] | None = None
    wall_albedo: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UserError(f"a scan is one of {', '.join(KINDS)}; found kind={self.kind!r}")
        if self.fixed not in ("laser", "sensor"):
            raise UserError(f"fixed is laser or sensor; found {self.fixed!r}")
        if min(self.nx, self.ny, self.n_bins) < 1 or not min(self.width, self.extent_y, self.bin_length) > 0:
            raise UserError(f"nx, ny, n_bins, width, height and bin_length must be positive; found {self}")

    @property
    def extent_y(self) -> float:
        """Extent of the scanned wall along y, m."""
        return self.width if self.height is None else self.height

    @property
    def scan_shape(self) -> tuple[int, ...]:
        """``(nx, ny)``, or ``(nx, ny, nx, ny)`` for an exhaustive scan."""
        return (self.nx, self.ny) * (2 if self.kind == "exhaustive" else 1)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Laser and sensor points ``[S, 3]`` each, in the order of `scan_shape`."""
        grid = wall_grid(self.nx, self.ny, self.width, self.extent_y).reshape(-1, 3)
        if self.kind == "exhaustive":
            return np.repeat(grid, len(grid), axis=0), np.tile(grid, (len(grid), 1))
        if self.kind == "confocal":
            return grid, grid
        fixed = np.broadcast_to([*self.fixed_point, 0.0], grid.shape)
        return (fixed, grid) if self.fixed == "laser" else (grid, fixed)
