"""The look that all figures share: colours, type, and the pieces they are made of."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from nlos_lit.capture import SPEED_OF_LIGHT
from nlos_lit.io.files import whole_file

# Okabe and Ito's colours, distinguishable in every common form of colour blindness.
BLUE, ORANGE, GREEN, PINK = "#0072B2", "#E69F00", "#009E73", "#CC79A7"


SKY, RED, BLACK = "#56B4E9", "#D55E00", "#000000"


INTENSITY, DEPTH, SIGNED = "inferno", "viridis_r", "PuOr"


NOTHING = "#d9d9d9"


STYLE = {
    "axes.prop_cycle": matplotlib.cycler(color=[BLUE, ORANGE, GREEN, PINK, SKY, RED, BLACK]),
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


SYMBOLS = {
    "omega_pf": r"$\Omega_\mathrm{pf}$",
    "sigma_pf": r"$\sigma_\mathrm{pf}$",
    "sigma_ls": r"$\sigma_\mathrm{ls}$",
    "intensity": r"$I_\mathrm{l}$",
    "I_l": r"$I_\mathrm{l}$",
    "kappa_s": r"$\kappa_\mathrm{s}$",
    "eta_s": r"$\eta_\mathrm{s}$",
}


def styled(plot: Callable[..., Figure]) -> Callable[..., Figure]:
    """The function with the shared style in force; pyplot and its global state are not touched."""

    @functools.wraps(plot)
    def wrapped(*args, **kwargs) -> Figure:
        with matplotlib.rc_context(STYLE):
            return plot(*args, **kwargs)

    return wrapped


def save_figure(figure: Figure, path: Path | str) -> None:
    """PNG (2000 pixels wide at most), PDF or SVG by the suffix; a whole file or none."""
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=min(150.0, 2000 / figure.get_figwidth()))


def _ends(axis: np.ndarray, pitch: float) -> tuple[float, float]:
    """Outer edges of the first and last cell whose centres are ``axis``."""
    return float(axis[0] - pitch / 2), float(axis[-1] + pitch / 2)


def _image(
    axes: Axes, values: np.ndarray, right: tuple[float, float], up: tuple[float, float], **options
) -> AxesImage:
    """``values`` [horizontal, vertical], the second index upwards."""
    return axes.imshow(values.T, extent=(*right, *up), origin="lower", aspect="equal", **options)


def _bar(image: AxesImage | PathCollection, label: str) -> None:
    """A colour bar beside the image, exactly as high."""
    image.axes.figure.colorbar(image, cax=image.axes.inset_axes((1.03, 0, 0.04, 1)), label=label)


def _upper_time_axis(axes: Axes, metres: float, per_second: float, label: str) -> None:
    """The same axis as time on top; ``metres`` is the lower axis's unit in metres."""
    factor = metres / SPEED_OF_LIGHT * per_second
    axes.secondary_xaxis(
        "top", functions=(lambda length: length * factor, lambda time: time / factor)
    ).set_xlabel(label)
