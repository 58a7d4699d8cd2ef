"""What happens to photons that are counted: dead time, afterpulses, memory that is not cleared."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.signal import fftconvolve
from wild_work import WildWork


def recorded(rate: np.ndarray, dead: int) -> np.ndarray:
    """Chance of a detection in every bin of a laser cycle, of a detector that is dead for a while after each.

    Args:
        rate: ``[S, T]`` photons a bin and cycle.
        dead: bins from a detection, its own included, in which no other is seen; at the start of a cycle the
            detector is ready.

    Returns:
        ``[S, T]`` chances.
    """
    seen, busy = np.zeros_like(rate), np.zeros(len(rate))
    chance = -np.expm1(-rate)
    for k in range(rate.shape[1]):
        if k >= dead:
            busy -= seen[:, k - dead]
        seen[:, k] = chance[:, k] * (1 - busy)
        busy += seen[:, k]
    return seen


def photon_by_photon(incident: np.ndarray, cycles: int, dead: int, rng: np.random.Generator) -> np.ndarray:
    """Counts ``[S, T]`` of a detector with dead time, photon by photon.

    Each photon falls into a cycle of its own choice; it is seen unless one was seen up to ``dead - 1`` bins
    before it in the same cycle.
    """
    bins = incident.shape[1]
    photons = rng.poisson(incident)
    spot, time = (np.repeat(n, photons.ravel()) for n in np.divmod(np.arange(photons.size), bins))
    # A gap longer than the dead time between cycles, so that one comparison says both.
    stride = bins + dead
    place = np.sort((spot * cycles + rng.integers(0, cycles, len(spot))) * stride + time)
    if len(place) == 0:
        return photons
    cycle = place // stride
    now = np.flatnonzero(np.diff(cycle, prepend=-1))
    kept = [now]
    while len(now):
        following = np.searchsorted(place, place[now] + dead)
        inside = following < len(place)
        following, before = following[inside], now[inside]
        now = following[cycle[following] == cycle[before]]
        kept.append(now)
    seen = place[np.concatenate(kept)]
    bin_ = seen // (cycles * stride) * bins + seen % stride
    return np.bincount(bin_, minlength=photons.size).reshape(photons.shape)


def pile_up(work: WildWork, detections: float) -> dict[str, float]:
    """Dead time of a part of the window, or more; so many ``detections`` a cycle on average."""
    bins = len(work.times)
    dead = int(bins * work.rng.uniform(0.25, 1.2))

    def cycles_of(m: np.ndarray) -> int:
        some = m[:: max(1, len(m) // 40)]

        def excess(log_cycles: float) -> float:
            return float(recorded(some / np.exp(log_cycles), dead).sum(axis=1).mean() - detections)

        mean = m.sum(axis=1).mean()
        return max(
            1, round(np.exp(brentq(excess, np.log(mean / 50), np.log(2 * mean / detections), xtol=0.01)))
        )

    def change(m: np.ndarray) -> np.ndarray:
        cycles = cycles_of(m)
        return cycles * recorded(m / cycles, dead)

    before = len(work.counting)

    def sampler(rng: np.random.Generator) -> np.ndarray:
        m = work.incident()
        for earlier in work.counting[:before]:
            m = earlier(m)
        return photon_by_photon(m, cycles_of(m), dead, rng)

    work.count(change, sampler)
    return {"detections": detections, "dead": dead * work.bin}


def afterpulses(work: WildWork, probability: float) -> dict[str, float]:
    """Two kinds of traps that let go of their charge after lifetimes of their own."""
    fast, slow = work.rng.uniform(5, 12), work.rng.uniform(30, 80)
    share = float(work.rng.uniform(0.3, 0.7))
    late = np.arange(1, len(work.times))
    kernel = np.zeros(len(work.times))
    kernel[0] = 1
    for part, decay in ((share, fast), (1 - share, slow)):
        # Normalised over all times: what comes after the window is lost.
        kernel[1:] += probability * part * np.exp(-late / decay) * np.expm1(1 / decay)
    work.count(lambda m: np.maximum(fftconvolve(m, kernel[None], axes=1)[:, : m.shape[1]], 0))
    return {"probability": probability, "share": share, "fast": fast * work.bin, "slow": slow * work.bin}


def crosstalk(work: WildWork, fraction: float) -> dict[str, float]:
    """Histograms that are not cleared: each spot leaves a share in the next ones, less and less."""
    again, turn = float(work.rng.uniform(0.3, 0.6)), work.turn

    def change(m: np.ndarray) -> np.ndarray:
        ordered, size = m[turn], fraction
        total = ordered.copy()
        for k in range(1, 6):
            total[k:] += size * ordered[:-k]
            size *= again
        counts = np.empty_like(m)
        counts[turn] = total
        return counts

    work.count(change)
    return {"fraction": fraction, "again": again}
