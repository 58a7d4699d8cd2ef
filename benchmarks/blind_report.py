"""docs/blind.md from stored outcomes: rates with binomial intervals, a confusion matrix, and every case."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.stats import beta

STRONG = 50.0
STRENGTHS = ("just detectable", "weak", "strong", "gross")


def interval(right: int, of: int) -> str:
    """Rate and its 95 % Clopper-Pearson interval."""
    if of == 0:
        return "–"
    low = beta.ppf(0.025, right, of - right + 1) if right else 0.0
    high = beta.ppf(0.975, right + 1, of - right) if right < of else 1.0
    return f"{right} of {of} = {right / of:.0%} ({low:.0%} … {high:.0%})"


def kind(case: dict) -> str:
    if case["unknown"]:
        return "unknown"
    return {0: "null", 1: "single"}.get(len(case["hidden"]), "pair")


def group(case: dict, name: str) -> list[str]:
    """The accepted name with those that were said to be indistinguishable from it."""
    return next((g for g in case["groups"] if g[0] == name), [name])


def error(case: dict) -> float:
    """Of the true statistic; a tenth of it for outcomes that were stored before it was worked out."""
    return case.get("statistic_error", 0.1 * case["statistic"])


def true_statistic(case: dict) -> str:
    if not case["hidden"]:
        return ""
    return f"{case['statistic']:.0f}" + (
        f" ± {case['statistic_error']:.0f}" if "statistic_error" in case else ""
    )


def first_right(case: dict) -> bool:
    return bool(case["named"]) and any(n in case["hidden"] for n in group(case, case["named"][0]))


def all_named(case: dict) -> bool:
    said = {n for name in case["named"] for n in group(case, name)}
    return set(case["hidden"]) <= said


def overnamed(case: dict) -> bool:
    """Something is named that is not hidden, nor any of its group."""
    return any(not set(group(case, name)) & set(case["hidden"]) for name in case["named"])


def missed_statistic(case: dict) -> float:
    """What the oracle, told every hidden effect, gains beyond what was named: on the scale of the true
    statistic.
    """
    return case["statistic"] * (1 - case["gain"] / case["oracle"]) if case["oracle"] else 0.0


def parameters_right(case: dict) -> list[bool]:
    """For each true quantity of each rightly named effect: within three reported errors or 15 %."""
    return [abs(s) <= 3 or abs(r) <= 0.15 for found in case["errors"].values() for s, r in found.values()]


def rows(cases: list[dict]) -> list[tuple[str, str, str]]:
    by = defaultdict(list)
    for case in cases:
        by[kind(case)].append(case)
    seen = [c for c in by["single"] if c["statistic"] > STRONG]
    weak = [c for c in by["single"] if c["statistic"] <= STRONG]
    sure = [c for c in seen if c["statistic"] - 2 * error(c) > STRONG]
    alone = [c for c in seen if c["named"] and c["named"][0] in c["hidden"]]
    right = [c for c in seen if first_right(c)]
    checks = [ok for c in alone for ok in parameters_right(c)]
    shares = [c["gain"] / c["oracle"] for c in seen]
    shown = [c for c in by["pair"] if all_named(c) or missed_statistic(c) > STRONG]
    held = by["single"] + by["pair"]
    unknown = by["unknown"]
    axis = [c for c in unknown if c["unexplained"] == c["axis"] and not c["named"]]
    unnamed = [c for c in unknown if not c["named"]]
    share = f"; median share {np.median(shares):.0%}, of all nats {_total(seen):.0%}" if shares else ""
    return [
        (
            "hidden effect named first, alone or in its group (true statistic > 50)",
            "≥ 95 %",
            interval(len(right), len(seen)),
        ),
        (
            "… where it exceeds 50 by two of its standard errors",
            "",
            interval(sum(map(first_right, sure)), len(sure)),
        ),
        ("… named first itself", "", interval(len(alone), len(seen))),
        ("the same below a true statistic of 50", "", interval(sum(map(first_right, weak)), len(weak))),
        (
            "false alarms on effect-free captures",
            "≤ 5 %",
            interval(sum(bool(c["named"]) for c in by["null"]), len(by["null"])),
        ),
        (
            "… something unexplained there",
            "",
            interval(sum(bool(c["unexplained"]) for c in by["null"]), len(by["null"])),
        ),
        (
            "nothing else named beside one or two hidden effects",
            "",
            interval(sum(not overnamed(c) for c in held), len(held)),
        ),
        (
            "parameters within 3 reported standard errors or 15 %",
            "≥ 90 %",
            interval(sum(checks), len(checks)),
        ),
        (
            "at least 80 % of the oracle's held-out gain",
            "≥ 80 % of it",
            interval(sum(map(_nearly_all, seen)), len(seen)) + share,
        ),
        (
            "… where the true statistic exceeds 50 by two of its errors",
            "",
            interval(sum(map(_nearly_all, sure)), len(sure)),
        ),
        (
            "two effects at once: both named",
            "≥ 85 %",
            interval(sum(map(all_named, by["pair"])), len(by["pair"])),
        ),
        (
            "… without pairs whose missing effect adds no statistic of 50",
            "",
            interval(sum(map(all_named, shown)), len(shown)),
        ),
        (
            "outside the registry: unexplained, right axis, nothing named",
            "≥ 90 %",
            interval(len(axis), len(unknown)),
        ),
        ("… nothing named", "", interval(len(unnamed), len(unknown))),
    ]


def _nearly_all(case: dict) -> bool:
    return case["gain"] >= 0.8 * case["oracle"]


def _total(cases: list[dict]) -> float:
    return sum(c["gain"] for c in cases) / sum(c["oracle"] for c in cases)


def confusion(cases: list[dict]) -> list[tuple[str, dict[str, int]]]:
    """Hidden single effect (or unknown) against the first name said."""
    table: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for case in cases:
        if kind(case) == "pair":
            continue
        hidden = case["unknown"] or (case["hidden"][0] if case["hidden"] else "nothing")
        said = case["named"][0] if case["named"] else ("unexplained" if case["unexplained"] else "nothing")
        if case["named"] and case["named"][0] not in case["hidden"] and first_right(case):
            said = f"group of {case['named'][0]}"
        table[hidden][said] += 1
    return sorted((h, dict(s)) for h, s in table.items())


def line(case: dict, mark: str) -> str:
    hidden = ", ".join(
        f"{n} ({STRENGTHS[s]})"
        for n, s in zip(case["spec"]["effects"], case["spec"]["strengths"], strict=True)
    )
    said = ", ".join("/".join(group(case, n)) for n in case["named"]) or "–"
    wrong = "; ".join(
        f"{q} {s:+.1f} σ, {r:+.0%}" for found in case["errors"].values() for q, (s, r) in found.items()
    )
    cells = (
        case["spec"]["scene"] + mark, f"{case['spec']['level']:g}", hidden or "nothing", true_statistic(case),
        said, case["unexplained"] or "–", f"{case['gain']:.0f}/{case['oracle']:.0f}" if hidden else "", wrong,
        f"{case['ratio']:.3f}", f"{case['seconds']:.0f}",
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def tables(store: Path) -> str:
    """All tables as Markdown, of the outcomes of ``blind.py table``.

    Outcomes that an older version has left in ``older`` stand in for captures that were not run since; they
    are marked.
    """
    now = {f.stem: json.loads(f.read_text()) for f in store.glob("[npsu]*_[0-9]*.json")}
    older = {f.stem: json.loads(f.read_text()) for f in (store / "older").glob("[npsu]*_[0-9]*.json")}
    named = dict(sorted((older | now).items()))
    cases = list(named.values())
    out = [f"{len(cases)} captures, {sum(c['seconds'] for c in cases) / 3600:.1f} hours of one core.", ""]
    out += ["| what | required | measured (95 % interval) | without † |", "|---|---|---|---|"]
    pairs = zip(rows(cases), rows([named[name] for name in now]), strict=True)
    out += [f"| {what} | {required} | {value} | {new} |" for (what, required, value), (_, _, new) in pairs]
    out += ["", "## Confusion: what was hidden, what was said first", ""]
    out += ["| hidden | said first (number of captures) |", "|---|---|"]
    for hidden, said in confusion(cases):
        ranked = sorted(said.items(), key=lambda pair: -pair[1])
        out.append(f"| {hidden} | {', '.join(f'{n} ({k})' for n, k in ranked)} |")
    out += ["", "## Every capture", ""]
    heads = (
        "scene | counts | hidden | true statistic | said | unexplained | nats / oracle's | "
        "parameter errors | base / noise | s"
    )
    out += [f"| {heads} |"]
    out += ["|---" * 10 + "|"]
    out += [line(case, "" if name in now else " †") for name, case in named.items()]
    return "\n".join(out) + "\n"
