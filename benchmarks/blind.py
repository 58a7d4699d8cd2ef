"""The blind benchmark: hide effects in captures, diagnose the files, count what was found.

    python benchmarks/blind.py run set=development first=0 number=40    diagnoses, stored as they are done
    python benchmarks/blind.py rows set=validation                   its rows into docs/blind_rows.jsonl
    python benchmarks/blind.py values                                   true quantities into rows without them
    python benchmarks/blind.py report                                   tables of docs/ from those rows
    python benchmarks/blind.py sensitivity set=development commit=…     what other constants would have said

Development captures may be looked at as often as one likes, validation captures when a design is finished;
the test set is drawn and run once, by the commit of the frozen rules (docs/blind.md). What it says is shown
when all of it is there, and not before.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import subprocess
import sys
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

from report import table

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blind")]
STORE = ROOT / "benchmarks" / "results" / "blind"
ROWS = ROOT / "docs" / "blind_rows.jsonl"
MARK = "<!-- measured: python benchmarks/blind.py report -->"
LAST = 8  # looks that are counted together


def work(set_name: str, index: int) -> dict:
    """Diagnose one capture and store the outcome."""
    import torch
    from judge_wild import judge

    from nlos_lit.inference.settings import CriticismSettings

    torch.set_num_threads(1)
    outcome = asdict(judge(set_name, index, CriticismSettings(processes=1))) | {"commit": commit()}
    file = STORE / f"{set_name}_{index:03d}.json"
    part = file.with_suffix(".part")
    part.write_text(json.dumps(outcome))
    part.rename(file)
    return outcome


def commit() -> str:
    """Of the checkout, marked where files differ from it."""
    run = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=7"]
    return subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip()


def line(row: dict) -> str:
    """One outcome in words."""
    said = " + ".join("/".join(group) for group in row["named"]) or "-"
    hidden = ", ".join(f"{n} {s}" for n, s in row["statistics"].items()) or "nothing"
    return (
        f"{row['set_name']} {row['index']} {row['spec']['family']} {row['spec']['scan']} "
        f"{row['spec']['level']:g} | {hidden} {row['axes'] or ''} -> {said} unknown {row['unknown'] or '-'} "
        f"| {row['base']:.3f} {row['extended']:.3f} {row['noise']:.3f} {row['seconds']:.0f} s {row['error']}"
    )


def run(set_name: str, first: int, number: int, processes: int) -> None:
    """Diagnose captures that have not been, several at a time.

    Raises:
        SystemExit: of the test set, where files differ from the commit: it is run once, by the frozen rules.
    """
    if set_name == "test" and commit().endswith("-dirty"):
        raise SystemExit(f"the test set is run once, by a commit of the frozen rules; found {commit()}")
    STORE.mkdir(parents=True, exist_ok=True)
    wanted = range(first, first + number)
    todo = [k for k in wanted if not (STORE / f"{set_name}_{k:03d}.json").exists()]
    began = time.monotonic()
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(work, set_name, k) for k in todo]
        for count, job in enumerate(as_completed(jobs), 1):
            left = (time.monotonic() - began) / count * (len(jobs) - count)
            row = job.result()
            said = f"test {row['index']} is stored" if set_name == "test" else line(row)
            print(f"[{count}/{len(jobs)}, {left / 60:.0f} min left] {said}", flush=True)


def keep_rows(set_name: str) -> None:
    """Add the stored rows of a set to the committed file; those of earlier commits stay."""
    old = [json.loads(text) for text in ROWS.read_text().splitlines()] if ROWS.exists() else []
    new = [json.loads(f.read_text()) for f in sorted(STORE.glob(f"{set_name}_*.json"))]
    again = {(row["set_name"], row["index"], row["commit"]) for row in new}
    kept = [row for row in old if (row["set_name"], row["index"], row["commit"]) not in again] + new
    ROWS.write_text("".join(json.dumps(row) + "\n" for row in kept))


def add_values() -> None:
    """True quantities into rows that were kept before these were: they follow from what was drawn."""
    from wild_table import Spec
    from wild_truth import true_values

    rows = [json.loads(text) for text in ROWS.read_text().splitlines()]
    for row in rows:
        if "values" not in row:
            drawn = {n: tuple(v) if isinstance(v, list) else v for n, v in row["spec"].items()}
            row["values"] = true_values(Spec(**drawn)) if row["right"] else {}
    ROWS.write_text("".join(json.dumps(row) + "\n" for row in rows))


def interval(right: int, of: int) -> str:
    """Rate and its 95 % Clopper–Pearson interval."""
    from scipy.stats import beta

    if of == 0:
        return "–"
    low = beta.ppf(0.025, right, of - right + 1) if right else 0.0
    high = beta.ppf(0.975, right + 1, of - right) if right < of else 1.0
    return f"{right} of {of} = {right / of:.0%} ({low:.0%} … {high:.0%})"


def in_first_group(row: dict) -> bool:
    """The one thing hidden stands in the group that is named first."""
    (right,) = row["right"].values()
    return bool(row["named"]) and bool(set(row["named"][0]) & set(right))


def first_right(row: dict) -> bool:
    """The first name said, alone or in a group of two, is right."""
    return in_first_group(row) and len(row["named"][0]) <= 2


def likely_right(row: dict) -> bool:
    """What is hidden is told of as likely."""
    (hidden,) = row["right"]
    return bool(set(row.get("likely", ())) & set(row["right"][hidden]))


def said(row: dict) -> set[str]:
    """All names in all groups."""
    return {name for group in row["named"] for name in group}


def told(row: dict, hidden: str) -> bool:
    """Something hidden stands in some group; of an unknown, nothing does, and its axis has a free term."""
    right = row["right"][hidden]
    return bool(said(row) & set(right)) if right else right_axis(row)


def true_names(row: dict) -> set[str]:
    """Of what is hidden, and its look-alikes."""
    return {n for names in (*row["right"].values(), *row["alike"].values()) for n in names}


def wrong_names(row: dict) -> list[str]:
    """Groups that hold nothing hidden, nor a look-alike of it."""
    true = true_names(row)
    return ["/".join(group) for group in row["named"] if not set(group) & true]


def all_right(row: dict) -> bool:
    """Everything hidden stands in some group."""
    return all(told(row, hidden) for hidden in row["right"])


def shows(row: dict, hidden: str) -> bool:
    """Something hidden ought to show."""
    from wild_statistic import CLEAR

    return row["statistics"][hidden][1] > CLEAR


def clear(row: dict) -> bool:
    """Everything hidden ought to show."""
    return all(shows(row, hidden) for hidden in row["statistics"])


def right_axis(row: dict) -> bool:
    """An unknown: nothing named, and a free term along one of its axes."""
    return not row["named"] and bool(set(row["unknown"]) & set(row["axes"]))


def within_two(row: dict) -> list[bool]:
    """Of each quantity of what is named rightly, whether it is within two of the errors that were said."""
    found = []
    for hidden, right in row["right"].items():
        for name in right:
            said = row["parameters"].get(name, {})
            for quantity, true in row.get("values", {}).get(hidden, {}).items():
                if quantity in said:
                    value, error = said[quantity]
                    found.append(abs(value - true) <= 2 * error)
    return found


def above_limit(row: dict) -> list[bool]:
    """Of what is stronger than the diagnosis says would be named in nine of ten, whether it is named."""
    found = []
    for hidden, right in row["right"].items():
        limits = [
            abs(row["values"][hidden][quantity]) > limit
            for name in right
            for quantity, limit in row.get("limits", {}).get(name, {}).items()
            if quantity in row["values"][hidden]
        ]
        if any(limits):
            found.append(told(row, hidden))
    return found


def rows_of(cases: list[dict]) -> list[tuple[str, str, str]]:
    """What was asked for, and measured."""
    from wild_statistic import CLEAR

    by = defaultdict(list)
    for case in cases:
        by[case["kind"]].append(case)
    seen = [c for c in by["single"] if clear(c)]
    faint = [c for c in by["single"] if not clear(c)]
    pairs = [c for c in by["pair"] if clear(c)]
    hidden = by["single"] + by["pair"]
    told = [c for c in seen if c["named"]]
    quantities = [held for c in hidden for held in within_two(c)]
    expected = [named for c in hidden for named in above_limit(c)]
    # What each spot has by itself says nothing of untouched ones.
    known = [c for c in by["unknown"] if right_axis(c) and "spot" not in c["axes"]]
    reached = [c["reached"] >= 0.8 for c in known if c.get("reached") is not None]
    return [
        (
            "false names on effect-free captures",
            "≤ 1 %",
            interval(sum(bool(c["named"]) for c in by["null"]), len(by["null"])),
        ),
        (
            "… a free term there",
            "",
            interval(sum(bool(c["unknown"]) for c in by["null"]), len(by["null"])),
        ),
        (
            "… told of as likely there",
            "",
            interval(sum(bool(c.get("likely")) for c in by["null"]), len(by["null"])),
        ),
        (
            f"named first, alone or in a group of two (projected true statistic > {CLEAR:g})",
            "≥ 95 %",
            interval(sum(map(first_right, seen)), len(seen)),
        ),
        (
            "… or told of as likely",
            "",
            interval(sum(first_right(c) or likely_right(c) for c in seen), len(seen)),
        ),
        ("… of the fainter ones", "", interval(sum(map(first_right, faint)), len(faint))),
        (
            "a wrong name beside or instead of one or two hidden effects",
            "",
            interval(sum(bool(wrong_names(c)) for c in hidden), len(hidden)),
        ),
        (
            "true cause in the group that is named first, of clear single effects with one",
            "85 – 95 %",
            interval(sum(map(in_first_group, told)), len(told)),
        ),
        (
            "… names in it, in the mean",
            "≤ 1.5",
            f"{sum(len(c['named'][0]) for c in told) / len(told):.2f}" if told else "–",
        ),
        (
            "quantities of what is named rightly within two reported errors",
            "≥ 90 %",
            interval(sum(quantities), len(quantities)),
        ),
        (
            "named where stronger than the limit that the diagnosis states",
            "≥ 90 %",
            interval(sum(expected), len(expected)),
        ),
        (
            "pairs: both named (both statistics clear)",
            "≥ 90 %",
            interval(sum(map(all_right, pairs)), len(pairs)),
        ),
        (
            "unknown: nothing named",
            "≥ 95 %",
            interval(sum(not c["named"] for c in by["unknown"]), len(by["unknown"])),
        ),
        (
            "unknown: nothing named, and a free term along the right axis",
            "≥ 90 %",
            interval(sum(map(right_axis, by["unknown"])), len(by["unknown"])),
        ),
        (
            "unknown: at least 80 % of what the true cause gains, of those with a right axis",
            "≥ 80 %",
            interval(sum(reached), len(reached)),
        ),
        ("diagnoses that failed", "0", interval(sum(bool(c["error"]) for c in cases), len(cases))),
    ]


def captures(cases: list[dict]) -> str:
    """One line a capture as Markdown."""
    heads = (
        "no.",
        "scene",
        "scan",
        "counts",
        "hidden (projected statistic)",
        "said",
        "likely",
        "free terms",
        "base / noise",
        "after / noise",
        "s",
        "commit",
    )
    lines = []
    for c in sorted(cases, key=lambda c: c["index"]):
        hidden = ", ".join(f"{n} ({s[1]:.0f})" for n, s in c["statistics"].items()) or "nothing"
        said = ", ".join("/".join(group) for group in c["named"]) or ("failed" if c["error"] else "–")
        noise = c["noise"] or float("nan")
        lines.append((
            c["index"], c["spec"]["family"], c["spec"]["scan"], f"{c['spec']['level']:g}", hidden, said,
            ", ".join(c.get("likely", ())) or "–", ", ".join(c["unknown"]) or "–",
            f"{c['base'] / noise:.3f}", f"{c['extended'] / noise:.3f}", f"{c['seconds']:.0f}", c["commit"],
        ))  # fmt: skip
    return table(heads, lines)


def rates(cases: list[dict]) -> str:
    """What was asked for and measured on one look, as Markdown."""
    seconds = sum(c["seconds"] for c in cases) / len(cases)
    measured = table(("what", "asked for", "measured (95 % interval)"), rows_of(cases))
    return f"{measured}\n\n{len(cases)} captures, {seconds:.0f} s of a core each."


def looks_of(cases: list[dict]) -> dict[str, list[dict]]:
    """Captures by the commit that they were run at, the last look first."""
    by: dict[str, list[dict]] = defaultdict(list)
    for case in cases:
        by[case["commit"]].append(case)
    return dict(reversed(by.items()))


def span(rows: list[dict]) -> str:
    """Numbers of the first capture and the last."""
    numbers = [row["index"] for row in rows]
    return f"{min(numbers)} – {max(numbers)}"


def side_by_side(looks: dict[str, list[dict]]) -> str:
    """All looks as Markdown: what was measured in a line each, a look a column, without intervals."""
    columns = [[value.split(" =")[0] for _, _, value in rows_of(rows)] for rows in looks.values()]
    whats = [what for what, _, _ in rows_of([])]
    lines = [*zip(whats, *columns, strict=True), ("commit", *looks)]
    return table(("what", *map(span, looks.values())), lines)


def by_hidden(cases: list[dict]) -> str:
    """Of each kind of thing that was hidden, alone or in a pair: how often it was told of, as Markdown."""
    known, unknown = defaultdict(list), defaultdict(list)
    for case in cases:
        for hidden, right in case["right"].items():
            (known if right else unknown)[hidden].append(case)
    lines = []
    for hidden, of_it in sorted(known.items()) + sorted(unknown.items()):
        seen = [told(c, hidden) for c in of_it if shows(c, hidden)]
        faint = [told(c, hidden) for c in of_it if not shows(c, hidden)]
        near = [
            not told(c, hidden)
            and bool((said(c) | set(c.get("likely", ()))) & {*c["right"][hidden], *c["alike"][hidden]})
            for c in of_it
        ]
        lines.append(
            (
                hidden if hidden in known else f"{hidden} (unknown)",
                f"{sum(seen)} of {len(seen)}",
                f"{sum(faint)} of {len(faint)}",
                sum(near),
            )
        )
    return table(("hidden", "clear ones told of", "fainter ones", "only a look-alike, or as likely"), lines)


def by_scene(cases: list[dict]) -> str:
    """Of each family of scenes: how near a fit comes to the noise, and what is said, as Markdown."""
    by = defaultdict(list)
    for case in cases:
        by[case["spec"]["family"]].append(case)
    lines = []
    for family, of_it in sorted(by.items()):
        null = [c for c in of_it if c["kind"] == "null"]
        seen = [c for c in of_it if c["kind"] == "single" and clear(c)]
        over = sorted(c["base"] / c["noise"] for c in null if c["noise"])
        lines.append(
            (
                family,
                f"{over[len(over) // 2]:.3f} ({over[0]:.3f} … {over[-1]:.3f})" if over else "–",
                f"{sum(bool(c['named']) for c in null)} of {len(null)}",
                f"{sum(map(first_right, seen))} of {len(seen)}",
            )
        )
    heads = ("scenes", "effect-free: over noise, median (range)", "false names", "clear ones named first")
    return table(heads, lines)


def test_set(rows: list[dict]) -> str:
    """What is said of the test set: how much of it has been run, and the rates when that is all."""
    from wild_table import LENGTH

    head = "## The test set\n\n"
    if {row["index"] for row in rows} != set(range(LENGTH)):
        return f"{head}{len(rows)} of {LENGTH} captures have been run. None has been looked at.\n"
    parts = (
        rates(rows),
        "### By what was hidden",
        "Alone or in a pair. The unknown is told of by a free term along its axis and no name.",
        by_hidden(rows),
        "### By scene",
        by_scene(rows),
        "### Captures",
        captures(rows),
    )
    return head + "\n\n".join(parts) + "\n"


def rewrite(page: str, parts: list[str]) -> None:
    """Tables of a page of docs, below its mark."""
    file = ROOT / "docs" / page
    file.write_text(file.read_text().split(MARK)[0] + MARK + "\n\n" + "\n".join(parts))


def report() -> None:
    """Rewrite the tables of docs/blind.md and docs/looks.md."""
    cases = [json.loads(text) for text in ROWS.read_text().splitlines()]
    test, validation, development = (
        [c for c in cases if c["set_name"] == name] for name in ("test", "validation", "development")
    )
    looks = looks_of(validation)
    last = [case for rows in list(looks.values())[:LAST] for case in rows]
    rewrite(
        "blind.md",
        [
            test_set(test),
            f"## The last {LAST} looks at the validation set, together\n\n"
            f"Captures {span(last)}, each look by another state of the program.\n\n{rates(last)}\n",
        ],
    )
    newest = {c["index"]: c for c in development}
    rewrite(
        "looks.md",
        [
            f"## All looks, the last first\n\n{side_by_side(looks)}\n",
            f"## Captures of the validation set\n\n{captures(validation)}\n",
            "## Captures of the development set, as they were last run\n\n"
            "No rates: rules were chosen on these captures. Rows of earlier commits are in\n"
            f"[blind_rows.jsonl](blind_rows.jsonl).\n\n{captures(list(newest.values()))}\n",
        ],
    )


def holding(row: dict, share: float, level: float, even: float, form: float) -> set[str]:
    """Effects that would have what they need when they were last asked for, by other constants.

    Older rows do not say how much of it is for what other terms take: that goes with the share.
    """
    from nlos_lit.effects import EFFECTS
    from nlos_lit.effects.free_terms import FREE
    from nlos_lit.inference.settings import CriticismSettings

    now, terms = CriticismSettings(), len(EFFECTS) + len(FREE)
    least, changed = math.log(terms / now.level), math.log(terms / level)
    names = {e.name for e in EFFECTS}
    found = set()
    for name, (own, needed, _, _, weight, _, _, *others) in row["tried"].items():
        shared = sum(others)
        needs = changed + (needed - least - shared) * share / now.share + shared * form / now.form
        if name in names and own > needs and weight > even:
            found.add(name)
    return found


def sensitivity(set_name: str, commit_of: str) -> None:
    """Print how many right and wrong terms hold by other constants, of one look's rows.

    Only what was tried is counted, with what was found when it was last asked for: a term that holds would
    change what comes after it.
    """
    from nlos_lit.inference.members import EVEN
    from nlos_lit.inference.settings import CriticismSettings

    every = [json.loads(text) for text in ROWS.read_text().splitlines()]
    rows = [r for r in every if (r["set_name"], r["commit"]) == (set_name, commit_of) and "tried" in r]
    now = CriticismSettings()
    known = {"share": now.share, "level": now.level, "even": EVEN, "form": now.form}
    others = {
        "share": (0.0, 0.02, 0.05, now.share, 0.2, 0.4),
        "level": (0.1, now.level, 0.001),
        "even": (0.0, 0.2, EVEN, 0.8, 0.95),
        "form": (0.0, 0.05, 0.1, now.form, 0.5),
    }
    lines = []
    for name, values in others.items():
        for value in values:
            right = wrong = captures = 0
            for row in rows:
                true, held = true_names(row), holding(row, **known | {name: value})
                right, wrong = right + len(held & true), wrong + len(held - true)
                captures += bool(held - true)
            lines.append((f"`{name}`", f"{value:g}", right, wrong, captures))
    heads = ("constant", "value", "right terms", "wrong ones", "captures with a wrong one")
    print(f"{len(rows)} captures\n\n{table(heads, lines)}")


def main(arguments: list[str]) -> None:
    what = arguments[0] if arguments else ""
    given = dict(a.split("=", 1) for a in arguments[1:])
    if what == "run":
        first, number, processes = (
            int(given.get(n, d)) for n, d in (("first", 0), ("number", 40), ("processes", 2))
        )
        run(given.get("set", "development"), first, number, processes)
    elif what == "rows":
        keep_rows(given["set"])
    elif what == "values":
        add_values()
    elif what == "report":
        report()
    elif what == "sensitivity":
        sensitivity(given.get("set", "development"), given["commit"])
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
