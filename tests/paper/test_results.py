"""The reduced form of every experiment, as one command, and the page it makes."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path

import pytest
from conftest import ROOT
from forked import command

from nlos_lit.paper.experiments import EXPERIMENTS

pytestmark = pytest.mark.timeout(1500)  # a minute and a half on two idle cores, several on busy ones

SYSTEMS = {"published system", "ours, phasor surface", "ours, refined"}


def results(*arguments: str) -> subprocess.CompletedProcess:
    return command("results.py", *arguments, seconds=1400)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("evidence")
    done = results("all", "size=reduced", f"out={folder}")
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "table.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_leaves_a_table_and_figures(made, name):
    record = json.loads((made / name / "evidence.json").read_text(encoding="utf-8"))
    assert record["name"] == name
    assert record["paper"]
    assert len(table(made / name)) == len(record["rows"]) > 0
    assert record["captions"]
    for figure in record["captions"]:
        assert (made / name / f"{figure}.png").stat().st_size > 5000


def test_what_the_tables_hold(made):
    rows = table(made / "table1")
    assert [(r["phasor kernel"], r["albedo"], r["laser-sensor"]) for r in rows[:6]] == [
        ("True", "False", "False"), ("True", "False", "True"), ("False", "True", "False"),
        ("False", "True", "True"), ("True", "True", "False"), ("True", "True", "True"),
    ]  # fmt: skip
    assert [float(r["paper's MSE"]) for r in rows[:6]] == sorted(
        (float(r["paper's MSE"]) for r in rows[:6]), reverse=True
    )
    assert {r["system"] for r in table(made / "figure10")} == SYSTEMS | {
        "ours, volume's front",
        "bp",
        "fbp",
        "lct",
        "dlct",
        "fk",
        "rsd",
    }
    levels = {float(r["counts a spot"]): float(r["SNR (dB)"]) for r in table(made / "figure6")}
    assert levels[4000] - levels[400] == pytest.approx(
        10, abs=1
    )  # signal² grows a hundredfold, variance tenfold
    assert {int(r["exposure (min)"]) for r in table(made / "figure7")} == {60, 180}
    assert [int(r["iteration"]) for r in table(made / "supplement2")] == [0, 2, 4]
    parameters = [r["parameter"] for r in table(made / "figure5")]
    assert parameters[:6] == parameters[6:]
    assert set(parameters) == {"omega_pf", "sigma_pf", "sigma_ls", "I_l", "kappa_s", "eta_s"}
    profiles = {r["profile"] for r in table(made / "profiles")}
    assert {
        "paper",
        "reference_code",
        "default",
        "default, refined",
        "effects vignetting, refined",
    } == profiles
    halves = [r for r in table(made / "figure8") if r["half"]]
    assert {r["system"] for r in halves} == SYSTEMS


def test_going_on_repeats_no_training(made):
    done = results("table1", "supplement2", "size=reduced", f"out={made}")
    assert done.returncode == 0, done.stderr[-2000:]
    assert "training" not in done.stderr
    assert "computing" not in done.stderr


def test_the_page_is_rewritten_between_its_marks(made, tmp_path):
    page = tmp_path / "docs" / "results.md"
    page.parent.mkdir()
    page.write_text((ROOT / "docs" / "results.md").read_text(encoding="utf-8"), encoding="utf-8")
    done = results("page", "size=reduced", f"out={made}", f"docs={page}")
    assert done.returncode == 0, done.stderr[-2000:]
    text = page.read_text(encoding="utf-8")
    assert "sphere and plate, 16×16" in text
    assert "| table1 |" in text  # the comparison of all
    for name in EXPERIMENTS:
        assert (page.parent / "results" / f"{name}.csv").exists()
        assert text.count(f"<!-- generated: {name} -->") == 1
    assert all(
        (page.parent / "images" / p.name).exists() for p in (page.parent / "images").glob("results_*.png")
    )
    assert len(list((page.parent / "images").glob("results_*.png"))) >= len(EXPERIMENTS)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["table2"], "cannot use 'table2'"),
        ([], "name what to make"),
        (["table1", "size=huge"], "size is one of full, reduced"),
        (["page", "out=nowhere"], "no finished experiment below nowhere"),
        (["figure9", "data=nowhere"], "this experiment needs data_s_u.mat"),
    ],
)
def test_what_cannot_work_is_one_sentence(arguments, sentence, tmp_path):
    if "page" not in arguments:
        arguments = [*arguments, f"out={tmp_path}"]
    done = results(*arguments)
    assert done.returncode == 2
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
