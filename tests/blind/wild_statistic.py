"""How clearly a hidden effect shows in its capture, from expected counts alone.

No fit of the tested program goes into it. Two numbers: what a test could expect that knows the scene, and
what one could expect that has to fit the scene, the response and the background as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from blind_elements import Axis, Elements, Legs, third_bounce
from blind_scenes import FINE, PAD
from scipy.signal import fftconvolve
from wild_scenes import WildScene
from wild_truth import Truth

from data_modules.simulate.sensor import response_kernel

PATCHES = 96
MOST = 10_000  # elements that make the patches
ALBEDO = 1.0  # prior standard deviation of a patch's log albedo
BINS = 3.0  # by which a patch may lie elsewhere along each of three axes, bins …
WHOLE = 30.0  # … and the whole scene
TILT = 0.3  # rad by which a patch may lean otherwise, about both axes across the line of sight
WIDTH = 0.5  # of the response's logarithmic widths
HALF = 2  # steps in a bin
CLEAR = 100.0  # from which on an effect should be named


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


def true_statistics(truth: Truth, steps: int = 8) -> dict[str, Statistic]:
    """Of every injection, each against the capture that lacks only it.

    Exposure and dark level are in no file, so every method fits both: hence the factor and the level. The
    second number is linear in the changes of the scene: for effects that move light by more than the
    response is wide it is too large, unless the scene is seen anew after each of some steps. That is done
    for those that show clearly without.

    Args:
        truth: of the capture.
        steps: how often at most the changed scene is seen anew (own scenes only; some seconds each).
    """
    if not truth.names:
        return {}
    basis = nuisances(truth)
    found = {name: statistic(truth.expected, truth.lacking[name], basis) for name in truth.names}
    if not truth.scene.own:
        return found
    return {
        name: replace(first, projected=refined(truth, name, basis, first.projected, steps))
        if first.projected > CLEAR
        else first
        for name, first in found.items()
    }


def statistic(with_: np.ndarray, without: np.ndarray, basis: np.ndarray) -> Statistic:
    """The two numbers.

    Args:
        with_, without: ``[S, T]`` expected counts.
        basis: ``[K, S, T]`` changes of the expected counts by one prior standard deviation.
    """
    inner, slope = _normal(with_, without, basis, np.zeros(len(basis)))
    plain = float(divergence(with_, without)[0].sum())
    return Statistic(plain, max(0.0, plain - float(slope @ np.linalg.solve(inner, slope))))


def refined(truth: Truth, name: str, basis: np.ndarray, projected: float, steps: int) -> float:
    """The projected number with the scene seen anew at the changes that take up most.

    Args:
        truth, name: of the capture, and the injection.
        basis: of the scene as it is. projected: with it.
        steps: at most.
    """
    change = np.zeros(len(basis))
    start, lacking = rendering(truth, change), truth.lacking[name]

    def without(change: np.ndarray) -> np.ndarray:
        # Where another effect has taken light away, the scene cannot take away more than there is.
        return np.maximum(lacking + rendering(truth, change) - start, 0.01 * lacking)

    least = divergence(truth.expected, lacking)[0].sum()
    for _ in range(steps):
        inner, slope = _normal(truth.expected, without(change), basis, change)
        for damping in (0, 1, 10, 100):
            bent = inner + damping * np.diag(np.diag(inner))
            tried = change + np.linalg.solve(bent, slope)[: len(change)]
            now = divergence(truth.expected, without(tried))[0].sum() + tried @ tried
            if now < least:
                break
        else:
            break
        settled, change, least = now > 0.95 * least, tried, now
        basis = nuisances(truth, change)
        inner, slope = _normal(truth.expected, without(change), basis, change)
        projected = min(projected, max(0.0, float(now - slope @ np.linalg.solve(inner, slope))))
        if settled:
            break
    return projected


def divergence(with_: np.ndarray, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twice the divergence in every bin, and its signed root, with factor and level at their best."""
    fitted = profiled(with_, without)
    gap = with_ - fitted
    each = 2 * np.maximum(with_ * np.log(with_ / fitted) - gap, 0)
    # The roots' squares sum to it, and for small gaps they are gap/√counts.
    return each, np.sign(gap) * np.sqrt(each)


def _normal(
    with_: np.ndarray, without: np.ndarray, basis: np.ndarray, change: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of a further change, with the prior; factor and level come last, and are free."""
    root = np.sqrt(with_).ravel()
    free = np.stack([without, np.ones_like(without)]).reshape(2, -1)
    free = 1e3 * free / np.linalg.norm(free / root, axis=1, keepdims=True)
    design = np.concatenate([basis.reshape(len(basis), -1), free.astype(np.float32)])
    design /= root.astype(np.float32)
    residual = divergence(with_, without)[1].ravel().astype(np.float32)
    inner = (design @ design.T).astype(np.float64) + np.eye(len(design))
    return inner, (design @ residual).astype(np.float64) - np.concatenate([change, [0, 0]])


def profiled(with_: np.ndarray, without: np.ndarray) -> np.ndarray:
    """``factor · without + level`` nearest to ``with_`` in divergence, positive everywhere."""
    design = np.stack([without.ravel(), np.full(without.size, without.mean())])
    at, target = np.array([with_.sum() / without.sum(), 0.0]), with_.ravel()

    def cost(at: np.ndarray) -> float:
        model = at @ design
        return np.inf if model.min() <= 0 else float((model - target * np.log(model)).sum())

    for _ in range(12):
        model = at @ design
        slope = design @ (1 - target / model)
        bend = (design * (target / model**2)) @ design.T
        step, size = np.linalg.lstsq(bend, slope)[0], 1.0
        before = cost(at)
        while cost(at - size * step) > before and size > 1e-6:
            size /= 2
        at = at - size * step
        if slope @ step < 1e-6:
            break
    return (at @ design).reshape(without.shape)


def nuisances(truth: Truth, change: np.ndarray | None = None) -> np.ndarray:
    """``[K, S, T]`` changes of counts by patches' albedos, places and tilts and the response's two widths.

    Each is for one prior standard deviation. Rendered patch by patch from the clean scene; a patch that
    moves delays its light at every spot by what its way grows. It moves away from the wall's middle and
    aside, by itself and with all others: where a scene is must be fitted, in all three dimensions. One that
    leans turns about its own middle, so that it looks brighter from one side of the wall, and its parts
    come sooner or later.

    Args:
        truth: of the capture.
        change: ``[K]`` at which they are taken, prior standard deviations; None for none.
    """
    scene = truth.scene
    elements, seen, groups, widths = _changed(truth, change)
    kernel, first = response_kernel(*widths, scene.window.bin_length / HALF)
    factor = _factor(truth)
    albedo, place, tilt, whole = [], [], [], np.zeros((3, len(scene.laser), scene.window.n_bins))
    for k in range(groups.max() + 1):
        mine = elements.of(groups == k)
        given = (mine, scene.laser, scene.sensor, seen[:, groups == k], _axis(scene))
        wide = _smeared(factor * third_bounce(*given), kernel, first)
        albedo.append(ALBEDO * _bins(wide))
        later = -BINS * _bins(_slope(wide))
        axes = _axes(scene, mine)
        place.append([later * growth[:, None] for growth in _growth(scene, mine, axes)])
        tilt.append([TILT * _bins(_smeared(factor * _leaning(given, a), kernel, first)) for a in axes[1:]])
        for k, growth in enumerate(_growth(scene, mine, np.eye(3))):
            whole[k] += WHOLE / BINS * later * growth[:, None]
    total = np.sum(albedo, axis=0) / ALBEDO
    moves = [change for along in zip(*place, strict=True) for change in along]
    moves += [change for about in zip(*tilt, strict=True) for change in about]
    return np.stack([*albedo, *moves, *whole, *_width_changes(scene, widths, total)]).astype(np.float32)


def rendering(truth: Truth, change: np.ndarray) -> np.ndarray:
    """``[S, T]`` counts of the scene with that change of patches and response, without background."""
    scene = truth.scene
    elements, seen, _, widths = _changed(truth, change)
    light = _factor(truth) * third_bounce(elements, scene.laser, scene.sensor, seen, _axis(scene))
    return _bins(_smeared(light, *response_kernel(*widths, scene.window.bin_length / HALF)))


def _changed(
    truth: Truth, change: np.ndarray | None
) -> tuple[Elements, np.ndarray, np.ndarray, tuple[float, float]]:
    """Elements, whether they are in view, their patches, and the response's σ and κ."""
    scene = truth.scene
    elements, seen = _thinned(scene)
    groups = patches(elements, PATCHES)
    sigma, decay = truth.response
    if change is None:
        return elements, seen, groups, (sigma, 1 / decay)
    number = groups.max() + 1
    lit, moves, tilts, whole, (wider, sharper) = np.split(
        change, [number, 4 * number, 6 * number, 6 * number + 3]
    )
    axes = np.stack([_axes(scene, elements.of(groups == k)) for k in range(number)])
    way = BINS * np.einsum("jk,kjx->kx", moves.reshape(3, number), axes) + WHOLE * whole
    turn = TILT * np.einsum("jk,kjx->kx", tilts.reshape(2, number).clip(-3, 3), axes[:, 1:])[groups]
    middle = np.stack([_middle(elements.of(groups == k)) for k in range(number)])[groups]
    turned = elements.centre + np.cross(turn, elements.centre - middle)
    normal = elements.normal + np.cross(turn, elements.normal)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    moved = turned + (scene.window.bin_length / 2 * way)[groups]
    bright = elements.albedo * np.exp(ALBEDO * lit.clip(-3, 3))[groups]
    limits = (sigma * np.exp(WIDTH * np.clip(wider, -3, 3)), np.exp(WIDTH * np.clip(sharper, -3, 3)) / decay)
    return replace(elements, centre=moved, normal=normal, albedo=bright), seen, groups, limits


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


def _axis(scene: WildScene) -> Axis:
    window = scene.window
    step = window.bin_length
    return Axis(window.t_start - PAD * step, step / HALF, HALF * (window.n_bins + 2 * PAD))


def _factor(truth: Truth) -> float:
    """Counts for each unit of rendered light."""
    scene = truth.scene
    elements, seen = _thinned(scene)
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


def _leaning(
    given: tuple[Elements, np.ndarray, np.ndarray, np.ndarray, Axis], about: np.ndarray
) -> np.ndarray:
    """``[S, n]`` change of a patch's light a radian that it turns about an axis through its middle."""
    mine = given[0]
    lean = np.cross(about, mine.normal)
    shift = np.cross(about, mine.centre - _middle(mine))

    def brighter(legs: Legs) -> np.ndarray:
        both = ((legs.to_laser, legs.cosine1), (legs.to_sensor, legs.cosine2))
        return sum(np.divide(_along(u, lean), c, out=np.zeros_like(c), where=c > 1e-3) for u, c in both)

    def longer(legs: Legs) -> np.ndarray:
        return -_along(legs.to_laser, shift) - _along(legs.to_sensor, shift)

    later = third_bounce(*given, weights=(longer,)) / (HALF * given[4].step)  # bins
    return third_bounce(*given, weights=(brighter,)) - _slope(later)


def _along(unit: tuple[np.ndarray, ...], vector: np.ndarray) -> np.ndarray:
    """``[B, N]`` part of vectors ``[N, 3]`` along unit vectors, 3 × ``[B, N]``."""
    return sum(u * v for u, v in zip(unit, vector.T, strict=True))


def _middle(mine: Elements) -> np.ndarray:
    """``[3]`` of a patch."""
    return mine.area @ mine.centre / mine.area.sum()


def _axes(scene: WildScene, mine: Elements) -> np.ndarray:
    """``[3, 3]`` unit vectors: from the wall's middle to a patch, and two across."""
    centre = _middle(mine)
    middle = (scene.sensor.min(axis=0) + scene.sensor.max(axis=0)) / 2
    away = (centre - middle) / np.linalg.norm(centre - middle)
    across = np.cross(away, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    return np.stack([away, across, np.cross(away, across)])


def _growth(scene: WildScene, mine: Elements, axes: np.ndarray) -> np.ndarray:
    """``[3, S]`` growth of the path to a patch that moves along each axis by ½."""
    centre = _middle(mine)
    legs = (centre - points for points in (scene.laser, scene.sensor))
    units = sum(leg / np.linalg.norm(leg, axis=1, keepdims=True) for leg in legs)
    return axes @ units.T / 2


def _width_changes(scene: WildScene, widths: tuple[float, float], signal: np.ndarray) -> list[np.ndarray]:
    """Of the whole scene's light, by σ and by κ."""
    light = scene.clean.reshape(len(scene.clean), -1, FINE // HALF).sum(axis=2)
    light = light * (signal.sum() / light.sum())
    sigma, kappa = widths
    step = scene.window.bin_length / HALF
    changes = []
    for more in ((np.exp(0.1), 1.0), (1.0, np.exp(0.1))):
        up, down = (
            _smeared(light, *response_kernel(sigma * f, kappa * g, step))
            for f, g in (more, (1 / more[0], 1 / more[1]))
        )
        changes.append(WIDTH * _bins(up - down) / 0.2)
    return changes
