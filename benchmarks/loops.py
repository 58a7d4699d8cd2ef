"""What compiled loops save: a batch of the surface fit, and who hides whom, beside tensor by tensor.

    python benchmarks/loops.py

Both sides work on the same surfels of a drawn scene, in turns in one process with one thread. Prints one JSON
line a size: medians in milliseconds of the process's own time, and their ratio.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from unittest.mock import patch

import numpy as np
import torch
from surface import drawn
from timing import median, seconds

from data_modules.spots import heldout_mask
from nlos_lit.effects.extension import Extension
from nlos_lit.surfels.fit import SurfelFit, SurfelSettings
from nlos_lit.surfels.start import seed_surfels

LOOPS = (
    "surfel_paths.compiled",
    "surfel_paths.for_loops",
    "surfel_graph.compiled",
    "surfel_visibility.for_loops",
)
SCENE = 806  # 64 × 64 spots
TURNS = 15


def fit_of(divided: int) -> SurfelFit:
    """A fit of the drawn scene, after the contest of its seeds, which are divided so often."""
    case = drawn(SCENE)
    capture = case.capture
    lit = capture.gated_counts().any(1)
    train = np.flatnonzero(~heldout_mask(capture, 8, 4) & lit)
    fit = seed_surfels(capture, case.image, case.grid, SurfelSettings(), train, None, Extension([]), seed=0)
    fit.begin_round()
    while not fit.round_done:
        fit.step()
    fit.end_round()
    for _ in range(divided):
        fit.model.divide(2)
    fit.begin_round()
    return fit


def plainly(work: Callable[[], object]) -> Callable[[], None]:
    """The same work with nothing compiled."""

    def run() -> None:
        with ExitStack() as stack:
            for name in LOOPS:
                stack.enter_context(patch(f"nlos_lit.functional.{name}", lambda values: False))
            work()

    return run


def in_turns(work: Callable[[], object], turns: int) -> dict[str, float]:
    """Medians of both sides."""
    other, found = plainly(work), {"compiled": list[float](), "tensors": list[float]()}
    work()
    other()
    for _ in range(turns):
        found["compiled"].append(seconds(work))
        found["tensors"].append(seconds(other))
    both = {name: 1e3 * median(values) for name, values in found.items()}
    rounded = {name: round(value, 2) for name, value in both.items()}
    return rounded | {"ratio": round(both["tensors"] / both["compiled"], 1)}


def main() -> None:
    torch.set_num_threads(1)
    for divided in range(4):
        fit = fit_of(divided)
        row = {"surfels": len(fit.model), "points": fit.model.quadrature**2, "spots": len(fit.model.laser)}
        row["batch"] = in_turns(fit.step, TURNS)
        row["hiders of 256 spots"] = in_turns(lambda fit=fit: fit.model.update_hiders(fit.train[:256]), 3)
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
