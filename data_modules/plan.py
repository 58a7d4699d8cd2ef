"""What to fit of a capture, and how finely: gate, summed bins and depths."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import stats

from data_modules.readers.assemble import direct_pulse, gate_after_direct_pulse, smooth
from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import spot_spacing

SPOTS_LOOKED_AT = 1024  # of large scans every n-th
SAMPLES = 8  # bins a wavelength; the shortest that a fit may reach, 0.53 of it, has four (conf/model)
CHANCE = 1e-6  # that noise in a spot's gate is taken for light that comes back
FAINT = 4  # standard deviations above the floor of light that is counted
_KNOWN: dict[int, Returns] = {}  # of captures that are still there, by their identity
LIGHT = 0.99  # share of a spot's light behind which nothing is imaged


@dataclass(frozen=True)
class Returns:
    """When light comes back, of the spots of which one can tell.

    Args:
        first: ``[K]`` path where the rise towards the peak passes a fifth of it, m.
        last: ``[K]`` path up to which ``LIGHT`` of the light has come, m.
        apart: ``[K]`` distance of laser and sensor point, m.
    """

    first: np.ndarray
    last: np.ndarray
    apart: np.ndarray


@dataclass(frozen=True)
class Plan:
    """What to fit of a capture.

    Args:
        wavelength: of the image, m.
        sum_bins: neighbouring bins to sum.
        gate: bins to fit, after summing.
        depth: nearest and farthest voxel plane, m; None where no light comes back.
        depth_pitch: between the planes: half a summed bin, m.
    """

    wavelength: float
    sum_bins: int
    gate: tuple[int, int]
    depth: tuple[float, float] | None
    depth_pitch: float

    def overrides(self) -> str:
        """As arguments of a command.

        Examples:
            >>> Plan(0.044, 4, (157, 512), (0.53, 1.22), 0.0024).overrides()
            "scene.sum_bins=4 'scene.gate=[157,512]' 'scene.volume.depth=[0.53,1.22]'"
        """
        gate = f"scene.sum_bins={self.sum_bins} 'scene.gate=[{self.gate[0]},{self.gate[1]}]'"
        if self.depth is None:
            return gate
        return f"{gate} 'scene.volume.depth=[{self.depth[0]:.4g},{self.depth[1]:.4g}]'"


def plan_capture(
    capture: Capture,
    wavelength: float | None = None,
    sum_bins: int | None = None,
    gate: tuple[int, int] | None = None,
) -> Plan:
    """Gate, summed bins and depths for a capture.

    Bins are summed as far as ``SAMPLES`` of them stay in a wavelength, and in the gate. The gate is the
    capture's own; where that is all bins and holds a direct pulse, it begins behind the pulse. Depths reach
    from where light first comes back to where the median spot has had ``LIGHT`` of it, with half a wavelength
    on either side: a voxel is never deeper than half the light's way, and straight behind a spot that way is
    z + √(z² + apart²).

    Args:
        capture: as read.
        wavelength: of the image, m; None takes four spot spacings, as the model does.
        sum_bins: taken as it is, where it is given.
        gate: the same, after summing.

    Returns:
        The plan.

    Examples:
        Light from 0.6 m away, in bins of 4 ps, at spots 2 cm apart:

        >>> x, y = np.meshgrid(0.02 * np.arange(8), 0.02 * np.arange(8), indexing="ij")
        >>> spots = np.stack([x.ravel(), y.ravel(), np.zeros(64)], axis=1)
        >>> up = np.tile([0.0, 0.0, 1.0], (64, 1))
        >>> counts = np.zeros((64, 1200), dtype=np.uint16)
        >>> counts[:, 1000:1030] = 50
        >>> plan = plan_capture(Capture(counts, spots, spots, up, up, bin_length=0.0012))
        >>> plan.sum_bins, plan.gate, plan.depth
        (8, (0, 150), (0.5576, 0.6616))
    """
    length = 4 * spot_spacing(capture) if wavelength is None else wavelength
    if sum_bins is None:
        most = (capture.gate[1] - capture.gate[0]) // SAMPLES
        sum_bins = max(1, min(math.floor(length / SAMPLES / capture.bin_length + 1e-6), most))
    summed = (capture if gate is not None else behind_pulse(capture)).sum_bins(sum_bins)
    if gate is not None:
        summed = summed.with_gate(*gate)
    came = returns(summed)
    depth = None
    if len(came.first):
        near = float(np.percentile((came.first**2 - came.apart**2) / (2 * came.first), 1)) - length / 2
        far = float(np.median(np.sqrt(np.maximum(came.last**2 - came.apart**2, 0)))) / 2 + length / 2
        near = max(near, length / 2)
        depth = (float(f"{near:.4g}"), float(f"{max(far, near + length):.4g}"))
    return Plan(length, sum_bins, summed.gate, depth, summed.bin_length / 2)


def behind_pulse(capture: Capture) -> Capture:
    """The capture with its gate behind the direct pulse, where the gate is all bins and there is one."""
    if not (capture.confocal and capture.is_counts and capture.gate == (0, capture.n_bins)):
        return capture
    mean = np.nan_to_num(capture.mean_transient())
    pulse = direct_pulse(mean, capture.bin_length, capture.t_start)
    if pulse is None or mean[pulse] <= 20 * np.median(mean):
        return capture
    return capture.with_gate(*gate_after_direct_pulse(capture.counts, capture.bin_length, capture.t_start)[0])


def returns(capture: Capture) -> Returns:
    """When light comes back, by each spot's gated transient, smoothed over 80 ps.

    The rise is the one that leads to the peak, so a direct pulse's tail at the gate's start does not count.
    Spots whose peak may be noise (:func:`light_of`) are left out, and so is light that does not stand
    ``FAINT`` standard deviations above the floor. They are worked out once for each capture.
    """
    key = id(capture)
    if key not in _KNOWN:
        found = np.array(list(_returns(capture)), dtype=np.float64).reshape(-1, 3)
        start = capture.path_gate[0]
        first, last = (start + (found[:, column] + 0.5) * capture.bin_length for column in (0, 1))
        _KNOWN[key] = Returns(first, last, found[:, 2])
        weakref.finalize(capture, _KNOWN.pop, key, None)
    return _KNOWN[key]


def _returns(capture: Capture) -> Iterator[tuple[int, int, float]]:
    """First and last bin of the gate with light, and how far apart laser and sensor point are."""
    first, last = capture.gate
    width = max(1, min(round(0.024 / capture.bin_length), last - first))
    observed = capture.gated_observed()
    for spot in range(0, capture.n_spots, max(1, capture.n_spots // SPOTS_LOOKED_AT)):
        # A rise over bins that were not recorded is no return: nobody knows when it began.
        bins = np.arange(last - first) if observed is None else np.flatnonzero(observed[spot])
        if len(bins) == 0:
            continue
        level = smooth(capture.counts[spot, first + bins], width)
        above, noise, is_light = light_of(level, width, capture.is_counts)
        peak = int(np.argmax(level))
        below = np.flatnonzero(above[:peak] < 0.2 * above[peak])
        if is_light and len(below):
            at = int(below[-1]) + 1
            around = bins[max(at - width, 0) : at + width]
            if around[-1] - around[0] < len(around):
                light = np.cumsum(np.where(above[at:] > FAINT * noise, above[at:], 0.0))
                end = at + int(np.searchsorted(light, LIGHT * light[-1]))
                apart = float(np.linalg.norm(capture.laser[spot] - capture.sensor[spot]))
                yield int(bins[at]), int(bins[end]), apart


def light_of(level: np.ndarray, width: int, is_counts: bool) -> tuple[np.ndarray, float, bool]:
    """What of a spot's smoothed transient is light that comes back.

    Args:
        level: ``[T]`` counts a bin, mean over ``width`` bins.
        width: bins that are smoothed over.
        is_counts: whether they are photon counts, and scatter.

    Returns:
        ``[T]`` what is above the lowest tenth; the standard deviation of its median; whether the peak is more
        than Poisson counts around the median would reach anywhere in the gate, but for ``CHANCE``.
    """
    above = level - float(np.percentile(level, 10))
    if not is_counts:
        return above, 0.0, bool(above.max() > 0)
    usual = max(float(np.median(level)) * width, 1.0)
    chance = len(level) * stats.poisson.sf(np.rint(float(level.max()) * width) - 1, usual)
    return above, math.sqrt(usual) / width, bool(chance < CHANCE)
