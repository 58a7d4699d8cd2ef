"""The look that all figures share: colours, type, symbols, and the pieces that several are made of."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.rcsetup import cycler

from nlos_lit.capture import SPEED_OF_LIGHT
from nlos_lit.io.files import whole_file

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType
    from numpy.typing import ArrayLike

# Okabe and Ito's colours, distinguishable in every common form of colour blindness.
BLUE, ORANGE, GREEN, PINK = "#0072B2", "#E69F00", "#009E73", "#CC79A7"
SKY, RED, BLACK = "#56B4E9", "#D55E00", "#000000"
NOTHING = "#d9d9d9"  # where an image has no value

INTENSITY, DEPTH, SIGNED = "inferno", "viridis_r", "PuOr"  # colour maps

STYLE: dict[RcKeyType, Any] = {
    "axes.prop_cycle": cycler(color=[BLUE, ORANGE, GREEN, PINK, SKY, RED, BLACK]),
    "axes.grid": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": "medium",
    "axes.formatter.useoffset": False,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.constrained_layout.h_pad": 0.08,
    "figure.dpi": 100,
    "font.size": 9,
    "image.interpolation": "nearest",
    "legend.frameon": False,
    "legend.fontsize": "small",
    "lines.linewidth": 1.3,
}

# How a parameter's name is written in a figure.
SYMBOLS = {
    "omega_pf": r"$\Omega_\mathrm{pf}$",
    "sigma_pf": r"$\sigma_\mathrm{pf}$",
    "sigma_ls": r"$\sigma_\mathrm{ls}$",
    "intensity": r"$I_\mathrm{l}$",
    "I_l": r"$I_\mathrm{l}$",
    "kappa_s": r"$\kappa_\mathrm{s}$",
    "eta_s": r"$\eta_\mathrm{s}$",
}

Arguments = ParamSpec("Arguments")


def styled(plot: Callable[Arguments, Figure]) -> Callable[Arguments, Figure]:
    """The function with the shared style in force; pyplot and its global state are not touched."""

    @functools.wraps(plot)
    def wrapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Figure:
        with matplotlib.rc_context(STYLE):
            return plot(*args, **kwargs)

    return wrapped


def save_figure(figure: Figure, path: Path | str) -> None:
    """PNG (2000 pixels wide at most), PDF or SVG by the suffix; a whole file or none.

    Args:
        figure: what to save.
        path: where to; its suffix chooses the format.
    """
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=min(150.0, 2000 / figure.get_figwidth()))


def cell_edges(centres: np.ndarray, pitch: float) -> tuple[float, float]:
    """Outer edges of the first and the last of a row of cells.

    Args:
        centres: ``[n]`` centres of the cells, m.
        pitch: their width, m.

    Returns:
        ``(first, last)`` edge, m.

    Examples:
        >>> cell_edges(np.array([0.5, 1.5, 2.5]), 1.0)
        (0.0, 3.0)
    """
    return float(centres[0] - pitch / 2), float(centres[-1] + pitch / 2)


def lattice_image(
    axes: Axes, values: np.ndarray, right: tuple[float, float], up: tuple[float, float], **options: Any
) -> AxesImage:
    """Draw values on a lattice, the first index to the right, the second upwards, both to the same scale.

    Args:
        axes: where to draw.
        values: ``[horizontal, vertical]``, or ``[horizontal, vertical, 3]`` red, green, blue in [0, 1].
        right: outer edges of the lattice along the first index, m.
        up: the same along the second.
        options: further ones of `Axes.imshow`, such as ``cmap``.

    Returns:
        the image, as a colour bar needs it.
    """
    turned = np.swapaxes(values, 0, 1)
    return axes.imshow(turned, extent=(*right, *up), origin="lower", aspect="equal", **options)


def colour_bar(drawn: AxesImage | Collection, label: str) -> None:
    """A colour bar beside an image, exactly as high.

    Args:
        drawn: the image, or the points or mesh of a plot, that the colours belong to.
        label: quantity and unit.
    """
    axes = drawn.axes
    assert isinstance(axes, Axes)
    axes.figure.colorbar(drawn, cax=axes.inset_axes((1.03, 0, 0.04, 1)), label=label)


def upper_time_axis(axes: Axes, metres: float, per_second: float, label: str) -> None:
    """The axis of path lengths once more on top, as time.

    Args:
        axes: whose lower axis is a path length.
        metres: unit of the lower axis in metres (0.01 for cm; a bin's length for bins).
        per_second: units of the upper axis in a second (1e9 for ns).
        label: of the upper axis.
    """
    factor = metres / SPEED_OF_LIGHT * per_second

    def time(length: ArrayLike) -> ArrayLike:
        return np.asarray(length) * factor

    def length(time: ArrayLike) -> ArrayLike:
        return np.asarray(time) / factor

    axes.secondary_xaxis("top", functions=(time, length)).set_xlabel(label)
