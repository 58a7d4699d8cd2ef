"""Verdicts and files of an experiment, by hand."""

from __future__ import annotations

import csv

import pytest

from nlos_lit.paper.record import Evidence, Glance, read_record
from nlos_lit.report.figures import loss_plot


@pytest.mark.parametrize(
    ("values", "higher", "verdict"),
    [
        (
            {"published": 10.0, "classical": {"lct": 8.0, "fk": 9.0}, "ours": 6.0, "refined": 2.0},
            False,
            "**better**, 4 ×",
        ),
        ({"published": 1.0, "classical": {"lct": 8.0}, "ours": 6.0, "refined": 2.0}, False, "worse, 2 ×"),
        (
            {"published": 0.4, "classical": {"fk": 0.5}, "ours": 0.8, "refined": 0.2},
            True,
            "**better**, 1.6 ×",
        ),
        ({"published": 0.9, "classical": {}, "ours": 0.45}, True, "worse, 2 ×"),
        ({"published": 1.0, "ours": 1.01}, False, "equal within 3 %"),
        ({"classical": {"lct": float("nan")}, "ours": 1.0}, False, "–"),
    ],
)
def test_verdict(values, higher, verdict):
    assert Glance("error", "scene", higher=higher, **values).row()["verdict"] == verdict


def test_the_best_classical_method_is_named():
    entry = Glance("error", "scene", 3.0, {"lct": 8.0, "fk": 4.0, "rsd": float("nan")}, 1.0)
    assert entry.row()["best classical"] == "4 (fk)"
    assert (
        Glance("score", "scene", 3.0, {"lct": 8.0, "fk": 4.0}, 1.0, higher=True).row()["best classical"]
        == "8 (lct)"
    )


def test_an_experiment_leaves_table_figures_and_texts(tmp_path):
    rows = [{"system": "lct", "error (mm)": 1 / 3}, {"system": "ours", "error (mm)": float("nan")}]
    figures, glance = {"curve": loss_plot({"a": [1.0, 0.5]})}, [Glance("error", "scene", 2.0, {}, 1.0)]
    made = Evidence("one", "Title", "paper says", "here", rows, figures, {"curve": "caption"}, glance)
    made.write(tmp_path)
    with (tmp_path / "table.csv").open(encoding="utf-8") as file:
        assert float(next(csv.DictReader(file))["error (mm)"]) == 1 / 3
    assert (tmp_path / "table.md").read_text(encoding="utf-8").splitlines()[2] == "| lct | 0.333 |"
    assert (tmp_path / "curve.png").stat().st_size > 3000
    record = read_record(tmp_path)
    assert record["rows"][1]["error (mm)"] is None
    assert record["glance"][0]["verdict"] == "**better**, 2 ×"
    assert record["captions"] == {"curve": "caption"}
