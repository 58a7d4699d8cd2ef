"""Are the chances that simulated captures give uniform where nothing is hidden?

    python benchmarks/p_values.py 371 20          the last 20 captures without effects up to validation 371

Each capture is fitted without effects and the pool is asked, as a diagnosis does first. Then so are ``TOYS``
captures drawn from that fit, and the chance of the capture's largest evidence is counted. If a capture is to
its fit as these are to theirs, chances are uniform over 1/(toys + 1), …, 1. Printed is one JSON line a
capture, and one with the Kolmogorov–Smirnov distance from that; how often so much comes by chance is counted
over drawn sets of chances. A capture takes some ten minutes of a core; two processes, of one thread each.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "tests" / "blind")]
STORE = ROOT / "benchmarks" / "results" / "p_values"
TOYS = 9  # captures drawn from each fit: chances are tenths
DRAWS = 100_000  # of as many uniform chances as there are captures
TABLE = "chances where nothing is hidden"


def row_of(number: int) -> dict:
    """One validation capture's row."""
    from blind import commit
    from blind_judge import pipeline_for
    from judge_wild import hidden

    from nlos_lit.capture.scan import Scan
    from nlos_lit.inference.pool import ask, lit_by
    from nlos_lit.inference.settings import CriticismSettings
    from nlos_lit.inference.split import split_spots
    from nlos_lit.inference.toys import run_toys

    began = time.monotonic()
    truth, capture = hidden("validation", number)
    pipeline, split, settings = pipeline_for(capture), split_spots(capture), CriticismSettings(toys=TOYS)
    base = pipeline(capture, split, 0)
    most = ask(base, split, lit_by(base, Scan.of(capture)), settings.spots, 0).candidates[0]
    store = STORE / commit() / f"{number:03d}"
    null = run_toys(capture, base, pipeline, split, settings, store, lambda *_: None)
    return {
        "table": TABLE,
        "commit": commit(),
        "command": f"python {' '.join(sys.argv)}",
        "seed": 0,
        "capture": f"validation {number}",
        "family": truth.spec.family,
        "counts_per_spot": truth.spec.level,
        "term": most.name,
        "evidence": round(most.evidence, 2),
        "toys": sorted(round(value, 2) for value in null.largest),
        "chance": null.chance(most.evidence),
        "seconds": round(time.monotonic() - began, 1),
    }


def distance(chances: np.ndarray) -> np.ndarray:
    """Kolmogorov–Smirnov distance of chances ``[..., n]`` from uniform over 1/(TOYS + 1), …, 1."""
    steps = np.arange(1, TOYS + 2) / (TOYS + 1)
    below = (chances[..., None] <= steps + 1e-9).mean(-2)
    return np.abs(below - steps).max(-1)


def summary(chances: list[float]) -> dict:
    """The distance of all, and how often chance alone gives as much."""
    drawn = np.random.default_rng(0).integers(1, TOYS + 2, (DRAWS, len(chances))) / (TOYS + 1)
    found = float(distance(np.array(chances)))
    return {
        "captures": len(chances),
        "distance": round(found, 3),
        "as_far_by_chance": round(float((distance(drawn) >= found - 1e-9).mean()), 4),
    }


def main(last: int, number: int) -> None:
    """Print the rows of the last captures without effects up to one, in their order."""
    from wild_table import spec_of

    free = [k for k in range(last + 1) if spec_of("validation", k).kind == "null"][-number:]
    rows = []
    for k in free:
        rows.append(row_of(k))
        print(json.dumps(rows[-1]), flush=True)
    about = {name: rows[0][name] for name in ("table", "commit", "command", "seed")}
    print(json.dumps(about | {"capture": "all"} | summary([row["chance"] for row in rows])))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
