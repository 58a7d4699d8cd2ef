"""The null distribution by toys: draw counts from the fitted base, go through the whole pipeline again, screen again.

What the pipeline itself does to a capture without effects (seeds, surfels that stay or die, an optimiser that stops) then counts as
noise. A statistic is judged against χ² stretched by the mean of its toys over its degrees of freedom, where that exceeds one.
"""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import stats

from nlos_lit.capture import Capture
from nlos_lit.criticism.criticise import CriticismSettings, look
from nlos_lit.criticism.screen import Candidate
from nlos_lit.criticism.split import Split
from nlos_lit.criticism.steps import Report
from nlos_lit.effects.scan import Scan
from nlos_lit.surfel_fit import SurfelFit

Pipeline = Callable[[Capture, Split, int], SurfelFit]


@dataclass(frozen=True)
class Null:
    """``stretch``: of each effect's statistic over its degrees of freedom, ≥ 1. ``largest``: largest predicted gain of each toy."""

    toys: int
    stretch: dict[str, float]
    largest: list[float]

    def p_value(self, candidate: Candidate) -> float:
        """Of the stretched χ²; the number of shapes tried stays paid for."""
        effect = candidate.effect
        stretched = candidate.statistic / self.stretch.get(effect.name, 1.0)
        return min(1.0, len(effect.shape_grid()) * float(stats.chi2.sf(stretched, candidate.degrees)))


def toy_capture(capture: Capture, fit: SurfelFit, seed: int) -> Capture:
    """Counts drawn from the fit, inside the gate; zeros before it."""
    expected = fit.model.expected(torch.arange(capture.n_spots), fit.extension).double().numpy()
    drawn = np.random.default_rng([seed, 77]).poisson(expected)
    counts = np.zeros(capture.counts.shape, dtype=np.uint32)
    counts[:, capture.gate[0] : capture.gate[1]] = drawn
    return dataclasses.replace(capture, counts=counts)


def run_toys(
    capture: Capture,
    fit: SurfelFit,
    pipeline: Pipeline,
    split: Split,
    settings: CriticismSettings,
    store: Path,
    report: Report,
) -> Null:
    """``settings.toys`` toys in ``settings.processes`` processes.

    Each is kept in ``store`` as it is done, so that interrupted work goes on.
    """
    began = time.monotonic()
    store.mkdir(parents=True, exist_ok=True)
    todo = [k for k in range(settings.toys) if not (store / f"toy_{k}.json").exists()]
    with ProcessPoolExecutor(settings.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(_toy, toy_capture(capture, fit, k), pipeline, split, settings, k, store) for k in todo]
        for done, job in enumerate(as_completed(jobs), 1):
            job.result()
            passed = time.monotonic() - began
            report(f"toy {settings.toys - len(todo) + done} of {settings.toys}", passed, passed / done * (len(todo) - done))
    return read_toys([store / f"toy_{k}.json" for k in range(settings.toys)])


def read_toys(files: list[Path]) -> Null:
    """The null distribution that stored toys give."""
    results = [json.loads(file.read_text()) for file in files]
    names = results[0]["statistic"]
    stretch = {n: max(1.0, float(np.mean([r["statistic"][n] / r["degrees"][n] for r in results]))) for n in names}
    return Null(len(results), stretch, [r["largest"] for r in results])


def _toy(capture: Capture, pipeline: Pipeline, split: Split, settings: CriticismSettings, seed: int, store: Path) -> None:
    torch.set_num_threads(1)
    fit = pipeline(capture, split, seed)
    candidates = look(fit, split, Scan.of(capture), settings, seed).candidates
    result = {
        "statistic": {c.effect.name: c.statistic for c in candidates},
        "degrees": {c.effect.name: c.degrees for c in candidates},
        "largest": max(c.gain for c in candidates),
    }
    part = store / f".toy_{seed}.json"
    part.write_text(json.dumps(result))
    part.rename(store / f"toy_{seed}.json")
