"""What the first pool says of captures in which effects are hidden, and where what is right stands in it.

    python benchmarks/pools.py 40 210                  development captures 40 … 209 with one effect
    python benchmarks/pools.py 40 210 kind=pair        … with two

Printed is one JSON line a capture: where the right terms stand in the pool, with their evidence (nats), what
it would be if all scatter were their own (``loud``), the share of their information that the scene cannot
imitate, and how their scores scatter; the terms that lead; those that are asked for beside each other. A base
and its pool take half a minute of one core; nothing is tried. One thread.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "tests" / "blind")]
LEADING = 5
MOST = 8  # terms that are taken together


def row_of(number: int) -> dict:
    """One development capture's row."""
    from blind import commit
    from blind_judge import pipeline_for
    from judge_wild import hidden
    from wild_statistic import true_statistics

    from nlos_lit.capture.scan import Scan
    from nlos_lit.effects.extension import Extension
    from nlos_lit.inference.asking import Asking
    from nlos_lit.inference.candidates import Candidate
    from nlos_lit.inference.pool import lit_by
    from nlos_lit.inference.scenes import Scenes
    from nlos_lit.inference.settings import CriticismSettings
    from nlos_lit.inference.split import split_spots
    from nlos_lit.runtime.steps import Steps

    began = time.process_time()
    truth, capture = hidden("development", number)
    pipeline, split = pipeline_for(capture), split_spots(capture)
    base = pipeline.fit(capture, split, pipeline.image(capture), Extension([]), 0)
    scan = lit_by(base, Scan.of(capture))
    scenes = Scenes(pipeline.fit, pipeline.grow, split, 0, Steps(), 1)
    pool = Asking(scenes, scan, CriticismSettings()).ask(base, MOST)

    def seen(candidate: Candidate) -> list[float]:
        """Evidence, loud evidence, share that is retained, scatter."""
        told = (candidate.evidence, candidate.loud, candidate.retained, candidate.scatter)
        return [round(value, 3) for value in told]

    place = {c.name: k for k, c in enumerate(pool.candidates)}
    return {
        "set": "development",
        "number": number,
        "family": truth.spec.family,
        "scan": truth.spec.scan,
        "counts_per_spot": truth.spec.level,
        "statistics": {n: [round(s.plain), round(s.projected)] for n, s in true_statistics(truth).items()},
        "right": {
            name: {n: [place[n], *seen(pool.candidates[place[n]])] for n in names if n in place}
            for name, names in truth.right.items()
        },
        "leading": {c.name: seen(c) for c in pool.candidates[:LEADING]},
        "together": {t.candidate.name: round(t.candidate.evidence, 1) for t in pool.together},
        "cpu_seconds": round(time.process_time() - began, 1),
        "commit": commit(),
    }


def main(arguments: list[str]) -> None:
    """Read a range of numbers and ``kind=NAME`` and print the rows."""
    from wild_table import spec_of

    torch.set_num_threads(1)
    first, last = (int(a) for a in arguments if a.isdigit())
    kind = dict(a.split("=", 1) for a in arguments if "=" in a).get("kind", "single")
    for number in range(first, last):
        if spec_of("development", number).kind == kind:
            print(json.dumps(row_of(number)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
