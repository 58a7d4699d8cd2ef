"""What parts of the robustness runs came to: lines of JSON with the commit and command that made them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def add(file: str | Path, row: dict[str, Any]) -> None:
    """Append a row and print it.

    Args:
        file: of rows.
        row: of one part.
    """
    asked = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    script = Path(sys.argv[0]).resolve()
    command = " ".join([script.relative_to(ROOT).as_posix(), *sys.argv[2:]])
    line = json.dumps(row | {"commit": commit, "command": command})
    with Path(file).open("a", encoding="utf-8") as rows:
        rows.write(line + "\n")
    print(line, flush=True)


def read(file: str | Path) -> list[dict[str, Any]]:
    """The rows of a file, in order."""
    return [json.loads(line) for line in Path(file).read_text(encoding="utf-8").splitlines()]
