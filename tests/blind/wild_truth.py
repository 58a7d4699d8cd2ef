"""Captures of the evaluation sets, and what is hidden in them.

    truth = make("development", 3, "capture.hdf5")

writes a y-tal file that tells nothing, and returns the truth.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from blind_scenes import scan_order, write_scan
from wild_scenes import WildScene, load
from wild_table import ALL, STRENGTHS, Spec, spec_of
from wild_work import WildWork


@dataclass(frozen=True)
class Truth:
    """What is hidden in a capture.

    Args:
        names: injections in the order of the light's way. unknown: the one outside the registry, or "".
        right: registry names that are right, for each injection (none for an unknown).
        alike: registry names that describe nearly the same counts: right in a group with a right one.
        axes: on which the unknown shows; each of them is right.
        values: true quantities of each injection, SI units. labels: their strengths in words.
        expected: ``[S, T]`` counts without photon noise. without: the same without anything hidden.
        lacking: the same without one injection, the others in it.
        counts: ``[S, T]`` photons.
        work: the measurement of ``expected``. works: those of ``lacking``.
        response: σ and 1/κ of the ordinary response, m. dark: ordinary background, counts a bin.
    """

    spec: Spec
    scene: WildScene
    names: tuple[str, ...]
    unknown: str
    right: dict[str, tuple[str, ...]]
    alike: dict[str, tuple[str, ...]]
    axes: tuple[str, ...]
    values: dict[str, dict[str, float]]
    labels: dict[str, str]
    expected: np.ndarray
    without: np.ndarray
    lacking: dict[str, np.ndarray]
    counts: np.ndarray
    work: WildWork
    works: dict[str, WildWork]
    response: tuple[float, float]
    dark: float

    @property
    def kind(self) -> str:
        """As `Spec.kind`, but what has come to be known since it was drawn as something unknown is single."""
        return "unknown" if self.unknown else ("null", "single", "pair")[len(self.names)]


def make(set_name: str, index: int, path: str | Path | None = None) -> Truth:
    """The capture number ``index`` of a set, written to ``path`` (replaced if it exists) where given."""
    truth = hide(spec_of(set_name, index))
    if path is not None:
        write(truth, path)
    return truth


def write(truth: Truth, path: str | Path) -> None:
    """The capture as a y-tal file that tells nothing of what is in it."""
    write_scan(path, truth.scene, truth.counts, scan_order(truth.spec.order, truth.spec.side))


def hide(spec: Spec) -> Truth:
    """The truth without a file."""
    names = _in_order(spec)
    whole, values = _measured(spec, names)
    expected = whole.expected()
    without = _measured(spec, ())[0].expected() if names else expected
    others = {name: _measured(spec, tuple(n for n in names if n != name))[0] for name in names}
    rng = np.random.default_rng([spec.seed, 1])
    counts = rng.poisson(expected) if whole.sampler is None else whole.sampler(rng)
    unknown = next((name for name in names if not ALL[name].right), "")
    return Truth(
        spec=spec,
        scene=whole.scene,
        names=names,
        unknown=unknown,
        right={name: ALL[name].right for name in names},
        alike={name: ALL[name].alike for name in names},
        axes=ALL[unknown].axes if unknown else (),
        values=values,
        labels={name: STRENGTHS[spec.strengths[spec.effects.index(name)]] for name in names},
        expected=expected,
        without=without,
        lacking={name: work.expected() for name, work in others.items()},
        counts=counts,
        work=whole,
        works=others,
        response=(whole.sigma * whole.bin, whole.bin / whole.kappa),
        dark=whole.dark,
    )


def true_values(spec: Spec) -> dict[str, dict[str, float]]:
    """True quantities of each injection, as in a :class:`Truth`, without its light."""
    return _measured(spec, _in_order(spec))[1]


def _in_order(spec: Spec) -> tuple[str, ...]:
    """Names of the injections in the order of the light's way."""
    return tuple(sorted(spec.effects, key=list(ALL).index))


def _measured(spec: Spec, names: tuple[str, ...]) -> tuple[WildWork, dict[str, dict[str, float]]]:
    """The measurement with those of its injections; each is the same whatever else there is."""
    scene = load(spec.family, spec.seed, spec.scan == "confocal", spec.side)
    rank = 2 * scan_order(spec.order, spec.side) / (spec.side**2 - 1) - 1
    rng = np.random.default_rng([spec.seed, 2])
    work = WildWork(
        scene,
        spec.level,
        rank,
        rng,
        sigma=float(rng.uniform(0.8, 1.5)),
        kappa=float(rng.uniform(0.4, 1.0)),
        dim=float(np.exp(rng.uniform(np.log(4e-5), np.log(2e-4)))),
    )
    values = {}
    for name in names:
        strength = ALL[name].ladder[spec.strengths[spec.effects.index(name)]]
        work.rng = np.random.default_rng([spec.seed, zlib.crc32(name.encode())])
        values[name] = ALL[name].inject(work, strength)
    return work, values
