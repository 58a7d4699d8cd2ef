"""The documentation's table and its example of a new effect."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import pytest
import torch
from effect_contract import BIN, EffectContract, scene

from nlos_lit.effects import EFFECTS

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "effects.md").read_text(encoding="utf-8")


(CODE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
WRITTEN = ModuleType("laser_afterglow")
exec(compile(CODE, "docs/effects.md", "exec"), WRITTEN.__dict__)
LaserAfterglow = WRITTEN.LaserAfterglow


class TestTheExample(EffectContract, effect=LaserAfterglow, fraction=0.2, duration=0.31):
    pass


def test_the_example_does_what_it_says():
    glow = LaserAfterglow(scene("confocal")[1])
    glow.set("fraction", 0.3)
    glow.set("duration", 4.5 * BIN)
    kernel = torch.zeros(10)
    kernel[3] = 1.0
    by_hand = torch.zeros(3 + 64)
    by_hand[3:7] = 0.3 / 4.5
    by_hand[7] = 0.3 * 0.5 / 4.5
    by_hand[3] += 1
    assert glow.response(kernel, 3).detach() == pytest.approx(by_hand, abs=1e-5)


def test_the_example_is_not_in_the_registry():
    assert "laser_afterglow" not in {effect.name for effect in EFFECTS}


def test_the_table_lists_the_registry():
    rows = [
        [c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in PAGE.splitlines()
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
        assert any(p.null is None for p in declared) == ("scanned" in row[3]), effect.name
