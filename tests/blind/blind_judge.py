"""A diagnosis of a hidden capture, and whether it was right.

The code under test gets the capture file and nothing else. The oracle is told the true effects' names and
rebuilds the scene with them; its gain says what was there to be had.
"""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from blind_truth import Spec, Truth, make_capture

from data_modules.readers import read_capture
from nlos_lit.capture import Capture
from nlos_lit.inference.base_pipeline import BasePipeline
from nlos_lit.inference.diagnose import diagnose
from nlos_lit.inference.heldout import Comparison, compare, log_likelihood
from nlos_lit.inference.members import Findings
from nlos_lit.inference.result import Diagnosis
from nlos_lit.inference.scenes import begun_with, solve_spots
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.inference.split import split_spots
from nlos_lit.model.build import PipelineSettings
from nlos_lit.surfels.fit import SurfelSettings

SURFELS = SurfelSettings(most=2400)  # conf/surfels/diagnosis.yaml


@dataclass(frozen=True)
class Outcome:
    """What was hidden and what was said.

    Args:
        named: accepted effects in order, first their groups.
        unexplained: the axis of the accepted free term with the most evidence, or "".
        formulas: that accepted free terms follow closely enough.
        statistic: 2 × the oracle's gain on spots that no fit saw, scaled to the number of fitted spots;
            statistic_error: its standard error, by bootstrap over wall blocks.
        gain, oracle: nats on the select spots, over the base.
        errors: per true quantity, (found - true)/stderr and found/true - 1.
        screened: the six best of the first pool: name, evidence (nats), retained information.
    """

    spec: dict
    hidden: tuple[str, ...]
    unknown: str
    axis: str
    named: list[str]
    groups: list[list[str]]
    unexplained: str
    statistic: float
    gain: float
    oracle: float
    statistic_error: float = 0.0
    errors: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    values: dict[str, dict[str, float]] = field(default_factory=dict)
    found: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    screened: list[tuple[str, float, float]] = field(default_factory=list)
    ratio: float = 1.0
    formulas: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def to_dict(self) -> dict:
        return asdict(self)

    @property
    def first_right(self) -> bool:
        """The first name, or a member of its group, is hidden in the capture."""
        if not self.named:
            return False
        group = next((g for g in self.groups if g[0] == self.named[0]), [self.named[0]])
        return any(name in self.hidden for name in group)

    @property
    def named_or_grouped(self) -> set[str]:
        """Every name said, alone or in a group."""
        return set(self.named) | {name for group in self.groups for name in group}


def pipeline_for(capture: Capture) -> BasePipeline:
    """Settings that follow from the capture's time window alone."""
    near, far = (length / 2 for length in capture.path_gate)
    model = PipelineSettings(0.1, wavelength_range=(2 / 3, 2.0))
    return BasePipeline({"depth": (max(0.15, near - 0.3), far)}, model, SURFELS, 2 << 30)


def diagnose_file(
    path: Path, options: CriticismSettings, seed: int = 0
) -> tuple[Diagnosis, Findings, Capture]:
    """All that the code under test is given."""
    capture = read_capture(path, "auto")
    pipeline = pipeline_for(capture)
    return *diagnose(capture, pipeline, options, name=path.stem, seed=seed), capture


def run_case(spec: Spec, options: CriticismSettings, oracle: bool = True) -> Outcome:
    """Hide, diagnose, judge."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.hdf5"
        truth = make_capture(spec, path)
        diagnosis, found, capture = diagnose_file(path, options)
    split = split_spots(capture)
    weight = len(split.fit) / len(split.select)
    before = log_likelihood(found.base, split.select)
    gain = float((log_likelihood(found.final, split.select) - before).sum())
    best = Comparison(0.0, 0.0, (0.0, 0.0))
    if oracle and truth.names:
        best = oracle_gain(truth, found, capture, before)
    return Outcome(
        spec=asdict(spec),
        hidden=truth.names,
        unknown=truth.unknown,
        axis=truth.axis,
        named=[e.name for e in diagnosis.effects],
        groups=diagnosis.groups,
        unexplained=diagnosis.unexplained.axis if diagnosis.unexplained.significant else "",
        statistic=2 * best.nats * weight,
        gain=gain,
        oracle=best.nats,
        statistic_error=2 * best.error * weight,
        errors=parameter_errors(truth, diagnosis),
        values=truth.values,
        found={e.name: {n: (p.value, p.stderr) for n, p in e.parameters.items()} for e in diagnosis.effects},
        screened=[(c.name, c.evidence, c.retained_information) for c in diagnosis.screened[:6]],
        ratio=diagnosis.base.deviance_per_bin / diagnosis.base.deviance_noise,
        formulas=[u.formula.name for u in diagnosis.unknown if u.formula and u.formula.offered],
        seconds=diagnosis.seconds,
    )


def oracle_gain(truth: Truth, found: Findings, capture: Capture, before: torch.Tensor) -> Comparison:
    """Nats on the select spots of a fine scene that is rebuilt with the true effects."""
    split, pipeline = split_spots(capture), pipeline_for(capture)
    candidates = [c for c in found.pools[0].candidates if c.name in truth.names]
    extension = begun_with(found.base, candidates)
    anew = pipeline.grow(pipeline.fit(capture, split, pipeline.image(capture), extension, 0), 0)
    return compare(before, log_likelihood(solve_spots(anew), split.select), split.block[split.select])


def parameter_errors(truth: Truth, diagnosis: Diagnosis) -> dict[str, dict[str, tuple[float, float]]]:
    """For every true quantity of every effect that was named."""
    errors: dict[str, dict[str, tuple[float, float]]] = {}
    for effect in diagnosis.effects:
        for name, true in truth.values.get(effect.name, {}).items():
            if name in effect.parameters:
                found = effect.parameters[name]
                sigmas = (found.value - true) / max(found.stderr, 1e-12)
                relative = found.value / true - 1 if true else float(np.inf)
                errors.setdefault(effect.name, {})[name] = (float(sigmas), float(relative))
    return errors


def one_thread() -> None:
    """Small tensors: a second thread costs more than it brings."""
    torch.set_num_threads(1)
