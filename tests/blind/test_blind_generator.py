"""Captures of the blind test: the files tell nothing, repeat, and hold what their truth says."""

import ast
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from blind_inject import EFFECTS, UNKNOWN
from blind_scenes import PLANS
from blind_truth import CASES, LEVELS, Spec, Truth, draw_spec, hide, make_capture, true_statistic
from blind_work import BACKGROUND
from conftest import ROOT

from data_modules.readers import read_capture

HERE = Path(__file__).parent


def test_files_tell_nothing_and_repeat(tmp_path):
    specs = {
        "null": Spec("letters", seed=4, order="serpentine"),
        "hidden": Spec("letters", ("pile_up", "vignetting"), (3, 2), seed=4, order="serpentine"),
        "unknown": Spec("letters", ("mains_ripple",), (3,), seed=4, order="serpentine"),
    }
    infos = {}
    for name, spec in specs.items():
        make_capture(spec, tmp_path / f"{name}.hdf5")
        with h5py.File(tmp_path / f"{name}.hdf5") as file:
            infos[name] = {key: (file[key].dtype.str, file[key].shape) for key in file} | {
                "text": file["scene_info"][()]
            }
            assert not file.attrs
        data = (tmp_path / f"{name}.hdf5").read_bytes()
        assert not any(word.encode() in data for word in (*EFFECTS, *UNKNOWN, *PLANS))
    assert infos["null"] == infos["hidden"] == infos["unknown"]
    make_capture(specs["hidden"], tmp_path / "again.hdf5")
    assert (tmp_path / "again.hdf5").read_bytes() == (tmp_path / "hidden.hdf5").read_bytes()
    capture = read_capture(tmp_path / "hidden.hdf5")
    assert capture.is_counts
    assert capture.scan_order[32:35].tolist() == [63, 62, 61]


def test_the_file_holds_photons_of_what_is_expected(tmp_path):
    truth = make_capture(Spec("default", ("wall_reflectance",), (2,), 500, seed=9), tmp_path / "c.hdf5")
    counts = read_capture(tmp_path / "c.hdf5").counts
    chi = (counts - truth.expected) ** 2 / truth.expected
    assert chi.mean() == pytest.approx(1, abs=0.05)
    assert truth.without.sum() / 1024 == pytest.approx(500 * (1 + 224 * BACKGROUND), rel=0.005)
    other = make_capture(Spec("default", ("wall_reflectance",), (2,), 500, seed=10), tmp_path / "d.hdf5")
    assert np.abs(np.log(other.expected / truth.expected)).max() > 0.1


def test_an_effect_is_the_same_alone_and_in_a_pair():
    alone = hide(Spec("default", ("ghost_pulse",), (2,), seed=6))
    pair = hide(Spec("default", ("ghost_pulse", "time_drift"), (2, 1), seed=6))
    assert pair.values["ghost_pulse"] == alone.values["ghost_pulse"]
    assert pair.names == ("time_drift", "ghost_pulse")
    assert pair.labels == {"ghost_pulse": "strong", "time_drift": "weak"}


def test_statistic_by_hand():
    with_, without = np.array([[30.0, 10.0]]), np.array([[10.0, 10.0]])
    truth = Truth(Spec("default"), (), "", "", {}, {}, with_, without, "raster")
    assert true_statistic(truth) == pytest.approx(2 * (30 * np.log(1.5) + 10 * np.log(0.5)))
    assert true_statistic(Truth(Spec("default"), (), "", "", {}, {}, 3 * without, without, "raster")) == 0


@pytest.mark.parametrize("name", CASES)
def test_cases(name):
    spec = CASES[name]
    truth = hide(spec)
    assert truth.expected.shape == truth.without.shape
    assert np.isfinite(truth.expected).all()
    assert truth.expected.min() > 0
    assert (*truth.names, *([truth.unknown] if truth.unknown else [])) == tuple(truth.values)
    assert set(truth.values) == set(spec.effects)
    if spec.effects:
        assert true_statistic(truth) > 1000
    else:
        assert true_statistic(truth) == 0


def test_cases_hold_every_effect_and_what_else_is_asked():
    hidden = [spec.effects for spec in CASES.values()]
    assert {e for (e, *rest) in (h for h in hidden if h) if not rest} >= set(EFFECTS)
    assert hidden.count(()) == 3
    assert sum(len(h) == 2 for h in hidden) == 1


def test_draws():
    own = tuple(name for name, plan in PLANS.items() if plan.mesh)
    specs = [draw_spec(seed, scenes=own) for seed in range(300)]
    assert specs[:5] == [draw_spec(seed, scenes=own) for seed in range(5)]
    assert {s.effects[0] for s in specs} == set(EFFECTS)
    assert {s.level for s in specs} == set(LEVELS)
    assert {s.strengths[0] for s in specs} == {0, 1, 2, 3}
    assert {s.order for s in specs} == {"raster", "serpentine"}
    assert {len(set(draw_spec(seed, "pair", scenes=own).effects)) for seed in range(50)} == {2}
    assert {draw_spec(seed, "unknown", scenes=own).effects[0] for seed in range(60)} == set(UNKNOWN)
    assert draw_spec(1, "null", scenes=("letters",)).effects == ()


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="wall_tilt cannot be hidden in z_confocal"):
        Spec("z_confocal", ("wall_tilt",), (1,))
    with pytest.raises(ValueError, match="both render the scene anew"):
        Spec("default", ("wall_tilt", "occlusion"), (1, 1))


def test_no_code_is_shared_with_what_is_tested():
    # blind_judge.py runs the code under test; nothing that hides effects may import it, which the loaded
    # modules below show.
    for path in set(HERE.glob("blind_*.py")) - {HERE / "blind_judge.py"}:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            assert all(n.split(".")[1:2] == ["capture"] for n in names if n.startswith("nlos_lit")), path
            assert "torch" not in {n.split(".")[0] for n in names}, path
    code = "import blind_truth, sys; print(*(m for m in sys.modules if m.startswith('nlos_lit.')))"
    environment = {"PYTHONPATH": f"{HERE}:{ROOT}", "PATH": ""}
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    loaded = {module.split(".")[1] for module in run.stdout.split()}
    assert loaded == {"capture"}
