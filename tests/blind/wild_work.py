"""A measurement in the making, as `blind_work` has it, with a response and a background of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from blind_elements import sight, third_bounce
from blind_scenes import FINE, PAD
from blind_work import Work, moved_in_time
from scipy.signal import fftconvolve
from wild_scenes import WildScene

from data_modules.simulate.sensor import response_kernel

Sampler = Callable[[np.random.Generator], np.ndarray]


@dataclass
class WildWork(Work):
    """A measurement in the making; injectors change it.

    Args:
        sigma, kappa: of the ordinary response, bins and 1/bins.
        dim: ordinary background, counts a bin for each count of the scene a spot.
        sampler: draws ``[S, T]`` counts where they are no Poisson counts of the expected ones; of the last
            step of ``counting`` only.
        laser, sensor: ``[S, 3]`` wall points that light really comes over, m. seen: ``[S, N]`` whether both
            see an element.
        plain: ``[S, n]`` light over them without weights on its paths.
    """

    scene: WildScene
    sigma: float = 1.0
    kappa: float = 0.6
    dim: float = 1e-4
    sampler: Sampler | None = None
    laser: np.ndarray = field(init=False)
    sensor: np.ndarray = field(init=False)
    seen: np.ndarray = field(init=False)
    plain: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.laser, self.sensor, self.seen = self.scene.laser, self.scene.sensor, self.scene.seen
        self.plain = self.light
        self.background = np.full((len(self.gain), self.scene.window.n_bins), self.dark)

    @property
    def dark(self) -> float:
        """Ordinary background, counts a bin."""
        return self.dim * self.level

    @property
    def along(self) -> np.ndarray:
        """``[S]`` place in the scan, from 0 to 1."""
        return (self.rank + 1) / 2

    @property
    def turn(self) -> np.ndarray:
        """``[S]`` spots in the order of acquisition."""
        return np.argsort(self.rank)

    def place_wall(self, wall: Callable[[np.ndarray], np.ndarray]) -> None:
        """Points ``[S, 3]`` of the file really are at ``wall`` of them."""
        confocal = self.laser is self.sensor
        self.sensor = wall(self.sensor)
        self.laser = self.sensor if confocal else wall(self.laser)
        self.light = self.plain = self.scene.rendered(wall=wall)

    def look_aside(self, sensor: np.ndarray) -> None:
        """The sensor looks at points ``[S, 3]`` of its own."""
        scene = self.scene
        self.sensor, self.seen = sensor, scene.seen & sight(scene.mesh, scene.elements, sensor)
        self.light = third_bounce(scene.elements, scene.laser, sensor, self.seen, scene.window.fine)
        self.plain = self.light

    def arrival(self, points: np.ndarray) -> np.ndarray:
        """``[S, N]`` path at which light from points ``[N, 3]`` comes, m."""
        gaps = (np.linalg.norm(points - wall[:, None], axis=2) for wall in (self.laser, self.sensor))
        path = sum(gaps)
        return path + self.delay[:, None] + self.stretch * (path - self.scene.window.middle)

    def count(self, change: Callable[[np.ndarray], np.ndarray], sampler: Sampler | None = None) -> None:
        """One more step that acts on ``[S, T]`` counts."""
        self.counting.append(change)
        self.sampler = sampler

    def signal(self) -> np.ndarray:
        """``[S, T]`` counts of the scene before gain, background and counting."""
        scale = self.level * len(self.light) / self.scene.clean.sum()
        seen = moved_in_time(self.light * scale, self.scene, self.delay, self.stretch)
        kernel, first = response_kernel(self.sigma * self.bin, self.kappa / self.bin, self.bin / FINE)
        seen = fftconvolve(seen, kernel[None], axes=1)[:, -first : -first + seen.shape[1]]
        for change in self.response:
            seen = change(seen, self.bin / FINE)
        bins = np.maximum(seen, 0).reshape(len(seen), -1, FINE).sum(axis=2)
        return bins[:, PAD:-PAD]

    def incident(self) -> np.ndarray:
        """``[S, T]`` counts before ``counting``."""
        signal = self.signal()
        return signal * self.shares(signal)[:, None] + self.background

    def shares(self, signal: np.ndarray) -> np.ndarray:
        """``[S]`` factor by which gain changes the scene's counts ``[S, T]``."""
        # What changes the gain leaves the light of the whole scan as it is, so that the photon level is what
        # was asked for.
        each = signal.sum(axis=1)
        return self.gain * (each.sum() / (each @ self.gain))

    def expected(self) -> np.ndarray:
        """``[S, T]`` counts."""
        counts = self.incident()
        for change in self.counting:
            counts = change(counts)
        return counts


def walk(work: WildWork) -> np.ndarray:
    """``[S]`` a random walk along the scan, mean 0, peak to peak 1."""
    values = np.empty(len(work.rank))
    values[work.turn] = np.cumsum(work.rng.standard_normal(len(values)))
    return centred(values)


def warm_up(work: WildWork) -> np.ndarray:
    """``[S]`` an exponential approach along the scan, mean 0, peak to peak 1, of either sign."""
    values = -np.exp(-work.along / work.rng.uniform(0.06, 0.4)) * work.rng.choice([-1, 1])
    return centred(values)


def centred(values: np.ndarray) -> np.ndarray:
    """Mean 0, peak to peak 1."""
    return (values - values.mean()) / np.ptp(values)
