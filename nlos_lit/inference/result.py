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
class Accepted:
    """An effect that the model was extended with."""

    name: str
    parameters: dict[str, Estimate]
    statistic: float
    p_value: float
    heldout_gain: Gain
    confusable_with: list[str] = field(default_factory=list)
    split_by: str = ""


@dataclass(frozen=True)
class Screened:
    """One effect's score test at its null, against the base.

    ``predicted_gain`` (nats, cross-validated over wall blocks) ranks; ``one_step`` are estimated parameters,
    ``shape`` the scanned ones; ``detectable`` is the smallest amplitude of each parameter that this capture
    would reveal (statistic 25). ``expected``: statistic without the effect, on average: degrees of freedom,
    or what toys show where that is more.
    """

    name: str
    statistic: float
    p_value: float
    retained_information: float
    degrees: int
    predicted_gain: float
    one_step: dict[str, float]
    shape: dict[str, float]
    detectable: dict[str, float]
    expected: float


@dataclass(frozen=True)
class Unexplained:
    """What is still wrong after all accepted effects, and along which axis it shows."""

    significant: bool
    axis: str
    statistic: float
    p_value: float


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
    """Everything that ``diagnose.py`` found."""

    effects: list[Accepted]
    groups: list[list[str]]
    unexplained: Unexplained
    screened: list[Screened]
    base: Scores
    extended: Scores
    untouched_test: dict[str, Scores]  # "base", "extended"
    witness: dict[str, Any] | None
    profiles: list[Profile]
    numerics: dict[str, float]
    notes: list[str]
    capture: dict[str, Any]
    toys: int
    seconds: float
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return plain(self)
