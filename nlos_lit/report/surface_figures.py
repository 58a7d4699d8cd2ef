"""Figures of a surface of surfels: what one sees of it from the wall, and what it leaves unexplained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from nlos_lit.report.style import (
    DEPTH,
    INTENSITY,
    NOTHING,
    SIGNED,
    cell_edges,
    colour_bar,
    lattice_image,
    styled,
)


@dataclass(frozen=True)
class Front:
    """What one sees of a surface from the wall, on a lattice; NaN for nothing.

    Args:
        albedo: ``[nx, ny]``.
        depth: ``[nx, ny]`` z, m.
        normals: ``[nx, ny, 3]`` unit, towards the wall's side.
        x: ``[nx]`` centres of the lattice's cells, evenly spaced, m.
        y: ``[ny]`` the same along y.
    """

    albedo: np.ndarray
    depth: np.ndarray
    normals: np.ndarray
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class FrontImage:
    """The phasor image from the wall.

    Args:
        values: ``[nx, ny]`` its maximum along z.
        x: ``[nx]`` centres of the voxels, evenly spaced, m.
        y: ``[ny]`` the same along y.
    """

    values: np.ndarray
    x: np.ndarray
    y: np.ndarray


@styled
def overview(
    image: FrontImage, front: Front, places: np.ndarray, residuals: np.ndarray, title: str = ""
) -> Figure:
    """Phasor image, albedo, depth and normals of the surface, and residuals over the wall, side by side.

    Args:
        image: that the surface was seeded from.
        front: of the surface.
        places: ``[N, 2]`` scanned wall points, m.
        residuals: ``[N]`` counted less expected at each, in standard deviations.
        title: of the figure.

    Returns:
        a figure of five panels to one scale; colours of albedo, depth and residuals span 98 % of them.
    """
    figure = Figure(figsize=(16, 3.4))
    panels = figure.subplots(1, 5, sharex=True, sharey=True)
    ends = _ends(front.x, front.y)
    colour_bar(lattice_image(panels[0], image.values, *_ends(image.x, image.y), cmap=INTENSITY, vmin=0), "")
    albedo, seen = (values[np.isfinite(values)] for values in (front.albedo, front.depth))
    brightest = float(np.quantile(albedo, 0.98)) if len(albedo) else 1.0
    colour_bar(lattice_image(panels[1], front.albedo, *ends, cmap="cividis", vmin=0, vmax=brightest), "")
    scale: dict[str, Any] = {"norm": Normalize(*np.quantile(seen, (0.01, 0.99)))} if len(seen) else {}
    colour_bar(lattice_image(panels[2], front.depth, *ends, cmap=DEPTH, **scale), "")
    lattice_image(panels[3], _normal_colours(front.normals), *ends)
    _normal_legend(panels[3])
    _wall_cells(panels[4], places, residuals)
    names = ("Phasor image", "Albedo", "Depth z (m)", "Normals", "Residual (standard deviations)")
    low, high = (_limits(v) for v in ((image.x, front.x, places[:, 0]), (image.y, front.y, places[:, 1])))
    for axes, name in zip(panels, names, strict=True):
        axes.set(xlabel="x (m)", facecolor=NOTHING, title=name, aspect="equal")
        axes.tick_params(labelleft=axes is panels[0])
    panels[0].set(ylabel="y (m)", xlim=low[::-1], ylim=high)
    figure.suptitle(title)
    return figure


def _ends(x: np.ndarray, y: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    return cell_edges(x, x[1] - x[0]), cell_edges(y, y[1] - y[0])


def _limits(along: tuple[np.ndarray, ...]) -> tuple[float, float]:
    """Of all centres along an axis, with a margin of 3 %."""
    values = np.concatenate(along)
    margin = 0.03 * float(np.ptp(values))
    return float(values.min()) - margin, float(values.max()) + margin


def _normal_colours(normals: np.ndarray) -> np.ndarray:
    """As in a normal map of the wall's view: red to the right, green up, blue towards the viewer."""
    shown = np.clip(0.5 + 0.5 * normals * [-1, 1, -1], 0, 1)
    nothing = [int(NOTHING[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    return np.where(np.isfinite(normals), shown, nothing)


def _normal_legend(axes: Axes) -> None:
    """A ball beside the panel, in the colours of its own normals."""
    right, up = np.meshgrid(*2 * [np.linspace(-1, 1, 61)], indexing="ij")
    inside = right**2 + up**2 <= 1
    towards = np.sqrt(np.clip(1 - right**2 - up**2, 0, None))
    ball = axes.inset_axes((1.03, 0.38, 0.24, 0.24))
    colours = np.concatenate([0.5 + 0.5 * np.stack([right, up, towards], 2), inside[:, :, None]], axis=2)
    lattice_image(ball, colours, (-1, 1), (-1, 1))
    ball.set_axis_off()


def _wall_cells(axes: Axes, places: np.ndarray, residuals: np.ndarray) -> None:
    """A square for each wall point, as large as they are apart."""
    extent = np.ptp(places, axis=0)
    sides = np.sqrt(len(places)) - 1
    half = max(float(extent.max()) / max(sides, 1), 1e-3) / 2
    corners = places[:, None, :] + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    limit = max(3.0, float(np.quantile(np.abs(residuals), 0.98)))
    drawn = PolyCollection(
        list(corners), array=residuals, cmap=SIGNED, norm=Normalize(-limit, limit), edgecolors="none"
    )
    axes.add_collection(drawn)
    colour_bar(drawn, "")
