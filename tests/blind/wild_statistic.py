"""How clearly a hidden effect shows in its capture, from expected counts alone.

No fit of the tested program goes into it. Two numbers: what a test could expect that knows the scene, and
what one could expect that has to fit the scene, the response and the background as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from blind_elements import Axis, Elements, third_bounce
from blind_scenes import PAD
from scipy.signal import fftconvolve
from wild_scenes import WildScene
from wild_truth import Truth

from data_modules.simulate.sensor import response_kernel

PATCHES = 96
MOST = 10_000  # elements that make the patches
ALBEDO = 1.0  # prior standard deviation of a patch's log albedo
BINS = 3.0  # of the path to a patch, bins
WIDTH = 0.5  # of the response's logarithmic widths
HALF = 2  # steps in a bin


@dataclass(frozen=True)
class Statistic:
    """Of one hidden effect.

    Args:
        plain: twice the Kullback–Leibler divergence of the expected counts with the effect from those
            without, least over one factor on all counts and one level added to all bins.
        projected: the part of it that no small change of the scene, the response and the background takes
            up.
    """

    plain: float
    projected: float


def true_statistics(truth: Truth) -> dict[str, Statistic]:
    """Of every injection, each against the capture that lacks only it.

    Exposure and dark level are in no file, so every method fits both: hence the factor and the level. The
    second number is linear in the changes of the scene: for effects that move light by more than the
    response is wide it is too large.
    """
    if not truth.names:
        return {}
    basis = nuisances(truth)
    return {name: statistic(truth.expected, truth.lacking[name], basis) for name in truth.names}


def statistic(with_: np.ndarray, without: np.ndarray, basis: np.ndarray) -> Statistic:
    """The two numbers.

    Args:
        with_, without: ``[S, T]`` expected counts.
        basis: ``[K, S, T]`` changes of the expected counts by one prior standard deviation.
    """
    fitted = profiled(with_, without)
    gap = with_ - fitted
    plain = 2 * np.maximum(with_ * np.log(with_ / fitted) - gap, 0)
    # Signed roots of the divergence: their squares sum to it, and for small gaps they are gap/√counts.
    residual = (np.sign(gap) * np.sqrt(plain)).ravel().astype(np.float32)
    free = np.stack([fitted, np.ones_like(fitted)]).reshape(2, -1)
    free = 1e3 * free / np.linalg.norm(free / np.sqrt(with_).ravel(), axis=1, keepdims=True)
    design = np.concatenate([basis.reshape(len(basis), -1), free.astype(np.float32)])
    design /= np.sqrt(with_).ravel().astype(np.float32)
    inner = (design @ design.T).astype(np.float64) + np.eye(len(design))
    seen = (design @ residual).astype(np.float64)
    whole = float(plain.sum())
    return Statistic(whole, max(0.0, whole - float(seen @ np.linalg.solve(inner, seen))))


def profiled(with_: np.ndarray, without: np.ndarray) -> np.ndarray:
    """``factor · without + level`` nearest to ``with_`` in divergence, positive everywhere."""
    design = np.stack([without.ravel(), np.full(without.size, without.mean())])
    at, target = np.array([with_.sum() / without.sum(), 0.0]), with_.ravel()

    def divergence(at: np.ndarray) -> float:
        model = at @ design
        return np.inf if model.min() <= 0 else float((model - target * np.log(model)).sum())

    for _ in range(12):
        model = at @ design
        slope = design @ (1 - target / model)
        bend = (design * (target / model**2)) @ design.T
        step, size = np.linalg.lstsq(bend, slope)[0], 1.0
        before = divergence(at)
        while divergence(at - size * step) > before and size > 1e-6:
            size /= 2
        at = at - size * step
        if slope @ step < 1e-6:
            break
    return (at @ design).reshape(without.shape)


def nuisances(truth: Truth) -> np.ndarray:
    """``[K, S, T]`` changes of counts by patches' albedos and paths and the response's two widths.

    Each is for one prior standard deviation. Rendered patch by patch from the clean scene; a patch that moves
    away from the wall's middle delays its light at every spot by what its way grows.
    """
    scene = truth.scene
    elements, seen = _thinned(scene)
    kernel, first = response_kernel(*_widths(truth), scene.window.bin_length / HALF)
    groups = patches(elements, PATCHES)
    factor = _factor(truth, scene, elements, seen)
    albedo, depth = [], []
    for k in range(groups.max() + 1):
        mine = elements.of(groups == k)
        light = factor * third_bounce(mine, scene.laser, scene.sensor, seen[:, groups == k], _axis(scene))
        wide = _smeared(light, kernel, first)
        albedo.append(ALBEDO * _bins(wide))
        depth.append(-BINS * _bins(_slope(wide)) * _growth(scene, mine)[:, None])
    total = np.sum(albedo, axis=0) / ALBEDO
    return np.stack([*albedo, *depth, *_width_changes(truth, scene, total)]).astype(np.float32)


def _thinned(scene: WildScene) -> tuple[Elements, np.ndarray]:
    """No more than about `MOST` elements, evenly taken, and whether they are in view."""
    elements = scene.elements if scene.own else scene.proxy
    step = -(-len(elements.area) // MOST)
    few = elements.of(slice(None, None, step))
    if not scene.own:
        return few, np.ones((len(scene.laser), len(few.area)), dtype=bool)
    return few, np.ascontiguousarray(scene.seen[:, ::step])


def patches(elements: Elements, number: int) -> np.ndarray:
    """``[N]`` patch of each element: the largest is halved across its longest side until there are enough."""
    groups = [np.arange(len(elements.area))]
    spread = [np.ptp(elements.centre, axis=0)]
    while len(groups) < min(number, len(elements.area)):
        k = int(np.argmax([s.max() for s in spread]))
        group, side = groups.pop(k), int(np.argmax(spread.pop(k)))
        order = group[np.argsort(elements.centre[group, side], kind="stable")]
        for half in np.array_split(order, 2):
            groups.append(half)
            spread.append(np.ptp(elements.centre[half], axis=0))
    labels = np.empty(len(elements.area), dtype=int)
    for k, group in enumerate(groups):
        labels[group] = k
    return labels


def _widths(truth: Truth) -> tuple[float, float]:
    sigma, decay = truth.response
    return sigma, 1 / decay


def _axis(scene: WildScene) -> Axis:
    window = scene.window
    step = window.bin_length
    return Axis(window.t_start - PAD * step, step / HALF, HALF * (window.n_bins + 2 * PAD))


def _factor(truth: Truth, scene: WildScene, elements: Elements, seen: np.ndarray) -> float:
    """Counts for each unit of rendered light."""
    some = slice(0, None, max(1, len(seen) // 32))
    laser = scene.laser[some]
    sensor = laser if scene.confocal else scene.sensor[some]
    light = third_bounce(elements, laser, sensor, seen[some], _axis(scene))
    signal = truth.without[some].sum() - truth.dark * truth.without[some].size
    return float(signal / light.sum())


def _smeared(light: np.ndarray, kernel: np.ndarray, first: int) -> np.ndarray:
    """Light ``[S, n]`` through the response; only where there is any is it worked out."""
    there = np.flatnonzero(light.any(axis=0))
    wide = np.zeros_like(light)
    if len(there):
        part = fftconvolve(light[:, there[0] : there[-1] + 1], kernel[None], axes=1)
        begin = there[0] + first
        low, high = max(0, begin), min(light.shape[1], begin + part.shape[1])
        wide[:, low:high] = part[:, low - begin : high - begin]
    return wide


def _slope(wide: np.ndarray) -> np.ndarray:
    """Change a bin of light ``[S, n]``, by the difference over a whole bin."""
    slope = np.zeros_like(wide)
    slope[:, 1:-1] = wide[:, 2:] - wide[:, :-2]
    return slope * (HALF / 2)


def _bins(light: np.ndarray) -> np.ndarray:
    return light.reshape(len(light), -1, HALF).sum(axis=2)[:, PAD:-PAD]


def _growth(scene: WildScene, mine: Elements) -> np.ndarray:
    """``[S]`` growth of the path for a path that grows by 1 as seen from the wall's middle."""
    centre = mine.area @ mine.centre / mine.area.sum()
    middle = (scene.sensor.min(axis=0) + scene.sensor.max(axis=0)) / 2
    away = (centre - middle) / np.linalg.norm(centre - middle)
    legs = (centre - points for points in (scene.laser, scene.sensor))
    return sum((leg / np.linalg.norm(leg, axis=1, keepdims=True)) @ away for leg in legs) / 2


def _width_changes(truth: Truth, scene: WildScene, signal: np.ndarray) -> list[np.ndarray]:
    """Of the whole scene's light, by σ and by κ."""
    light = scene.clean.reshape(len(scene.clean), -1, 8 // HALF).sum(axis=2)
    light = light * (signal.sum() / light.sum())
    sigma, kappa = _widths(truth)
    step = scene.window.bin_length / HALF
    changes = []
    for more in ((np.exp(0.1), 1.0), (1.0, np.exp(0.1))):
        up, down = (
            _smeared(light, *response_kernel(sigma * f, kappa * g, step))
            for f, g in (more, (1 / more[0], 1 / more[1]))
        )
        changes.append(WIDTH * _bins(up - down) / 0.2)
    return changes
