"""The notebooks are executed, small, and run again to the end."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LARGEST = 300_000  # bytes
LONGEST = 110
each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def cells(path: Path) -> list[dict]:
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def test_there_are_three():
    assert [path.stem for path in NOTEBOOKS] == ["ablation", "hidden_fault", "own_capture"]


@each
def test_it_is_executed(path):
    code = [cell for cell in cells(path) if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert outputs
    assert all(output["output_type"] != "error" for output in outputs)


@each
def test_it_is_small_and_readable(path):
    assert path.stat().st_size < LARGEST
    lines = [line for cell in cells(path) for line in "".join(cell["source"]).splitlines()]
    assert [line for line in lines if len(line) > LONGEST] == []
    told = [output.get("text", "") for cell in cells(path) for output in cell.get("outputs", ())]
    assert not any("\x1b" in "".join(text) for text in told)  # no progress bar's escapes


@pytest.mark.slow
@each
def test_it_runs_to_the_end(path):
    program = Path(sys.executable).parent / "nlos"
    if importlib.util.find_spec("nbclient") is None or not program.exists():
        pytest.skip("needs pip install '.[notebooks]'")
    code = f"from execute_notebooks import executed; import pathlib; executed(pathlib.Path({str(path)!r}))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT / "scripts", capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
