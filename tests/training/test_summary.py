"""What a run says about itself."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest
import torch
from small_capture import fields

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.io.files import write_json
from nlos_lit.runtime.memory import peak_bytes
from nlos_lit.training.outcome import heldout_scores
from nlos_lit.training.summary import build_summary, git_state, versions


def test_summary_has_the_promised_shape(tmp_path):
    summary = build_summary(
        scene="su",
        seed=7,
        loss=(4.0, 1.5),
        nmse=(0.6, 0.2, 0.04),
        deviance_per_bin=(6.0, 1.25, 0.94),
        parameters={"omega_pf": (176.5, "rad/m"), "eta_s": (0.5, "counts/bin")},
        seconds=(2.0, 0.25, 27.0),
        geometry={"coverage": np.float64("nan")},
        mesh={"vertices": 12},
    )
    write_json(tmp_path / "summary.json", summary)
    read = json.loads((tmp_path / "summary.json").read_text())
    assert read["scene"] == "su"
    assert read["seed"] == 7
    assert read["loss"] == {"initial": 4.0, "final": 1.5}
    assert read["heldout"]["nmse"] == {"initial": 0.6, "final": 0.2, "noise_floor": 0.04}
    assert read["heldout"]["deviance_per_bin"] == {"initial": 6.0, "final": 1.25, "noise": 0.94}
    assert read["parameters"]["omega_pf"] == {"value": 176.5, "unit": "rad/m"}
    assert read["seconds"] == {"setup": 2.0, "per_iteration": 0.25, "total": 27.0}
    assert read["geometry"] == {"coverage": None}
    assert read["mesh"] == {"vertices": 12}
    assert {"peak_memory_bytes", "versions", "git"} <= set(read)


def test_versions_name_what_results_depend_on():
    found = versions()
    assert found["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert {"python", "nlos_lit", "numpy", "open3d", "hydra-core", "lightning"} <= set(found)


def test_git_state_follows_the_checkout(tmp_path):
    assert git_state(tmp_path) is None

    def git(*arguments: str) -> str:
        identity = (
            "-c",
            "user.name=t",
            "-c",
            "user.email=t@t",
            "-c",
            "commit.gpgsign=false",
            "-c",
            f"core.hooksPath={tmp_path / 'none'}",
        )
        return subprocess.run(
            ["git", "-C", tmp_path, *identity, *arguments], check=True, capture_output=True, text=True
        ).stdout.strip()

    git("init", "-q")
    assert git_state(tmp_path) is None  # no commit yet
    (tmp_path / "a").write_text("1")
    git("add", "a")
    git("commit", "-qm", "one")
    assert git_state(tmp_path) == {"commit": git("rev-parse", "HEAD"), "dirty": False}
    (tmp_path / "untracked").write_text("1")
    assert not git_state(tmp_path)["dirty"]
    (tmp_path / "a").write_text("2")
    assert git_state(tmp_path)["dirty"]
    (tmp_path / "sub").mkdir()
    assert git_state(tmp_path / "sub") is None  # the project lies inside somebody else's repository


def test_peak_memory_is_bytes_and_never_falls():
    before = peak_bytes()
    block = np.ones(300_000_000, dtype=np.uint8)
    after = peak_bytes()
    del block
    assert 50e6 < before <= after
    assert peak_bytes() == pytest.approx(after, abs=2e6)  # the kernel counts pages in lots
    assert after >= 300e6


def test_expected_values_have_no_noise_and_nan_is_no_result():
    first = {"nmse": 1.0, "nmse_noise_floor": 6.9e30, "deviance_per_bin": 3.0, "deviance_noise": 1.1}
    counted, expected = (Capture(**fields(is_counts=is_counts)) for is_counts in (True, False))
    last = {**first, "nmse": 0.5}
    assert heldout_scores(first, last, counted)["nmse"] == (1.0, 0.5, 6.9e30)
    told = heldout_scores(first, last, expected)
    assert told["nmse"][:2] == (1.0, 0.5)
    assert np.isnan([told["nmse"][2], told["deviance_per_bin"][2]]).all()
    with pytest.raises(UserError, match=r"the fit has left the numbers \(nmse NaN or infinite\)"):
        heldout_scores(first, {**first, "nmse": float("nan")}, counted)
