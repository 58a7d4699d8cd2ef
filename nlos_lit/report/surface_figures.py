"""Figures of a surface of surfels while it is fitted: what one sees of it from the relay wall."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from nlos_lit.report.style import DEPTH, NOTHING, cell_edges, colour_bar, lattice_image, styled


@styled
def front_view(
    albedo: np.ndarray, depth: np.ndarray, x: np.ndarray, y: np.ndarray, title: str = ""
) -> Figure:
    """Albedo and depth of the front of a surface, side by side, as seen from the wall.

    Args:
        albedo: ``[nx, ny]``; NaN for nothing.
        depth: ``[nx, ny]`` z, m; NaN for nothing.
        x: ``[nx]`` centres of the lattice's cells, evenly spaced, m.
        y: ``[ny]`` the same along y.
        title: of the figure.

    Returns:
        a figure of two panels; the depth's colours span 98 % of the cells.
    """
    figure = Figure(figsize=(9, 4))
    left, right = figure.subplots(1, 2)
    ends = cell_edges(x, x[1] - x[0]), cell_edges(y, y[1] - y[0])
    seen = depth[np.isfinite(depth)]
    scale: dict[str, Any] = {"norm": Normalize(*np.quantile(seen, (0.01, 0.99)))} if len(seen) else {}
    colour_bar(lattice_image(left, albedo, *ends, cmap="cividis", vmin=0), "albedo")
    colour_bar(lattice_image(right, depth, *ends, cmap=DEPTH, **scale), "z (m)")
    for axes, name in ((left, "Albedo of the front"), (right, "Its depth")):
        axes.set(xlabel="x (m)", ylabel="y (m)", facecolor=NOTHING, title=name)
        axes.invert_xaxis()
    figure.suptitle(title)
    return figure
