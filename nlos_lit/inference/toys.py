"""The null distribution by toys: draw counts from the fitted base, go through the whole pipeline again,
screen again.

What the pipeline itself does to a capture without effects (seeds, surfels that stay or die, an optimiser that
stops) then counts as noise. A statistic is judged against a gamma distribution with the mean and variance of
its toys, and against χ²: the larger p counts. On a bright capture a base leaves something like a slow tail
every time, 190 ± 65 where χ² expects 1: no stretched χ² is so narrow.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.inference.criticise import CriticismSettings, look
from nlos_lit.inference.screen import Candidate
from nlos_lit.inference.split import Split
from nlos_lit.runtime.steps import Report
from nlos_lit.surfels.fit import SurfelFit

FEW = 10
Pipeline = Callable[[Capture, Split, int], SurfelFit]


@dataclass(frozen=True)
class Null:
    """The null distribution of the screening's statistics.

    Args:
        toys: how many there were.
        moments: mean and variance of each effect's statistic.
        largest: largest predicted gain of each toy, nats.
    """

    toys: int
    moments: dict[str, tuple[float, float]]
    largest: list[float]

    def expected(self, candidate: Candidate) -> float:
        """Mean statistic without the effect, at least its degrees of freedom."""
        return max(float(candidate.degrees), self.moments.get(candidate.effect.name, (0.0, 0.0))[0])

    def p_value(self, candidate: Candidate) -> float:
        """Of the gamma distribution or of χ², whichever is larger.

        A toy's statistic is that of its best shape, too. Fewer toys than ``FEW`` do not settle a variance: it
        is then at least that of a χ² with the same mean.
        """
        mean, variance = self.moments.get(candidate.effect.name, (0.0, 0.0))
        if self.toys < FEW:
            variance = max(variance, 2 * mean**2 / candidate.degrees)
        if variance == 0 or mean <= 0:
            return candidate.p_value
        return max(
            candidate.p_value,
            float(stats.gamma.sf(candidate.statistic, mean**2 / variance, scale=variance / mean)),
        )


def toy_capture(capture: Capture, fit: SurfelFit, seed: int) -> Capture:
    """Counts drawn from the fit, inside the gate; zeros before it.

    Args:
        capture: whose scan is kept.
        fit: of all its spots.
        seed: of the counts.

    Returns:
        a capture of the same scan.
    """
    expected = fit.model.expected(torch.arange(capture.n_spots), fit.extension).double().numpy()
    drawn = np.random.default_rng([seed, 77]).poisson(expected)
    counts = np.zeros(capture.counts.shape, dtype=np.uint32)
    counts[:, capture.gate[0] : capture.gate[1]] = drawn
    return capture.with_counts(counts)


def run_toys(
    capture: Capture,
    fit: SurfelFit,
    pipeline: Pipeline,
    split: Split,
    settings: CriticismSettings,
    store: Path,
    report: Report,
) -> Null:
    """Draw toys from the fit and screen each after its own fit, several at a time in other processes.

    Each is kept as it is done, so that interrupted work goes on.

    Args:
        capture: whose scan is kept.
        fit: the base, which toys are drawn from.
        pipeline: that each goes through.
        split: of the spots.
        settings: ``toys`` of them in ``processes`` processes.
        store: folder of their results.
        report: called with what is done, seconds since the start and seconds left.

    Returns:
        the null distribution.

    Raises:
        UserError: a file in ``store`` is damaged or foreign.
    """
    began = time.monotonic()
    store.mkdir(parents=True, exist_ok=True)
    todo = [k for k in range(settings.toys) if not (store / f"toy_{k}.json").exists()]
    with ProcessPoolExecutor(settings.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [
            pool.submit(_toy, toy_capture(capture, fit, k), pipeline, split, settings, k, store) for k in todo
        ]
        for done, job in enumerate(as_completed(jobs), 1):
            job.result()
            passed = time.monotonic() - began
            report(
                f"toy {settings.toys - len(todo) + done} of {settings.toys}",
                passed,
                passed / done * (len(todo) - done),
            )
    return read_toys([store / f"toy_{k}.json" for k in range(settings.toys)])


def read_toys(files: list[Path]) -> Null:
    """The null distribution that stored toys give.

    Args:
        files: one a toy.

    Raises:
        UserError: a file is damaged or foreign.
    """
    results = [_read_toy(file) for file in files]
    drawn = {n: np.array([r["statistic"][n] for r in results]) for n in results[0]["statistic"]}
    moments = {n: (float(v.mean()), float(v.var(ddof=1)) if len(v) > 1 else 0.0) for n, v in drawn.items()}
    return Null(len(results), moments, [r["largest"] for r in results])


def _read_toy(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text())
        return {
            "statistic": {str(name): float(value) for name, value in found["statistic"].items()},
            "largest": float(found["largest"]),
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{file} is damaged, or holds no toy: move it away") from error


def _toy(
    capture: Capture, pipeline: Pipeline, split: Split, settings: CriticismSettings, seed: int, store: Path
) -> None:
    torch.set_num_threads(1)
    fit = pipeline(capture, split, seed)
    candidates = look(fit, split, Scan.of(capture), settings, seed).candidates
    result = {
        "statistic": {c.effect.name: c.statistic for c in candidates},
        "largest": max(c.gain for c in candidates),
    }
    part = store / f".toy_{seed}.json"
    part.write_text(json.dumps(result))
    part.rename(store / f"toy_{seed}.json")
