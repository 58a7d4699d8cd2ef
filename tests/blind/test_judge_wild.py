"""What the rows of the evaluation say of a diagnosis, on cases worked out by hand."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
import torch
from conftest import ROOT
from judge_wild import reached
from wild_table import LENGTH, Spec
from wild_truth import hide, write

from data_modules.readers import read_capture
from nlos_lit.inference.diagnose import split_of
from nlos_lit.metrics.transients import expected_deviance, poisson_deviance

sys.path.append(str(ROOT / "benchmarks"))

import blind

ECHO = {
    "kind": "single",
    "spec": {"family": "plates"},
    "base": 1.1,
    "noise": 1.0,
    "right": {"ghost_echoes": ["ghost_pulse"]},
    "alike": {"ghost_echoes": []},
    "axes": [],
    "statistics": {"ghost_echoes": [300.0, 200.0]},
    "values": {"ghost_echoes": {"fraction": 0.1, "delay": 0.2, "again": 0.5}},
    "limits": {"ghost_pulse": {"fraction": 0.02}},
    "named": [{"irf_tail": 0.6, "ghost_pulse": 0.4}],
    "parameters": {"irf_tail": {"fraction": [0.3, 0.01]}, "ghost_pulse": {"fraction": [0.12, 0.01]}},
    "unknown": [],
    "likely": [],
    "error": "",
}
UNKNOWN = ECHO | {
    "kind": "unknown",
    "right": {"dead_columns": []},
    "alike": {"dead_columns": []},
    "statistics": {"dead_columns": [300.0, 200.0]},
    "values": {"dead_columns": {"loss": 0.3}},
    "named": [],
    "parameters": {},
    "axes": ["wall"],
    "unknown": ["wall"],
    "reached": 0.8,
}


def said(*cases: dict) -> dict[str, str]:
    """What is measured, by the beginning of its line."""
    return {
        what.split(",")[0].split(" (")[0]: value.split(" =")[0] for what, _, value in blind.rows_of(cases)
    }


def test_the_true_cause_may_stand_anywhere_in_the_first_group():
    wrong = ECHO | {"named": [{"irf_tail": 1.0}, {"ghost_pulse": 1.0}]}
    large = ECHO | {"named": [{"irf_tail": 0.5, "afterpulsing": 0.3, "ghost_pulse": 0.2}]}
    silent = ECHO | {"named": [], "parameters": {}}
    lines = said(ECHO, wrong, large, silent)
    assert lines["true cause in the group that is named first"] == "2 of 3"
    assert lines["… names in it"] == "2.00"
    assert lines["named first"] == "1 of 4"


@pytest.mark.parametrize(("error", "held"), [(0.0101, "1 of 1"), (0.0099, "0 of 1")])
def test_quantities_are_those_that_mean_the_same(error, held):
    """The wrong name in the group has a fraction, too, and no echo has a loss."""
    case = ECHO | {"parameters": ECHO["parameters"] | {"ghost_pulse": {"fraction": [0.12, error]}}}
    assert said(case, UNKNOWN)["quantities of what is named rightly within two reported errors"] == held


@pytest.mark.parametrize(("limit", "named"), [(0.099, "1 of 2"), (0.101, "–")])
def test_limits_are_held_against_what_is_as_strong(limit, named):
    case = ECHO | {"limits": {"ghost_pulse": {"fraction": limit, "again": 0.1 if limit < 0.1 else 0.6}}}
    assert (
        said(case, case | {"named": []})["named where stronger than the limit that the diagnosis states"]
        == named
    )


@pytest.mark.parametrize(
    ("case", "counted"),
    [
        (UNKNOWN, "1 of 1"),
        (UNKNOWN | {"reached": 0.79}, "0 of 1"),
        (UNKNOWN | {"unknown": ["time"]}, "–"),
        (UNKNOWN | {"axes": ["spot", "wall"]}, "–"),
    ],
)
def test_free_terms_are_held_against_the_true_cause(case, counted):
    older = {name: value for name, value in case.items() if name != "reached"}
    assert said(case, older)["unknown: at least 80 % of what the true cause gains"] == counted


def test_what_a_true_cause_gains(tmp_path):
    """Beside a scene that never saw it, it explains the counts nearly as well as noise allows."""
    truth = hide(Spec("plates", effects=("dead_columns",), strengths=(2,), level=1500, seed=3, side=16))
    write(truth, tmp_path / "capture.hdf5")
    capture = read_capture(tmp_path / "capture.hdf5", "auto")
    spots = split_of(capture).test
    counts = torch.from_numpy(truth.counts[spots]).double()
    noise = float(expected_deviance(torch.from_numpy(truth.expected[spots])).mean())
    without = float(poisson_deviance(counts, torch.from_numpy(truth.without[spots])).mean())
    test = {"base": without, "extended": noise}
    told = {n: SimpleNamespace(deviance_per_bin=value) for n, value in test.items()}
    share = reached(truth, capture, SimpleNamespace(untouched_test=told))
    assert share == pytest.approx(1, abs=0.15)
    assert share > 1, "its scene is not the true one"


def test_nothing_is_said_of_a_test_set_that_is_not_complete(monkeypatch):
    rows = [ECHO | {"index": k} for k in range(LENGTH)]
    monkeypatch.setattr(blind, "rates", lambda cases: f"rates of {len(cases)}")
    monkeypatch.setattr(blind, "captures", lambda cases: "captures")
    assert "rates" not in blind.test_set(rows[1:])
    assert "209 of 210 captures have been run" in blind.test_set(rows[1:])
    assert "rates of 210" in blind.test_set(rows)


def test_what_is_told_of_by_what_was_hidden():
    """A faint one is counted apart, and a look-alike alone is none."""
    faint = ECHO | {"statistics": {"ghost_echoes": [10.0, 8.0]}}
    alike = ECHO | {"named": [{"irf_tail": 1.0}], "alike": {"ghost_echoes": ["irf_tail"]}}
    lines = blind.by_hidden([ECHO, faint, alike, UNKNOWN]).splitlines()
    assert lines[2] == "| ghost_echoes | 1 of 2 | 1 of 1 | 1 |"
    assert lines[3] == "| dead_columns (unknown) | 1 of 1 | 0 of 0 | 0 |"


def test_what_is_said_by_scene():
    empty = ECHO | {"kind": "null", "right": {}, "named": []}
    cases = [
        empty,
        empty | {"base": 1.3, "named": [{"clock_scale": 1.0}]},
        empty | {"base": 1.2},
        ECHO,
        ECHO | {"named": [], "spec": {"family": "mesh"}},
    ]
    lines = blind.by_scene(cases).splitlines()
    assert lines[2:] == [
        "| mesh | – | 0 of 0 | 0 of 1 |",
        "| plates | 1.200 (1.100 … 1.300) | 1 of 3 | 1 of 1 |",
    ]


def test_the_test_set_is_run_by_a_commit_alone(monkeypatch, tmp_path):
    monkeypatch.setattr(blind, "STORE", tmp_path / "outcomes")
    monkeypatch.setattr(blind, "commit", lambda: "1234567-dirty")
    with pytest.raises(SystemExit, match="found 1234567-dirty"):
        blind.run("test", 0, 1, 1)
    assert not (tmp_path / "outcomes").exists()
    blind.run("development", 0, 0, 1)
    monkeypatch.setattr(blind, "commit", lambda: "1234567")
    blind.run("test", 0, 0, 1)
