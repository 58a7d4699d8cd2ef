"""What a diagnosis says, as frozen records; ``diagnosis.json`` is :meth:`Diagnosis.to_dict`."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, cast, get_args, get_origin, get_type_hints

import numpy as np

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import bounded
from nlos_lit.io.files import plain
from nlos_lit.metrics.transients import Scores

LARGEST = 2**28  # bytes of a diagnosis


@dataclass(frozen=True)
class Estimate:
    """A parameter with its standard error."""

    value: float
    stderr: float
    unit: str


@dataclass(frozen=True)
class Gain:
    """What an effect brings on spots it was not fitted to.

    Args:
        deviance_per_bin_before: of the control.
        deviance_per_bin_after: with the effect.
        nats_per_photon: gained.
        ci95: of ``nats_per_photon``, by block bootstrap.
    """

    deviance_per_bin_before: float
    deviance_per_bin_after: float
    nats_per_photon: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Shape:
    """What a free term looks like along its axis, or over the wall, or over time and another axis.

    Args:
        unit: of the values: ``1`` (logarithm of a factor) or ``m`` (a delay).
        edges: ``[K + 1]`` of the axis, or of the first of two; bins, spots in order of acquisition, metres on
            the wall, or counts.
        values: ``[K]`` or ``[K1, K2]``.
        edges_y: ``[K2 + 1]`` of the second axis.
    """

    axis: str
    unit: str
    edges: np.ndarray
    values: np.ndarray
    edges_y: np.ndarray | None = None


@dataclass(frozen=True)
class Followed:
    """The formula that comes nearest to a free term, see :mod:`nlos_lit.inference.distil`.

    Args:
        name: of the formula. equation: in terms of x, and what x is.
        share: of the free term's gain on spots that were not fitted.
        offered: it keeps enough to be an effect of its own.
        curve: ``[K + 1]`` its values at the edges of the free term's shape, a constant added that lays it
            through that; None where the two are not of one kind.
    """

    name: str
    equation: str
    parameters: dict[str, Estimate]
    share: float
    offered: bool
    curve: np.ndarray | None = None


@dataclass(frozen=True)
class Tried:
    """A term as it was tried beside a scene.

    Args:
        nats: gained over none, one number for each held-out wall block of each capture.
        values: of its amplitudes, by name, in their units, if other captures must have the same.
    """

    nats: list[float]
    values: dict[str, list[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Accepted:
    """A term that the model was extended with: an effect of the registry, or a free term.

    Args:
        evidence: nats in the pool when it was asked for, log Bayes factor against none.
        heldout_gain: on spots that were not fitted.
        weights: how far the capture leaves open which term is meant, by name, the term itself among them;
            what weighs too little is left out.
        split_by: the measurement that would tell those apart.
        axis: of a free term, else empty.
        shape: of a free term. formula: that it follows best; None where none was asked for.
        needed: nats of evidence that this term needed; None for those of all others.
        tried: the names of ``weights`` as they were tried, each beside the same scene.
        advised: nats that captures as long as this one are expected to tell between the term and the rival
            that is hardest to tell from it, by what is done in them, see :mod:`nlos_lit.inference.advise`.
        explained: share that it explains of what held-out spots leave unexplained without it.
        misfit: of ``needed``, nats that what the scene cannot follow may give it: they count in the errors.
    """

    name: str
    parameters: dict[str, Estimate]
    evidence: float
    heldout_gain: Gain
    weights: dict[str, float] = field(default_factory=dict)
    split_by: str = ""
    axis: str = ""
    shape: Shape | None = None
    formula: Followed | None = None
    needed: float | None = None
    tried: dict[str, Tried] = field(default_factory=dict)
    advised: dict[str, float] = field(default_factory=dict)
    explained: float = 0.0
    misfit: float = 0.0

    @property
    def confusable_with(self) -> list[str]:
        """Other names that this capture leaves open."""
        return [name for name in self.weights if name != self.name]


@dataclass(frozen=True)
class Screened:
    """One term as the pool sees it at its null, beside the base.

    Args:
        evidence: nats.
        retained_information: share of its information that scene and response cannot imitate.
        scatter: how much more its scores scatter between wall blocks than counts do; 1 where they do not.
        degrees: coefficients.
        one_step: estimated parameters. shape: scanned ones.
        detectable: the smallest amplitude of each parameter that this capture would reveal in nine of ten
            cases; of a field its root mean square, if all of its coefficients are as large.
    """

    name: str
    evidence: float
    retained_information: float
    scatter: float
    degrees: int
    one_step: dict[str, float]
    shape: dict[str, float]
    detectable: dict[str, float]


@dataclass(frozen=True)
class Unexplained:
    """What no effect of the registry explains: the axis of the free term that holds most of it."""

    significant: bool
    axis: str
    evidence: float


@dataclass(frozen=True)
class Profile:
    """Signed residual significance along one axis, before and after the extension.

    ``edges`` ``[K + 1]`` in ``unit``, ``before`` and ``after`` ``[K]`` (K1 × K2 for the wall, with ``edges``
    of both sides).
    """

    axis: str
    unit: str
    edges: np.ndarray
    before: np.ndarray
    after: np.ndarray
    edges_y: np.ndarray | None = None


@dataclass(frozen=True)
class Further:
    """What another capture said of names that were open.

    Args:
        name: of that capture.
        asked: names that were open, the accepted one first.
        nats: what each gains there over none of them, on wall blocks that were not fitted.
        kept: of names whose values must stay what they were, the share of the gain of values fitted anew
            that those of before keep; below a half these contradict each other, and ``nats`` are theirs.
        seen: that capture asks for any of them by itself.
        weights: of all captures together, by name.
        stays: names that are left, the accepted one first.
    """

    name: str
    asked: list[str]
    nats: dict[str, float]
    kept: dict[str, float]
    seen: bool
    weights: dict[str, float]
    stays: list[str]


@dataclass(frozen=True)
class Likely:
    """A term that is not named, although spots that were not fitted are predicted much better with it.

    Args:
        nats: that they gain. error: of it, over wall blocks.
        explained: share that it explains of what they leave unexplained without it.
        evidence: its own, nats, less than …
        needed: … what the scene leaves unexplained may look like it by.
    """

    name: str
    nats: float
    error: float
    explained: float
    evidence: float
    needed: float


@dataclass(frozen=True)
class Diagnosis:
    """Everything that ``diagnose.py`` found.

    Args:
        effects: of the registry, that the model was extended with, in that order.
        unknown: free terms that it was extended with.
        groups: names that the capture cannot tell apart, an accepted effect first.
        needed: nats of evidence that a term of this pool needed.
        chance: of evidence as large as the largest, without any effect: counted over ``toys``; without toys
            what the theory says of the one that exceeds most what it needs.
        further: what other captures said of the groups.
        likely: terms that were tried, predict much and are not certain, the largest gain first.
        along: effects that the last model has without a name.
    """

    effects: list[Accepted]
    unknown: list[Accepted]
    groups: list[list[str]]
    unexplained: Unexplained
    screened: list[Screened]
    base: Scores
    extended: Scores
    untouched_test: dict[str, Scores]  # "base", "extended"
    witness: dict[str, Any] | None
    profiles: list[Profile]
    needed: float
    chance: float
    notes: list[str]
    capture: dict[str, Any]
    toys: int
    seconds: float
    seed: int
    further: list[Further] = field(default_factory=list)
    likely: list[Likely] = field(default_factory=list)
    along: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return plain(self)

    @staticmethod
    def read(file: Path) -> Diagnosis:
        """What :meth:`to_dict` gave, from a file.

        Args:
            file: ``diagnosis.json``.

        Returns:
            The same; values that were infinite or none are NaN.

        Raises:
            UserError: the file is missing, damaged, or of an earlier version.
        """
        try:
            return cast(Diagnosis, _made(Diagnosis, json.loads(bounded(file, LARGEST))))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise UserError(
                f"{file} holds no diagnosis of this version; diagnose the capture again"
            ) from error


def _made(kind: Any, value: Any) -> Any:
    """A value of a type, from its plain form."""
    if is_dataclass(kind):
        known = get_type_hints(kind)
        return cast(type, kind)(**{f.name: _made(known[f.name], value[f.name]) for f in fields(kind)})
    inside = get_args(kind)
    if get_origin(kind) is UnionType:
        return None if value is None else _made(next(i for i in inside if i is not NoneType), value)
    if get_origin(kind) is list:
        return [_made(inside[0], one) for one in value]
    if get_origin(kind) is dict:
        return {key: _made(inside[1], one) for key, one in value.items()}
    if get_origin(kind) is tuple:
        return tuple(_made(one, v) for one, v in zip(inside, value, strict=True))
    if kind is np.ndarray:
        return np.array(value, dtype=np.float64)
    if kind is float:
        return math.nan if value is None else float(value)
    if kind is not Any and isinstance(kind, type) and not isinstance(value, kind):
        raise TypeError(f"{value!r} is no {kind.__name__}")
    return value
