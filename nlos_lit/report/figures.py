"""Figures of what a run finds: volume, surface, transients, imaging parameters, and how the training went.

Functions take results and return figures; beyond projections they compute nothing. Front views are drawn as
seen from the relay wall: +y up, +x to the left (the world is right-handed with z into the scene).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.points import Points
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
    SIGNED,
    SYMBOLS,
    cell_edges,
    colour_bar,
    lattice_image,
    styled,
    upper_time_axis,
)

MOST_DRAWN = 20_000  # points a scatter plot still shows as a surface and draws within a second or two


@styled
def volume_projections(
    values: np.ndarray, grid: VolumeGrid, threshold: float = 0.2, title: str = ""
) -> Figure:
    """Maximum of a volume from the front, from the side and from above, and the depth of the maximum.

    Args:
        values: ``[nz, nx, ny]``, nonnegative, any unit.
        grid: where the voxels lie.
        threshold: the depth map is empty where a column's maximum is below this share of the volume's.
        title: of the figure.

    Returns:
        a figure of four panels to one scale.
    """
    ends_x, ends_y, ends_z = (
        cell_edges(axis, pitch) for axis, pitch in zip((grid.x, grid.y, grid.z), grid.pitch, strict=True)
    )
    wide, high, deep = (np.ptp(ends) for ends in (ends_x, ends_y, ends_z))
    inches = 8 / (wide + max(deep, wide))  # one scale for all panels
    figure = Figure(figsize=(inches * (wide + max(deep, wide)) + 3, inches * (high + max(deep, high)) + 1.8))
    front, side, top, depth = figure.subplots(
        2, 2, width_ratios=(wide, max(deep, wide)), height_ratios=(high, max(deep, high))
    ).flat
    peak = float(values.max())
    scale: dict[str, Any] = {"cmap": INTENSITY, "vmin": 0, "vmax": peak if peak > 0 else 1}
    image = _front(front, values.max(axis=0), ends_x, ends_y, **scale)
    front.set_title("Front (from the wall), maximum along z")
    lattice_image(side, values.max(axis=1), ends_z, ends_y, **scale).axes.set(xlabel="z (m)", ylabel="y (m)")
    side.set_title("Side, maximum along x; wall to the left")
    lattice_image(top, values.max(axis=2).T, ends_x, ends_z, **scale).axes.set(xlabel="x (m)", ylabel="z (m)")
    top.invert_xaxis()
    top.set_title("Above, maximum along y; wall at the bottom")
    seen = values.max(axis=0) >= max(threshold * peak, np.finfo(float).tiny)
    deepest = np.where(seen, grid.z[values.argmax(axis=0)], np.nan)
    distances = _front(depth, deepest, ends_x, ends_y, cmap=DEPTH)
    if seen.any():
        colour_bar(distances, "z (m)")
    depth.set_title(f"Depth of the maximum, above {threshold:g} of the peak")
    colour_bar(image, "intensity")
    figure.suptitle(title)
    return figure


@styled
def albedo_projection(albedo: np.ndarray, mask: np.ndarray, grid: VolumeGrid) -> Figure:
    """Front view of an albedo volume: its maximum along z; grey where there is nothing.

    Args:
        albedo: ``[nz, nx, ny]``.
        mask: ``[nz, nx, ny]`` True in the voxels that count.
        grid: where the voxels lie.

    Returns:
        a figure of one panel.
    """
    figure = Figure(figsize=(5, 4.2))
    highest = np.where(mask, albedo, -np.inf).max(axis=0)
    ends = cell_edges(grid.x, grid.pitch[0]), cell_edges(grid.y, grid.pitch[1])
    axes = figure.subplots()
    shown = np.where(np.isfinite(highest), highest, np.nan)
    colour_bar(_front(axes, shown, *ends, cmap="cividis", vmin=0), "albedo")
    axes.set_title("Albedo from the wall, maximum along z")
    return figure


@styled
def depth_error_map(estimated: np.ndarray, truth: np.ndarray, x: np.ndarray, y: np.ndarray) -> Figure:
    """True depth, estimated depth and their difference, side by side.

    Args:
        estimated: ``[nx, ny]`` z of the reconstruction, m; NaN for nothing.
        truth: ``[nx, ny]`` z of the true surface, m; NaN for nothing.
        x: ``[nx]`` centres of the lattice's cells, evenly spaced, m.
        y: ``[ny]`` the same along y.

    Returns:
        a figure of three panels; the difference in mm, its colours ending where 95 % lie inside.
    """
    figure = Figure(figsize=(12, 3.8))
    axes = figure.subplots(1, 3)
    ends = cell_edges(x, x[1] - x[0]), cell_edges(y, y[1] - y[0])
    both = np.concatenate([truth[np.isfinite(truth)], estimated[np.isfinite(estimated)]])
    scale: dict[str, Any] = (
        {"cmap": DEPTH, "norm": Normalize(*np.quantile(both, (0.01, 0.99)))} if len(both) else {}
    )
    colour_bar(_front(axes[0], truth, *ends, **scale), "z (m)")
    colour_bar(_front(axes[1], estimated, *ends, **scale), "z (m)")
    error = 1e3 * (estimated - truth)
    known = np.abs(error[np.isfinite(error)])
    limit = max(float(np.quantile(known, 0.95)), 1e-6) if len(known) else 1.0
    colour_bar(_front(axes[2], error, *ends, cmap=SIGNED, vmin=-limit, vmax=limit), "error (mm), 95 % inside")
    for axis, title in zip(axes, ("True depth", "Estimated depth", "Estimate minus truth"), strict=True):
        axis.set_title(title)
    return figure


@styled
def surface_plot(points: Points) -> Figure:
    """Points from the wall, coloured by depth and by normal, and in three dimensions."""
    figure = Figure(figsize=(13, 4.2))
    if not len(points):
        figure.text(0.5, 0.5, "no surface found", ha="center", va="center", fontsize="x-large")
        return figure
    front, normal = figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2)
    solid = figure.add_subplot(1, 3, 3, projection="3d")
    drawn = np.linspace(0, len(points) - 1, min(len(points), MOST_DRAWN)).astype(np.int64)
    # Far ones first, so that near ones cover them.
    drawn = drawn[np.argsort(-points.positions[drawn, 2], kind="stable")]
    x, y, z = points.positions[drawn].T
    # Colours as in a normal map of the wall's view: red to the right, green up, blue towards the viewer.
    colours = 0.5 + 0.5 * points.normals[drawn] * [-1, 1, -1]
    dots: dict[str, Any] = {
        "s": float(np.clip(20_000 / len(drawn), 1, 30)),
        "linewidths": 0,
        "rasterized": True,
    }
    shades = front.scatter(x, y, c=z, cmap=DEPTH, **dots)
    colour_bar(shades, "z (m)")
    normal.scatter(x, y, c=np.clip(colours, 0, 1), **dots)
    for axis in (front, normal):
        axis.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", facecolor="#f7f7f7")
        axis.invert_xaxis()
    solid.scatter(x, z, y, c=z, cmap=DEPTH, **dots)
    solid.set(xlabel="x (m)", ylabel="z (m)", aspect="equal")
    solid.invert_xaxis()
    solid.view_init(elev=20, azim=-65)
    solid.locator_params(nbins=4)
    front.set_title(f"{len(points)} points from the wall, by depth")
    normal.set_title("Normals (red right, green up, blue to the wall)")
    solid.set_title("Wall in front, y (m) up")
    return figure


@styled
def kernel_plot(omega_pf: float, sigma_pf: float) -> Figure:
    """The virtual illumination P(t) = exp(iΩt) exp(−t²/2σ²) against path length.

    Args:
        omega_pf: Ω, its angular frequency along the path, rad/m.
        sigma_pf: σ, the width of its envelope, m of path.

    Returns:
        a figure of one panel: envelope, real and imaginary part over ±4σ.
    """
    figure = Figure(figsize=(5.5, 3.2))
    axes = figure.subplots()
    t = np.linspace(-4 * sigma_pf, 4 * sigma_pf, 1001)
    envelope = np.exp(-(t**2) / (2 * sigma_pf**2))
    axes.plot(100 * t, envelope, color=BLACK, linestyle="--", linewidth=1, label="envelope")
    axes.plot(100 * t, -envelope, color=BLACK, linestyle="--", linewidth=1)
    axes.plot(100 * t, envelope * np.cos(omega_pf * t), color=PINK, label="real")
    axes.plot(100 * t, envelope * np.sin(omega_pf * t), color=GREEN, label="imaginary")
    axes.set(xlabel="path length (cm)", ylabel="P(t)", ylim=(-1.1, 1.1))
    axes.set_title(
        rf"$\Omega_\mathrm{{pf}}$ = {omega_pf:.4g} rad/m, $\lambda$ = {200 * np.pi / omega_pf:.3g} cm, "
        rf"$\sigma_\mathrm{{pf}}$ = {100 * sigma_pf:.3g} cm"
    )
    axes.legend(loc="upper right")
    return figure


@styled
def laser_sensor_plot(psi: np.ndarray, bin_length: float, first: float = 0.0) -> Figure:
    """The laser-sensor response Ψ against path length, with the time on top.

    Args:
        psi: ``[K]`` response, one value a bin.
        bin_length: optical path of a bin, m.
        first: path length of its first entry, m.

    Returns:
        a figure of one panel.
    """
    figure = Figure(figsize=(5.5, 3.2))
    axes = figure.subplots()
    path = first + bin_length * np.arange(len(psi))
    axes.plot(100 * path, psi, color=BLUE, drawstyle="steps-mid")
    axes.axvline(0, color=BLACK, linewidth=0.6, linestyle=":")
    axes.set(xlabel="path length (cm)", ylabel="response per bin", xlim=(100 * path[0], 100 * path[-1]))
    upper_time_axis(axes, 0.01, 1e12, "time (ps)")
    axes.set_title(rf"Laser-sensor response $\Psi$, bins of {1e3 * bin_length:.3g} mm")
    return figure


@styled
def transients_plot(
    measured: np.ndarray,
    rendered: np.ndarray,
    path: np.ndarray,
    labels: Sequence[str],
    band: tuple[np.ndarray, np.ndarray] | None = None,
    observed: np.ndarray | None = None,
) -> Figure:
    """Measured against rendered transients, one panel a spot.

    What was not recorded is a gap in the measured curve, shaded grey.

    Args:
        measured: ``[K, T]`` counts a bin.
        rendered: ``[K, T]`` expected counts a bin.
        path: ``[T]`` path length at the bins' centres, m.
        labels: K names of the spots.
        band: (low, high), each ``[K, T]``, shaded: the range that the rendered transient and counting
            statistics allow.
        observed: ``[K, T]`` bool, the bins that were recorded; None for all.

    Returns:
        a figure of K panels in one column (K < 3) or two.
    """
    columns = 1 if len(measured) < 3 else 2
    rows = -(-len(measured) // columns)
    figure = Figure(figsize=(5.5 * columns, 0.7 + 1.9 * rows))
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for k, axes in enumerate(panels.flat):
        if k >= len(measured):
            axes.set_axis_off()
            continue
        seen = measured[k] if observed is None else np.where(observed[k], measured[k], np.nan)
        axes.plot(path, seen, color=BLACK, linewidth=0.8, drawstyle="steps-mid", label="measured")
        if observed is not None and not observed[k].all():
            axes.fill_between(
                path, 0, 1, where=~observed[k], transform=axes.get_xaxis_transform(), color=NOTHING,
                alpha=0.5, linewidth=0, step="mid",
            )  # fmt: skip
        axes.plot(path, rendered[k], color=RED, label="rendered")
        if band is not None:
            axes.fill_between(
                path, band[0][k], band[1][k], color=ORANGE, alpha=0.4, linewidth=0, step="mid", label="noise"
            )
        axes.text(0.01, 0.95, labels[k], transform=axes.transAxes, ha="left", va="top")
        axes.set(ylabel="counts", xlim=(path[0], path[-1]))
        axes.set_ylim(0, 1.3 * max(np.max(measured[k]), np.max(rendered[k]), 1e-12))  # headroom for the label
        if k < columns:
            upper_time_axis(axes, 1.0, 1e9, "time (ns)")
        if k + columns >= len(measured):
            axes.set_xlabel("path length (m)")
            axes.tick_params(labelbottom=True)
    figure.legend(*panels.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


@styled
def loss_plot(history: Mapping[str, Sequence[float]]) -> Figure:
    """Losses over the iterations, name → values; logarithmic where all are positive."""
    figure = Figure(figsize=(5.5, 3.4))
    axes = figure.subplots()
    for name, values in history.items():
        axes.plot(np.arange(len(values)), values, label=name, marker="o" if len(values) == 1 else None)
    if history and min(min(values, default=1) for values in history.values()) > 0:
        axes.set_yscale("log")
    axes.set(xlabel="iteration", ylabel="loss", title="Loss")
    axes.locator_params(axis="x", integer=True)
    if history:
        axes.legend()
    return figure


@styled
def parameter_plot(history: Mapping[str, Sequence[float]], units: Mapping[str, str]) -> Figure:
    """Imaging parameters over the iterations, one panel each (Fig. 5 of the paper).

    Args:
        history: name → value after each iteration.
        units: name → unit.

    Returns:
        a figure of up to three panels a row.
    """
    columns = min(len(history), 3)
    rows = -(-len(history) // columns)
    figure = Figure(figsize=(3.2 * columns, 0.5 + 2.2 * rows))
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat[len(history) :]:
        axes.set_axis_off()
    for axes, (name, values) in zip(panels.flat, history.items(), strict=False):
        axes.plot(np.arange(len(values)), values, marker="o" if len(values) == 1 else None)
        symbol = SYMBOLS.get(name, name)
        axes.set(title=symbol, ylabel=units[name], xlabel="iteration")
        axes.locator_params(axis="x", integer=True)
        axes.margins(y=0.15)
    return figure


def _front(
    axes: Axes, values: np.ndarray, x: tuple[float, float], y: tuple[float, float], **options: Any
) -> AxesImage:
    """``values`` [nx, ny] as seen from the wall."""
    image = lattice_image(axes, values, x, y, **options)
    axes.set(xlabel="x (m)", ylabel="y (m)", facecolor=NOTHING)
    axes.invert_xaxis()
    return image
