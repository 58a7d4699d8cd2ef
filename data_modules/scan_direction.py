"""Along which axis a wall was scanned line by line, told by light that changes with time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy import stats

from nlos_lit.capture import Capture
from nlos_lit.capture.background import quietest_level

WINDOW = 4  # spots before and behind, whose means are compared
QUIET = 0.1  # a bin is quiet where its mean is above the quietest level by no more than this share …
ERRORS = 4.0  # … and as many standard errors
FLAT = 3  # degree of what is taken for the wall's own unevenness
LESS = 0.25  # of the changes along one axis are left along the other where that is told


class Direction(NamedTuple):
    """Changes of the quiet bins' light along the lines of a scan and across them; 0 is what noise makes.

    Args:
        along: mean squared change over the lines as the capture has them, less the noise's, in its units.
        across: the same from line to line.
        chance: that so much less would be across than along if no light changed with time.
    """

    along: float
    across: float
    chance: float

    @property
    def turned(self) -> bool:
        """Most changes would be gone if the wall had been scanned along its other axis."""
        return self.across < LESS * self.along


def scan_direction(capture: Capture) -> Direction | None:
    """Whether the light of bins without scene changes along the lines of a scan, or rather across them.

    Ambient light that comes and goes changes slowly in the order of acquisition. Spots of one line were taken
    one after the other, so that they look alike; neighbours in the next line were taken a line later. Each
    spot's counts in the quiet bins (square roots, which scatter alike) are freed of a cubic polynomial over
    the wall, and the means of ``WINDOW`` spots before and behind each are compared.

    Args:
        capture: as read.

    Returns:
        None where the scan is no grid taken line by line, or too small, or has spots that were not recorded.
    """
    lines = _lines(capture)
    if lines is None or min(lines.shape) < 4 * WINDOW or capture.gated_observed() is not None:
        return None
    counts = capture.counts[:, slice(*capture.gate)]
    mean = counts.mean(axis=0, dtype=np.float64)
    level = quietest_level(torch.from_numpy(mean))
    quiet = mean <= level * (1 + QUIET) + ERRORS * np.sqrt(level / len(counts))
    seen = counts[:, quiet].sum(axis=1, dtype=np.float64)
    scatter = _flattened(2 * np.sqrt(seen + 3 / 8)[lines])
    along, across = (_changes(part) for part in (scatter, scatter.T))
    edge = np.repeat([1.0, 0.0, -1.0], [WINDOW, 1, WINDOW])
    likeness = np.correlate(edge, edge, "full") / (edge @ edge)
    error = np.sqrt(2 * 2 * (likeness**2).sum() / scatter.size)
    return Direction(along, across, float(stats.norm.sf((along - across) / error)))


def _lines(capture: Capture) -> np.ndarray | None:
    """``[lines, spots]`` rows of the capture, each line along one axis of its grid."""
    if capture.scan_shape is None or len(capture.scan_shape) != 2:
        return None
    rank = capture.scan_order.reshape(capture.scan_shape)
    grid = np.arange(capture.n_spots).reshape(capture.scan_shape)
    for ranks, rows in ((rank, grid), (rank.T, grid.T)):
        line = ranks // ranks.shape[1]
        if (line == line[:, :1]).all():
            return np.asarray(rows)
    return None


def _flattened(values: np.ndarray) -> np.ndarray:
    """``[n, m]`` without the polynomial of degree ``FLAT`` that is nearest to them."""
    u, v = np.meshgrid(*(np.linspace(-1, 1, n) for n in values.shape), indexing="ij")
    powers = [(a, b) for a in range(FLAT + 1) for b in range(FLAT + 1 - a)]
    design = np.stack([(u**a * v**b).ravel() for a, b in powers], axis=1)
    fit = np.linalg.lstsq(design, values.ravel(), rcond=None)[0]
    return values - (design @ fit).reshape(values.shape)


def _changes(values: np.ndarray) -> float:
    """Mean squared change along the last axis between windows, less that of white noise, over it."""
    total = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
    sums = (total[:, WINDOW:] - total[:, :-WINDOW]) / WINDOW
    change = sums[:, WINDOW + 1 :] - sums[:, : -WINDOW - 1]
    return float((change**2).mean() * WINDOW / 2 - 1)
