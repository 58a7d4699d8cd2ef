"""What a capture's counts say before any long run: pulse, first returns, what to fit, what looks wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_modules.nonsense import nonsense
from data_modules.plan import Plan, plan_capture, returns
from data_modules.readers import READERS
from data_modules.readers.assemble import direct_pulse
from data_modules.suspicions import strange_depths, suspicions
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
        plan: what to fit of it.
        warnings: what looks wrong, one sentence each.
    """

    mean: np.ndarray
    totals: np.ndarray
    pulse: int | None
    pulse_share: float
    first_returns: np.ndarray
    plan: Plan
    warnings: tuple[str, ...]


def examine(capture: Capture) -> Findings:
    """Direct pulse, depth of the first returns, what to fit, and what looks wrong."""
    first, last = capture.gate
    mean = capture.mean_transient()
    totals = capture.counts[:, first:last].sum(axis=1, dtype=np.float64)
    observed = capture.gated_observed()
    if observed is not None:
        totals[~observed.any(axis=1)] = np.nan
    known = np.nan_to_num(mean)
    pulse = direct_pulse(known, capture.bin_length, capture.t_start) if first > 0 else None
    share = float(known[:first].sum() / known.sum()) if pulse is not None else 0.0
    depths = returns(capture).first / 2
    warnings = tuple(nonsense(capture)) or (*suspicions(capture), *strange_depths(capture, depths))
    return Findings(mean, totals, pulse, share, depths, plan_capture(capture), warnings)


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
        # No finer than the bins: between equal depths there would be no room for eight rows.
        first, last = findings.first_returns.min(), findings.first_returns.max()
        heights, edges = np.histogram(
            findings.first_returns, bins=8, range=(first, max(last, first + 4 * capture.bin_length))
        )
        lines += [
            f"             {a:6.3f} m {'#' * round(40 * n / heights.max())} {n}"
            for n, a in zip(heights, edges[:-1], strict=True)
        ]
    else:
        lines.append("first return none found in the gate")
    plan = findings.plan
    lines += [
        f"plan         {plan.overrides()}",
        f"             for an image at a wavelength of {100 * plan.wavelength:.3g} cm: bins of "
        f"{plan.sum_bins * capture.bin_width_ps:.3g} ps, planes {1e3 * plan.depth_pitch:.3g} mm apart",
    ]
    lines += [f"done         {step}" for step in capture.provenance.get("steps", [])]
    lines += [f"LOOK AT      {warning}" for warning in findings.warnings] or ["nothing suspicious"]
    return "\n".join(lines)


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
