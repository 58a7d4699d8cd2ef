"""The generated parts of the documentation say what the classes say."""

from __future__ import annotations

import re
from pathlib import Path

from effect_contract import scene

from nlos_lit.effects import EFFECTS
from nlos_lit.effects.page import generated

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")


def test_the_page_is_what_the_classes_say():
    assert generated(PAGE) == PAGE, "run python -m nlos_lit.effects.page"
    assert len(re.findall("<!-- generated: ", PAGE)) == 4


def test_numbers_of_effects_that_pages_name_are_those_there_are():
    for file in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for number in re.findall(r"\b(\d+) effects\b", file.read_text(encoding="utf-8")):
            assert int(number) == len(EFFECTS), file


def test_the_table_lists_the_registry():
    table = PAGE[PAGE.index("<!-- generated: table -->") :]
    rows = [
        [c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in table[: table.index("<!-- end -->")].splitlines()
        if line.startswith("| `")
    ]
    assert [row[0].strip("`") for row in rows] == [effect.name for effect in EFFECTS]
    scan = scene("confocal")[1]
    for row, effect in zip(rows, EFFECTS, strict=True):
        assert row[1] == effect.stage
        declared = effect.declare(scan)
        assert re.findall(r"`(\w+)`", row[3]) == [p.name for p in declared], effect.name
        assert {p.unit for p in declared} == set(re.findall(r"\((1|m|rad|bins|counts/bin)\)", row[3])), (
            effect.name
        )
        assert any(len(p.grid) > 1 for p in declared) == ("scanned" in row[3]), effect.name
