"""What the pipeline itself does to captures without effects: draw counts from the fitted base, go through the
whole pipeline again, ask the pool again.

One number is kept of each toy, the largest evidence over the pool, and the chance that is reported is
counted: (1 + toys with as much)/(1 + toys).
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import bounded
from nlos_lit.capture.scan import Scan
from nlos_lit.inference.pool import ask, lit_by
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.inference.split import Split
from nlos_lit.runtime.steps import Report
from nlos_lit.surfels.fit import SurfelFit

Pipeline = Callable[[Capture, Split, int], SurfelFit]


@dataclass(frozen=True)
class Null:
    """The null distribution of the largest evidence.

    Args:
        largest: of each toy, nats.
    """

    largest: list[float]

    @property
    def toys(self) -> int:
        return len(self.largest)

    def chance(self, evidence: float) -> float:
        """Of so much evidence without any effect; n toys know no chance below 1/(n + 1).

        Examples:
            >>> Null([0.5, 3.0, 1.0]).chance(2.0)
            0.5
        """
        return (1 + sum(value >= evidence for value in self.largest)) / (1 + self.toys)


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
    """Draw toys from the fit and ask the pool about each after its own fit, several at a time.

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
    return Null([_read_toy(file) for file in files])


def _read_toy(file: Path) -> float:
    try:
        return float(json.loads(bounded(file))["largest"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(f"{file} is damaged, or holds no toy: move it away") from error


def _toy(
    capture: Capture, pipeline: Pipeline, split: Split, settings: CriticismSettings, seed: int, store: Path
) -> None:
    torch.set_num_threads(1)
    fit = pipeline(capture, split, seed)
    pool = ask(fit, split, lit_by(fit, Scan.of(capture)), settings.spots, seed).candidates
    part = store / f".toy_{seed}.json"
    part.write_text(json.dumps({"largest": pool[0].evidence, "term": pool[0].name}))
    part.rename(store / f"toy_{seed}.json")
