"""How the paper's figures are drawn, in the style of `nlos_lit.report.style`.

Functions take results and return figures; they compute nothing beyond scaling.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlos_lit.report.style import (
    BLACK,
    BLUE,
    DEPTH,
    GREEN,
    INTENSITY,
    NOTHING,
    ORANGE,
    PINK,
    RED,
    SKY,
    SYMBOLS,
    lattice_image,
    styled,
)

COLOURS = {
    "ours, refined": RED,
    "ours, phasor surface": ORANGE,
    "ours, volume's front": "#F0E442",
    "published system": BLACK,
    "lct": BLUE,
    "dlct": SKY,
    "fk": GREEN,
    "rsd": PINK,
    "bp": "#999999",
    "fbp": "#555555",
}


@dataclass(frozen=True)
class Panel:
    """One axes of :func:`lines`: label → (x, y)."""

    title: str
    xlabel: str
    ylabel: str
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    logx: bool = False
    logy: bool = False
    level: Mapping[str, float] = field(default_factory=dict)  # horizontal lines, label → y


@styled
def lines(panels: Sequence[Panel], columns: int = 3) -> Figure:
    """Lines with markers, one colour a system through all panels, one legend.

    Args:
        panels: at least one, drawn row by row.
        columns: panels a row, at most.

    Returns:
        the figure.
    """
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.8 * columns, 0.5 + 2.9 * rows))
    drawn = figure.subplots(rows, columns, squeeze=False).ravel()
    handles = {}
    for axes, panel in zip(drawn, panels, strict=False):
        for label, (x, y) in panel.series.items():
            width = 2.0 if label.startswith("ours") else 1.2
            (handles[label],) = axes.plot(
                x, y, marker="o", markersize=3.5, linewidth=width, color=COLOURS.get(label), label=label
            )
        for label, value in panel.level.items():
            handles[label] = axes.axhline(value, color=BLACK, linestyle=":", linewidth=0.9, label=label)
        axes.set(title=panel.title, xlabel=panel.xlabel, ylabel=panel.ylabel)
        if panel.logx:
            measured = sorted({value for x, _ in panel.series.values() for value in x})
            axes.set_xscale("log")
            axes.set_xticks(measured, labels=[f"{value:g}" for value in measured])
            axes.tick_params(axis="x", which="minor", bottom=False)
        if panel.logy:
            axes.set_yscale("log")
    for axes in drawn[len(panels) :]:
        axes.set_axis_off()
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(5, len(handles)))
    return figure


@styled
def dots(
    rows: Sequence[str], groups: Mapping[str, Sequence[Sequence[float]]], xlabel: str, title: str
) -> Figure:
    """Values of each row on a logarithmic axis, one mark a value, groups side by side.

    Args:
        rows: R labels, from the top.
        groups: label of a group (at most four) → R lists of positive values.
        xlabel: quantity and unit.
        title: of the figure.

    Returns:
        the figure.
    """
    figure = Figure(figsize=(7, 0.9 + 0.38 * len(rows)))
    axes = figure.subplots()
    shift = 0.24 / max(1, len(groups) - 1)
    for index, (label, values) in enumerate(groups.items()):
        colour = (RED, BLACK, BLUE, GREEN)[index]
        for place, row in enumerate(values):
            height = np.full(len(row), place + shift * index - 0.12)
            axes.scatter(
                row,
                height,
                color=colour,
                s=26,
                marker="od^s"[index],
                label=label if place == 0 else None,
                zorder=3,
            )
    axes.set(xlabel=xlabel, title=title, xscale="log", yticks=range(len(rows)), yticklabels=rows)
    axes.invert_yaxis()
    axes.grid(axis="x", which="both", color="#e5e5e5")
    axes.set_axisbelow(True)
    figure.legend(loc="outside lower center", ncols=len(groups))
    return figure


@dataclass(frozen=True)
class Image:
    """A front view ``[nx, ny]``, NaN for nothing; ``limits`` None scales it to its own 99.5th percentile."""

    values: np.ndarray
    kind: str = "intensity"  # intensity, depth, albedo or rgb
    limits: tuple[float, float] | None = None
    note: str = ""


def limits_of(values: np.ndarray, low: float = 0.01, high: float = 0.99) -> tuple[float, float]:
    """Ends of a colour scale that leave the extremes out.

    Args:
        values: any shape; NaN counts for nothing.
        low: share of the values below the lower end.
        high: share of the values below the upper end.

    Returns:
        ``(lower, upper)``.

    Examples:
        >>> limits_of(np.array([0.0, 1.0, 2.0, np.nan]), 0.25, 0.75)
        (0.5, 1.5)
    """
    ends = np.nanquantile(values, (low, high))
    return float(ends[0]), float(ends[1])


@styled
def images(
    grid: Sequence[Sequence[Image | None]],
    rows: Sequence[str],
    columns: Sequence[str],
    extent: Sequence[tuple[float, float, float, float]],
    side: float = 1.75,
) -> Figure:
    """Front views from the wall (+x to the left) in rows and columns.

    Args:
        grid: R rows of C images; None for one that cannot be.
        rows: R labels.
        columns: C labels.
        extent: ``(x0, x1, y0, y1)`` of each row's images, m.
        side: width of an image, inches.

    Returns:
        the figure; a row of depths has one colour bar.
    """
    figure = Figure(figsize=(1.2 + (side + 0.1) * len(columns), 0.4 + side * len(rows)))
    panels = figure.subplots(len(rows), len(columns), squeeze=False)
    for i, row in enumerate(grid):
        shown = {}
        for j, image in enumerate(row):
            axes = panels[i, j]
            axes.set(xticks=[], yticks=[], facecolor=NOTHING)
            if i == 0:
                axes.set_title(columns[j], fontsize="small")
            if j == 0:
                axes.set_ylabel(rows[i], fontsize="small")
            if image is None:
                axes.text(0.5, 0.5, "–", transform=axes.transAxes, ha="center", va="center")
                axes.set_box_aspect((extent[i][3] - extent[i][2]) / (extent[i][1] - extent[i][0]))
                continue
            drawn = lattice_image(axes, image.values, extent[i][:2], extent[i][2:], **_scale(image))
            axes.invert_xaxis()
            shown[image.kind] = drawn
            if image.note:
                box = {"facecolor": "black", "alpha": 0.55, "pad": 1.2, "linewidth": 0}
                text = {"transform": axes.transAxes, "fontsize": "x-small", "color": "white", "va": "bottom"}
                axes.text(0.03, 0.03, image.note, bbox=box, **text)
        if "depth" in shown:
            figure.colorbar(shown["depth"], ax=panels[i, -1], label="z (m)", shrink=0.85)
    return figure


def _scale(image: Image) -> dict[str, Any]:
    known = image.values[np.isfinite(image.values)]
    if image.kind == "rgb":
        return {}
    if image.limits is not None:
        low, high = image.limits
    elif image.kind == "depth":
        low, high = np.quantile(known, (0.01, 0.99)) if len(known) else (0, 1)
    else:
        low, high = 0.0, max(float(np.quantile(known, 0.995)) if len(known) else 0.0, 1e-12)
    return {
        "cmap": {"intensity": INTENSITY, "depth": DEPTH, "albedo": "cividis"}[image.kind],
        "vmin": low,
        "vmax": high,
    }


@styled
def convergence(
    track: Mapping[str, Sequence[float]],
    units: Mapping[str, str],
    truth: Mapping[str, float],
    kernels: Mapping[str, tuple[float, float]],
    transients: Mapping[str, tuple[np.ndarray, np.ndarray]],
    title: str,
) -> Figure:
    """Imaging parameters over the iterations, the virtual illumination before and after, one transient.

    Args:
        track: name → value after each iteration, for six parameters.
        units: name → unit.
        truth: name → true value, where it is known.
        kernels: label → (Ω_pf in rad/m, σ_pf in m), first and final.
        transients: label that begins with measured, first or final → (path ``[T]`` in m, counts a bin
            ``[T]``).
        title: of the figure.

    Returns:
        the figure.
    """
    figure = Figure(figsize=(13.5, 5.6))
    panels = figure.subplots(2, 4)
    places = [panels[i, j] for j in range(3) for i in range(2)]
    for axes, (name, values) in zip(places, track.items(), strict=True):
        axes.plot(np.arange(1, len(values) + 1), values, color=BLUE)
        if name in truth:
            axes.axhline(truth[name], color=BLACK, linestyle=":", linewidth=1, label="truth")
            axes.legend()
        axes.set(title=SYMBOLS.get(name, name), ylabel=units[name], xlabel="iteration")
        axes.margins(y=0.15)
    _kernels(panels[0, 3], kernels)
    panels[0, 3].legend(loc="upper right")
    styles = {"measured": (BLACK, 0.8), "first": (SKY, 1.2), "final": (RED, 1.4)}
    for label, (path, counts) in transients.items():
        colour, width = styles[label.split()[0]]
        panels[1, 3].plot(path, counts, label=label, color=colour, linewidth=width)
    panels[1, 3].set(title="one held-out transient", xlabel="path length (m)", ylabel="counts a bin")
    panels[1, 3].legend()
    figure.suptitle(title)
    return figure


def _kernels(axes: Axes, kernels: Mapping[str, tuple[float, float]]) -> None:
    reach = 3 * max(sigma for _, sigma in kernels.values())
    t = np.linspace(-reach, reach, 801)
    for (label, (omega, sigma)), colour in zip(kernels.items(), (SKY, RED), strict=False):
        axes.plot(100 * t, np.exp(-(t**2) / (2 * sigma**2)) * np.cos(omega * t), label=label, color=colour)
    axes.set(title="virtual illumination, real part", xlabel="path length (cm)", ylabel="P(t)")


@styled
def progress(
    labels: Sequence[str],
    volumes: Sequence[Image],
    depths: Sequence[Image],
    kernels: Sequence[tuple[float, float]],
    transients: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    extent: tuple[float, float, float, float],
) -> Figure:
    """Volume, surface, kernel and a transient in rows, states of a training in columns.

    Args:
        labels: C states.
        volumes: C front views of the volume.
        depths: C depth maps.
        kernels: C of (Ω_pf in rad/m, σ_pf in m).
        transients: C of (path in m, measured, rendered counts a bin), ``[T]`` each.
        extent: ``(x0, x1, y0, y1)`` of the images, m.

    Returns:
        the figure.
    """
    figure = Figure(figsize=(0.5 + 2.6 * len(labels), 9.2))
    panels = figure.subplots(4, len(labels), squeeze=False)
    for j, label in enumerate(labels):
        for i, image in enumerate((volumes[j], depths[j])):
            drawn = lattice_image(panels[i, j], image.values, extent[:2], extent[2:], **_scale(image))
            panels[i, j].set(xticks=[], yticks=[], facecolor=NOTHING)
            panels[i, j].invert_xaxis()
            if i == 1 and j == len(labels) - 1:
                figure.colorbar(drawn, ax=panels[i, j], label="z (m)")
        panels[0, j].set_title(label)
        _kernels(panels[2, j], {"": kernels[j]})
        panels[2, j].set_title("")
        path, measured, rendered = transients[j]
        panels[3, j].plot(path, measured, color=BLACK, linewidth=0.8, label="measured")
        panels[3, j].plot(path, rendered, color=RED, label="rendered")
        panels[3, j].set(xlabel="path length (m)")
    for axes, name in zip(panels[:, 0], ("intensity", "depth", "P(t)", "counts a bin"), strict=True):
        axes.set_ylabel(name)
    panels[3, 0].legend()
    return figure


@styled
def clouds(
    grid: Sequence[Sequence[tuple[np.ndarray, np.ndarray] | None]],
    rows: Sequence[str],
    columns: Sequence[str],
    limit: float,
) -> Figure:
    """Points from the wall coloured by a distance, in rows and columns.

    Args:
        grid: R rows of C clouds, each points ``[N, 3]`` and distance ``[N]``, m; None for one that cannot be.
        rows: R labels.
        columns: C labels.
        limit: distance of the darkest colour, m.

    Returns:
        the figure.
    """
    figure = Figure(figsize=(1.1 + 1.75 * len(columns), 0.5 + 1.9 * len(rows)))
    panels = figure.subplots(len(rows), len(columns), squeeze=False, sharex="row", sharey="row")
    drawn = None
    for i, row in enumerate(grid):
        for j, cloud in enumerate(row):
            axes = panels[i, j]
            axes.set(xticks=[], yticks=[], aspect="equal", facecolor="#f4f4f4")
            if i == 0:
                axes.set_title(columns[j], fontsize="small")
            if j == 0:
                axes.set_ylabel(rows[i], fontsize="small")
            if cloud is None or not len(cloud[0]):
                axes.text(0.5, 0.5, "–", transform=axes.transAxes, ha="center", va="center")
                continue
            points, distance = cloud
            order = np.argsort(-points[:, 2])
            colours = {"c": 1e3 * distance[order], "cmap": "magma_r", "vmin": 0, "vmax": 1e3 * limit}
            x, y = points[order, :2].T
            drawn = axes.scatter(x, y, s=1.2, linewidths=0, rasterized=True, **colours)
        panels[i, 0].set_xlim(*panels[i, 0].get_xlim()[::-1])
    if drawn is not None:
        figure.colorbar(
            drawn, ax=panels, label="distance to the other surface (mm)", shrink=0.8, extend="max"
        )
    return figure
