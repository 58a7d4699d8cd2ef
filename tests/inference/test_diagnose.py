"""The diagnose command as a user runs it: a process on a reduced scene, a finished run, and what cannot
work.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from forked import command
from inference_scenes import capture_of, raster
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from data_modules.readers import write_capture
from nlos_lit.commands.simulate import simulate
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.result import Accepted, Diagnosis, Estimate, Gain, Tried
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.io.files import write_json
from nlos_lit.io.views import read_view

SCENE = [
    "scene.simulate.scan.nx=24",
    "scene.simulate.scan.ny=24",
    "scene.volume.depth=[0.4,0.95]",
    "scene.volume.depth_pitch=0.0192",
]
SMALL = [
    "surfels.contest=40", "surfels.rounds=2", "surfels.steps=40", "surfels.more=0",
    "criticism.spots=96", "criticism.rivals=1", "criticism.most=1", "threads=1",
]  # fmt: skip
# A diagnosis that tries nothing, where nothing hangs on what it says.
TINY = [*SMALL, "surfels.contest=20", "surfels.steps=20", "criticism.level=1e-12", "criticism.share=1"]
FIGURES = [
    "residual_time",
    "residual_depth",
    "residual_wall",
    "residual_scan",
    "residual_rate",
    "screening",
    "deviance",
]


def run(script: str, *overrides: str, folder: Path, check: bool = True) -> subprocess.CompletedProcess:
    done = command(f"{script}.py", *overrides, f"hydra.run.dir={folder}")
    if check:
        assert done.returncode == 0, done.stderr[-3000:] + done.stdout[-2000:]
    return done


def times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("diagnosis") / "one"
    run("diagnose", *SCENE, *SMALL, folder=folder)
    return folder


def test_a_diagnosis_leaves_a_page_to_explore(finished):
    view, said = (
        read_view(finished / "diagnosis"),
        json.loads((finished / "diagnosis" / "diagnosis.json").read_text()),
    )
    assert view.facts["status"] == "finished"
    assert view.facts["profiles"] == said["profiles"]
    assert view.facts["next"]["text"]
    assert view.volume is not None
    names = ", ".join(term["name"] for term in [*said["effects"], *said["unknown"]])
    assert list(view.models) == ["rendered", *([f"extended by {names}"] if names else [])]
    assert "explore.html" in (finished / "diagnosis" / "report.html").read_text(encoding="utf-8")
    assert (finished / "diagnosis" / "explore.html").is_file()


def test_a_diagnosis_leaves_page_numbers_and_figures(finished):
    said = json.loads((finished / "diagnosis" / "diagnosis.json").read_text())
    assert set(said) == {
        "effects", "unknown", "groups", "unexplained", "screened", "base", "extended", "untouched_test",
        "witness", "profiles", "needed", "chance", "notes", "capture", "toys", "seconds", "seed", "further",
        "likely", "along",
    }  # fmt: skip
    assert {s["name"] for s in said["screened"]} == {e.name for e in [*EFFECTS, *FREE]}
    for one in said["screened"]:
        assert -1e-3 <= one["retained_information"] <= 1 + 1e-3
        assert one["scatter"] >= 1
    evidence = [s["evidence"] for s in said["screened"]]
    assert evidence == sorted(evidence, reverse=True)
    misfit = (said["needed"] - np.log(len(evidence) / 0.01)) / CriticismSettings.share
    assert 0 <= misfit < 1000, "nats that the fine scene leaves"
    assert said["chance"] == pytest.approx(min(1, 0.01 * np.exp(said["needed"] - evidence[0])))
    assert said["effects"] == [], "nothing is hidden in the scene"
    assert said["unknown"] == []
    assert set(said["unexplained"]) == {"significant", "axis", "evidence"}
    assert said["unexplained"]["significant"] is False
    if evidence[0] < said["needed"]:
        assert said["base"] == said["extended"]
    assert said["untouched_test"]["base"]["deviance_noise"] == pytest.approx(
        said["base"]["deviance_noise"], rel=0.05
    )
    assert (
        said["base"]["deviance_noise"]
        < said["base"]["deviance_per_bin"]
        < 1.5 * said["base"]["deviance_noise"]
    )
    assert [p["axis"] for p in said["profiles"]] == ["time", "depth", "scan", "rate", "wall"]
    wall = said["profiles"][-1]
    assert wall["edges"][0] == pytest.approx(-0.5 + 1 / 48)  # spots stand in the middle of their cells
    assert wall["edges_y"][-1] == pytest.approx(0.5 - 1 / 48)
    assert (said["capture"]["kind"], said["capture"]["spots"], said["capture"]["bins"]) == (
        "confocal",
        576,
        256,
    )
    page = (finished / "diagnosis" / "report.html").read_text()
    assert page.count("data:image/png;base64,") >= len(FIGURES)
    for name in FIGURES:
        assert (finished / "diagnosis" / "figures" / f"{name}.png").stat().st_size > 5000
    assert (finished / "config.yaml").exists()


def test_a_second_capture_is_asked_what_stays(finished, tmp_path):
    """The first diagnosis left two names open, of which its own blocks cannot tell."""
    first, second = tmp_path / "first", tmp_path / "second scan.hdf5"
    shutil.copytree(finished, first)
    file = first / "diagnosis" / "diagnosis.json"
    even = {name: Tried([0.5] * 16) for name in ("background_slope", "direct_leak")}
    term = Accepted(
        "background_slope", {"slope": Estimate(0.3, 0.1, "1")}, 30.0, Gain(1.1, 1.0, 0.01, (0.005, 0.02)),
        dict.fromkeys(even, 0.5), "a look", tried=even,
    )  # fmt: skip
    opened = dataclasses.replace(Diagnosis.read(file), effects=[term], groups=[list(even)])
    write_json(file, opened.to_dict())
    simulate(
        [
            f"out={second}",
            "nx=24",
            "ny=24",
            "seed=5",
            "effects=[background_slope]",
            "background_slope.slope=0.8",
        ]
    )
    done = command("diagnose.py", str(first), "--split-with", str(second), *SMALL)
    assert done.returncode == 0, done.stderr[-3000:] + done.stdout[-2000:]
    said = Diagnosis.read(file)
    (further,) = said.further
    assert (further.name, further.asked, further.kept) == ("second_scan", list(even), {})
    assert further.nats["background_slope"] > further.nats["direct_leak"]
    assert further.stays[0] == "background_slope"
    assert len(said.effects[0].tried["background_slope"].nats) == 32
    page = (first / "diagnosis" / "report.html").read_text(encoding="utf-8")
    assert "What second_scan says of it" in page
    facts = read_view(first / "diagnosis").facts
    assert facts["status"] == "finished"
    assert any("second_scan" in sentence for sentence in facts["said"])
    assert "scene.simulate.scan.nx=24" in facts["next"]["command"]
    again = command("diagnose.py", str(first), "--split-with", str(tmp_path / "no.mat"))
    assert again.returncode == 2
    assert "split_with must be a file or folder that is there" in again.stderr


def test_figures_are_in_tensorboard(finished):
    events = EventAccumulator(str(finished / "tensorboard"))
    events.Reload()
    assert {f"diagnosis/{name}" for name in FIGURES} <= set(events.Tags()["images"])


def test_a_finished_diagnosis_is_not_overwritten(finished):
    before = times(finished)
    done = run("diagnose", *SCENE, *SMALL, folder=finished, check=False)
    assert done.returncode == 2
    assert "already holds a diagnosis" in done.stderr
    assert times(finished) == before


def test_a_finished_run_is_diagnosed_in_its_folder(tmp_path):
    trained = tmp_path / "run"
    small = [
        "model.rays=20",
        "batch_spots=8",
        "heldout.block=3",
        "heldout.monitor_spots=16",
        "export.spots=16",
        "logger=none",
    ]
    run(
        "train",
        *SCENE,
        "scene.simulate.scan.nx=16",
        "scene.simulate.scan.ny=16",
        *small,
        "scene.name=two plates",
        "threads=1",
        "scene.iterations=1",
        "seed=3",
        folder=trained,
    )
    before = times(trained)
    run("diagnose", *TINY, f"run={trained}", folder=tmp_path / "log")
    said = json.loads((trained / "diagnosis" / "diagnosis.json").read_text())
    assert said["capture"]["name"] == "two plates"
    assert said["capture"]["spots"] == 256
    assert (trained / "diagnosis" / "report.html").exists()
    assert list((trained / "tensorboard").glob("events.out.tfevents.*"))
    assert {path: time for path, time in times(trained).items() if path in before} == before
    again = run("diagnose", *SMALL, f"run={trained}", folder=tmp_path / "log", check=False)
    assert again.returncode == 2
    assert "already holds a diagnosis; move" in again.stderr


def test_what_cannot_be_diagnosed_is_one_sentence(tmp_path):
    render = dataclasses.replace(capture_of(raster(16), counts=np.ones((256, 64))), is_counts=False)
    write_capture(tmp_path / "render.hdf5", render)
    own = f"scene=capture scene.volume.depth=[0.4,0.9] force=true scene.path={tmp_path / 'render.hdf5'}"
    bad = {
        f"run={tmp_path / 'nowhere'}": "run must be a file or folder that is there",
        f"run={tmp_path}": "is not the folder of a finished run: config.yaml is missing",
        own: "holds expected values (a render)",
        "scene.simulate.scan.nx=6 scene.simulate.scan.ny=6": "needs a scan of at least 16 × 16 spots",
    }
    for overrides, words in bad.items():
        done = run("diagnose", *SMALL, *overrides.split(), folder=tmp_path / "bad", check=False)
        assert done.returncode == 2, done.stderr[-2000:]
        assert "Traceback" not in done.stderr
        sentence = done.stderr.strip().splitlines()[-1]
        assert sentence.startswith("error: ")
        assert words in sentence
        assert not (tmp_path / "bad" / "diagnosis").exists()
