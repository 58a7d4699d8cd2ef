"""Rows as JSON, Markdown tables, figures on log axes, sections of docs/speed.md."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
STORE = ROOT / "benchmarks" / "results" / "speed"
PAGE = ROOT / "docs" / "speed.md"


def perform(tasks: dict[str, Callable[[], None]], arguments: Sequence[str], usage: str) -> None:
    """The tasks named among ``arguments``, all of them where none is, with ``threads=N`` of torch (one if not
    given).
    """
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    chosen = [a for a in arguments if "=" not in a] or list(tasks)
    if not set(chosen) <= set(tasks) or not set(given) <= {"threads"}:
        raise SystemExit(usage)
    torch.set_num_threads(int(given.get("threads", 1)))
    for name in chosen:
        tasks[name]()


def _file(kind: str, name: str) -> Path:
    return STORE / kind / (re.sub(r"[^A-Za-z0-9.=-]+", "_", name) + ".json")


def store(kind: str, name: str, row: dict[str, Any]) -> None:
    """Keep a row; a reader never sees half of one."""
    path = _file(kind, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(row, indent=1))
    part.rename(path)


def stored(kind: str, name: str) -> dict[str, Any] | None:
    path = _file(kind, name)
    return json.loads(path.read_text()) if path.exists() else None


def table(head: Sequence[object], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Least-squares slope on log axes: y grows as x to this power."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def write_section(name: str, text: str) -> None:
    """Replace what stands between ``<!-- name -->`` and ``<!-- /name -->`` in docs/speed.md."""
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    page = PAGE.read_text()
    head, rest = page.split(begin, 1)
    PAGE.write_text(head + begin + "\n\n" + text + "\n\n" + end + rest.split(end, 1)[1])


def growth_figure(
    name: str, series: dict[str, tuple[Sequence[float], dict[str, Sequence[float]]]], label: str
) -> None:
    """One log-log panel a quantity: ``{quantity: (values, {curve: times})}`` into docs/images/NAME.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(3, len(series))
    rows = -(-len(series) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.4 * columns, 2.9 * rows), squeeze=False, layout="constrained"
    )
    for panel, (quantity, (x, curves)) in zip(axes.flat, series.items(), strict=False):
        for curve, y in curves.items():
            panel.loglog(x, y, "o-", label=f"{curve}, slope {slope(x, y):.2f}")
        panel.set_xlabel(quantity)
        panel.set_xticks(list(x), [f"{v / 1000:.0f} k" if v > 9999 else f"{v:g}" for v in x])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
        panel.legend(fontsize=7)
    for panel in list(axes.flat)[len(series) :]:
        panel.axis("off")
    figure.supylabel(label)
    figure.savefig(ROOT / "docs" / "images" / f"{name}.png", dpi=110)
    plt.close(figure)
