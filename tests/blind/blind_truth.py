"""Captures with something hidden in them, and what it is.

    truth = make_capture(draw_spec(7), "capture.hdf5")

writes a y-tal file that tells nothing, and returns the truth. A capture is scene × hidden effects × strengths
× photon level × seed.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from blind_inject import EFFECTS, ORDER, UNKNOWN
from blind_scenes import SIDE, available, load, scan_order, write_scan
from blind_work import Work

LEVELS = (500, 1500, 5000, 10000)
STRENGTHS = ("just detectable", "weak", "strong", "gross")


@dataclass(frozen=True)
class Spec:
    """What to make.

    Args:
        scene: of `blind_scenes.PLANS`.
        effects: hidden, from `EFFECTS` or `UNKNOWN`; none, one or two.
        strengths: 0 … 3 for each, see `STRENGTHS`.
        level: counts of the scene a spot, on average over the scan.
        seed: of shapes and photons. The shape of an effect depends on nothing else, so that alone and in a
            pair it is the same.
        order: ``raster`` or ``serpentine``.
    """

    scene: str
    effects: tuple[str, ...] = ()
    strengths: tuple[int, ...] = ()
    level: float = 1500
    seed: int = 0
    order: str = "raster"

    def __post_init__(self) -> None:
        if len(self.effects) != len(self.strengths):
            raise ValueError(f"one strength for each effect, please: {self}")
        for name in self.effects:
            scenes = (EFFECTS | UNKNOWN)[name].scenes
            if scenes and self.scene not in scenes:
                raise ValueError(f"{name} cannot be hidden in {self.scene}, only in {', '.join(scenes)}")
        if not compatible(self.effects):
            raise ValueError(
                f"{' and '.join(self.effects)} both render the scene anew; hide only one of them"
            )


@dataclass(frozen=True)
class Truth:
    """What is hidden in a capture.

    Args:
        names: effects of the registry, in the order of the light's way. unknown: the one outside it, or "".
        axis: on which the unknown shows: time, depth, wall, scan or rate.
        values: true quantities of each effect, SI units.
        labels: strength of each effect in words.
        expected: ``[S, T]`` counts without photon noise. without: the same without the effects.
        scan_order_option: what to tell the command line; the file carries it as well.
    """

    spec: Spec
    names: tuple[str, ...]
    unknown: str
    axis: str
    values: dict[str, dict[str, float]]
    labels: dict[str, str]
    expected: np.ndarray
    without: np.ndarray
    scan_order_option: str


def make_capture(spec: Spec, path: str | Path) -> Truth:
    """Write the capture of ``spec`` to ``path`` (replaced if it exists) and say what is in it."""
    truth = hide(spec)
    scene = load(spec.scene)
    counts = np.random.default_rng([spec.seed, 1]).poisson(truth.expected)
    write_scan(path, scene, counts, scan_order(spec.order, SIDE))
    return truth


def hide(spec: Spec) -> Truth:
    """The truth without a file."""
    scene = load(spec.scene)
    rank = 2 * scan_order(spec.order, SIDE) / (SIDE**2 - 1) - 1
    work = Work(scene, spec.level, rank, np.random.default_rng(0))
    without = work.expected()
    values, labels = {}, {}
    kinds = EFFECTS | UNKNOWN
    for name, strength in sorted(
        zip(spec.effects, spec.strengths, strict=True), key=lambda pair: ORDER.index(pair[0])
    ):
        work.rng = np.random.default_rng([spec.seed, zlib.crc32(name.encode())])
        values[name] = kinds[name].inject(work, kinds[name].ladder[strength])
        labels[name] = STRENGTHS[strength]
    unknown = next((name for name in values if name in UNKNOWN), "")
    return Truth(
        spec=spec,
        names=tuple(name for name in values if name in EFFECTS),
        unknown=unknown,
        axis=UNKNOWN[unknown].axis if unknown else "",
        values=values,
        labels=labels,
        expected=work.expected() if values else without,
        without=without,
        scan_order_option=spec.order,
    )


def true_statistic(truth: Truth) -> float:
    """Twice the Kullback–Leibler divergence of the expected counts with the effects from those without.

    The best a likelihood-ratio test could expect if it knew the scene and everything else but one global
    factor on all counts. A test that must fit scene, response and background can expect less: how much less
    is the effect's retained information.
    """
    with_, without = truth.expected, truth.without
    without = without * (with_.sum() / without.sum())
    return float(2 * (with_ * np.log(with_ / without) - with_ + without).sum())


def draw_spec(
    seed: int,
    kind: str = "single",
    *,
    effects: tuple[str, ...] | None = None,
    scenes: tuple[str, ...] | None = None,
    strengths: tuple[int, ...] = (0, 1, 2, 3),
    levels: tuple[float, ...] = LEVELS,
) -> Spec:
    """Something to hide, drawn with equal chances: the same arguments give the same.

    Args:
        seed: of the draw and of the capture.
        kind: ``null``, ``single``, ``pair`` or ``unknown``.
        effects: to draw from; None for all. scenes: to draw from; None for all whose data are there.
        strengths, levels: to draw from.
    """
    rng = np.random.default_rng([seed, 2])
    number = {"null": 0, "single": 1, "pair": 2, "unknown": 1}[kind]
    table = UNKNOWN if kind == "unknown" else EFFECTS
    names = tuple(table) if effects is None else effects
    there = tuple(available()) if scenes is None else scenes
    for _ in range(1000):
        hidden = tuple(str(n) for n in rng.choice(names, number, replace=False)) if number else ()
        fitting = [s for s in there if all(s in (table[n].scenes or there) for n in hidden)]
        if fitting and compatible(hidden):
            break
    else:
        raise ValueError(f"nothing fits: effects {names}, scenes {there}")
    return Spec(
        scene=str(rng.choice(fitting)),
        effects=hidden,
        strengths=tuple(int(rng.choice(strengths)) for _ in hidden),
        level=float(rng.choice(levels)),
        seed=seed,
        order="serpentine" if rng.random() < 0.2 else "raster",
    )


_RENDERED = {
    "retroreflection",
    "specular_lobe",
    "occlusion",
    "higher_order_bounces",
    "wall_tilt",
    "wall_scale",
    "laser_sensor_baseline",
}


def compatible(names: tuple[str, ...]) -> bool:
    """At most one of the effects renders the scene anew."""
    return len(_RENDERED.intersection(names)) < 2


def _case(
    name: str, scene: str, level: float = 5000, strength: int = 3, seed: int = 1, order: str = "raster"
) -> Spec:
    return Spec(scene, (name,), (strength,), level, seed, order)


# A seeded subset for continuous integration, on scenes that need no data.
CASES: dict[str, Spec] = {
    **{name: _case(name, "corner" if name == "higher_order_bounces" else "default") for name in EFFECTS},
    "nothing, default": Spec("default", seed=11),
    "nothing, letters": Spec("letters", level=5000, seed=12),
    "nothing, sphere": Spec("sphere_before_plate", seed=13),
    "pair": Spec("default", ("wall_reflectance", "irf_tail"), (3, 3), 5000, 14),
    "unknown": _case("missing_codes", "default", seed=15),
}
