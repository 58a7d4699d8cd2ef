"""Scenes of single points, whose measurement can be worked out by hand."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from blind_elements import Axis, Elements, third_bounce
from blind_scenes import Scene, Window
from blind_work import Work

from data_modules.simulate import wall_grid

WINDOW = Window(0.008, 224, 1.1)
LEVEL = 1500.0


def points(*places, normal=(0.0, 0.0, -1.0), area=1e-4, albedo=1.0) -> Elements:
    """Elements at places (x, y, z), m."""
    n = len(places)
    return Elements(
        np.array(places, dtype=float),
        np.tile(np.array(normal, float), (n, 1)),
        np.full(n, area),
        np.full(n, albedo),
    )


def scene_of(elements: Elements) -> Scene:
    """A confocal scan of them, all in view."""
    wall = wall_grid(32, 32, 0.8, 0.8).reshape(-1, 3)
    seen = np.ones((1024, len(elements.area)), dtype=bool)
    return Scene(
        "points",
        WINDOW,
        wall,
        wall,
        third_bounce(elements, wall, wall, seen, WINDOW.fine),
        None,
        elements,
        seen,
    )


@lru_cache(maxsize=1)
def one_dot() -> Scene:
    """One small element before the wall, off its middle."""
    return scene_of(points((0.1, -0.05, 0.7)))


def work_on(scene: Scene, seed: int = 3) -> Work:
    """Nothing hidden yet."""
    return Work(scene, LEVEL, 2 * np.arange(1024) / 1023 - 1, np.random.default_rng(seed))


def mean_path(light: np.ndarray, axis: Axis) -> np.ndarray:
    """``[S]`` mean arrival of fine light, m."""
    return light @ (axis.edges[:-1] + axis.step / 2) / light.sum(axis=1)


def bin_path(counts: np.ndarray) -> np.ndarray:
    """``[S]`` mean arrival of counts, m."""
    return (
        counts @ (WINDOW.t_start + (np.arange(WINDOW.n_bins) + 0.5) * WINDOW.bin_length) / counts.sum(axis=1)
    )


def shift_of(work: Work) -> np.ndarray:
    """``[S]`` how much later the light comes than in the untouched scene, m."""
    return bin_path(work.signal()) - bin_path(work_on(work.scene).signal())
