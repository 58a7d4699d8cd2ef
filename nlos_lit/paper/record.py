"""What an experiment leaves: a table, figures, captions, and the comparison in one line each."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from matplotlib.figure import Figure

from nlos_lit.io.files import write_json
from nlos_lit.io.tables import Row, cell, markdown_table, write_csv
from nlos_lit.report.style import save_figure
from nlos_lit.training.summary import git_state

CLASSICAL = ("bp", "fbp", "lct", "dlct", "fk", "rsd")


@dataclass(frozen=True)
class Glance:
    """One quantity on one capture, for all systems; lower is better unless ``higher`` says otherwise.

    Args:
        what: the quantity with its unit.
        data: the capture.
        published: the paper's own formulation, run here (``model=paper``).
        classical: value by method of the classical reconstructions.
        ours: the default model's phasor surface.
        refined: the surfels.
    """

    what: str
    data: str
    published: float | None = None
    classical: dict[str, float] = field(default_factory=dict)
    ours: float | None = None
    refined: float | None = None
    higher: bool = False

    def row(self) -> Row:
        """The comparison as a row of a table.

        The verdict compares the better of ours with the better of the others.
        """
        known = {name: value for name, value in self.classical.items() if _known(value)}
        sign = -1 if self.higher else 1
        best = min(known, key=lambda name: sign * known[name]) if known else None
        mine = [value for value in (self.ours, self.refined) if _known(value)]
        others = [value for value in (self.published, None if best is None else known[best]) if _known(value)]
        verdict = "–"
        if mine and others:
            better, rival = (max, max) if self.higher else (min, min)
            verdict = compare(better(mine), rival(others), self.higher)
        return {
            "quantity": self.what,
            "data": self.data,
            "published system": self.published,
            "best classical": None if best is None else f"{cell(known[best])} ({best})",
            "ours, phasor surface": self.ours,
            "ours, refined": self.refined,
            "verdict": verdict,
        }


def _known(value: float | None) -> TypeGuard[float]:
    return value is not None and bool(np.isfinite(value))


def compare(mine: float, rival: float, higher: bool) -> str:
    """How much better one value is than another, in words.

    Args:
        mine: ours.
        rival: theirs.
        higher: more is better.

    Returns:
        the verdict as Markdown; – where a value is not positive.

    Examples:
        >>> compare(2.0, 8.0, higher=False)
        '**better**, 4 ×'
        >>> compare(0.5, 0.8, higher=True)
        'worse, 1.6 ×'
    """
    if mine <= 0 or rival <= 0:
        return "–"
    factor = mine / rival if higher else rival / mine
    if 0.97 < factor < 1.03:
        return "equal within 3 %"
    return f"**better**, {factor:.3g} ×" if factor > 1 else f"worse, {1 / factor:.3g} ×"


@dataclass(frozen=True)
class Evidence:
    """A finished experiment.

    Args:
        name: of the command.
        title: one line.
        paper: what the paper shows there, on which data.
        here: on which data it was measured here, and how.
        rows: the table.
        figures: name → figure.
        captions: name → caption, one for each figure.
        glance: the comparisons.
        hidden: columns that only the CSV holds.
    """

    name: str
    title: str
    paper: str
    here: str
    rows: list[Row]
    figures: dict[str, Figure]
    captions: dict[str, str]
    glance: list[Glance] = field(default_factory=list)
    hidden: tuple[str, ...] = ()

    def write(self, folder: Path) -> None:
        """``table.csv``, ``table.md``, a PNG a figure, and ``evidence.json`` with everything that is text."""
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(folder / "table.csv", self.rows)
        shown = [{key: value for key, value in row.items() if key not in self.hidden} for row in self.rows]
        (folder / "table.md").write_text(markdown_table(shown) + "\n", encoding="utf-8")
        for name, figure in self.figures.items():
            save_figure(figure, folder / f"{name}.png")
        texts = {key: getattr(self, key) for key in ("name", "title", "paper", "here", "captions")}
        comparisons = [entry.row() for entry in self.glance]
        write_json(
            folder / "evidence.json", {**texts, "rows": shown, "glance": comparisons, "git": git_state()}
        )


def read_record(folder: Path) -> dict[str, Any]:
    """What :meth:`Evidence.write` left in ``evidence.json``."""
    return json.loads((folder / "evidence.json").read_text(encoding="utf-8"))
