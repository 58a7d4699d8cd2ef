"""Runs side by side: columns are the settings that differ, and seeds are put together."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.commands.compare import main as compare
from nlos_lit.io.volumes import write_volume
from nlos_lit.training.configs import compose
from nlos_lit.training.sweep_table import (
    over_seeds,
    run_rows,
    table,
    told_runs,
    write_grid,
    write_hparams,
    write_table,
)


def run(folder, error: float, *overrides: str, geometry: dict | None = None):
    folder.mkdir(parents=True)
    config = compose("train", [*overrides, f"folder={folder}"])
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    one = {"initial": 1.0, "final": error, "noise_floor": 0.1, "noise": 0.2}
    summary = {
        "heldout": {"nmse": one, "deviance_per_bin": one},
        "transient_mse": {"heldout": one, "train": one},
        "geometry": geometry,
        "seconds": {"per_iteration": 0.5},
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Two ablations and two thresholds, with two seeds and one."""
    folder = tmp_path_factory.mktemp("sweep")
    settings = ["ablation=all", "scene.threshold=0.3"]
    run(folder / "0", 0.4, *settings, "seed=0", geometry={"depth_median_abs": 0.01})
    run(folder / "1", 0.6, *settings, "seed=1", geometry={"depth_median_abs": 0.03})
    run(folder / "2", 0.7, "ablation=phasor", "seed=0", geometry={"depth_median_abs": 0.05})
    return folder


def folders(sweep):
    return sorted(path.parent for path in sweep.glob("*/summary.json"))


def test_columns_are_what_differs(sweep):
    rows = run_rows(folders(sweep))
    assert list(rows[0])[:5] == ["run", "seed", "scene.threshold", "ablation", "MSE transient (held out)"]
    assert [row["run"] for row in rows] == ["2", "1", "0"]
    assert [row["MSE transient (held out)"] for row in rows] == [0.7, 0.6, 0.4]  # the best last
    assert [(row["scene.threshold"], row["depth, median (m)"]) for row in rows] == [
        (0.2, 0.05),
        (0.3, 0.03),
        (0.3, 0.01),
    ]


def test_seeds_are_put_together(sweep, tmp_path):
    rows = run_rows(folders(sweep))
    spread = over_seeds(rows)
    assert [row["seeds"] for row in spread] == [1, 2]
    both = spread[1]
    assert both["NMSE"] == pytest.approx(0.5)
    assert both["NMSE ±"] == pytest.approx(0.02**0.5)  # of 0.4 and 0.6
    assert spread[0]["NMSE ±"] is None
    assert "| 0.3 | all | 2 | 0.5 ± 0.14 |" in table(rows)
    write_table(tmp_path, rows)
    with (tmp_path / "seeds.csv").open() as file:
        assert [row["seeds"] for row in csv.DictReader(file)] == ["1", "2"]
    assert over_seeds([{"scene": "a", "NMSE": 1.0}, {"scene": "b", "NMSE": 2.0}]) == []


def test_an_ablation_is_one_column(tmp_path):
    for ablation in ("all", "phasor"):
        run(tmp_path / ablation, 0.5, f"ablation={ablation}")
    rows = run_rows(folders(tmp_path))
    assert [list(row.items())[1] for row in rows] == [("ablation", "all"), ("ablation", "phasor")]
    assert "depth, median (m)" not in rows[0]


def test_any_runs_are_compared(sweep, capsys, tmp_path):
    two = [str(folder) for folder in folders(sweep)[1:]]
    assert compare(two) == 0
    told = capsys.readouterr().out
    assert told.startswith("| run | seed | scene.threshold | ablation | MSE transient (held out) |")
    assert len(told.splitlines()) == 4
    for words, sentence in [
        ([two[0]], "error: give the folders of two runs or more; found "),
        ([two[0], str(tmp_path)], "is not the folder of a finished run: config.yaml is missing"),
    ]:
        assert compare(words) == 2
        assert sentence in capsys.readouterr().err


def test_runs_that_differ_in_nothing_are_told_by_their_folders(tmp_path):
    alike = [run(tmp_path / day / "run", error, "seed=0") for day, error in (("a", 0.4), ("b", 0.5))]
    assert [row["run"] for row in run_rows(alike)] == [str(alike[1]), str(alike[0])]


def test_a_sweep_is_one_picture(sweep, tmp_path):
    runs = told_runs(folders(sweep))
    assert not write_grid(tmp_path / "grid.png", runs)  # no run left a volume
    grid = VolumeGrid((0.0, 0.0, 0.5), (0.1, 0.1, 0.1), (3, 4, 4))
    for run_ in runs[:2]:
        write_volume(run_.folder / "volume.h5", np.random.default_rng(0).random((3, 4, 4)), grid)
    assert write_grid(tmp_path / "grid.png", runs)
    assert (tmp_path / "grid.png").stat().st_size > 5000


def test_a_sweep_is_shown_among_hparams(sweep):
    runs = told_runs(folders(sweep))
    write_hparams(runs)
    (events,) = (runs[0].folder / "tensorboard").glob("events.*")
    reader = EventAccumulator(str(events)).Reload()
    assert reader.Scalars("sweep/NMSE")[0].value == pytest.approx(0.4)
    kept = {tag: reader.SummaryMetadata(tag) for tag in reader.summary_metadata}
    begun = HParamsPluginData.FromString(kept["_hparams_/session_start_info"].plugin_data.content)
    told = begun.session_start_info.hparams
    assert told["scene.threshold"].number_value == pytest.approx(0.3)
    assert told["ablation"].string_value == "all"
