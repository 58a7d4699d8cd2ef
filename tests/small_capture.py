"""A valid confocal capture of 4 × 3 spots and 10 bins, to change and to break."""

from __future__ import annotations

import numpy as np

NORMAL = np.array([0.0, 0.0, 1.0])


def grid_points(nx=4, ny=3, pitch=(0.1, 0.2), first=(-0.2, 0.1, 0.0)) -> np.ndarray:
    x, y = np.meshgrid(
        first[0] + pitch[0] * np.arange(nx), first[1] + pitch[1] * np.arange(ny), indexing="ij"
    )
    return np.stack([x, y, np.full_like(x, first[2])], axis=-1).reshape(-1, 3)


def fields(**changes) -> dict:
    """A valid confocal 4 × 3 capture of 10 bins."""
    points = grid_points()
    counts = np.arange(120, dtype=np.uint16).reshape(12, 10)
    given = {
        "counts": counts, "laser": points, "sensor": points, "laser_normal": np.tile(NORMAL, (12, 1)),
        "sensor_normal": np.tile(NORMAL * 2, (12, 1)), "bin_length": 0.1, "t_start": 0.5,
        "scan_shape": (4, 3),
    }  # fmt: skip
    return given | changes
