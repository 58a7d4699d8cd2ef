"""The blind benchmark: hide effects in captures, diagnose the files, count what was found: ``python benchmarks/blind.py table``.

    python benchmarks/blind.py cases                the small seeded set that tests use a part of
    python benchmarks/blind.py table count=120      nulls, single effects, pairs, unknowns
    python benchmarks/blind.py report               docs/blind.md from what has been run so far

Every diagnosis is stored as it is done (benchmarks/results/blind/), so that an interrupted run goes on where it was.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blind"), str(ROOT / "benchmarks")]
STORE = ROOT / "benchmarks" / "results" / "blind"
SHARES = {"null": 0.42, "single": 0.38, "pair": 0.08, "unknown": 0.12}
MARK = "<!-- measured: python benchmarks/blind.py report -->"
SCENES = ("default", "letters", "z_confocal")


def table(count: int) -> dict[str, object]:
    """``count`` drawn captures by name; kinds interleaved, so that a part of the run is a fair sample."""
    from blind_truth import LEVELS, draw_spec

    specs, done = {}, dict.fromkeys(SHARES, 0)
    for k in range(count):
        kind = min(SHARES, key=lambda name: (done[name] + 1) / SHARES[name])
        done[kind] += 1
        strengths = (1, 2, 3) if kind in ("pair", "unknown") else (0, 1, 2, 3)
        specs[f"{k:03d}_{kind}"] = draw_spec(1000 + k, kind, scenes=SCENES, strengths=strengths, levels=LEVELS)
    return specs


def work(name: str, spec: object) -> str:
    """Diagnose one capture and store the outcome."""
    from blind_judge import one_thread, run_case

    from nlos_lit.criticism.criticise import CriticismSettings

    one_thread()
    outcome = run_case(spec, CriticismSettings(numerics=False))
    part = STORE / f".{name}.json"
    part.write_text(json.dumps(outcome.to_dict()))
    part.rename(STORE / f"{name}.json")
    hidden = ", ".join((*outcome.hidden, outcome.unknown)).strip(", ") or "nothing"
    strengths = "".join(map(str, outcome.spec["strengths"]))
    said = ", ".join(outcome.named) or "-"
    errors = {n: [round(v, 2) for v in e] for es in outcome.errors.values() for n, e in es.items()}
    return (
        f"{name} {spec.scene} {spec.level:g} | {hidden} {strengths} (TS {outcome.statistic:.0f}) -> {said} {outcome.groups} "
        f"unexplained {outcome.unexplained or '-'} gain {outcome.gain:.0f}/{outcome.oracle:.0f} {errors} base {outcome.ratio:.3f} "
        f"{outcome.seconds:.0f} s"
    )


def run(specs: dict[str, object], processes: int = 2) -> None:
    STORE.mkdir(parents=True, exist_ok=True)
    todo = {name: spec for name, spec in specs.items() if not (STORE / f"{name}.json").exists()}
    began = time.monotonic()
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(work, name, spec) for name, spec in todo.items()]
        for done, job in enumerate(as_completed(jobs), 1):
            left = (time.monotonic() - began) / done * (len(jobs) - done)
            print(f"[{done}/{len(jobs)}, {left / 60:.0f} min left] {job.result()}", flush=True)


def main(arguments: list[str]) -> None:
    what = arguments[0] if arguments else "table"
    given = dict(a.split("=", 1) for a in arguments[1:])
    if what == "cases":
        from blind_truth import CASES

        run({f"case_{name.replace(' ', '_').replace(',', '')}": spec for name, spec in CASES.items()})
    elif what == "table":
        run(table(int(given.get("count", 96))))
    elif what == "report":
        from blind_report import tables

        page = ROOT / "docs" / "blind.md"
        head = page.read_text().split(MARK)[0]
        page.write_text(head + MARK + "\n\n" + tables(STORE))
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
