"""From a file's arrays to a `Capture` in the world frame: what every reader does last."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from data_modules.readers.options import ReaderOptions
from data_modules.readers.unrecorded import find_unrecorded
from nlos_lit.capture import SPEED_OF_LIGHT, Capture
from nlos_lit.capture.errors import CaptureError

COMMON_OPTIONS = frozenset(
    {
        "t_start",
        "gate",
        "flip_x",
        "flip_y",
        "swap_xy",
        "scan_order",
        "exposure_s",
        "counts",
        "observed",
    }
)
log = logging.getLogger(__name__)
DIRECT_PULSE_PATH = 0.3  # m; a pulse later than this is not the wall's own return
USUAL_GATE_PATH = 0.72  # m; the 600 bins of 4 ps that the LCT's authors cut
TAIL_FRACTION = 1e-4  # of the direct pulse's peak, where its tail is taken to have ended


def assemble(
    path: Path,
    fmt: str,
    options: ReaderOptions,
    *,
    counts: np.ndarray,
    laser: np.ndarray,
    sensor: np.ndarray,
    bin_length: float,
    shape: tuple[int, ...] | None,
    t_start: float = 0.0,
    gate: tuple[int, int] | None = None,
    behind_pulse: bool = False,
    laser_normal: np.ndarray | None = None,
    sensor_normal: np.ndarray | None = None,
    is_counts: bool | None = None,
    exposure_s: float | None = None,
    scan_order: np.ndarray | None = None,
    listed: np.ndarray | None = None,
    observed: np.ndarray | None = None,
    find_observed: bool = True,
    cropped: bool = False,
    steps: list[str] | None = None,
    facts: dict[str, Any] | None = None,
) -> Capture:
    """Apply the options, put the spots in the order x, y ascending, and build the capture.

    Args:
        path: the file, for the provenance.
        fmt: name of the format, for the provenance.
        options: what the user says; it overrides what the file says.
        counts: ``[S, T]`` in the file's order of spots.
        laser: ``[S, 3]`` lit wall points in the world frame, m.
        sensor: ``[S, 3]`` observed wall points, m.
        bin_length: optical path of one bin, m.
        shape: scanned grid, in the file's order of axes; None for irregular spots.
        t_start: path length at the start of bin 0, m.
        gate: ``(first, last)`` bins that may be fitted; None for all.
        behind_pulse: choose the gate by `gate_after_direct_pulse`, where the user gives none.
        laser_normal: ``[S, 3]`` wall normals at ``laser``; None for +z.
        sensor_normal: ``[S, 3]`` wall normals at ``sensor``; None for +z.
        is_counts: None to tell by whether all values are whole numbers.
        exposure_s: exposure per spot, s, where the file says it.
        scan_order: ``[S]`` rank of each spot, where the file says it.
        listed: ``[S]`` for a file that lists its spots: the row of that list which each spot comes from.
        observed: ``[S, T]`` bool, the bins that were recorded, where the file says it.
        find_observed: look for bins that were not recorded (:func:`find_unrecorded`), where the values are
            counts and the user does not say otherwise.
        cropped: the format cuts bins off that are empty in every spot.
        steps: what was done to the data, for the provenance.
        facts: further provenance.

    Returns:
        the capture in the world frame.

    Raises:
        CaptureError: the scan order does not fit the spots, or the data make no `Capture`.
    """
    steps = list(steps or [])
    spots = counts.shape[0]
    up = np.broadcast_to([0.0, 0.0, 1.0], (spots, 3))
    vectors = [
        np.asarray(v, dtype=np.float64)
        for v in (laser, sensor, _or(laser_normal, up), _or(sensor_normal, up))
    ]
    for name in ("swap_xy", "flip_x", "flip_y"):
        if getattr(options, name):
            vectors = [_mirror(vector, name) for vector in vectors]
            steps.append(f"{name} as asked")
    if options.t_start is not None:
        t_start = options.t_start
        steps.append(f"bin 0 begins at path {t_start:g} m as asked")
    if options.gate is not None:
        gate = options.gate
        steps.append(f"gate [{gate[0]}, {gate[1]}) as asked")
    elif behind_pulse:
        gate, told = gate_after_direct_pulse(counts, bin_length, t_start)
        steps.append(told)
    if is_counts is None:
        is_counts = counted(counts)
    if options.counts is not None:
        is_counts = options.counts
        steps.append(f"values are {'photon counts' if is_counts else 'expected values'} as asked")
    if options.observed is not None:
        observed = None
        steps.append("every bin was recorded, as asked")
    elif find_observed and is_counts:
        observed, found = find_unrecorded(counts, cropped)
        steps += found
        for told in found:
            log.info("%s: %s", path.name, told)
    rank = acquisition_order(options.scan_order, shape if listed is None else None, spots)
    if rank is None:
        rank = scan_order if scan_order is not None else listed
    elif listed is not None:
        rank = _permutation(rank, spots)[listed]
    if shape is not None:
        order = ascending_order(shape, vectors[0], vectors[1])
        shape = order.shape
        if not np.array_equal(order.ravel(), np.arange(spots)):
            rank = (np.arange(spots) if rank is None else _permutation(rank, spots))[order.ravel()]
            counts = counts[order.ravel()]
            observed = None if observed is None else observed[order.ravel()]
            vectors = [vector[order.ravel()] for vector in vectors]
            steps.append("spots ordered by x, then y")
    laser, sensor, laser_normal, sensor_normal = vectors
    return Capture(
        counts,
        laser,
        sensor,
        laser_normal,
        sensor_normal,
        bin_length=bin_length,
        t_start=t_start,
        gate=gate,
        scan_shape=shape,
        scan_order=rank,
        exposure_s=options.exposure_s if options.exposure_s is not None else exposure_s,
        is_counts=is_counts,
        provenance={"source": str(path), "format": fmt, **(facts or {}), "steps": steps},
        observed=observed,
    )


def cell_centres(number: int, side: float) -> np.ndarray:
    """Centres of equal cells of a line that is centred on 0.

    Args:
        number: of cells.
        side: length of the line, m.

    Returns:
        ``[number]`` centres, ascending, m.

    Examples:
        >>> cell_centres(4, 2.0).tolist()
        [-0.75, -0.25, 0.25, 0.75]
    """
    return side * ((np.arange(number) + 0.5) / number - 0.5)


def wall_points(first: np.ndarray, second: np.ndarray, axes: str) -> np.ndarray:
    """Points of a grid on the wall z = 0, in the file's order of axes.

    Args:
        first: ``[n₁]`` coordinates along the first file axis, m.
        second: ``[n₂]`` coordinates along the second, m.
        axes: world axes that the two run along, ``xy`` or ``yx``.

    Returns:
        ``[n₁·n₂, 3]`` points, the second axis changing fastest, m.

    Examples:
        >>> wall_points(np.array([1.0, 0.0]), np.array([5.0]), "yx").tolist()
        [[5.0, 1.0, 0.0], [5.0, 0.0, 0.0]]
    """
    a, b = (grid.ravel() for grid in np.meshgrid(first, second, indexing="ij"))
    x, y = (a, b) if axes == "xy" else (b, a)
    return np.stack([x, y, np.zeros_like(x)], axis=1)


def ascending_order(shape: tuple[int, ...], laser: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """File rows of a scan, with each pair of axes turned so that it runs along +x, +y.

    Args:
        shape: of the scan in the file, ``[n₁, n₂]`` or ``[l₁, l₂, s₁, s₂]``.
        laser: ``[S, 3]`` wall points in the world frame, m.
        sensor: ``[S, 3]`` wall points, m.

    Returns:
        indices of the file's rows, in the scan's shape in the world frame.

    Examples:
        A scan whose rows run from the top downwards and whose columns run along +x:

        >>> points = wall_points(np.array([0.1, -0.1]), np.array([-0.2, 0.2]), "yx")
        >>> ascending_order((2, 2), points, points).tolist()
        [[2, 0], [3, 1]]
    """
    order = np.arange(len(laser)).reshape(shape)
    scanned = laser if np.ptp(laser, axis=0).max() > 0 else sensor
    for axis in range(0, len(shape), 2):
        points = scanned if len(shape) == 2 else (laser, sensor)[axis // 2]
        first, second = (_run(points, order, axis + k) for k in (0, 1))
        if abs(first[1]) + abs(second[0]) > abs(first[0]) + abs(second[1]):
            order = order.swapaxes(axis, axis + 1)
            first, second = second, first
        if first[0] < 0:
            order = np.flip(order, axis)
        if second[1] < 0:
            order = np.flip(order, axis + 1)
    return order


def _run(points: np.ndarray, order: np.ndarray, axis: int) -> np.ndarray:
    """``[3]`` mean way from the first to the last point along a scan axis, m."""
    return (points[order.take(-1, axis)] - points[order.take(0, axis)]).reshape(-1, 3).mean(axis=0)


def grid_of(points: np.ndarray) -> tuple[np.ndarray, tuple[int, int]] | None:
    """Order in which listed points fill a rectangular grid exactly once; None where they do not.

    Args:
        points: ``[S, 3]`` (or ``[S, 2]``) wall points, m; coordinates closer than 1e-4 of the extent are one.

    Returns:
        ``[S]`` rows of the list, x then y ascending, and the grid's shape ``(nx, ny)``.

    Examples:
        >>> order, shape = grid_of(np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 2.0], [1.0, 2.0]]))
        >>> order.tolist(), shape
        ([1, 2, 0, 3], (2, 2))
        >>> grid_of(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 1.0]])) is None
        True
    """
    (column, nx), (row, ny) = _lines(points[:, 0]), _lines(points[:, 1])
    if nx * ny != len(points):
        return None
    cell = column * ny + row
    order = np.argsort(cell, kind="stable")
    return (order, (nx, ny)) if np.array_equal(cell[order], np.arange(len(points))) else None


def _lines(values: np.ndarray) -> tuple[np.ndarray, int]:
    """Which of the distinct coordinates each value is, and how many there are.

    Values closer than 1e-4 of the extent are one.
    """
    order = np.argsort(values, kind="stable")
    steps = np.diff(values[order], prepend=values[order[:1]]) > 1e-4 * max(float(np.ptp(values)), 1e-9)
    index = np.empty(len(values), dtype=np.int64)
    index[order] = np.cumsum(steps)
    return index, int(steps.sum()) + 1


def counted(values: np.ndarray) -> bool:
    """Whether an array can be photon counts: integers only."""
    return values.dtype.kind in "ui" or bool(np.array_equal(values, np.rint(values)))


def acquisition_order(
    wanted: str | np.ndarray | None, shape: tuple[int, ...] | None, spots: int
) -> np.ndarray | None:
    """Rank of each spot in the order of acquisition, in the file's order of spots.

    Args:
        wanted: ``raster`` (last axis fastest), ``serpentine`` (the same, every second line backwards),
            ``columns`` (first axis fastest), the ranks themselves, or None.
        shape: of the scanned grid in the file's order of axes; None where there is none.
        spots: number S of spots.

    Returns:
        ``[S]`` ranks; None where nothing was said.

    Raises:
        CaptureError: an unknown name, or one that needs a scanned grid where there is none.

    Examples:
        >>> acquisition_order("serpentine", (2, 3), 6).tolist()
        [0, 1, 2, 5, 4, 3]
        >>> acquisition_order("columns", (2, 3), 6).tolist()
        [0, 2, 4, 1, 3, 5]
    """
    if wanted is None:
        return None
    if not isinstance(wanted, str):
        return np.asarray(wanted)
    if wanted == "raster":
        return np.arange(spots)
    if shape is None or len(shape) != 2:
        raise CaptureError(
            f"scan_order {wanted!r} needs a file with one scanned grid; give each spot's rank instead"
        )
    raster = np.arange(spots).reshape(shape)
    if wanted == "serpentine":
        raster[1::2] = raster[1::2, ::-1]
        return raster.ravel()
    if wanted == "columns":
        return np.arange(spots).reshape(shape[::-1]).T.ravel()
    raise CaptureError(
        f"scan_order must be raster, serpentine, columns or an array of ranks; found {wanted!r}"
    )


def remove_delays(counts: np.ndarray, delays: np.ndarray) -> tuple[np.ndarray, float, str]:
    """Take a delay off each spot by whole bins, so that counts stay counts.

    Args:
        counts: ``[S, T]``.
        delays: ``[S]`` in bins, not negative.

    Returns:
        ``[S, T - longest]`` counts (no bin wraps round or is made up), the mean of what rounding left over
        (bins, to be added to the time of bin 0), and a sentence for the provenance.

    Raises:
        CaptureError: delays that are not finite or negative, or that leave no bin.

    Examples:
        >>> counts, offset, told = remove_delays(np.array([[0, 0, 7, 1], [5, 2, 0, 0]]), np.array([2.0, 0.0]))
        >>> counts.tolist(), offset
        ([[7, 1], [5, 2]], 0.0)
    """
    if not np.isfinite(delays).all() or delays.min() < 0:
        raise CaptureError("the delays to take off each spot must be finite and not negative")
    if delays.max() >= counts.shape[1] - 0.5:
        raise CaptureError(
            f"delays of up to {delays.max():.0f} bins leave nothing of the file's {counts.shape[1]} bins; "
            "check the bin width"
        )
    whole = np.rint(delays).astype(np.int64)
    left = counts.shape[1] - int(whole.max())
    shifted = np.empty((counts.shape[0], left), dtype=counts.dtype)
    for delay in np.unique(whole):
        rows = whole == delay
        shifted[rows] = counts[rows, delay : delay + left]
    rest = whole - delays
    offset = float(rest.mean())
    total = counts.sum(dtype=np.float64)
    lost = 1 - shifted.sum(dtype=np.float64) / total if total > 0 else 0.0
    off = np.abs(rest - offset).max()
    told = (
        f"took {whole.min()} to {whole.max()} bins off the spots' times (whole bins, at most {off:.2f} off; "
        f"{lost:.2%} of the counts fell outside the {left} bins that all spots share)"
    )
    return shifted, offset, told


def smooth(transient: np.ndarray, width: int) -> np.ndarray:
    """Running mean, edges repeated.

    Args:
        transient: ``[T]``.
        width: bins that each mean is taken over.

    Returns:
        ``[T]`` float64.

    Examples:
        >>> smooth(np.array([0, 3, 0, 0]), 3).tolist()
        [1.0, 1.0, 1.0, 0.0]
    """
    padded = np.pad(transient.astype(np.float64), (width // 2, width - 1 - width // 2), mode="edge")
    total = np.cumsum(np.concatenate([[0.0], padded]))
    return (total[width:] - total[:-width]) / width


def direct_pulse(mean: np.ndarray, bin_length: float, t_start: float = 0.0) -> int | None:
    """Bin of the wall's own return: the highest of the mean transient, if it comes near path zero.

    Args:
        mean: ``[T]`` transient averaged over the spots.
        bin_length: optical path of one bin, m.
        t_start: path length at the start of bin 0, m.

    Returns:
        the bin; None where the highest lies 0.3 m of path or more from path zero.

    Examples:
        >>> direct_pulse(np.array([0.0, 9.0, 1.0, 3.0]), bin_length=0.1)
        1
        >>> direct_pulse(np.array([0.0, 2.0, 1.0, 3.0]), bin_length=0.1) is None
        True
    """
    peak = int(np.argmax(mean))
    return peak if abs(t_start + (peak + 0.5) * bin_length) < DIRECT_PULSE_PATH else None


def gate_after_direct_pulse(
    counts: np.ndarray, bin_length: float, t_start: float = 0.0
) -> tuple[tuple[int, int], str]:
    """Bins behind the wall's own return.

    The mean transient has a valley between the pulse's tail and the largest later rise above the lowest level
    so far. The gate begins where the tail, above that valley, has sunk below 1e-4 of the pulse's peak for
    good. Without a later rise: 0.72 m of path (2.4 ns) behind the pulse.

    Args:
        counts: ``[S, T]``.
        bin_length: optical path of one bin, m.
        t_start: path length at the start of bin 0, m.

    Returns:
        ``(first, last)`` and a sentence for the provenance; all bins where there is no direct pulse.
    """
    bins = counts.shape[1]
    mean = counts.mean(axis=0, dtype=np.float64)
    peak = direct_pulse(mean, bin_length, t_start)
    if peak is None:
        return (0, bins), "gate: all bins (no direct pulse near path zero)"
    width = max(1, round(0.012 / bin_length))  # 40 ps
    level = smooth(mean, width)[peak:]
    lowest = np.minimum.accumulate(level)
    rise = np.divide(level, lowest, out=np.ones_like(level), where=lowest > 0)
    if (lowest == 0).any():
        rise[int(np.argmax(lowest == 0)) :] = level[int(np.argmax(lowest == 0)) :]
    top = int(np.argmax(rise))
    first = peak + round(USUAL_GATE_PATH / bin_length)
    rule = "2.4 ns behind the direct pulse"
    if rise[top] > 1.2 and top > 0:
        valley = int(np.argmin(level[: top + 1]))
        tail = np.flatnonzero(level[: valley + 1] - level[valley] >= TAIL_FRACTION * mean[peak])
        first = peak + (int(tail[-1]) + 1 if len(tail) else valley)
        rule = "where the direct pulse's tail has ended"
    if first >= bins:
        return (0, bins), "gate: all bins (the direct pulse fills the file)"
    return (first, bins), f"gate [{first}, {bins}): begins {rule}"


def bin_length_of(bin_width_ps: float) -> float:
    """Optical path of one bin of a width in ps, m.

    Examples:
        >>> bin_length_of(4.0)
        0.001199169832
    """
    return SPEED_OF_LIGHT * bin_width_ps * 1e-12


def _permutation(rank: np.ndarray, spots: int) -> np.ndarray:
    if rank.shape != (spots,):
        raise CaptureError(
            f"scan_order must give one rank for each of the {spots} spots; found shape {rank.shape}"
        )
    return rank


def _or(value: np.ndarray | None, default: np.ndarray) -> np.ndarray:
    return default if value is None else value


def _mirror(vectors: np.ndarray, name: str) -> np.ndarray:
    if name == "swap_xy":
        return vectors[:, [1, 0, 2]]
    return vectors * ([-1.0, 1.0, 1.0] if name == "flip_x" else [1.0, -1.0, 1.0])
