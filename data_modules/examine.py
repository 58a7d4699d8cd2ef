"""What a capture's counts say before any long run: direct pulse, first returns, and what looks wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_modules.readers import READERS
from data_modules.readers.assemble import counted, direct_pulse, smooth
from nlos_lit.capture import Capture


@dataclass(frozen=True)
class Findings:
    """What the counts say.

    Args:
        mean: ``[T]`` transient, counts a bin, over the spots that recorded it; NaN where none did.
        totals: ``[S]`` counts inside the gate; NaN where the spot recorded none of its bins.
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
    mean = capture.mean_transient()
    totals = capture.counts[:, first:last].sum(axis=1, dtype=np.float64)
    observed = capture.gated_observed()
    if observed is not None:
        totals[~observed.any(axis=1)] = np.nan
    known = np.nan_to_num(mean)
    pulse = direct_pulse(known, capture.bin_length, capture.t_start) if first > 0 else None
    share = float(known[:first].sum() / known.sum()) if pulse is not None else 0.0
    returns = _first_returns(capture)
    return Findings(mean, totals, pulse, share, returns, tuple(_warnings(capture, known, totals, returns)))


def describe(capture: Capture, fmt: str, findings: Findings) -> str:
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
        f"recorded     {_recorded(capture)}",
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


def _first_returns(capture: Capture) -> np.ndarray:
    """Half the path of the gated bin where a spot's transient, smoothed over 80 ps, rises past a fifth of its
    peak.

    The rise is the one that leads to the peak, so a direct pulse's tail at the gate's start does not count.
    Spots whose peak does not stand six standard deviations above their own lowest tenth are left out; of
    large scans every n-th spot is looked at.
    """
    first, last = capture.gate
    width = max(1, min(round(0.024 / capture.bin_length), last - first))
    observed = capture.gated_observed()
    found = []
    for spot in range(0, capture.n_spots, max(1, capture.n_spots // 1024)):
        # A rise over bins that were not recorded is no return: nobody knows when it began.
        bins = np.arange(last - first) if observed is None else np.flatnonzero(observed[spot])
        if len(bins) == 0:
            continue
        level = smooth(capture.counts[spot, first + bins], width)
        floor = float(np.percentile(level, 10))
        peak = int(np.argmax(level))
        height = level[peak] - floor
        noise = np.sqrt(max(floor, 1 / width) / width) if capture.is_counts else 0.0
        below = np.flatnonzero(level[:peak] - floor < 0.2 * height)
        if height > 6 * noise and len(below):
            at = int(below[-1]) + 1
            around = bins[max(at - width, 0) : at + width]
            if around[-1] - around[0] < len(around):
                found.append(bins[at])
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
    if capture.is_counts and not counted(capture.counts):
        told.append("the values are taken as photon counts but are not whole numbers; check counts")
    totals = totals[np.isfinite(totals)]
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
    return told


def _recorded(capture: Capture) -> str:
    """Which of the gate's bins were recorded, in words."""
    observed = capture.gated_observed()
    if observed is None:
        return "every bin of the gate"
    part, none = int((~observed.all(axis=1)).sum()), int((~observed.any(axis=1)).sum())
    return (
        f"{observed.mean():.1%} of the gate's bins; {none} of {capture.n_spots} spots have none of them, "
        f"{part - none} only some"
    )


def _spacing(capture: Capture) -> str:
    if capture.scan_shape is None:
        return ""
    scanned = capture.laser if np.ptp(capture.laser, axis=0).max() > 0 else capture.sensor
    steps = [np.diff(np.unique(np.round(scanned[:, axis], 6))) for axis in (0, 1)]
    told = " × ".join(f"{1e3 * np.median(step):.4g} mm" if len(step) else "one line" for step in steps)
    return f", spacing {told}"


def _three(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]
    return f"{values.min():.4g} / {np.median(values):.4g} / {values.max():.4g}"
