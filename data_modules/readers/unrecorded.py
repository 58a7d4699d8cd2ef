"""Bins that a file holds as zeros but that nobody recorded: dead spots, and spots cut shorter than others."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np

CHANCE = 1e-9  # probability that a capture with every bin recorded has any run of zeros that is taken for one
UNLIKE = 1e-3  # share of the spots that may be weak or dark for reasons of their own, and say nothing


class _Runs(NamedTuple):
    """Runs of zeros: spot, first bin, bin after the last; ``[R]`` each."""

    spot: np.ndarray
    first: np.ndarray
    last: np.ndarray

    @property
    def length(self) -> np.ndarray:
        return self.last - self.first

    def take(self, which: np.ndarray) -> _Runs:
        return _Runs(*(values[which] for values in self))


def find_unrecorded(counts: np.ndarray, cropped: bool = False) -> tuple[np.ndarray | None, list[str]]:
    """Runs of zeros where the other spots say that many counts must be.

    A run is compared with the other spots that hold counts in its bins; they must be more than half of all.
    Their counts there (the weakest of them but for one in a thousand, times this spot's level in the bins
    outside the run, at most 1) are λ, and zeros have the probability exp(-λ). Dark spots and low counts give
    a small λ and stay. Where more than one in a thousand of the others is itself without counts for half as
    long, no further away than that, light may merely come later or end sooner at this spot, and its zeros
    stay too. A spot without any count is compared by the others' totals.

    Bins that are empty in every spot are left as they are, since nothing tells them from the time before the
    first light, unless the format is known to cut its captures.

    Args:
        counts: ``[S, T]`` photon counts.
        cropped: the format cuts bins off: those at both ends that are empty in every spot, next to a bin with
            many counts, were not recorded.

    Returns:
        ``[S, T]`` bool, True where a bin was recorded (None: everywhere), and what was found, in words.

    Examples:
        Of a hundred spots with about two counts a bin, one begins 40 bins late, and one is dead:

        >>> counts = np.random.default_rng(0).poisson(2.0, (100, 80))
        >>> counts[7, :40] = 0
        >>> counts[31] = 0
        >>> observed, told = find_unrecorded(counts)
        >>> (~observed).sum(axis=1)[[6, 7, 31]].tolist()
        [0, 40, 80]
        >>> told[0]
        'not recorded: all bins of 1 of 100 spots (no count where others hold many)'
    """
    spots, bins = counts.shape
    filled = np.flatnonzero(counts.any(axis=0))
    if len(filled) == 0:
        return None, []
    start, end = int(filled[0]), int(filled[-1]) + 1
    zeros = _zero_runs(counts, start, end)
    enough = float(np.log(max(1, len(zeros.spot)) / CHANCE))
    found = _found(counts, zeros, enough)
    observed = np.ones((spots, bins), dtype=bool)
    for spot, first, last in zip(*found, strict=True):
        whole = (first, last) == (start, end)
        observed[spot, slice(None) if whole else slice(first, last)] = False
    told = _words(found, (start, end), spots)
    if cropped:
        edges = ((0, start, start), (end, bins, end - 1))
        cut = [(a, b) for a, b, edge in edges if a < b and counts[:, edge].sum(dtype=np.float64) > enough]
        for a, b in cut:
            observed[:, a:b] = False
        if cut:
            told.append(
                f"not recorded: bins {' and '.join(f'[{a}, {b})' for a, b in cut)} of all spots (cut off)"
            )
    return (None, []) if observed.all() else (observed, told)


def _zero_runs(counts: np.ndarray, start: int, end: int) -> _Runs:
    """Every run of zeros within bins ``[start, end)``."""
    padded = np.zeros((len(counts), end - start + 2), dtype=np.int8)
    padded[:, 1:-1] = counts[:, start:end] == 0
    change = np.diff(padded, axis=1)
    spot, first = np.nonzero(change == 1)
    return _Runs(spot, start + first, start + np.nonzero(change == -1)[1])


def _found(counts: np.ndarray, zeros: _Runs, enough: float) -> _Runs:
    """The runs whose zeros are no chance.

    Args:
        counts: ``[S, T]``.
        zeros: all runs of zeros.
        enough: -ln of the probability that a run must fall below.

    Returns:
        some of the runs.
    """
    mean = np.concatenate([[0.0], np.cumsum(counts.mean(axis=0, dtype=np.float64))])
    # More than half of the spots must hold counts there, so their mean is at most twice that of all.
    runs = zeros.take((zeros.length > 1) & (2 * (mean[zeros.last] - mean[zeros.first]) > enough))
    if len(runs.spot) == 0:
        return runs
    edges = np.unique(np.concatenate([runs.first, runs.last]))
    total = counts.sum(axis=1, dtype=np.float64)
    parts = np.add.reduceat(counts[:, : edges[-1]], edges[:-1], axis=1, dtype=np.float64)
    upto = np.concatenate([np.zeros((len(counts), 1)), np.cumsum(parts, axis=1)], axis=1)  # from edges[0] on
    whole = np.ones(len(counts), dtype=bool)
    order = np.lexsort((runs.last, runs.first, runs.length))
    alike = np.flatnonzero((np.diff(runs.first[order]) != 0) | (np.diff(runs.last[order]) != 0)) + 1
    chosen = np.zeros(len(order), dtype=bool)
    groups, found = np.split(order, alike), True
    while found:  # again, since spots that were found in one round misled it
        found = False
        for same in groups:
            first, last = int(runs.first[same[0]]), int(runs.last[same[0]])
            a, b = np.searchsorted(edges, (first, last))
            inside = upto[:, b] - upto[:, a]
            others = whole & (inside > 0)
            if chosen[same].all() or 2 * np.count_nonzero(others) <= len(counts):
                continue
            level = np.quantile(inside[others], UNLIKE)
            outside = (total - inside)[runs.spot[same]]
            share = np.minimum(outside / max((total - inside)[others].mean(), 1e-300), 1.0)
            dead = outside == 0
            likely = ~chosen[same] & (np.where(dead, 1.0, share) * level > enough)
            if likely.any() and not dead.all() and _dark_beside(zeros, others, first, last):
                likely &= dead
            chosen[same[likely]] = True
            whole[runs.spot[same[likely]]] = False
            found |= bool(likely.any())
    return runs.take(chosen)


def _dark_beside(zeros: _Runs, others: np.ndarray, first: int, last: int) -> bool:
    """Whether zeros for half as long as ``[first, last)``, near it, are no rarity in other spots."""
    half = (last - first) / 2
    near = (zeros.length >= half) & (zeros.last > first - half) & (zeros.first < last + half)
    dark = np.unique(zeros.spot[near & others[zeros.spot]])
    return len(dark) > UNLIKE * int(np.count_nonzero(others))


def _words(found: _Runs, whole: tuple[int, int], spots: int) -> list[str]:
    """What was not recorded: dead spots, then the runs that most spots share, then how many others."""
    runs = Counter(zip(found.first.tolist(), found.last.tolist(), strict=True))
    dead = runs.pop(whole, 0)
    told = (
        [f"not recorded: all bins of {dead} of {spots} spots (no count where others hold many)"]
        if dead
        else []
    )
    common = runs.most_common(3)
    told += [
        f"not recorded: bins [{first}, {last}) of {number} of {spots} spots (zeros where others hold many)"
        for (first, last), number in common
    ]
    rest = runs.total() - sum(number for _, number in common)
    if rest:
        told.append(f"not recorded: {rest} more runs of zeros where other spots hold many counts")
    return told
