"""The command: what it writes reads back, and what it cannot do is one sentence."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from data_modules.readers import read_capture
from data_modules.simulate import load_truth
from nlos_lit.errors import UserError

# By its path: this folder has the same name.
_SPEC = importlib.util.spec_from_file_location("simulate_command", Path(__file__).resolve().parents[2] / "simulate.py")
simulate = importlib.util.module_from_spec(_SPEC)
sys.modules["simulate_command"] = simulate
_SPEC.loader.exec_module(simulate)

SMALL = ["nx=3", "ny=4", "bin_length=0.02", "n_bins=100", "width=0.6", "height=0.8"]


def test_writes_a_capture_and_its_truth(tmp_path, capsys):
    out = tmp_path / "made" / "letters.hdf5"
    simulate.main(["scene=letters", f"out={out}", "seed=3", "kind=single", "fixed_point=[0.1,-0.1]", *SMALL])
    assert "single_laser, 12 spots × 100 bins" in capsys.readouterr().out
    capture = read_capture(out)
    assert capture.kind == "single_laser"
    assert capture.scan_shape == (3, 4)
    assert capture.n_bins == 100
    assert capture.laser == pytest.approx(np.tile([0.1, -0.1, 0.0], (12, 1)))
    assert capture.counts.sum() == pytest.approx(12 * 1500, rel=0.05)
    assert np.isfinite(load_truth(out.with_name("letters_truth.h5")).depth).any()


def test_keeps_what_is_already_there(tmp_path, capsys):
    out = tmp_path / "a.hdf5"
    out.write_text("precious")
    with pytest.raises(SystemExit) as end:
        simulate.main([f"out={out}", *SMALL])
    assert end.value.code == 2
    assert "already there" in capsys.readouterr().err
    assert out.read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nx=many"], "nx=many"),
        (["spots=3"], "no option 'spots'"),
        (["--help"], "defaults"),
        (["kind=spiral"], "confocal"),
        (["kappa=-1"], "kappa"),
        (["kappa="], "kappa"),
    ],
)
def test_arguments_that_make_no_sense_are_explained(arguments, words):
    with pytest.raises(UserError, match=words):
        simulate.parse(arguments)


@pytest.mark.parametrize(("scene", "mesh"), [("castle", None), ("mesh", None), ("default", "x.obj")])
def test_scenes_that_do_not_exist_are_explained(scene, mesh):
    with pytest.raises(UserError, match="scene is one of default, letters"):
        simulate.build(scene, mesh)
