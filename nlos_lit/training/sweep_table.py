"""One table of a multirun: a row a job, as CSV and Markdown."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from nlos_lit.io.files import whole_file
from nlos_lit.io.tables import markdown_table, write_csv

log = logging.getLogger(__name__)

COLUMNS = {
    "scene": ("scene",),
    "ablation": ("ablation",),
    "seed": ("seed",),
    "MSE transient (held out)": ("transient_mse", "heldout", "final"),
    "MSE transient (train)": ("transient_mse", "train", "final"),
    "NMSE": ("heldout", "nmse", "final"),
    "NMSE noise": ("heldout", "nmse", "noise_floor"),
    "deviance/bin": ("heldout", "deviance_per_bin", "final"),
    "s/iteration": ("seconds", "per_iteration"),
}


class SweepTable(Callback):
    """Hydra callback: after a multirun, ``table.csv`` and ``table.md`` in the sweep's folder."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the table of all jobs that left a summary."""
        folder = Path(config.hydra.sweep.dir)
        rows = sweep_rows(folder)
        if rows:
            write_table(folder, rows)
            log.info("the sweep's table is %s", folder / "table.md")


def sweep_rows(folder: Path) -> list[dict[str, Any]]:
    """A row per ``*/summary.json`` below ``folder``, best held-out error last, as in the paper's Table 1."""
    rows = []
    for path in sorted(folder.glob("*/summary.json")):
        summary = json.loads(path.read_text())
        row: dict[str, Any] = {}
        for column, keys in COLUMNS.items():
            value: Any = summary
            for key in keys:
                value = value[key]
            row[column] = value
        rows.append(row)
    return sorted(rows, key=lambda row: -row["MSE transient (held out)"])


def write_table(folder: Path, rows: list[dict[str, Any]]) -> None:
    """``table.csv`` and ``table.md``, four digits a number.

    Args:
        folder: where to.
        rows: column → value.
    """
    write_csv(folder / "table.csv", rows)

    def cell(value: Any) -> str:
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    with whole_file(folder / "table.md") as partial:
        partial.write_text(markdown_table(rows, cell) + "\n", encoding="utf-8")
