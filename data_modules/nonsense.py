"""What no capture of a hidden scene can be: wrong units, turned walls, noise, a gate without light.

Each check is one function, from a capture to sentences with the value found and what is usual. What merely
looks wrong is in :mod:`data_modules.suspicions`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import stats

from data_modules.plan import plan_capture, returns
from nlos_lit.capture import Capture

SMALLEST, LARGEST = 1e-15, 1e12  # of a capture's largest value; squares of it stand in single precision
SHORTEST, LONGEST = 0.03, 3000.0  # of a bin, ps
NARROWEST, WIDEST = 1e-3, 50.0  # of a wall, m
FARTHEST = 1000.0  # path to the gate's first bin, m
CHANCE = 1e-6  # that noise is taken for light
SCALES = (1, 8, 32)  # bins
TOGETHER = 1024  # spots that are looked at at once


def nonsense(capture: Capture) -> list[str]:
    """What cannot be of a capture: sentences of the first check that finds something, none of a good one."""
    return next((told for check in CHECKS if (told := check(capture))), [])


def largest_value(capture: Capture) -> list[str]:
    """Values that single precision loses."""
    largest = float(capture.counts.max())
    if SMALLEST < largest < LARGEST:
        return []
    return [
        f"the capture's largest value is {largest:.3g}; usual are 1 to 100000 counts a bin, and what "
        f"is computed of values beyond {SMALLEST:g} to {LARGEST:g} is lost in rounding: look for a damaged "
        "value, or give values in another unit"
    ]


def bin_width(capture: Capture) -> list[str]:
    """Bins of a width that no counter has."""
    if SHORTEST < capture.bin_width_ps < LONGEST:
        return []
    return [
        f"a bin is {capture.bin_width_ps:.3g} ps wide ({capture.bin_length:.3g} m of path); usual are 1 to "
        "100 ps: check the unit of the file's bin width"
    ]


def wall_extent(capture: Capture) -> list[str]:
    """A wall in millimetres or kilometres, or no wall at all."""
    extent = capture.wall_extent
    if extent < WIDEST and (extent > NARROWEST or capture.n_spots == 1):
        return []
    return [
        f"the {capture.n_spots} spots lie on a wall {extent:.4g} m across; usual are 0.1 to 5 m: check the "
        "unit of the positions"
    ]


def normals(capture: Capture) -> list[str]:
    """Normals that contradict each other, or point away from the hidden scene."""
    between = _angle(np.median((capture.laser_normal * capture.sensor_normal).sum(axis=1)))
    if between > 95:
        return [
            f"the wall's normals at the laser points are turned by {between:.0f}° against those at the "
            "sensor points (usual: 0°); both must point to the hidden scene"
        ]
    away = _angle(min(np.median(n[:, 2]) for n in (capture.laser_normal, capture.sensor_normal)))
    if away > 95:
        return [
            f"the wall's normals are turned by {away:.0f}° from the hidden scene, which lies at z > 0 "
            "(usual: 0°); turn them round, or the wall"
        ]
    return []


def times(capture: Capture) -> list[str]:
    """A gate at a time when no light can come."""
    first, last = capture.path_gate
    straight = float(np.linalg.norm(capture.laser - capture.sensor, axis=1).min())
    if last <= straight:
        return [
            f"the gate ends at a path of {last:.4g} m, and light from laser to sensor point takes at least "
            f"{straight:.4g} m; usual are 0.3 to 10 m: check t_start and the gate"
        ]
    if first > FARTHEST:
        return [
            f"the gate begins at a path of {first:.4g} m; usual are 0.3 to 10 m: check t_start, the bin "
            "width and the gate"
        ]
    return []


def noise_alone(capture: Capture) -> list[str]:
    """A gate without counts, with the same value everywhere, or with nothing but noise."""
    first, last = capture.gate
    counts = capture.counts[:, first:last]
    gate = f"the gate [{first}, {last})"
    if counts.max() == 0:
        return [f"{gate} holds no counts{_outside(capture)}: give another gate"]
    seen = capture.gated_observed()
    values = counts if seen is None else counts[seen]
    if values.min() == values.max():
        return [
            f"every bin of {gate} holds the same value, {values.max():.4g}; usual are transients that rise "
            "and fall, and scatter: is this array the counts?"
        ]
    if last - first < 3 or has_light(capture):
        return []
    return [
        f"{gate} holds nothing but noise, {values.mean():.3g} a bin at every time{_outside(capture)}; light "
        "that comes back rises and falls: check the gate and which array holds the counts"
    ]


def has_light(capture: Capture) -> bool:
    """Whether anything in the gate changes along time beyond noise.

    In noise that is alike at all times, the spots' deviations from their means add up to a χ² along time, at
    each of ``SCALES``, those of neighbouring bins are uncorrelated, and no spot has a peak that Poisson
    counts would not reach. What has a chance of less than ``CHANCE`` by any of these is taken for light.
    """
    counts, seen = capture.counts[:, slice(*capture.gate)], capture.gated_observed()
    bins = counts.shape[1]
    columns, variance, product, square, pairs = np.zeros(bins), 0.0, 0.0, 0.0, 0
    for start in range(0, len(counts), TOGETHER):
        part = counts[start : start + TOGETHER].astype(np.float64)
        known = np.ones_like(part) if seen is None else seen[start : start + TOGETHER].astype(np.float64)
        number = np.maximum(known.sum(axis=1, keepdims=True), 1)
        rest = (part - (part * known).sum(axis=1, keepdims=True) / number) * known
        columns += rest.sum(axis=0)
        variance += float((rest**2 / number).sum())
        product += float((rest[:, 1:] * rest[:, :-1]).sum())
        square += float((rest[:, 1:] ** 2).sum())
        pairs += int((known[:, 1:] * known[:, :-1]).sum())
    if variance == 0 or not math.isfinite(square):
        return True  # nothing that could be told
    for width in SCALES:
        groups = bins // width
        sums = columns[: groups * width].reshape(groups, width).sum(axis=1)
        if groups > 1 and stats.chi2.sf((sums**2).sum() / (width * variance), groups - 1) < CHANCE:
            return True
    follow = product / square + 1 / bins
    if follow * math.sqrt(max(pairs, 1)) > stats.norm.isf(CHANCE):
        return True
    return capture.is_counts and len(returns(capture).first) > 0


def _outside(capture: Capture) -> str:
    """Where the light is instead, in words."""
    first, last = capture.gate
    mean = np.nan_to_num(capture.mean_transient())
    inside = mean[first:last].max()
    mean[first:last] = 0
    brightest = int(mean.argmax())
    if mean[brightest] <= inside:
        return ""
    return f", the brightest bin is {brightest} (mean {mean[brightest]:.3g}), outside of it"


def volume_without_light(capture: Capture, depth: tuple[float, float]) -> list[str]:
    """A volume in front of or behind all that sends light back.

    Args:
        capture: as it is fitted.
        depth: nearest and farthest voxel plane, m.

    Returns:
        Sentences.
    """
    from_light = plan_capture(capture, gate=capture.gate, sum_bins=1).depth
    if from_light is None or (depth[0] <= from_light[1] and from_light[0] <= depth[1]):
        return []
    return [
        f"the volume spans depths of {depth[0]:.4g} to {depth[1]:.4g} m, and light comes back from "
        f"{from_light[0]:.3g} to {from_light[1]:.3g} m: check scene.volume.depth, the bin width and t_start"
    ]


def _angle(cosine: float) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, float(cosine)))))


CHECKS: tuple[Callable[[Capture], list[str]], ...] = (
    largest_value,
    bin_width,
    wall_extent,
    normals,
    times,
    noise_alone,
)
