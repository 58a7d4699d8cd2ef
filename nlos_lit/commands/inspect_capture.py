"""Print and plot what a capture file holds, before a long run."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_modules.readers import READERS, ReaderOptions, detect_format, read_capture
from data_modules.readers.assemble import direct_pulse, smooth
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


@dataclass(frozen=True)
class Findings:
    """What the counts say.

    Args:
        mean: ``[T]`` transient, counts a bin, over all spots.
        totals: ``[S]`` counts inside the gate.
        pulse: bin of the direct pulse's peak; None where there is none before the gate.
        pulse_share: of all counts, before the gate; 0 without a pulse.
        first_returns: ``[K]`` depth of the first return, half the path, m, of the spots that have one.
        warnings: what looks wrong, one sentence each.
    """

    mean: np.ndarray
    totals: np.ndarray
    pulse: int | None
    pulse_share: float
    first_returns: np.ndarray
    warnings: tuple[str, ...]


def examine(capture: Capture) -> Findings:
    """Direct pulse, depth of the first returns, and what looks wrong."""
    first, last = capture.gate
    mean = capture.counts.mean(axis=0, dtype=np.float64)
    totals = capture.counts[:, first:last].sum(axis=1, dtype=np.float64)
    pulse = direct_pulse(mean, capture.bin_length, capture.t_start) if first > 0 else None
    share = float(mean[:first].sum() / mean.sum()) if pulse is not None else 0.0
    returns = _first_returns(capture)
    return Findings(mean, totals, pulse, share, returns, tuple(_warnings(capture, mean, totals, returns)))


def report(capture: Capture, fmt: str, findings: Findings) -> str:
    """The findings in words.

    Args:
        capture: as read.
        fmt: name of its format.
        findings: of :func:`examine`.

    Returns:
        One finding a line, the lines that begin with LOOK AT last.
    """
    description = next(reader.DESCRIPTION for reader in READERS if fmt == reader.NAME)
    first, last = capture.gate
    start = capture.t_start
    whole = (start, start + capture.n_bins * capture.bin_length)
    points = np.unique(np.round(np.concatenate([capture.laser, capture.sensor]), 6), axis=0)
    size = np.ptp(points, axis=0)
    per_spot = capture.counts.sum(axis=1, dtype=np.float64)
    counted = "photon counts" if capture.is_counts else "expected values, not counts"
    near, far = capture.path_gate
    lines = [
        f"format       {fmt} ({description})",
        f"kind         {capture.kind}, {counted}",
        f"spots        {capture.n_spots}"
        + (f" = {' × '.join(map(str, capture.scan_shape))}" if capture.scan_shape else ", irregular"),
        f"wall         {size[0]:.4g} m × {size[1]:.4g} m between outermost spots" + _spacing(capture),
        f"bins         {capture.n_bins} of {capture.bin_width_ps:.4g} ps = "
        f"{1e3 * capture.bin_length:.4g} mm of path",
        f"time         path {whole[0]:.4g} to {whole[1]:.4g} m, depth to {whole[1] / 2:.4g} m",
        f"gate         bins [{first}, {last}): path {near:.4g} to {far:.4g} m, "
        f"depth {near / 2:.4g} to {far / 2:.4g} m",
        f"counts       a spot, all bins: {_three(per_spot)}; "
        f"in the gate: {_three(findings.totals)} (least, median, most)",
    ]
    if capture.exposure_s is not None:
        lines.append(f"exposure     {capture.exposure_s:g} s a spot")
    if findings.pulse is None:
        lines.append("direct pulse none before the gate")
    else:
        at = start + (findings.pulse + 0.5) * capture.bin_length
        lines.append(
            f"direct pulse peak in bin {findings.pulse} (path {at:.4g} m); "
            f"{findings.pulse_share:.1%} of counts lie before the gate"
        )
    if len(findings.first_returns):
        low, middle, high = np.percentile(findings.first_returns, [5, 50, 95])
        lines.append(
            f"first return depth {low:.3f} / {middle:.3f} / {high:.3f} m "
            f"(5 / 50 / 95 % of {len(findings.first_returns)} spots)"
        )
        heights, edges = np.histogram(findings.first_returns, bins=8)
        lines += [
            f"             {a:6.3f} m {'#' * round(40 * n / heights.max())} {n}"
            for n, a in zip(heights, edges[:-1], strict=True)
        ]
    else:
        lines.append("first return none found in the gate")
    lines += [f"done         {step}" for step in capture.provenance.get("steps", [])]
    lines += [f"LOOK AT      {warning}" for warning in findings.warnings] or ["nothing suspicious"]
    return "\n".join(lines)


def draw(capture: Capture, findings: Findings, path: Path) -> None:
    """One picture: mean transient with gate, counts over the wall, three spots, one time slice.

    Args:
        capture: as read.
        findings: of :func:`examine`.
        path: PNG file to write.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    first, last = capture.gate
    way = capture.t_start + (np.arange(capture.n_bins) + 0.5) * capture.bin_length
    figure, ((mean, wall), (samples, slice_)) = plt.subplots(2, 2, figsize=(12, 9), layout="constrained")
    mean.semilogy(way, np.where(findings.mean > 0, findings.mean, np.nan), lw=0.8, color="k")
    mean.axvspan(*capture.path_gate, color="tab:green", alpha=0.15, label="gate")
    mean.set(title="mean transient", xlabel="path (m)", ylabel="counts a bin")
    mean.legend()
    _on_wall(figure, wall, capture, findings.totals, "counts in the gate, wall seen from its own side")
    ranked = np.argsort(findings.totals, kind="stable")
    for share, name in ((0.05, "weak"), (0.5, "median"), (0.95, "strong")):
        spot = ranked[int(share * (capture.n_spots - 1))]
        samples.plot(way[first:last], capture.counts[spot, first:last], lw=0.6, label=f"{name} spot {spot}")
    samples.set(title="three spots, gated", xlabel="path (m)", ylabel="counts a bin")
    samples.legend()
    peak = first + int(np.argmax(findings.mean[first:last]))
    _on_wall(
        figure,
        slice_,
        capture,
        capture.counts[:, peak].astype(np.float64),
        f"bin {peak}, path {way[peak]:.3f} m",
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def inspect_capture(arguments: list[str]) -> int:
    """Print what the file named by ``arguments`` holds, draw it, and return the exit status."""
    given = _parser().parse_args(arguments).__dict__
    path, fmt, out = given.pop("file"), given.pop("format"), given.pop("out")
    size, gate = given.pop("wall_size"), given.pop("gate")
    try:
        wall_size = None if size is None else (size[0] if len(size) == 1 else tuple(size))
        options = ReaderOptions(wall_size=wall_size, gate=tuple(gate) if gate else None, **given)
        capture = read_capture(path, fmt, options=options)
        findings = examine(capture)
        print(report(capture, detect_format(path) if fmt == "auto" else fmt, findings))
        picture = out / f"{path.stem}_capture.png"
        try:
            out.mkdir(parents=True, exist_ok=True)
            draw(capture, findings, picture)
        except OSError as error:
            raise UserError(f"cannot write {picture}: {error.strerror or error}") from error
        print(f"picture      {picture}")
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Print and plot what a capture file holds.")
    parser.add_argument("file", type=Path, help="capture file, or folder of C_i, C_d, sub_Sig")
    parser.add_argument(
        "--format", default="auto", help=f"auto, or one of {', '.join(reader.NAME for reader in READERS)}"
    )
    parser.add_argument("--bin-width-ps", type=float)
    parser.add_argument(
        "--wall-size",
        type=float,
        nargs="+",
        metavar="M",
        help="side of the scanned square, or its two sides, m",
    )
    parser.add_argument("--t-start", type=float, metavar="M", help="path at the start of bin 0, m")
    parser.add_argument("--gate", type=int, nargs=2, metavar=("FIRST", "LAST"), help="bins to fit")
    for name in ("flip-x", "flip-y", "swap-xy"):
        parser.add_argument(f"--{name}", action="store_true", default=None)
    parser.add_argument(
        "--raw-scale", action=argparse.BooleanOptionalAction, help="the file carries tal's raw scale, or not"
    )
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="where the picture goes")
    return parser


def _first_returns(capture: Capture) -> np.ndarray:
    """Half the path of the gated bin where a spot's transient, smoothed over 80 ps, rises past a fifth of its
    peak.

    The rise is the one that leads to the peak, so a direct pulse's tail at the gate's start does not count.
    Spots whose peak does not stand six standard deviations above their own lowest tenth are left out; of
    large scans every n-th spot is looked at.
    """
    first, last = capture.gate
    width = max(1, min(round(0.024 / capture.bin_length), last - first))
    found = []
    for transient in capture.counts[:: max(1, capture.n_spots // 1024), first:last]:
        level = smooth(transient, width)
        floor = float(np.percentile(level, 10))
        peak = int(np.argmax(level))
        height = level[peak] - floor
        noise = np.sqrt(max(floor, 1 / width) / width) if capture.is_counts else 0.0
        below = np.flatnonzero(level[:peak] - floor < 0.2 * height)
        if height > 6 * noise and len(below):
            found.append(int(below[-1]) + 1)
    return (capture.t_start + (first + np.asarray(found, dtype=np.float64) + 0.5) * capture.bin_length) / 2


def _warnings(capture: Capture, mean: np.ndarray, totals: np.ndarray, returns: np.ndarray) -> list[str]:
    first, last = capture.gate
    extent = float(np.linalg.norm(np.ptp(np.concatenate([capture.laser, capture.sensor]), axis=0)))
    told = []
    width = max(1, round(0.012 / capture.bin_length))
    level = smooth(mean, width)
    pulse = direct_pulse(mean, capture.bin_length, capture.t_start)
    if pulse is not None and first <= pulse + width and mean[pulse] > 20 * np.median(mean):
        told.append(
            f"the gate begins at bin {first}, at or before the direct pulse's peak (bin {pulse}); "
            "begin it behind the pulse"
        )
    elif (
        pulse is not None
        and level[first] > 0.1 * level[first:last].max()
        and level[first] > 1.5 * level[min(first + 8 * width, last - 1)]
    ):
        told.append(f"the gate begins at bin {first} before the direct pulse has decayed; begin it later")
    depth = float(np.median(returns)) if len(returns) else 0.0
    if depth > 10:
        told.append(
            f"the bin width implies a scene {depth:.0f} m away; "
            f"check bin_width_ps (now {capture.bin_width_ps:g} ps)"
        )
    elif len(returns) and depth < 0.02:
        told.append(
            f"the first returns come from {100 * depth:.1f} cm; check the bin width, t_start and the gate"
        )
    if extent > 10 or extent < 0.02:
        told.append(f"the wall is {extent:.3g} m across; check wall_size")
    if capture.bin_width_ps > 500 or capture.bin_width_ps < 0.5:
        told.append(f"bins of {capture.bin_width_ps:.3g} ps are unusual; check bin_width_ps")
    empty = int((totals == 0).sum())
    if empty:
        told.append(f"{empty} of {capture.n_spots} spots hold no counts in the gate")
    if len(totals) > 8 and np.median(totals) > 0 and totals.max() > 50 * np.median(totals):
        told.append(
            f"the strongest spot has {totals.max() / np.median(totals):.0f} times the median counts: "
            "a hot spot?"
        )
    filled = np.flatnonzero(mean[first:last])
    if (
        capture.is_counts
        and len(filled)
        and (filled[0] > 0.05 * (last - first) or filled[-1] < 0.95 * (last - first) - 1)
    ):
        told.append(
            f"only bins {first + filled[0]} to {first + filled[-1]} of the gate hold counts; "
            "the rest may be cropped, not dark"
        )
    if capture.is_counts:
        begins = np.argmax(capture.counts[:, first:last] > 0, axis=1)[totals > 0]
        busy = np.median(totals) > 20 * (last - first)
        if busy and len(begins) and np.ptp(begins) > 0.2 * (last - first):
            told.append(
                "some spots hold nothing in the first part of the gate where others do: "
                "cropped there, not dark"
            )
    return told


def _spacing(capture: Capture) -> str:
    if capture.scan_shape is None:
        return ""
    scanned = capture.laser if np.ptp(capture.laser, axis=0).max() > 0 else capture.sensor
    steps = [np.diff(np.unique(np.round(scanned[:, axis], 6))) for axis in (0, 1)]
    told = " × ".join(f"{1e3 * np.median(step):.4g} mm" if len(step) else "one line" for step in steps)
    return f", spacing {told}"


def _three(values: np.ndarray) -> str:
    return f"{values.min():.4g} / {np.median(values):.4g} / {values.max():.4g}"


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
    axes.set(title=title, xlabel="x (m)", ylabel="y (m)")
