"""A measurement in the making, on which the hidden effects of the blind test act.

It holds expected values on a fine time axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from blind_elements import Axis
from blind_scenes import FINE, PAD, Scene
from scipy.signal import fftconvolve

from data_modules.simulate.sensor import response_kernel

SIGMA, KAPPA = 1.0, 0.6  # of the response, bins and 1/bins
BACKGROUND = 0.15 / 1500  # counts a bin for each count a spot


@dataclass
class Work:
    """A measurement in the making; injectors change it.

    Args:
        scene: what is seen. level: counts of the scene a spot, on average. rank: ``[S]`` order of
            acquisition, -1 to 1.
        rng: for shapes of the effect.
        light: ``[S, n]`` clean light on the fine axis.
        delay: ``[S]`` m and ``stretch``: a photon at path L comes at L + delay + stretch·(L - middle of the
            window).
        response: acts on ``[S, n]`` after the ordinary response, with the fine step in m.
        gain: ``[S]`` relative factor on the scene's light. background: ``[S, T]`` counts. counting: acts on
            ``[S, T]`` counts.
    """

    scene: Scene
    level: float
    rank: np.ndarray
    rng: np.random.Generator
    light: np.ndarray = field(init=False)
    delay: np.ndarray = field(init=False)
    stretch: float = 0.0
    response: list[Callable[[np.ndarray, float], np.ndarray]] = field(default_factory=list)
    gain: np.ndarray = field(init=False)
    background: np.ndarray = field(init=False)
    counting: list[Callable[[np.ndarray], np.ndarray]] = field(default_factory=list)

    def __post_init__(self) -> None:
        spots = len(self.scene.laser)
        self.light = self.scene.clean
        self.delay, self.gain = np.zeros(spots), np.ones(spots)
        self.background = np.full((spots, self.scene.window.n_bins), BACKGROUND * self.level)

    @property
    def bin(self) -> float:
        return self.scene.window.bin_length

    @property
    def dark(self) -> float:
        """Ordinary background, counts a bin."""
        return BACKGROUND * self.level

    @property
    def times(self) -> np.ndarray:
        """``[T]`` bin numbers."""
        return np.arange(self.scene.window.n_bins)

    def signal(self) -> np.ndarray:
        """``[S, T]`` counts of the scene before gain, background and counting."""
        scale = self.level * len(self.light) / self.light.sum()
        seen = moved_in_time(self.light * scale, self.scene, self.delay, self.stretch)
        kernel, first = response_kernel(SIGMA * self.bin, KAPPA / self.bin, self.bin / FINE)
        seen = fftconvolve(seen, kernel[None], axes=1)[:, -first : -first + seen.shape[1]]
        for change in self.response:
            seen = change(seen, self.bin / FINE)
        bins = np.maximum(seen, 0).reshape(len(seen), -1, FINE).sum(axis=2)
        return bins[:, PAD:-PAD]

    def expected(self) -> np.ndarray:
        """``[S, T]`` counts."""
        signal = self.signal()
        # What changes the gain leaves the light of the whole scan as it is, so that the photon level is what
        # was asked for.
        each = signal.sum(axis=1)
        counts = signal * (self.gain * (each.sum() / (each @ self.gain)))[:, None] + self.background
        for change in self.counting:
            counts = change(counts)
        return counts


def moved_in_time(
    light: np.ndarray, scene: Scene, delay: np.ndarray, stretch: float, axis: Axis | None = None
) -> np.ndarray:
    """Light ``[S, n]`` at path L brought to L + delay + stretch·(L - middle).

    The cumulative light is interpolated linearly. The axis is the window's fine one where none is given.
    """
    if not delay.any() and stretch == 0:
        return light
    edges, middle = (axis or scene.window.fine).edges, scene.window.middle
    total = np.concatenate([np.zeros((len(light), 1)), np.cumsum(light, axis=1)], axis=1)
    came = edges + stretch * (edges - middle)
    return np.stack(
        [np.diff(np.interp(edges, came + late, row)) for late, row in zip(delay, total, strict=True)]
    )


def wave(work: Work) -> np.ndarray:
    """``[S]`` smooth random function of the scan order, mean 0, peak to peak 1.

    It is made of three slow cosines and is never just a slope.
    """
    u = (work.rank + 1) / 2
    size = work.rng.uniform(0.5, 1.0, 3) * work.rng.choice([-1, 1], 3) / [1.0, 1.2, 2.0]
    values = sum(a * np.cos(np.pi * k * u) for k, a in enumerate(size, 1))
    values -= values.mean()
    return values / np.ptp(values)


def blotches(work: Work) -> np.ndarray:
    """``[S]`` smooth random map over the wall, mean 0, rms 1: four broad Gaussians of either sign."""
    places, rng = work.scene.places, work.rng
    values = np.zeros(len(places))
    for sign in (1, -1, rng.choice([-1, 1]), rng.choice([-1, 1])):
        centre, width = rng.uniform(-1, 1, 2), rng.uniform(0.45, 0.8)
        values += sign * rng.uniform(0.5, 1) * np.exp(-((places - centre) ** 2).sum(axis=1) / (2 * width**2))
    values -= values.mean()
    return values / values.std()
