"""How clearly a hidden effect shows in its capture, from expected counts alone.

No fit of the tested program goes into it. Two numbers: what a test could expect that knows the scene, and
what one could expect that has to fit the scene, the response and the background as well.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from blind_elements import Axis, Elements, Legs, third_bounce
from blind_scenes import FINE, PAD
from blind_work import moved_in_time
from scipy.signal import fftconvolve
from wild_scenes import WildScene
from wild_truth import Truth
from wild_work import WildWork

from data_modules.simulate.sensor import response_kernel

PATCHES = 96
MOST = 10_000  # elements that make the patches
ALBEDO = 1.0  # prior standard deviation of a patch's log albedo
BINS = 3.0  # by which a patch may lie elsewhere along each of three axes, bins …
WHOLE = 30.0  # … and the whole scene
TILT = 0.3  # rad by which a patch may lean otherwise, about both axes across the line of sight
WIDTH = 0.5  # of the response's logarithmic widths
HALF = 2  # steps in a bin
DAMPINGS = (0, 0.1, 1, 10, 100, 1000)  # of a step, in shares of what each change tells by itself
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
        steps: how often at most the changed scene is seen anew (own scenes only; some seconds each). None of
            them leaves the scene as it is.
    """
    if not truth.names:
        return {}
    found = {}
    for name in truth.names:
        basis = nuisances(truth, name)
        first = statistic(truth.expected, truth.lacking[name], basis)
        if steps and truth.scene.own and first.projected > CLEAR:
            first = replace(first, projected=refined(truth, name, basis, first.projected, steps))
        found[name] = first
    return found


def statistic(with_: np.ndarray, without: np.ndarray, basis: np.ndarray) -> Statistic:
    """The two numbers.

    Args:
        with_, without: ``[S, T]`` expected counts.
        basis: ``[K, S, T]`` changes of the expected counts by one prior standard deviation.
    """
    inner, slope = _normal(with_, without, basis, np.zeros(len(basis)), np.sqrt(with_))
    plain = float(divergence(with_, without)[0].sum())
    return Statistic(plain, max(0.0, plain - float(slope @ np.linalg.solve(inner, slope))))


def refined(truth: Truth, name: str, basis: np.ndarray, projected: float, steps: int) -> float:
    """The projected number with the scene seen anew at the changes that take up most.

    Levenberg–Marquardt steps, each with the damping by which it gains most. They begin from the scene as it
    is, or from one so moved that its light comes about when it does with the injection, whichever is nearer:
    where light has moved by more than the response is wide, no slope of the counts leads to it.

    Args:
        truth, name: of the capture, and the injection.
        basis: of the scene as it is. projected: with it.
        steps: at most.
    """
    with_, change = truth.expected, np.zeros(len(basis))

    def gap(change: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        without = rendering(truth, name, change)
        return float(divergence(with_, without)[0].sum() + change @ change), change, without

    least, change, without = min(
        (gap(start) for start in (change, moved_scene(truth, name, len(basis)))), key=lambda found: found[0]
    )
    if change.any():
        basis = nuisances(truth, name, change)
    best = 0
    for step in range(steps + 1):
        inner, slope = _normal(with_, without, basis, change, _root_slope(with_, without))
        promised = max(0.0, float(least - slope @ np.linalg.solve(inner, slope)))
        if step == steps or promised > 0.95 * least:
            break
        # What was too bold a step ago may no longer be; beyond the best damping it grows worse again.
        tried = []
        for k in range(max(0, best - 1), len(DAMPINGS)):
            bent = inner + DAMPINGS[k] * np.diag(np.diag(inner))
            tried.append((*gap(change + np.linalg.solve(bent, slope)[: len(change)]), k))
            if len(tried) > 1 and tried[-2][0] < min(least, tried[-1][0]):
                break
        now, *found, best = min(tried, key=lambda one: one[0])
        if now >= least:
            break
        least, (change, without) = now, found
        basis = nuisances(truth, name, change)
    return min(projected, promised)


def moved_scene(truth: Truth, name: str, length: int) -> np.ndarray:
    """``[K]`` change by which light comes about when it does with an injection: of places alone.

    Least squares over the arrivals from patches' middles at all spots, weighted as counts and the response's
    width tell them, with the prior of the places.

    Args:
        truth, name: of the capture, and the injection.
        length: K.
    """
    scene, split, work = truth.scene, _split(truth.scene), truth.works[name]
    number, unit = len(split.middle), BINS * scene.window.bin_length / 2
    sigma, decay = truth.response
    weight = _factor(truth) * _light_of_patches(work, split) / (sigma**2 + decay**2)
    target = truth.work.arrival(split.middle)
    # Moves of each patch, and last of all of them, in prior standard deviations.
    moves, more, size = np.zeros((number + 1, 3)), WHOLE / BINS, 3 * (number + 1)
    for _ in range(5):
        place = split.middle + unit * (moves[:-1] + more * moves[-1])
        legs = (place - wall[:, None] for wall in (work.laser, work.sensor))
        rise = sum(leg / np.linalg.norm(leg, axis=2, keepdims=True) for leg in legs)
        rise = unit * (1 + work.stretch) * rise
        pull = np.einsum("sk,ski->ki", weight * (target - work.arrival(place)), rise)
        own = np.einsum("sk,ski,skj->kij", weight, rise, rise)
        inner, each = np.zeros((number + 1, 3, number + 1, 3)), np.arange(number)
        inner[each, :, each] = own
        inner[each, :, -1] = more * own
        inner[-1, :, each] = more * own
        inner[-1, :, -1] = more**2 * own.sum(axis=0)
        slope = np.concatenate([pull, more * pull.sum(axis=0, keepdims=True)]) - moves
        step = np.linalg.solve(inner.reshape(size, size) + np.eye(size), slope.ravel())
        moves = moves + step.reshape(-1, 3)
    change = np.zeros(length)
    change[number : 4 * number] = np.einsum("kx,kjx->jk", moves[:-1], split.axes).ravel()
    change[6 * number : 6 * number + 3] = moves[-1]
    return change


def _light_of_patches(work: WildWork, split: Split) -> np.ndarray:
    """``[S, P]`` light of each patch."""
    elements, seen, groups = _thinned(split.elements, work.seen, split.groups)
    light = np.empty((len(work.laser), len(split.middle)))
    for k in range(len(split.middle)):
        mine = groups == k
        given = (elements.of(mine), work.laser, work.sensor, seen[:, mine], _axis(work.scene))
        light[:, k] = third_bounce(*given).sum(axis=1)
    return light


def divergence(with_: np.ndarray, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twice the divergence in every bin, and its signed root, with factor and level at their best."""
    fitted = profiled(with_, without)
    gap = with_ - fitted
    each = 2 * np.maximum(with_ * np.log(with_ / fitted) - gap, 0)
    # The roots' squares sum to it, and for small gaps they are gap/√counts.
    return each, np.sign(gap) * np.sqrt(each)


def _root_slope(with_: np.ndarray, without: np.ndarray) -> np.ndarray:
    """``[S, T]`` counts without the injection that change a signed root of `divergence` by one, there.

    Near to ``with_`` it is √counts; a bin that has light in only one of both is far from it, and with √counts
    a step would not even lead downhill.
    """
    fitted = profiled(with_, without)
    gap = with_ - fitted
    near = np.abs(gap) < 0.01 * fitted
    return np.where(near, np.sqrt(with_), fitted * divergence(with_, without)[1] / np.where(near, 1, gap))


def _normal(
    with_: np.ndarray, without: np.ndarray, basis: np.ndarray, change: np.ndarray, root: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of a further change, with the prior; factor and level come last, and are free."""
    root = root.ravel()
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


def nuisances(truth: Truth, name: str, change: np.ndarray | None = None) -> np.ndarray:
    """``[K, S, T]`` changes of counts by patches' albedos, places and tilts and the response's two widths.

    Each is for one prior standard deviation. Rendered patch by patch, as the other injections let it be seen;
    a patch that moves delays its light at every spot by what its way grows. It moves away from the wall's
    middle and aside, by itself and with all others: where a scene is must be fitted, in all three dimensions.
    One that leans turns about its own middle, so that it looks brighter from one side of the wall, and its
    parts come sooner or later.

    Args:
        truth: of the capture.
        name: the injection that the counts lack.
        change: ``[K]`` at which they are taken, prior standard deviations; None for none.
    """
    scene, work, split, axis = truth.scene, truth.works[name], _split(truth.scene), _axis(truth.scene)
    elements, widths = _changed(truth, split, change)
    elements, seen, groups = _thinned(elements, work.seen, split.groups)
    kernel, first = response_kernel(*widths, scene.window.bin_length / HALF)
    factor = _factor(truth)
    albedo, place, tilt, whole = [], [], [], np.zeros((3, len(scene.laser), scene.window.n_bins))
    for k in range(groups.max() + 1):
        mine = elements.of(groups == k)
        given = (mine, work.laser, work.sensor, np.ascontiguousarray(seen[:, groups == k]), axis)

        def bounce(*weights: Callable[[Legs], np.ndarray], given: tuple = given) -> np.ndarray:
            light = third_bounce(*given, weights)
            return factor * moved_in_time(light, scene, work.delay, work.stretch, axis)

        wide = _smeared(bounce(), kernel, first)
        albedo.append(ALBEDO * _bins(wide))
        later = -BINS * _bins(_slope(wide))
        axes = split.axes[k]
        place.append([later * growth[:, None] for growth in _growth(work, mine, axes)])
        leaning = (_leaning(mine, bounce, axis, about) for about in axes[1:])
        tilt.append([TILT * _bins(_smeared(light, kernel, first)) for light in leaning])
        for j, growth in enumerate(_growth(work, mine, np.eye(3))):
            whole[j] += WHOLE / BINS * later * growth[:, None]
    total = np.sum(albedo, axis=0) / ALBEDO
    moves = [change for along in zip(*place, strict=True) for change in along]
    moves += [change for about in zip(*tilt, strict=True) for change in about]
    basis = np.stack([*albedo, *moves, *whole, *_width_changes(work, widths, total)])
    return (basis * _passed(work)).astype(np.float32)


def _passed(work: WildWork) -> np.ndarray:
    """``[S, T]`` counts for each count of the scene before gain and counting, about."""
    return work.shares(work.signal())[:, None] * work.expected() / work.incident()


def rendering(truth: Truth, name: str, change: np.ndarray) -> np.ndarray:
    """``[S, T]`` expected counts of the scene with that change of patches and response, without an injection.

    Args:
        truth, name: of the capture, and the injection that they lack.
        change: ``[K]`` prior standard deviations.
    """
    scene, work = truth.scene, copy(truth.works[name])
    elements, (sigma, kappa) = _changed(truth, _split(scene), change)
    light = third_bounce(elements, work.laser, work.sensor, work.seen, scene.window.fine)
    # Where another effect has taken light away, the scene cannot take away more than there is.
    work.light = np.maximum(work.light + light - work.plain, 0)
    work.sigma, work.kappa = sigma / work.bin, kappa * work.bin
    return work.expected()


@dataclass(frozen=True)
class Split:
    """A scene cut into patches.

    Args:
        elements: all of them. groups: ``[N]`` their patches.
        middle: ``[P, 3]``. axes: ``[P, 3, 3]`` along which each moves.
    """

    elements: Elements
    groups: np.ndarray
    middle: np.ndarray
    axes: np.ndarray


def _split(scene: WildScene) -> Split:
    elements = scene.elements if scene.own else scene.proxy
    groups = patches(elements, PATCHES)
    mine = [elements.of(groups == k) for k in range(groups.max() + 1)]
    return Split(
        elements, groups, np.stack([_middle(m) for m in mine]), np.stack([_axes(scene, m) for m in mine])
    )


def _changed(truth: Truth, split: Split, change: np.ndarray | None) -> tuple[Elements, tuple[float, float]]:
    """Elements, and the response's σ and κ."""
    elements, groups = split.elements, split.groups
    sigma, decay = truth.response
    if change is None:
        return elements, (sigma, 1 / decay)
    number = len(split.middle)
    lit, moves, tilts, whole, (wider, sharper) = np.split(
        change, [number, 4 * number, 6 * number, 6 * number + 3]
    )
    way = BINS * np.einsum("jk,kjx->kx", moves.reshape(3, number), split.axes) + WHOLE * whole
    turn = TILT * np.einsum("jk,kjx->kx", tilts.reshape(2, number).clip(-3, 3), split.axes[:, 1:])[groups]
    turned = elements.centre + np.cross(turn, elements.centre - split.middle[groups])
    normal = elements.normal + np.cross(turn, elements.normal)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    moved = turned + (truth.scene.window.bin_length / 2 * way)[groups]
    bright = elements.albedo * np.exp(ALBEDO * lit.clip(-3, 3))[groups]
    limits = (sigma * np.exp(WIDTH * np.clip(wider, -3, 3)), np.exp(WIDTH * np.clip(sharper, -3, 3)) / decay)
    return replace(elements, centre=moved, normal=normal, albedo=bright), limits


def _thinned(
    elements: Elements, seen: np.ndarray, groups: np.ndarray
) -> tuple[Elements, np.ndarray, np.ndarray]:
    """No more than about `MOST`, evenly taken of each patch, with its whole area; their view and patches."""
    step = -(-len(groups) // MOST)
    order = np.argsort(groups, kind="stable")
    first = np.searchsorted(groups[order], groups[order])
    few = np.sort(order[(np.arange(len(order)) - first) % step == 0])
    share = np.bincount(groups, elements.area) / np.bincount(groups[few], elements.area[few])
    some = elements.of(few)
    return replace(some, area=some.area * share[groups[few]]), seen[:, few], groups[few]


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
    elements = scene.elements if scene.own else scene.proxy
    some = slice(0, None, max(1, len(scene.laser) // 32))
    laser = scene.laser[some]
    sensor = laser if scene.confocal else scene.sensor[some]
    light = third_bounce(elements, laser, sensor, scene.seen[some], _axis(scene))
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


def _leaning(mine: Elements, bounce: Callable[..., np.ndarray], axis: Axis, about: np.ndarray) -> np.ndarray:
    """``[S, n]`` change of a patch's light a radian that it turns about an axis through its middle."""
    lean = np.cross(about, mine.normal)
    shift = np.cross(about, mine.centre - _middle(mine))

    def brighter(legs: Legs) -> np.ndarray:
        both = ((legs.to_laser, legs.cosine1), (legs.to_sensor, legs.cosine2))
        return sum(np.divide(_along(u, lean), c, out=np.zeros_like(c), where=c > 1e-3) for u, c in both)

    def longer(legs: Legs) -> np.ndarray:
        return -_along(legs.to_laser, shift) - _along(legs.to_sensor, shift)

    return bounce(brighter) - _slope(bounce(longer) / (HALF * axis.step))


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


def _growth(work: WildWork, mine: Elements, axes: np.ndarray) -> np.ndarray:
    """``[3, S]`` growth of the path to a patch that moves along each axis by ½."""
    centre = _middle(mine)
    legs = (centre - points for points in (work.laser, work.sensor))
    units = sum(leg / np.linalg.norm(leg, axis=1, keepdims=True) for leg in legs)
    return (1 + work.stretch) * axes @ units.T / 2


def _width_changes(work: WildWork, widths: tuple[float, float], signal: np.ndarray) -> list[np.ndarray]:
    """Of the whole scene's light, by σ and by κ."""
    light = moved_in_time(work.light, work.scene, work.delay, work.stretch)
    light = light.reshape(len(light), -1, FINE // HALF).sum(axis=2)
    light = light * (signal.sum() / light.sum())
    sigma, kappa = widths
    step = work.bin / HALF
    changes = []
    for more in ((np.exp(0.1), 1.0), (1.0, np.exp(0.1))):
        up, down = (
            _smeared(light, *response_kernel(sigma * f, kappa * g, step))
            for f, g in (more, (1 / more[0], 1 / more[1]))
        )
        changes.append(WIDTH * _bins(up - down) / 0.2)
    return changes
