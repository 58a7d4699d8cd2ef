"""The true hidden surface of a scene, where it is known: depth, normals and albedo over (x, y)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SurfaceTruth:
    """The first hidden surface along +z on a lattice of (x, y).

    Args:
        x: ``[nx]`` evenly spaced, increasing, m.
        y: ``[ny]``.
        depth: ``[nx, ny]`` z of the surface, m; NaN where there is none.
        normals: ``[nx, ny, 3]`` unit vectors towards the wall's side, where known; ignored where depth is
            NaN.
        albedo: ``[nx, ny]``, where known.

    Raises:
        ValueError: shapes disagree, an axis is not evenly increasing, or there is no surface.

    Examples:
        >>> import numpy as np
        >>> plane = SurfaceTruth(np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.1]), np.full((3, 2), 0.5))
        >>> plane.cell
        (0.1, 0.1)
    """

    x: np.ndarray
    y: np.ndarray
    depth: np.ndarray
    normals: np.ndarray | None = None
    albedo: np.ndarray | None = None

    def __post_init__(self) -> None:
        lattice = (len(self.x), len(self.y))
        for name, shape in {"depth": lattice, "normals": (*lattice, 3), "albedo": lattice}.items():
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise ValueError(f"{name} of the truth must be {list(shape)}; found shape {values.shape}")
        for name in ("x", "y"):
            steps = np.diff(getattr(self, name).astype(np.float64))
            if len(steps) == 0 or steps.min() <= 0 or np.ptp(steps) > 1e-3 * steps.mean():
                raise ValueError(
                    f"{name} of the truth must be evenly spaced and increasing, at least two values"
                )
        if not np.isfinite(self.depth).any():
            raise ValueError("the truth holds no surface: every depth is NaN")

    @property
    def cell(self) -> tuple[float, float]:
        """Spacing of the lattice in x and y, m."""
        dx, dy = (float(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (self.x, self.y))
        return dx, dy
