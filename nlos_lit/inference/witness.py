"""The direct pulse (first bounce), outside the gate and seen by no fit: does it agree with what was found?

Its energy at a spot is laser power × wall reflectance × collection, its decay the detector's slow tail, its
arrival the spot's own time zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.effects import EFFECTS
from nlos_lit.inference.per_spot import neighbours
from nlos_lit.surfels.fit import SurfelFit

LEAST = 20.0  # counts a spot before the gate that make a witness


def witness(capture: Capture, fit: SurfelFit) -> dict[str, Any] | None:
    """What the direct pulse says of the effects that have it as witness.

    Args:
        capture: with bins before its gate.
        fit: to the gate alone.

    Returns:
        Correlation of the fitted gain with the pulse's energy per spot, and what it is by chance, both tails'
        decays (m of path), the maps, and what single spots' delays, fitted and of the pulse, have over their
        neighbours (m of path) with their correlation; None without the pulse.
    """
    first = capture.gate[0]
    before = capture.counts[:, :first].sum(1, dtype=np.float64)
    if first == 0 or before.mean() < LEAST or not capture.confocal:
        return None
    found: dict[str, Any] = {
        "direct_pulse_counts": float(before.mean()),
        "wall_gain_correlation": None,
        "wall_gain_by_chance": None,
        "tail_decay_fitted_m": None,
        "tail_decay_direct_m": None,
        "maps": None,
        "delay_correlation": None,
        "delays": None,
    }
    gain = log_gain(fit, capture.n_spots)
    if gain is not None:
        energy = np.log(before.clip(1))
        found["wall_gain_correlation"] = float(np.corrcoef(gain, energy)[0, 1])
        if capture.scan_shape is not None and len(capture.scan_shape) == 2:
            shape, maps = capture.scan_shape, {"direct": before / before.mean(), "fitted": np.exp(gain)}
            found["maps"] = {name: m.reshape(shape).tolist() for name, m in maps.items()}
            found["wall_gain_by_chance"] = by_chance(gain.reshape(shape), energy.reshape(shape))
    slow = [e for e in fit.extension.effects if e.witness == "tail"]
    if slow:
        first_acting = min(slow, key=lambda e: EFFECTS.index(type(e)))
        found["tail_decay_fitted_m"] = float(first_acting.value("decay").detach())
        found["tail_decay_direct_m"] = direct_decays(capture)
    for effect in fit.extension.effects:
        if effect.witness == "delay":
            fitted = effect.value("offset").detach().reshape(-1).double().numpy()
            spots = np.flatnonzero(fitted)  # those of other spots stay at 0
            near = neighbours(capture, torch.from_numpy(spots)).numpy()
            delays = {
                "direct": over_neighbours(direct_delays(capture)[spots], near),
                "fitted": over_neighbours(fitted[spots], near),
            }
            found["delay_correlation"] = float(np.corrcoef(delays["direct"], delays["fitted"])[0, 1])
            found["delays"] = {name: d.tolist() for name, d in delays.items()}
    return found


def by_chance(one: np.ndarray, other: np.ndarray) -> float:
    """How well two maps agree where they should not: with one of them turned or mirrored.

    Smooth maps have few degrees of freedom. Two slopes in directions that know nothing of each other
    correlate by more than 0.7 in one of two cases.

    Args:
        one: ``[nx, ny]``.
        other: the same.

    Returns:
        The largest correlation, without its sign, over all other ways in which one fits the other.

    Examples:
        >>> rising = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
        >>> round(by_chance(rising, rising), 2)
        1.0
        >>> spot = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        >>> round(by_chance(spot, spot), 2)
        0.2
    """
    turns = range(4) if one.shape[0] == one.shape[1] else (0, 2)
    ways = [np.rot90(m, k) for k in turns for m in (other, other[::-1])][1:]
    return max(abs(float(np.corrcoef(one.ravel(), way.ravel())[0, 1])) for way in ways)


def direct_delays(capture: Capture) -> np.ndarray:
    """How much later each spot's direct pulse comes than the mean of all, m of path.

    Least squares in the mean pulse and its slope, weighted as counts are: to first order a pulse of any
    strength that is shifted is the sum of both. So it holds for a small part of the pulse's own width.

    Args:
        capture: with bins before its gate.

    Returns:
        ``[S]``.
    """
    counts = capture.counts[:, : capture.gate[0]].astype(np.float64)
    mean = counts.mean(0)
    columns = np.stack([mean, -np.gradient(mean)], 1)
    weighted = columns / mean.clip(1e-3 * mean.max())[:, None]
    strength, shifted = np.linalg.solve(columns.T @ weighted, weighted.T @ counts.T)
    return capture.bin_length * shifted / strength.clip(1e-9)


def over_neighbours(values: np.ndarray, near: np.ndarray) -> np.ndarray:
    """What each spot has over the mean of its nearest neighbours.

    What is smooth over the wall is no spot's own.

    Args:
        values: ``[S]``.
        near: ``[S, K]`` from :func:`~nlos_lit.inference.per_spot.neighbours`.

    Returns:
        ``[S]``.
    """
    return values - values[near].mean(1)


@torch.no_grad()
def log_gain(fit: SurfelFit, n_spots: int) -> np.ndarray | None:
    """Log of all fitted gains together that the direct pulse's energy must show, too.

    Args:
        fit: with effects.
        n_spots: of the capture.

    Returns:
        ``[S]``; None where no effect changes the gain.
    """
    acting = [e for e in fit.extension.effects if e.witness == "energy"]
    if not acting:
        return None
    spots, signal = torch.arange(n_spots), torch.ones(n_spots, 1)
    for effect in acting:
        signal = effect.gain(signal, spots)
    return signal[:, 0].log().numpy()


def direct_decays(capture: Capture) -> list[float] | None:
    """Decay lengths (m) of the mean direct pulse, early and late, of exponentials fitted behind its peak.

    The level before the gate's start is taken as background. Early is from 1/20 to 1/200 of the peak, late
    the rest down to three times the background.
    """
    mean = capture.counts[:, : capture.gate[0]].mean(0, dtype=np.float64)
    peak = int(mean.argmax())
    tail = mean[peak:]
    level = float(np.median(tail[-max(8, len(tail) // 8) :]))
    above = tail - level
    marks = [np.flatnonzero(above < above[0] * f) for f in (1 / 20, 1 / 200)]
    end = np.flatnonzero(above < max(3 * level, 1e-4 * above[0]))
    if any(len(m) == 0 for m in marks):
        return None
    stops = [int(marks[0][0]), int(marks[1][0]), int(end[0]) if len(end) else len(tail)]
    found = []
    for a, b in ((stops[0], stops[1]), (stops[1], stops[2])):
        if b - a < 4:
            continue
        x, y = np.arange(a, b), np.log(above[a:b].clip(1e-9))
        slope = np.polyfit(x, y, 1, w=np.sqrt(above[a:b].clip(0)))[0]
        found.append(float(-capture.bin_length / slope) if slope < 0 else float("nan"))
    return found or None
