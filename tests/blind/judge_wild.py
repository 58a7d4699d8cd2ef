"""A diagnosis of a capture of the evaluation sets, and what it said beside the truth.

The code under test gets the capture file and nothing else.
"""

from __future__ import annotations

import tempfile
import time
import traceback
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from blind_judge import pipeline_for
from wild_statistic import true_statistics
from wild_truth import Truth, make

from data_modules.readers import read_capture
from nlos_lit.capture import Capture
from nlos_lit.inference.diagnose import diagnose, split_of
from nlos_lit.inference.heldout import log_likelihood
from nlos_lit.inference.members import Findings
from nlos_lit.inference.result import Diagnosis
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.metrics.transients import transient_scores


@dataclass(frozen=True)
class Outcome:
    """One row of the table; a diagnosis that fails is a row, too.

    Args:
        right: registry names that are right, of each thing hidden. alike: those right in a group with one.
        axes: on which an unknown shows. statistics: ``[plain, projected]`` of each thing hidden.
        named: weights by name of each effect that was accepted, in order. unknown: axes of free terms.
        parameters: value and standard error by effect and quantity.
        base, extended, noise: deviance per bin of the untouched spots.
        largest: term and nats of the most evidence in the first pool.
        likely: terms that are told of and not named.
        tried: of each term what was found when it was last asked for: own and needed nats, gain of the select
            spots and its error, weight, explained share, whether it was accepted, and the nats of those
            needed that are for what other terms take from it.
        values: true quantities of each thing hidden, under a registry's names where they mean the same.
        limits: by right name and quantity what would be named in nine of ten, by the diagnosis itself.
        reached: of an unknown, see :func:`reached`.
        error: what went wrong.
    """

    set_name: str
    index: int
    spec: dict
    kind: str
    right: dict[str, list[str]]
    alike: dict[str, list[str]]
    axes: list[str]
    statistics: dict[str, list[float]]
    named: list[dict[str, float]] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    parameters: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    base: float = 0.0
    extended: float = 0.0
    noise: float = 0.0
    largest: tuple[str, float] = ("", 0.0)
    likely: list[str] = field(default_factory=list)
    tried: dict[str, list[float]] = field(default_factory=dict)
    values: dict[str, dict[str, float]] = field(default_factory=dict)
    limits: dict[str, dict[str, float]] = field(default_factory=dict)
    reached: float | None = None
    seconds: float = 0.0
    error: str = ""


def hidden(set_name: str, index: int) -> tuple[Truth, Capture]:
    """What is hidden, and the capture as its file is read."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.hdf5"
        return make(set_name, index, path), read_capture(path, "auto")


def judge(set_name: str, index: int, options: CriticismSettings) -> Outcome:
    """Hide, diagnose, note what was said."""
    truth, capture = hidden(set_name, index)
    known = {
        "set_name": set_name,
        "index": index,
        "spec": asdict(truth.spec),
        "kind": truth.kind,
        "right": {name: list(said) for name, said in truth.right.items()},
        "alike": {name: list(said) for name, said in truth.alike.items()},
        "axes": list(truth.axes),
        "statistics": {
            n: [round(s.plain, 1), round(s.projected, 1)] for n, s in true_statistics(truth).items()
        },
        "values": truth.values,
    }
    began = time.process_time()
    try:
        diagnosis, found = diagnose(capture, pipeline_for(capture), options, name="capture", seed=0)
    except Exception:  # a failure counts against the rates, and the others go on
        return Outcome(**known, error=traceback.format_exc(limit=-2), seconds=time.process_time() - began)
    seconds, right = time.process_time() - began, {n for names in truth.right.values() for n in names}
    known["limits"] = {s.name: s.detectable for s in diagnosis.screened if s.name in right}
    if truth.unknown:
        known["reached"] = reached(truth, capture, diagnosis)
    return Outcome(**known, **said(diagnosis, found), seconds=seconds)


def reached(truth: Truth, capture: Capture, diagnosis: Diagnosis) -> float:
    """Share of what a perfectly known cause gains over the base that the diagnosis gains, on untouched spots.

    The cause is taken from the simulator: by how much it changes each bin's light. It acts on a scene of
    counts without it, which has not bent to it, and is as far from the truth as other scenes are.
    """
    drawn = np.random.default_rng([truth.spec.seed, 3]).poisson(truth.without).astype(capture.counts.dtype)
    before = replace(capture, counts=drawn, observed=None)
    pipeline, split = pipeline_for(before), split_of(before)
    coarse = pipeline(before, split, 0)
    scenes = coarse, pipeline.grow(coarse, 0)
    scene = max(scenes, key=lambda fit: float(log_likelihood(fit, split.select).sum()))
    spots, (first, last) = split_of(capture).test, capture.gate
    change = torch.from_numpy((truth.expected / truth.without)[spots, first:last])
    with torch.no_grad():
        light = scene.model.expected(torch.from_numpy(spots), scene.extension).double() * change
    counts, observed = torch.from_numpy(capture.gated_counts()[spots]), capture.gated_observed()
    seen = None if observed is None else torch.from_numpy(observed[spots])
    known = transient_scores(counts, light, seen).deviance_per_bin
    base, extended = (diagnosis.untouched_test[n].deviance_per_bin for n in ("base", "extended"))
    return (base - extended) / (base - known)


def said(diagnosis: Diagnosis, found: Findings) -> dict:
    """The fields of an outcome that a diagnosis fills."""
    test, effects = diagnosis.untouched_test, diagnosis.effects
    asked = {m.name: (m.confirmed, m.accepted) for m in found.members if m.confirmed}
    return {
        "named": [{n: round(w, 3) for n, w in (e.weights or {e.name: 1.0}).items()} for e in effects],
        "unknown": [e.axis for e in diagnosis.unknown],
        "parameters": {e.name: {n: [p.value, p.stderr] for n, p in e.parameters.items()} for e in effects},
        "base": test["base"].deviance_per_bin,
        "extended": test["extended"].deviance_per_bin,
        "noise": test["extended"].deviance_noise,
        "largest": (diagnosis.screened[0].name, diagnosis.screened[0].evidence),
        "likely": [term.name for term in diagnosis.likely],
        "tried": {
            name: [
                c.evidence,
                c.needed,
                c.gain.nats,
                c.gain.error,
                c.weight,
                c.explained,
                float(accepted),
                c.shared,
            ]
            for name, (c, accepted) in asked.items()
        },
    }
