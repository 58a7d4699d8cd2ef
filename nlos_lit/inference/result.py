"""What a diagnosis says, as frozen records; ``diagnosis.json`` is :meth:`Diagnosis.to_dict`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nlos_lit.io.files import plain
from nlos_lit.metrics.transients import Scores


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
        name: of the formula. equation: in terms of x, from 0 to 1 along the axis.
        share: of the free term's gain on spots that were not fitted.
        offered: it keeps enough to be an effect of its own.
    """

    name: str
    equation: str
    parameters: dict[str, Estimate]
    share: float
    offered: bool


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
            cases.
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
class Diagnosis:
    """Everything that ``diagnose.py`` found.

    Args:
        effects: of the registry, that the model was extended with, in that order.
        unknown: free terms that it was extended with.
        groups: names that the capture cannot tell apart, an accepted effect first.
        needed: nats of evidence that a term of this pool needed.
        chance: of evidence as large as the largest, without any effect: counted over ``toys``; without toys
            what the theory says.
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

    def to_dict(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return plain(self)
