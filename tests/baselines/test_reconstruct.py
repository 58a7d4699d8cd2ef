"""The baselines' command, as a user runs it."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest
from forked import command

from nlos_lit.io.volumes import read_volume

SMALL = [f"scene.simulate.scan.{axis}=16" for axis in ("nx", "ny")]
SMALL += ["scene.volume.depth=[0.4,0.9]", "scene.volume.depth_pitch=0.0096"]


def reconstruct(*overrides: str) -> subprocess.CompletedProcess:
    return command("reconstruct.py", *overrides)


def test_every_method_by_one_sweep(tmp_path):
    done = reconstruct("-m", "method=glob(*)", *SMALL, f"hydra.sweep.dir={tmp_path}")
    assert done.returncode == 0, done.stderr[-2000:]
    summaries = {path.parent.name.split("_")[-1]: path for path in tmp_path.glob("*/summary.json")}
    assert set(summaries) == {"rsd", "lct", "dlct", "fk", "bp", "fbp"}
    for method, path in summaries.items():
        summary = json.loads(path.read_text())
        assert summary["method"]["name"] == method
        assert summary["geometry"]["depth_median_abs"] < 0.03
        assert summary["seconds"]["method"] > 0
        values, grid, _ = read_volume(path.parent / "volume.h5")
        assert values.shape == grid.shape == (53, 16, 16)
        assert values.max() == pytest.approx(1)
        assert np.isfinite(values).all()
        assert (path.parent / "figures" / "volume.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (["method=lct", "scene.simulate.scan.kind=single"], "lct needs a confocal scan"),
        (["method=bp", "memory_budget=1KiB"], "above the budget"),
        (["method=fk", "scene.volume.depth=[4,5]"], "spans depths of 4 to 5 m, and light comes back from"),
        (["method=fk", "scene.volume.depth=[4,5]", "force=true"], "outside the capture's time window"),
    ],
)
def test_what_cannot_work_is_one_sentence(overrides, sentence, tmp_path):
    done = reconstruct(*SMALL, *overrides, f"hydra.run.dir={tmp_path}/bad")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert sentence in done.stderr.strip().splitlines()[-1]
    assert not (tmp_path / "bad").exists()
