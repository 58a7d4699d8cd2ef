"""Runs that are killed again and again end with the numbers of one that was left alone."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT

SMALL = [
    "scene.simulate.scan.nx=12", "scene.simulate.scan.ny=12", "scene.volume.depth=[0.4,0.95]",
    "scene.volume.depth_pitch=0.0192", "scene.iterations=30", "model.rays=40", "batch_spots=8",
    "heldout.block=3", "heldout.monitor_spots=16", "export.spots=16", "threads=1", "logger=none",
    "callbacks.checkpoint.every=2", "refine=true", "surfels.contest=20", "surfels.rounds=2",
    "surfels.steps=60", "surfels.more=0",
]  # fmt: skip
KILLS = 12
BEGUN = "overrides.json"


def left(folder: Path) -> tuple[dict, dict]:
    """What two runs that are the same have in common."""
    summary = json.loads((folder / "summary.json").read_text())
    kept = {key: summary[key] for key in ("loss", "heldout", "parameters", "iterations", "transient_mse")}
    return kept | {"refined": summary["refined"]["heldout"]}, torch.load(
        folder / "refined" / "surfels.pt", weights_only=True
    )


def start(folder: Path) -> subprocess.Popen:
    what = [f"resume={folder}"] if (folder / BEGUN).exists() else [*SMALL, f"hydra.run.dir={folder}"]
    return subprocess.Popen(
        [sys.executable, "train.py", *what],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


@pytest.mark.slow
def test_a_run_that_is_killed_again_and_again_ends_as_one_that_is_not(tmp_path):
    alone, killed = tmp_path / "alone", tmp_path / "killed"
    began = time.monotonic()
    whole = start(alone)
    told = whole.communicate(timeout=300)[0]
    assert whole.returncode == 0, told
    took = time.monotonic() - began
    rng = np.random.default_rng(0)
    ends = []
    for wait in rng.uniform(0.2 * took, took, KILLS):
        process = start(killed)
        try:
            process.wait(wait)
        except subprocess.TimeoutExpired:
            process.send_signal(rng.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT]))
        told = process.communicate(timeout=300)[0]
        ends.append(process.returncode)
        assert process.returncode != 2, told
        assert not (killed / "checkpoints" / "last-v1.ckpt").exists()
        if (killed / "summary.json").exists():
            break
    process = start(killed)
    told = process.communicate(timeout=300)[0]
    assert process.returncode == 0, told
    print(f"{took:.0f} s; ended by", ends)
    (one, surfels), (other, again) = left(alone), left(killed)
    assert one == other
    assert surfels.keys() == again.keys()
    for name, value in surfels.items():
        assert torch.equal(value, again[name]) if torch.is_tensor(value) else value == again[name], name
