"""Runs side by side: the settings in which they differ, their errors, and the spread over seeds."""

from __future__ import annotations

import json
import logging
import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import bounded
from nlos_lit.io.files import whole_file
from nlos_lit.io.tables import markdown_table, write_csv
from nlos_lit.io.volumes import read_volume
from nlos_lit.report.fronts import View, front_views
from nlos_lit.report.style import save_figure
from nlos_lit.training.folder import plain_yaml

log = logging.getLogger(__name__)

ERRORS = {
    "MSE transient (held out)": ("transient_mse", "heldout", "final"),
    "MSE transient (train)": ("transient_mse", "train", "final"),
    "NMSE": ("heldout", "nmse", "final"),
    "NMSE noise": ("heldout", "nmse", "noise_floor"),
    "deviance/bin": ("heldout", "deviance_per_bin", "final"),
    "depth, median (m)": ("geometry", "depth_median_abs"),
    "normals, median (°)": ("geometry", "normal_median_deg"),
    "coverage": ("geometry", "coverage"),
    "s/iteration": ("seconds", "per_iteration"),
}
# Sections of a config that say where and how a run is kept, or repeat what a name says.
NOT_SETTINGS = ("folder", "callbacks", "logger", "trainer.default_root_dir", "ablation.optimise", "ckpt_path")
ALONE = {"scene.name": "scene", "ablation.name": "ablation", "method.name": "method"}
RUN, SEEDS = "run", "seeds"


class SweepTable(Callback):
    """Hydra callback: after a multirun, its table, a picture of all runs, and their place in TensorBoard."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write ``table.csv``, ``table.md``, ``grid.png`` and HParams of all jobs that left a summary."""
        folder = Path(config.hydra.sweep.dir)
        runs = told_runs(sorted(path.parent for path in folder.glob("*/summary.json")))
        if not runs:
            return
        write_table(folder, rows_of(runs))
        shown = [folder / "table.md"]
        if write_grid(folder / "grid.png", runs):
            shown.append(folder / "grid.png")
        write_hparams(runs)
        log.info("the sweep side by side: %s", ", ".join(map(str, shown)))


@dataclass(frozen=True)
class ToldRun:
    """A finished run beside others.

    Args:
        folder: of the run.
        settings: in which it differs from them, by key.
        errors: by column of :data:`ERRORS`; None where it has none.
    """

    folder: Path
    settings: dict[str, Any]
    errors: dict[str, Any]


def told_runs(folders: Sequence[Path]) -> list[ToldRun]:
    """Runs with what tells them apart.

    Raises:
        UserError: a folder holds no finished run.
    """
    read = [_read(folder) for folder in folders]
    settings = differing([dict(_settings(config)) for config, _ in read])
    errors = [{column: _at(summary, keys) for column, keys in ERRORS.items()} for _, summary in read]
    return [ToldRun(*told) for told in zip(folders, settings, errors, strict=True)]


def run_rows(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """A row a run: its folder, where it differs from the others, its errors; the best last, as in Table 1.

    Errors that no run has (geometry without a truth) are left out.

    Args:
        folders: of finished runs.

    Returns:
        column → value; the folder's name comes first (its whole path where two have the same), then settings.

    Raises:
        UserError: a folder holds no finished run.
    """
    return rows_of(told_runs(folders))


def rows_of(runs: Sequence[ToldRun]) -> list[dict[str, Any]]:
    """The rows of :func:`run_rows`."""
    known = [column for column in ERRORS if any(run.errors[column] is not None for run in runs)]
    names = [run.folder.resolve().name for run in runs]
    if len(set(names)) < len(names):
        names = [str(run.folder) for run in runs]
    rows = [
        {RUN: name, **run.settings, **{column: run.errors[column] for column in known}}
        for name, run in zip(names, runs, strict=True)
    ]
    order = [run.errors["MSE transient (held out)"] or run.errors["NMSE"] or math.inf for run in runs]
    return [row for _, row in sorted(zip(order, rows, strict=True), key=lambda pair: -pair[0])]


def write_grid(path: Path, runs: Sequence[ToldRun], columns: int = 4) -> bool:
    """A picture of the volumes of all runs, each with what tells it apart.

    Args:
        path: of the picture.
        runs: those without a ``volume.h5``, of a surface alone, are left out.
        columns: panels in a row.

    Returns:
        Whether there was a volume to draw.
    """
    views = []
    for run in runs:
        if (run.folder / "volume.h5").is_file():
            values, grid, _ = read_volume(run.folder / "volume.h5")
            told = [f"{key.split('.')[-1]} {_show(value)}" for key, value in run.settings.items()]
            views.append(View("\n".join(told) or run.folder.name, values, grid))
    if views:
        save_figure(front_views(views, columns), path)
    return bool(views)


def write_hparams(runs: Sequence[ToldRun]) -> None:
    """Settings and errors of runs as TensorBoard's HParams, in the ``tensorboard`` of each."""
    for run in runs:
        settings = {
            key: value if isinstance(value, bool | int | float | str) else str(value)
            for key, value in run.settings.items()
        }
        errors = {f"sweep/{column}": float(v) for column, v in run.errors.items() if v is not None}
        with SummaryWriter(run.folder / "tensorboard") as writer:
            for part in hparams(settings, errors):
                writer.file_writer.add_summary(part)
            for name, value in errors.items():
                writer.add_scalar(name, value)


def differing(settings: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Of each of some sets of settings, those that are not alike in all; of several that differ alike one.

    Examples:
        >>> differing([{"a": 1, "b": 2, "c": 5, "d": 2}, {"a": 1, "b": 3, "c": 6, "d": 3}])
        [{'b': 2, 'c': 5}, {'b': 3, 'c': 6}]
    """
    keys = list(dict.fromkeys(key for each in settings for key in each))
    values = {key: [repr(each.get(key)) for each in settings] for key in keys}
    told: dict[str, list[str]] = {}
    for key in keys:
        if len(set(values[key])) > 1 and values[key] not in told.values():
            told[key] = values[key]
    return [{key: each.get(key) for key in told} for each in settings]


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows that differ in the seed alone, as one: mean and sample standard deviation of each error.

    Args:
        rows: of :func:`run_rows`.

    Returns:
        column → value, with the number of seeds; empty where no setting was run with two.
    """
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        named = {key: row[key] for key in row if key not in (*ERRORS, RUN, "seed")}
        groups.setdefault(tuple((key, repr(value)) for key, value in named.items()), []).append(row)
    if max((len(group) for group in groups.values()), default=0) < 2:
        return []
    told = []
    for group in groups.values():
        row = {key: value for key, value in group[0].items() if key not in (*ERRORS, RUN, "seed")}
        row[SEEDS] = len(group)
        for column in (column for column in ERRORS if column in group[0]):
            values = [each[column] for each in group if each[column] is not None]
            row[column] = statistics.fmean(values) if values else None
            row[f"{column} ±"] = statistics.stdev(values) if len(values) > 1 else None
        told.append(row)
    return told


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """All runs as Markdown, and below them the spread over seeds where there is one; four digits a number."""
    spread = over_seeds(rows)
    for row in spread:
        for column in [column for column in ERRORS if column in row]:
            mean, deviation = row.pop(column), row.pop(f"{column} ±")
            row[column] = _show(mean) + (f" ± {deviation:.2g}" if deviation is not None else "")
    tables = [markdown_table([dict(row) for row in rows], _show)]
    if spread:
        tables.append("Mean and standard deviation over seeds:\n\n" + markdown_table(spread, _show))
    return "\n\n".join(tables)


def write_table(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """``table.csv``, ``table.md``, and ``seeds.csv`` where settings were run with several seeds.

    Args:
        folder: where to.
        rows: of :func:`run_rows`.
    """
    write_csv(folder / "table.csv", [dict(row) for row in rows])
    spread = over_seeds(rows)
    if spread:
        write_csv(folder / "seeds.csv", spread)
    with whole_file(folder / "table.md") as partial:
        partial.write_text(table(rows) + "\n", encoding="utf-8")


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Config and summary of a finished run."""
    for name in ("config.yaml", "summary.json"):
        if not (folder / name).is_file():
            raise UserError(f"{folder} is not the folder of a finished run: {name} is missing")
    try:
        summary = json.loads(bounded(folder / "summary.json"))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{folder / 'summary.json'} is damaged, or not written by this program") from error
    return plain_yaml(folder / "config.yaml"), summary


def _settings(config: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key → value of what was set, the scene's and the ablation's names by their groups' names."""
    for name, value in config.items():
        key = f"{above}{name}"
        if f"{key}.".startswith(tuple(f"{section}." for section in NOT_SETTINGS)):
            continue
        if isinstance(value, dict):
            yield from _settings(value, f"{key}.")
        else:
            yield ALONE.get(key, key), value


def _at(summary: Any, keys: Iterable[str]) -> Any:
    """What a summary holds below some keys; None where it does not, or no number."""
    for key in keys:
        if not isinstance(summary, dict) or key not in summary:
            return None
        summary = summary[key]
    return summary if isinstance(summary, int | float) else None


def _show(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value).replace("|", "\\|")
