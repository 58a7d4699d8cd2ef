"""What looks wrong in a capture: each check one function, from a capture to sentences.

A check that is statistical speaks of a capture that is as it should be with a probability of at most
``CHANCE``: for Poisson counts, for spots whose unevenness has exponential tails, or for fair coins, as each
says. On top of that the scatter of counts must be wrong enough to matter (``MATTERS``).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from data_modules.plan import light_of
from data_modules.readers.assemble import counted, direct_pulse, smooth
from data_modules.scan_direction import scan_direction
from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import find_lattice, scan_geometry
from nlos_lit.capture.errors import CaptureError

CHANCE = 1e-6  # of a false alarm, a check and capture
MATTERS = 0.1  # relative error of all standard errors from which on a wrong scatter is told
SPOTS_LOOKED_AT = 1024  # of large scans every n-th, where a check goes over spots one by one
NEIGHBOURS = 8
CHANGED = "that somebody changed? Give them as measured"


def suspicions(capture: Capture) -> tuple[str, ...]:
    """All that looks wrong, one sentence each; empty where nothing does."""
    return tuple(sentence for check in CHECKS for sentence in check(capture))


def gate_and_pulse(capture: Capture) -> list[str]:
    """A gate that holds the direct pulse or its tail, or a pulse that is not at path zero."""
    first, last = capture.gate
    mean = np.nan_to_num(capture.mean_transient())
    pulse = direct_pulse(mean, capture.bin_length, capture.t_start)
    if pulse is None:
        return []
    width = max(1, round(0.012 / capture.bin_length))
    level = smooth(mean, width)
    bright = mean[pulse] > 20 * np.median(mean)
    told = []
    if first <= pulse + width and bright:
        told.append(
            f"the gate begins at bin {first}, at or before the direct pulse's peak (bin {pulse}); "
            "begin it behind the pulse"
        )
    elif (
        level[first] > 0.1 * level[first:last].max()
        and level[first] > 1.5 * level[min(first + 8 * width, last - 1)]
    ):
        told.append(f"the gate begins at bin {first} before the direct pulse has decayed; begin it later")
    above = mean > mean[pulse] / 2
    left = pulse - int(np.argmin(above[pulse::-1])) if not above[: pulse + 1].all() else 0
    right = pulse + int(np.argmin(above[pulse:]))
    path = capture.t_start + (pulse + 0.5) * capture.bin_length
    if capture.confocal and bright and abs(path) > max(right - left, 2) * capture.bin_length:
        told.append(
            f"the direct pulse peaks at path {path:.4g} m, more than its own width from zero; in a confocal "
            f"scan it is the wall's return at path 0: t_start={capture.t_start - path:.4g} would put it there"
        )
    return told


def distances(capture: Capture) -> list[str]:
    """Lengths that no scene and no wall has: wrong units, usually."""
    extent = capture.wall_extent
    told = []
    if extent > 10 or extent < 0.02:
        told.append(f"the wall is {extent:.3g} m across; check wall_size")
    if capture.bin_width_ps > 500 or capture.bin_width_ps < 0.5:
        told.append(f"bins of {capture.bin_width_ps:.3g} ps are unusual; check bin_width_ps")
    return told


def whole_numbers(capture: Capture) -> list[str]:
    """Values that were photon counts before somebody scaled them or took their root."""
    values = capture.counts[:: max(1, capture.n_spots // SPOTS_LOOKED_AT)]
    levels = np.unique(values[values > 0]).astype(np.float64)
    if counted(levels):
        step = int(np.gcd.reduce(levels[levels < 2**53].astype(np.int64)))  # beyond, floats are all even
        if step > 1 and len(levels) * math.log(step) > -math.log(CHANCE):
            return [f"every value is a multiple of {step}: photon counts {CHANGED}"]
        return []
    for power, what in ((1, "a whole number"), (2, "the square root of a whole number")):
        unit = common_unit(levels**power)
        if unit is not None:
            times = "" if abs(unit - 1) < 1e-4 else f" times {unit ** (1 / power):.6g}"
            return [f"every value is {what}{times}: photon counts {CHANGED}"]
    if capture.is_counts:
        return ["the values are taken as photon counts but are not whole numbers; check counts"]
    return []


def common_unit(levels: np.ndarray) -> float | None:
    """The number of which all values are whole multiples, where that is no chance.

    Args:
        levels: ``[K]`` distinct positive values, ascending, as precise as float32.

    Returns:
        The largest such number; None where there is none, or the values are too few, or too many of them are
        too large to tell.

    Examples:
        >>> counts = np.array([1.0, 2, 3, 4, 5, 7, 11, 12])
        >>> round(common_unit(0.3 * counts), 6)
        0.3
        >>> common_unit(np.sqrt(counts)) is None
        True
    """
    slack = 0.02  # of a whole number, to either side
    if len(levels) < 2:
        return None
    unit = float(np.diff(levels, prepend=0.0).min())
    near = levels[levels < 200 * unit]
    if len(near):
        steps = np.rint(near / unit)
        unit = float((near * steps).sum() / (steps**2).sum())
    telling = levels[levels < slack * 2**22 * unit]
    steps = np.rint(telling / unit)
    whole = bool((np.abs(telling / unit - steps) < slack).all())
    enough = len(telling) * -math.log(2 * slack) > -math.log(CHANCE) and 2 * len(telling) >= len(levels)
    # Numbers of few digits (half floats, RGBE) are multiples, too, but the larger ones of a larger unit.
    upper = steps[len(steps) // 2 :].astype(np.int64)
    return unit if whole and enough and np.gcd.reduce(upper) == 1 else None


def scatter(capture: Capture) -> list[str]:
    """Counts that scatter more or less along time than Poisson counts do."""
    if not (capture.is_counts and counted(capture.counts)):
        return []
    quiet, whole = dispersion(capture, 0.25), dispersion(capture, 1.0)
    told: list[str] = []
    for (factor, error), wrong in ((quiet, 1), (quiet, -1), (whole, -1)):
        significant = wrong * (factor - 1) > stats.norm.isf(CHANCE / 3) * error
        if significant and wrong * (math.sqrt(factor) - 1) > MATTERS and not told:
            kind, cause = (
                ("more", "are they photon counts, and was the light steady?")
                if wrong > 0
                else ("less", "were they smoothed, averaged, interpolated, or their root taken?")
            )
            told.append(
                f"the counts scatter {kind} along time than photons do: their variance is {factor:.2f} "
                f"± {error:.2f} of their mean (Poisson: 1); {cause}"
            )
    return told


def dispersion(capture: Capture, share: float) -> tuple[float, float]:
    """Variance over mean of the gated counts by their second differences along time.

    (a − 2b + c)² has the mean λ_a + 4λ_b + λ_c for Poisson counts whose expectation is straight over three
    bins. Where it bends, the ratio comes out too large, never too small; so the quietest bins are taken, as
    every other spot shows them, and measured on the spots between.

    Args:
        capture: photon counts.
        share: of the gate's bins that are taken, the quietest.

    Returns:
        The ratio and its standard error, by the spread over spots; ``(1, inf)`` where there are no counts.
    """
    first, last = capture.gate
    counts = capture.counts[:, first:last].astype(np.float64)
    if last - first < 3 or len(counts) < 4:
        return 1.0, math.inf
    a, b, c = counts[:, :-2], counts[:, 1:-1], counts[:, 2:]
    squares, means = (a - 2 * b + c) ** 2, a + 4 * b + c
    observed = capture.gated_observed()
    if observed is not None:
        three = observed[:, :-2] & observed[:, 1:-1] & observed[:, 2:]
        squares, means = squares * three, means * three
    level = means[::2].sum(axis=0)
    ranked = np.argsort(np.where(level > 0, level, np.inf), kind="stable")
    chosen = ranked[: math.ceil(share * np.count_nonzero(level))]
    above, below = squares[1::2, chosen].sum(axis=1), means[1::2, chosen].sum(axis=1)
    if below.sum() == 0:
        return 1.0, math.inf
    ratio = float(above.sum() / below.sum())
    return ratio, float(np.sqrt(((above - ratio * below) ** 2).sum()) / below.sum())


def saturation(capture: Capture) -> list[str]:
    """A largest value that is held more often than the tail of a distribution holds one."""
    if not counted(capture.counts):
        return []
    most = capture.counts.max()
    width = math.ceil(math.sqrt(float(most)))  # one standard deviation of the counts
    top = capture.counts == most
    beside = np.count_nonzero(capture.counts >= most - width) - np.count_nonzero(top) if most > width else 0
    number = int(np.count_nonzero(top))
    if most <= width or stats.poisson.sf(number - 1, max(beside, 1) / width) > CHANCE:
        return []
    inside = int(np.count_nonzero(top[:, slice(*capture.gate)]))
    return [
        f"{number} bins hold exactly the largest value {most:g} ({inside} of them in the gate), where "
        f"{beside / width:.2g} were to be expected: the counter is saturated; give fewer counts a bin, or a "
        "gate without them"
    ]


def not_recorded(capture: Capture) -> list[str]:
    """Spots without any recorded bin, whole lines of them, and spots that are cropped inside the gate."""
    observed = capture.gated_observed()
    if observed is None:
        return []
    dead = np.asarray(~observed.any(axis=1))
    cropped = ~observed.all(axis=1) & ~dead
    told = []
    if dead.any():
        told.append(f"{dead.sum()} of {capture.n_spots} spots are dead{_lines(capture, dead)}; left out")
    if cropped.any():
        inside = capture.gate[0] + np.flatnonzero(observed[~dead].all(axis=0))
        whole = max(np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1), key=len)
        told.append(
            f"{cropped.sum()} of {capture.n_spots} spots are cropped inside the gate; "
            + (f"bins {whole[0]} to {whole[-1]} are whole; " if len(whole) else "")
            + "the bins that were not recorded are left out"
        )
    return told


def empty_spots(capture: Capture) -> list[str]:
    """Spots without counts beside spots with so many that it is no chance."""
    totals, whole = _totals(capture)
    empty = np.asarray(whole & (totals == 0))
    if not empty.any() or len(totals) <= NEIGHBOURS:
        return []
    beside = np.median(totals[_neighbours(capture, np.flatnonzero(empty))], axis=1)
    if capture.is_counts and beside.max() < math.log(capture.n_spots / CHANCE):
        return []
    return [f"{empty.sum()} of {capture.n_spots} spots hold no counts in the gate{_lines(capture, empty)}"]


def cropped_spots(capture: Capture) -> list[str]:
    """Zeros that begin or end in the very same bin at many spots, and that the others' counts speak against.

    Light comes at another time at every spot; a crop does not. Runs of zeros count where they are no chance
    at the spot's own mean. Their edges must pile up in one bin and not in that on its empty side, and more
    spots must be empty there than would be by chance at the mean of all, each as bright as it is in its other
    bins.
    """
    if not capture.is_counts:
        return []
    first, last = capture.gate
    counts = capture.counts[:, first:last]
    observed = capture.gated_observed()
    zeros = (counts == 0) if observed is None else (counts == 0) & observed
    padded = np.zeros((len(zeros), last - first + 2), dtype=np.int8)
    padded[:, 1:-1] = zeros
    change = np.diff(padded, axis=1)
    spot, begin = np.nonzero(change == 1)
    end = np.nonzero(change == -1)[1]
    total = counts.sum(axis=1, dtype=np.float64)
    long = total[spot] / (last - first) * (end - begin) > math.log(zeros.size / CHANCE)
    begin, end = begin[long], end[long]
    for edges, what, empty_side in ((end, "up to", -1), (begin, "from", 1)):
        number = np.bincount(edges, minlength=last - first + 1)
        number[[0, last - first]] = 0  # the gate's own edges
        at = int(np.argmax(number))
        beside = max(1, number[at + empty_side]) if number[at] else 1
        if stats.poisson.sf(number[at] - 1, beside) > CHANCE / (last - first):
            continue
        alike = edges == at  # nearly all of these runs hold the bins [a, b)
        a, b = int(np.quantile(begin[alike], 0.9)), int(np.quantile(end[alike], 0.1))
        inside = counts[:, a:b].sum(axis=1, dtype=np.float64)
        outside = total - inside
        expected = outside * inside.sum() / outside.sum()
        empty = int(np.count_nonzero(zeros[:, a:b].all(axis=1)))
        if stats.poisson.sf(empty - 1, np.exp(-expected).sum()) < CHANCE / (last - first):
            return [
                f"{empty} of {capture.n_spots} spots hold zeros {what} bin {first + at}, at {number[at]} of "
                "them exactly, where others hold counts: cropped, not dark? Mark those bins as not recorded "
                "(docs/own-data.md), or choose another gate"
            ]
    return []


def empty_ends(capture: Capture) -> list[str]:
    """A gate whose first or last bins are empty at all spots, and that full light borders on.

    Light comes and goes by and by: bins beside one that holds so many counts would not all be empty.
    """
    first, last = capture.gate
    if not capture.is_counts:
        return []
    total = capture.counts[:, first:last].sum(axis=0, dtype=np.float64)
    filled = np.flatnonzero(total)
    if not len(filled):
        return []
    a, b = int(filled[0]), int(filled[-1])
    ends = [(0, a, a), (b + 1, last - first, b)]
    if not any(begin < end and total[edge] > -math.log(CHANCE) for begin, end, edge in ends):
        return []
    return [
        f"only bins {first + a} to {first + b} of the gate hold counts, and they begin or end with many: the "
        "rest is cropped, not dark; choose the gate accordingly"
    ]


def uneven_spots(capture: Capture) -> list[str]:
    """Spots, or lines of them, far brighter or darker than their neighbours in the scan."""
    totals, whole = _totals(capture)
    looked_at = np.flatnonzero(whole & (totals > 0))
    if len(looked_at) < 4 * NEIGHBOURS:
        return []
    beside = np.median(totals[_neighbours(capture, looked_at)], axis=1)
    looked_at, beside = looked_at[beside > 0], beside[beside > 0]
    excess = np.log(totals[looked_at] / beside)
    told = []
    for sign, what in ((1, "brighter"), (-1, "darker")):
        found = apart(sign * excess)
        if len(found):
            marked = np.zeros(capture.n_spots, dtype=bool)
            marked[looked_at[found]] = True
            factor = math.exp(float(np.median(np.abs(excess[found]))))
            where = _lines(capture, marked) or f" (first: spot {looked_at[found].min()})"
            told.append(
                f"{len(found)} of {capture.n_spots} spots are {factor:.3g} times {what} than their "
                f"neighbours{where}: {'hot' if sign > 0 else 'weak or partly dead'}? "
                "Leave them out (observed=) or say why"
            )
    return told


def _totals(capture: Capture) -> tuple[np.ndarray, np.ndarray]:
    """Each spot's counts in the gate, and whether it recorded all of them."""
    totals = capture.counts[:, slice(*capture.gate)].sum(axis=1, dtype=np.float64)
    observed = capture.gated_observed()
    if observed is None:
        return totals, np.ones(len(totals), dtype=bool)
    return totals, np.asarray(observed.all(axis=1))


def _neighbours(capture: Capture, spots: np.ndarray) -> np.ndarray:
    """The ``NEIGHBOURS`` spots nearest to each of some spots, laser and sensor point together."""
    places = np.concatenate([capture.laser, capture.sensor], axis=1)
    return cKDTree(places).query(places[spots], NEIGHBOURS + 1)[1][:, 1:]


def apart(values: np.ndarray) -> np.ndarray:
    """Indices of the largest values where a gap sets them apart from the rest.

    In an exponential tail of scale σ (which is heavier than a Gaussian's) a gap between neighbouring values
    exceeds g with a probability of at most exp(−g/σ); σ is the mean excess of the values below the gap.

    Args:
        values: ``[N]``.

    Returns:
        ``[K]`` indices, none where there is no such gap above the upper twentieth.

    Examples:
        >>> values = np.random.default_rng(0).normal(size=400)
        >>> apart(values).tolist()
        []
        >>> values[7] = 20.0
        >>> apart(values).tolist()
        [7]
    """
    order = np.argsort(-values, kind="stable")
    ranked = values[order]
    most = max(1, len(values) // 20)
    behind = max(2 * NEIGHBOURS, most)
    for number in range(min(most, len(values) - behind - 1), 0, -1):
        rest = ranked[number : number + behind + 1]
        scale = float((rest[:-1] - rest[-1]).mean())
        if scale > 0 and ranked[number - 1] - ranked[number] > scale * math.log(most / CHANCE):
            return order[:number]
    return order[:0]


def _lines(capture: Capture, marked: np.ndarray) -> str:
    """Rows and columns of the scan of which most spots are marked, in words."""
    if capture.scan_shape is None or len(capture.scan_shape) != 2:
        return ""
    grid = marked.reshape(capture.scan_shape)
    told = []
    for axis, name in ((1, "column"), (0, "row")):
        full = np.flatnonzero(2 * grid.sum(axis=axis) > grid.shape[axis])
        if len(full) and len(full) < grid.shape[1 - axis]:
            along = "x" if axis == 1 else "y"
            told.append(f"{name} {', '.join(str(n) for n in full[:4])} along {along}")
    return f" ({'; '.join(told)})" if told else ""


def wall(capture: Capture) -> list[str]:
    """Wall points off a plane, or a plane that is not z = 0, by more than one bin of path there and back."""
    points = np.unique(np.round(np.concatenate([capture.laser, capture.sensor]), 6), axis=0)
    if len(points) < 4:
        return []
    centre = points.mean(axis=0)
    spread, axes = np.linalg.svd(points - centre, full_matrices=False)[1:]
    if spread[1] < 1e-6 * spread[0]:  # on one line
        return []
    bin_depth = capture.bin_length / 2
    off = float(np.abs((points - centre) @ axes[2]).max())
    if off > bin_depth:
        return [
            f"the wall points lie up to {off:.3g} m off their plane, a bin is {bin_depth:.2g} m there and "
            "back: methods for a flat wall (lct, fk, the fast phasor image) do not fit; check the positions"
        ]
    away = float(np.abs(points[:, 2]).max())
    if away > bin_depth:
        tilt = math.degrees(math.acos(min(1.0, abs(float(axes[2, 2])))))
        return [
            f"the wall's plane reaches z = {away:.3g} m (tilted by {tilt:.2g}°); the frame has it at z = 0, "
            "and depths are counted from there (docs/own-data.md)"
        ]
    return []


def spacing(capture: Capture) -> list[str]:
    """A scan that is no regular lattice."""
    if scan_geometry(capture) is not None:
        return []
    moving = capture.laser if np.ptp(capture.laser, axis=0).max() > 0 else capture.sensor
    try:
        find_lattice(moving)
        reason = "laser and sensor points both move"
    except CaptureError as error:
        reason = str(error)
    return [
        f"the spots form no regular lattice ({reason}): images come from direct sums, which is slow, and lct "
        "and fk do not work"
    ]


def strange_depths(capture: Capture, depths: np.ndarray) -> list[str]:
    """First returns at a depth that no scene has.

    Args:
        capture: as read.
        depths: ``[K]`` half the path of the first returns, m.

    Returns:
        Sentences.
    """
    if not len(depths):
        return []
    depth = float(np.median(depths))
    if depth > 10:
        return [
            f"the bin width implies a scene {depth:.0f} m away; "
            f"check bin_width_ps (now {capture.bin_width_ps:g} ps)"
        ]
    if depth < 0.02:
        return [
            f"the first returns come from {100 * depth:.1f} cm; check the bin width, t_start and the gate"
        ]
    return []


def time_order(capture: Capture) -> list[str]:
    """Light that rises more slowly than it falls, at more spots than fair coins would allow.

    A pulse, its tail, and the falloff with distance all make transients rise faster than they fall. Compared
    are the counts within 1 ns (0.3 m of path, half of it to either side) of a spot's peak, where that stands
    out (:func:`~data_modules.plan.light_of`); and, where they do not tell, the steepest rise within 80 ps and
    the steepest fall.
    """
    first, last = capture.gate
    half = max(1, round(0.006 / capture.bin_length))
    reach = half + max(2, round(0.15 / capture.bin_length))
    step = max(1, round(0.024 / capture.bin_length))
    around_peak, steepest = [], []
    for spot in range(0, capture.n_spots, max(1, capture.n_spots // SPOTS_LOOKED_AT)):
        counts = capture.counts[spot, first:last].astype(np.float64)
        level = smooth(counts, 2 * half + 1)
        if len(level) <= step or not light_of(level, 2 * half + 1, capture.is_counts)[2]:
            continue
        change = level[step:] - level[:-step]
        steepest.append(change.max() + change.min())
        peak = int(np.argmax(level))
        side = min(reach, peak, last - first - 1 - peak)
        if side > half:
            behind = counts[peak + half + 1 : peak + side + 1].sum()
            around_peak.append(behind - counts[peak - side : peak - half].sum())
    for votes in (around_peak, steepest):
        slow, fast = (sum(sign * vote > 0 for vote in votes) for sign in (-1, 1))
        if stats.binom.sf(fast - 1, slow + fast, 0.5) < CHANCE:
            return []
        if stats.binom.sf(slow - 1, slow + fast, 0.5) < CHANCE:
            return [
                f"at {slow} of {slow + fast} spots light rises more slowly than it falls; does time run "
                "backwards in the file?"
            ]
    return []


def scan_lines(capture: Capture) -> list[str]:
    """Light of the quiet bins that changes along the lines of the scan, and hardly from one to the next."""
    found = scan_direction(capture) if capture.is_counts else None
    if found is None or not found.turned or found.chance > CHANCE:
        return []
    times = found.along / max(found.across, 0.01)
    return [
        f"the light of bins without scene changes {times:.2g} times more along the lines of the scan than "
        "across them: it seems to have been taken along the other axis; say so (scan_order=columns, or "
        "raster where it says columns), or effects that follow the scan are sought in the wrong order"
    ]


CHECKS: tuple[Callable[[Capture], list[str]], ...] = (
    gate_and_pulse,
    distances,
    whole_numbers,
    scatter,
    saturation,
    not_recorded,
    empty_spots,
    cropped_spots,
    empty_ends,
    uneven_spots,
    wall,
    spacing,
    time_order,
    scan_lines,
)
