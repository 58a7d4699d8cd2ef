"""Several reconstructions side by side, each as one sees it from the wall."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.report.style import DEPTH, INTENSITY, NOTHING, cell_edges, colour_bar, lattice_image, styled

PANEL = 3.1  # inches


@dataclass(frozen=True)
class View:
    """A reconstruction to be shown.

    Args:
        title: of its panels.
        values: ``[nz, nx, ny]``, nonnegative, any unit.
        grid: where the voxels lie.
    """

    title: str
    values: np.ndarray
    grid: VolumeGrid


@styled
def front_views(
    views: Sequence[View], columns: int = 3, threshold: float | None = None, title: str = ""
) -> Figure:
    """The largest value along z of each, relative to its own maximum.

    Args:
        views: at least one.
        columns: panels in a row.
        threshold: share of the maximum from which on the depth of the largest value is drawn below; None
            draws no depths.
        title: of the figure.

    Returns:
        a figure, +y up and +x to the left.
    """
    columns = min(columns, len(views))
    rows = math.ceil(len(views) / columns)
    kinds = 1 if threshold is None else 2
    figure = Figure(figsize=(PANEL * columns + 0.6, PANEL * rows * kinds + 0.4))
    places = figure.subplots(rows * kinds, columns, squeeze=False)
    for axes in places.flat:
        axes.set_axis_off()
    for index, view in enumerate(views):
        row, column = divmod(index, columns)
        peak = max(float(view.values.max()), np.finfo(float).tiny)
        front = view.values.max(axis=0) / peak
        _draw(places[row * kinds, column], view, front, INTENSITY, (0.0, 1.0), view.title)
        if threshold is not None:
            deepest = np.where(front >= threshold, view.grid.z[view.values.argmax(axis=0)], np.nan)
            _draw(places[row * kinds + 1, column], view, deepest, DEPTH, None, "depth of the maximum (m)")
    figure.suptitle(title)
    return figure


def _draw(
    axes: Axes,
    view: View,
    values: np.ndarray,
    colours: str,
    ends: tuple[float, float] | None,
    title: str,
) -> None:
    axes.set_axis_on()
    axes.set_facecolor(NOTHING)
    x, y = (
        cell_edges(axis, pitch)
        for axis, pitch in zip((view.grid.x, view.grid.y), view.grid.pitch[:2], strict=True)
    )
    scale = {} if ends is None else {"vmin": ends[0], "vmax": ends[1]}
    drawn = lattice_image(axes, values, x, y, cmap=colours, **scale)
    if x[1] > x[0]:
        axes.invert_xaxis()
    axes.set_title(title)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    if ends is None and np.isfinite(values).any():
        colour_bar(drawn, "")
