"""What experiments measure with, by hand, and what a workspace keeps and refuses."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import yaml
from conftest import ROOT

from data_modules.simulate import SCENES, ScanPlan, simulate_capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.points import Points
from nlos_lit.metrics.geometry import GeometryErrors
from nlos_lit.paper.figure5 import settled_at
from nlos_lit.paper.figure6 import signal_to_noise
from nlos_lit.paper.figure7 import consensus, contrast, separation
from nlos_lit.paper.figure9 import cell_median
from nlos_lit.paper.methods import f_score, front_of_points, selected
from nlos_lit.paper.page import begin, replace_part
from nlos_lit.paper.subjects import sensor_of, thinned
from nlos_lit.paper.workspace import Scene, Subject, Workspace


def points(rows: list[tuple[float, float, float]], albedo: list[float]) -> Points:
    return Points(np.array(rows), np.tile([0.0, 0.0, -1.0], (len(rows), 1)), np.array(albedo))


def test_separation_counts_ordered_pairs():
    """Letters 3, 5 against background 1, 4, 5: 1 + 2.5 of 6 pairs are ordered (a tie counts half)."""
    front = np.array([[3.0, 5.0, 1.0], [4.0, 5.0, 9.0]])
    letters = np.array([[True, True, False], [False, False, False]])
    background = np.array([[False, False, True], [True, True, False]])
    assert separation(front, letters, background) == pytest.approx(3.5 / 6)
    assert separation(front**3, letters, background) == pytest.approx(3.5 / 6)


def test_contrast_is_in_amplitudes():
    front = np.array([16.0, 16.0, 1.0, 9.0])
    assert contrast(
        front, np.array([True, True, False, False]), np.array([False, False, True, True])
    ) == pytest.approx(2.0)


def test_consensus_takes_what_methods_agree_on():
    one, two = np.zeros((10, 10)), np.zeros((10, 10))
    one[:3], two[:3] = 4.0, 100.0  # both, on their own scales
    two[3] = 25.0  # amplitude a half in one of two: in between
    letters, background = consensus([one, two])
    assert letters[:3].all()
    assert not letters[3:].any()
    assert background[4:].all()


def measured(counts: float, seed: int | None = 3):
    scan = ScanPlan(nx=8, ny=6, width=1.0, bin_length=0.0144, n_bins=160)
    return simulate_capture(SCENES["default"](), scan, sensor_of(0.0144, counts), seed)[0]


def test_thinning_keeps_a_share_of_every_photon():
    capture = measured(4000.0)
    thin = thinned(capture, 0.25, seed=1)
    assert (thin.counts <= capture.counts).all()
    assert thin.counts.sum() == pytest.approx(0.25 * capture.counts.sum(), rel=0.01)
    # binomial, not a scaling: the variance around the mean is p (1 - p) n
    rest = thin.counts - 0.25 * capture.counts.astype(float)
    assert (rest**2).sum() == pytest.approx(0.25 * 0.75 * capture.counts.sum(), rel=0.05)
    assert "thinned binomially to 0.25" in thin.provenance["steps"][-1]


@pytest.mark.parametrize("counts", [300.0, 6000.0])
def test_signal_to_noise_against_expected_values(counts):
    noisy, clean = measured(counts), measured(counts, seed=None)
    signal = clean.counts - sensor_of(0.0144, counts).background
    expected = 10 * np.log10((signal**2).sum() / clean.counts.sum())
    grid = VolumeGrid((0, 0, 0.4), (0.1, 0.1, 0.1), (2, 2, 2))
    assert signal_to_noise(Scene(noisy, None, None, grid, 4, 0.2)) == pytest.approx(expected, abs=0.3)


@pytest.mark.parametrize(
    ("values", "iteration"), [([2.0, 1.5, 1.005, 1.0], 3), ([1.0, 1.0], 1), ([1.0, 1.2, 1.0], 3)]
)
def test_settled(values, iteration):
    assert settled_at(values) == iteration


def test_f_score():
    nothing = dict.fromkeys((f.name for f in dataclasses.fields(GeometryErrors)), 0.0)
    assert f_score(
        GeometryErrors(**{**nothing, "points": 10, "coverage": 0.5, "off_truth": 0.25})
    ) == pytest.approx(0.6)
    assert f_score(GeometryErrors(**{**nothing, "points": 0, "off_truth": float("nan")})) == 0


def test_points_on_a_lattice():
    x, y = np.array([0.0, 0.1, 0.2]), np.array([0.5, 0.6])
    cloud = points([(0.04, 0.5, 1), (-0.04, 0.52, 1), (0.21, 0.6, 1), (0.5, 0.5, 1)], [0.25, 0.5, 1.0, 7.0])
    assert front_of_points(cloud, x, y) == pytest.approx(np.array([[0.75, 0], [0, 0], [0, 1.0]]))
    median = cell_median(cloud, cloud.albedo, x, y)
    assert median[0, 0] == pytest.approx(0.375)
    assert np.isnan(median[1, 1])
    assert len(selected(cloud, cloud.albedo > 0.4)) == 3


def test_what_is_kept_is_computed_once(tmp_path):
    work, calls = Workspace(tmp_path, "evidence"), []

    def compute():
        calls.append(1)
        return {"image": np.eye(2), "error": 0.5}

    for _ in range(2):
        kept = work.kept("deep/name", compute)
        assert kept["image"].tolist() == [[1, 0], [0, 1]]
        assert float(kept["error"]) == 0.5
    assert len(calls) == 1


def test_a_finished_training_is_not_repeated(tmp_path):
    folder = tmp_path / "runs" / "one"
    (folder / ".hydra").mkdir(parents=True)
    (folder / "summary.json").write_text("{}")
    (folder / ".hydra" / "overrides.yaml").write_text(
        yaml.safe_dump(["experiment=evidence", "scene=x", "seed=1", "ckpt_path=last"])
    )
    work, subject = Workspace(tmp_path, "evidence"), Subject("x", "x", ("scene=x",))
    assert work.train("one", subject, "seed=1") == folder
    with pytest.raises(UserError, match="was trained with other settings"):
        work.train("one", subject, "seed=2")


def test_a_failed_training_says_where_its_output_is(tmp_path):
    work, subject = (
        Workspace(tmp_path, "evidence"),
        Subject("x", "x", ("scene=capture", "scene.path=nowhere.hdf5")),
    )
    with pytest.raises(UserError, match=r"the training one failed .*found nowhere\.hdf5.*output\.txt"):
        work.train("one", subject)


def test_missing_data_are_named(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "there.mat").touch()
    work = Workspace(tmp_path, "evidence", [tmp_path])
    assert work.needed("there.mat") == tmp_path / "deep" / "there.mat"
    with pytest.raises(UserError, match=r"needs absent\.mat; found none below .*data=DIR"):
        work.needed("absent.mat")


def test_what_is_written_by_hand_stays():
    text = f"# Results\nby hand\n{begin('a')}\nold\n<!-- end -->\n"
    text += f"more by hand\n{begin('b')}\nother\n<!-- end -->\n"
    new = replace_part(text, "a", "fresh \\1")
    assert new == text.replace("old", "fresh \\1")
    with pytest.raises(UserError, match="must hold one part between <!-- generated: c -->"):
        replace_part(text, "c", "")


ALONE = """
import multiprocessing, sys, threading, time
from nlos_lit.paper.workspace import _end_with_parent


def child():
    threading.Thread(target=_end_with_parent, daemon=True).start()
    print("begun", flush=True)
    time.sleep(60)


multiprocessing.get_context("fork").Process(target=child).start()
time.sleep(60)
"""


def test_a_training_ends_with_the_command_that_wanted_it():
    command = subprocess.Popen([sys.executable, "-c", ALONE], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert command.stdout is not None
    assert command.stdout.readline() == "begun\n"
    command.kill()
    assert command.communicate(timeout=20)[0] == ""  # the end of the output: nobody holds it any more
