"""The blind benchmark: hide effects in captures, diagnose the files, count what was found: ``python
benchmarks/blind.py table``.

    python benchmarks/blind.py cases                the small seeded set that tests use a part of
    python benchmarks/blind.py table                nulls, single effects, pairs, unknowns; some 2 hours of 2
    cores python benchmarks/blind.py report               docs/blind.md from what has been run so far

Every diagnosis is stored as it is done (benchmarks/results/blind/), so that an interrupted run goes on where
it was.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blind"), str(ROOT / "benchmarks")]
STORE = ROOT / "benchmarks" / "results" / "blind"
MARK = "<!-- measured: python benchmarks/blind.py report -->"
SCENES = ("default", "letters", "z_confocal", "sphere_before_plate")
RENDERS = ("z_confocal", "bunny_confocal")
# counts a spot up to which a render's Monte-Carlo noise (5 % a bin and more) stays below that of the counts
CALM = 1500


def table() -> dict[str, object]:
    """The captures by name, in such an order that a part of the run is a fair sample of the whole.

    42 without effects, every effect of the registry twice (at strengths 0 and 2, or 1 and 3), 12 pairs, every
    unknown thrice; scenes and photon levels in turn.
    """
    from blind_inject import EFFECTS, UNKNOWN
    from blind_truth import LEVELS, STRENGTHS, draw_spec

    table_of = EFFECTS | UNKNOWN
    steps = range(len(STRENGTHS))
    kinds = {
        "null": [((), ())] * 42,
        "single": [((name,), ((k + 2 * again) % 4,)) for again in (0, 1) for k, name in enumerate(EFFECTS)],
        "pair": [(None, tuple(steps[1:]))] * 12,
        "unknown": [((name,), (strength,)) for strength in (2, 3, 1) for name in UNKNOWN],
    }
    drawn = []
    for kind, wanted in kinds.items():
        for k, (names, strengths) in enumerate(wanted):
            seed = 1000 * (1 + list(kinds).index(kind)) + k
            possible = table_of[names[0]].scenes if names else ()
            fitting = [scene for scene in SCENES if scene in (possible or SCENES)] or possible
            scenes = (fitting[k % len(fitting)],)
            level = LEVELS[(k + k // len(LEVELS)) % len(LEVELS)]
            if any(scene in RENDERS for scene in scenes):
                level = min(level, CALM)
            spec = draw_spec(
                seed,
                kind,
                effects=names or None,
                scenes=scenes,
                strengths=strengths or tuple(steps),
                levels=(level,),
            )
            drawn.append(((k + 0.5) / len(wanted), f"{kind}_{k:02d}", spec))
    return {name: spec for _, name, spec in sorted(drawn, key=lambda entry: entry[0])}


def work(name: str, spec: object) -> str:
    """Diagnose one capture and store the outcome."""
    from blind_judge import one_thread, run_case

    from nlos_lit.inference.criticise import CriticismSettings

    one_thread()
    outcome = run_case(spec, CriticismSettings(numerics=False, processes=1))
    part = STORE / f".{name}.json"
    part.write_text(json.dumps(outcome.to_dict()))
    part.rename(STORE / f"{name}.json")
    hidden = ", ".join((*outcome.hidden, outcome.unknown)).strip(", ") or "nothing"
    strengths = "".join(map(str, outcome.spec["strengths"]))
    said = ", ".join(outcome.named) or "-"
    errors = {n: [round(v, 2) for v in e] for es in outcome.errors.values() for n, e in es.items()}
    return (
        f"{name} {spec.scene} {spec.level:g} | {hidden} {strengths} (TS {outcome.statistic:.0f}) "
        f"-> {said} {outcome.groups} unexplained {outcome.unexplained or '-'} "
        f"gain {outcome.gain:.0f}/{outcome.oracle:.0f} {errors} base {outcome.ratio:.3f} "
        f"{outcome.seconds:.0f} s"
    )


def done(name: str, spec: object) -> bool:
    """Whether the outcome of this very capture is stored."""
    file = STORE / f"{name}.json"
    return file.exists() and json.loads(file.read_text())["spec"] == json.loads(json.dumps(asdict(spec)))


def run(specs: dict[str, object], processes: int = 2) -> None:
    STORE.mkdir(parents=True, exist_ok=True)
    todo = {name: spec for name, spec in specs.items() if not done(name, spec)}
    began = time.monotonic()
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(work, name, spec) for name, spec in todo.items()]
        for count, job in enumerate(as_completed(jobs), 1):
            left = (time.monotonic() - began) / count * (len(jobs) - count)
            print(f"[{count}/{len(jobs)}, {left / 60:.0f} min left] {job.result()}", flush=True)


def main(arguments: list[str]) -> None:
    what = arguments[0] if arguments else "table"
    given = dict(a.split("=", 1) for a in arguments[1:])
    if what == "cases":
        from blind_truth import CASES

        run({f"case_{name.replace(' ', '_').replace(',', '')}": spec for name, spec in CASES.items()})
    elif what == "table":
        run(table(), int(given.get("processes", 2)))
    elif what == "report":
        from blind_report import tables

        page = ROOT / "docs" / "blind.md"
        head = page.read_text().split(MARK)[0]
        page.write_text(head + MARK + "\n\n" + tables(STORE))
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
