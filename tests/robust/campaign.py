"""All robustness runs, and the page that tells of them.

``python tests/robust/campaign.py`` runs every part (hours) and rewrites docs/robustness.md;
``python tests/robust/campaign.py page`` rewrites the page alone from docs/robustness_rows.jsonl.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from rows import ROOT, read

HERE = Path(__file__).parent
ROWS = ROOT / "docs" / "robustness_rows.jsonl"
PAGE = ROOT / "docs" / "robustness.md"
BEGIN, END = "<!-- rows: made by tests/robust/campaign.py -->", "<!-- end of rows -->"
SHOWN = 2  # failures of a row
SAME = ("mistakes", "nonsense")  # parts that try the same each time; in the others chance has a part
FORMATS = ("ytal", "lct", "fk", "phasor_field", "zaragoza", "chen", "tsai_ahn", "cid")
PARTS = (
    ["mistakes.py"],
    ["nonsense_cases.py"],
    *(["fuzz_readers.py", f"format={name}"] for name in FORMATS),
    ["full_disks.py"],
    ["kill_commands.py"],
)
TITLES = {
    "readers": "Damaged files",
    "mistakes": "Mistakes in settings",
    "nonsense": "Captures that cannot be",
    "kills": "Kills",
    "disks": "Full disks",
}


def tables(rows: list[dict[str, Any]]) -> str:
    """Markdown of all parts: how many were tried, refused, accepted, failed."""
    told = []
    for part, title in TITLES.items():
        made = counted([row for row in rows if row["part"] == part])
        if not made:
            continue
        of_part = [
            summed([row for row in made if _name(row) == name]) for name in dict.fromkeys(map(_name, made))
        ]
        kills = part == "kills"
        head = "| | kills (KILL, INT, TERM) | chains | ended alike | failed |" if kills else (
            "| | tried | refused | told of | accepted | failed |"
        )  # fmt: skip
        told += [f"### {title}", "", head, "|---" * (head.count("|") - 1) + "|"]
        told += [_line(row, kills) for row in of_part]
        failures = [line for row in of_part for line in _failures(row)]
        if failures:
            told += ["", "Failed, as it was said:", "", *failures]
        where = sorted({f"`{row['command']}` at {row['commit']}" for row in made})
        told += ["", "Made by:", "", *(f"- {one}" for one in where), ""]
    return "\n".join(told).rstrip()


def counted(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without those that a newer one repeats; what failed in these is kept by the newer one.

    Args:
        rows: of one part, in the order in which they were made.

    Returns:
        All of them where chance has a part; else the newest of each name.
    """
    if not rows or rows[0]["part"] not in SAME:
        return rows
    newest: dict[str, dict[str, Any]] = {}
    for row in rows:
        before = newest.get(_name(row), {"failures": []})
        earlier = [f"at {before['commit']}: {failure}" for failure in before["failures"]]
        newest[_name(row)] = row | {"failures": [*earlier, *row["failures"]]}
    return list(newest.values())


def summed(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Runs of one command or format as one: numbers added, lists joined."""
    whole = dict(rows[0])
    for row in rows[1:]:
        for key, value in row.items():
            if isinstance(value, dict):
                whole[key] = {
                    name: whole[key].get(name, 0) + value.get(name, 0) for name in {**whole[key], **value}
                }
            elif isinstance(value, int | float | list):
                whole[key] = whole[key] + value
    return whole


def _name(row: dict[str, Any]) -> str:
    return str(row.get("format") or row.get("kind") or "all")


def _failures(row: dict[str, Any]) -> list[str]:
    told = [f"- {_name(row)}: `{failure[:70]}`" for failure in row["failures"][:SHOWN]]
    rest = len(row["failures"]) - SHOWN
    return [*told, f"- {_name(row)}: {rest} more like these"] if rest > 0 else told


def _line(row: dict[str, Any], kills: bool) -> str:
    if kills:
        by = ", ".join(str(row["by"].get(f"SIG{name}", 0)) for name in ("KILL", "INT", "TERM"))
        cells = [_name(row), f"{row['kills']} ({by})", row["chains"], row["same"], len(row["failures"])]
    else:
        accepted = row.get("read", 0) + row.get("accepted", 0) + row.get("done", 0)
        failed = row["tried"] - row["refused"] - accepted - row.get("warned", 0)
        cells = [_name(row), row["tried"], row["refused"], row.get("warned", 0), accepted, failed]
    return f"| {' | '.join(map(str, cells))} |"


def with_rows(text: str, rows: list[dict[str, Any]]) -> str:
    """The page with its tables made anew."""
    before, _, rest = text.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{tables(rows)}\n\n{END}{rest.partition(END)[2]}"


def main(arguments: list[str]) -> None:
    if arguments != ["page"]:
        ROWS.unlink(missing_ok=True)
        for script, *given in PARTS:
            subprocess.run([sys.executable, str(HERE / script), str(ROWS), *given], check=True)
    PAGE.write_text(with_rows(PAGE.read_text(encoding="utf-8"), read(ROWS)), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
