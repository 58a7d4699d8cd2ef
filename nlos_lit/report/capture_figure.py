"""The picture of a capture as it was read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlos_lit.capture import Capture
from nlos_lit.io.files import whole_file

NOT_RECORDED = "0.7"  # grey

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


def draw_capture(capture: Capture, mean_transient: np.ndarray, totals: np.ndarray, path: Path) -> None:
    """One picture: mean transient with gate, counts over the wall, three spots, one time slice.

    What was not recorded is a gap in the curves and grey on the wall.

    Args:
        capture: as read.
        mean_transient: ``[T]`` counts a bin, mean over the spots; NaN where no spot recorded it.
        totals: ``[S]`` counts inside the gate; NaN where the spot recorded none of its bins.
        path: PNG file to write.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    first, last = capture.gate
    way = capture.t_start + (np.arange(capture.n_bins) + 0.5) * capture.bin_length
    figure, ((mean, wall), (samples, slice_)) = plt.subplots(2, 2, figsize=(12, 9), layout="constrained")
    counts = capture.counts
    if capture.observed is not None:
        counts = np.where(capture.observed, counts, np.nan)
    mean.semilogy(way, np.where(mean_transient > 0, mean_transient, np.nan), lw=0.8, color="k")
    mean.axvspan(*capture.path_gate, color="tab:green", alpha=0.15, label="gate")
    mean.set(title="mean transient", xlabel="path (m)", ylabel="counts a bin")
    mean.legend()
    _on_wall(figure, wall, capture, totals, "counts in the gate, wall seen from its own side")
    ranked = np.argsort(totals, kind="stable")[: np.count_nonzero(np.isfinite(totals))]
    for share, name in ((0.05, "weak"), (0.5, "median"), (0.95, "strong")):
        spot = ranked[int(share * (len(ranked) - 1))]
        samples.plot(way[first:last], counts[spot, first:last], lw=0.6, label=f"{name} spot {spot}")
    samples.set(title="three spots, gated", xlabel="path (m)", ylabel="counts a bin")
    samples.legend()
    peak = first + int(np.nanargmax(mean_transient[first:last]))
    _on_wall(
        figure,
        slice_,
        capture,
        counts[:, peak].astype(np.float64),
        f"bin {peak}, path {way[peak]:.3f} m",
    )
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=110)
    plt.close(figure)


def _on_wall(figure: Figure, axes: Axes, capture: Capture, values: np.ndarray, title: str) -> None:
    """Values over the wall points, +x to the left and +y up, as one sees the scene from the wall."""
    image: AxesImage | PathCollection
    points = (
        capture.laser
        if np.ptp(capture.laser, axis=0).max() > np.ptp(capture.sensor, axis=0).max()
        else capture.sensor
    )
    if capture.scan_shape is not None and len(capture.scan_shape) == 2:
        (x0, y0), (x1, y1) = points[0, :2], points[-1, :2]
        half = [
            (b - a) / max(n - 1, 1) / 2
            for a, b, n in ((x0, x1, capture.scan_shape[0]), (y0, y1, capture.scan_shape[1]))
        ]
        extent = (x0 - half[0], x1 + half[0], y0 - half[1], y1 + half[1])
        image = axes.imshow(
            values.reshape(capture.scan_shape).T, origin="lower", extent=extent, cmap="viridis"
        )
        axes.invert_xaxis()
    else:
        places, index = np.unique(np.round(points[:, :2], 6), axis=0, return_inverse=True)
        totals = np.bincount(index.ravel(), weights=values)
        image = axes.scatter(places[:, 0], places[:, 1], c=totals, s=20, cmap="viridis")
        axes.set_aspect("equal")
        axes.invert_xaxis()
    figure.colorbar(image, ax=axes)
    axes.set_facecolor(NOT_RECORDED)
    axes.set(title=title, xlabel="x (m)", ylabel="y (m)")
