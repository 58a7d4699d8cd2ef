"""The main command, as a user runs it: a process, real files, real TensorBoard events, real DDP."""

from __future__ import annotations

import csv
import dataclasses
import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT
from forked import command
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nlos_lit.capture.errors import UserError
from nlos_lit.effects.strengths import report
from nlos_lit.io.points import read_points
from nlos_lit.io.views import read_view
from nlos_lit.io.volumes import read_volume
from nlos_lit.surfels.fit import score_spots
from nlos_lit.training.configs import compose
from nlos_lit.training.run_folder import open_run, prepare_run
from nlos_lit.training.surface_run import load_refined

SMALL = [
    "scene.simulate.scan.nx=12", "scene.simulate.scan.ny=12",
    "scene.volume.depth=[0.4,0.95]", "scene.volume.depth_pitch=0.0192",
    "model.rays=40", "batch_spots=8", "heldout.block=3", "heldout.monitor_spots=16", "export.spots=16",
    "trainer.check_val_every_n_epoch=2", "callbacks.checkpoint.every=1", "callbacks.figures.every=5",
    "export.transients=2", "threads=1",
]  # fmt: skip


def train(*overrides: str, folder: Path | None = None, check: bool = True) -> subprocess.CompletedProcess:
    place = [f"hydra.run.dir={folder}"] if folder is not None else []
    small = [
        o
        for o in SMALL
        if not (o.startswith("scene.simulate") and any(v.startswith("scene=") for v in overrides))
    ]
    flags = [o for o in overrides if o.startswith("-")]
    values = [o for o in overrides if not o.startswith("-")]
    done = command("train.py", *flags, *small, *place, *values)
    if check:
        assert done.returncode == 0, done.stderr[-3000:] + done.stdout[-2000:]
    return done


def state(folder: Path, name: str = "last") -> dict:
    return torch.load(folder / "checkpoints" / f"{name}.ckpt", weights_only=True)


EACH = "callbacks.checkpoint.each=true"


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "one"
    train(
        "scene.iterations=6",
        "effects=[wall_reflectance,irf_tail]",
        "surfels.rounds=2",
        "surfels.steps=5",
        "surfels.contest=8",
        "surfels.more=0",
        EACH,
        folder=folder,
    )
    return folder


def test_a_run_leaves_a_page_to_explore(finished):
    view, capture = read_view(finished), open_run(finished).capture
    assert view.facts["status"] == "finished"
    assert "train.py" in view.facts["origin"]["command"]
    np.testing.assert_array_equal(view.counts, capture.gated_counts()[view.spots])
    assert list(view.models) == ["rendered", "extended by irf_tail, wall_reflectance"]
    model, extension = load_refined(finished, capture)
    with torch.no_grad():
        expected = model.expected(torch.from_numpy(view.spots[:5]), extension).numpy()
    np.testing.assert_allclose(view.models["extended by irf_tail, wall_reflectance"][:5], expected, atol=0.05)
    assert len(view.clouds["surfels"]) == len(read_points(finished / "refined" / "points.ply"))
    page = (finished / "explore.html").read_text(encoding="utf-8")
    assert "finished at" in page
    depth = np.load(finished / "depth.npy")
    assert depth.shape == read_volume(finished / "volume.h5")[0].shape[1:]
    near = np.nanmedian(depth)
    assert 0.4 < near < 0.95
    assert (finished / "mesh.glb").exists() == (finished / "mesh.ply").exists()
    refined = json.loads((finished / "summary.json").read_text())["refined"]
    axes = refined["depth_axes"]
    assert np.load(finished / "refined" / "depth.npy").shape == (axes["x"]["cells"], axes["y"]["cells"])


def test_run_leaves_everything_a_later_command_needs(finished):
    summary = json.loads((finished / "summary.json").read_text())
    assert summary["scene"] == "default"
    assert summary["loss"]["final"] < summary["loss"]["initial"]
    nmse = summary["heldout"]["nmse"]
    assert nmse["noise_floor"] < nmse["final"] < nmse["initial"]
    assert set(summary["heldout"]["deviance_per_bin"]) == {"initial", "final", "noise"}
    assert set(summary["parameters"]) == {"omega_pf", "sigma_pf", "sigma_ls", "I_l", "kappa_s", "eta_s"}
    assert all(np.isfinite(entry["value"]) and entry["unit"] for entry in summary["parameters"].values())
    assert set(summary["seconds"]) == {"setup", "per_iteration", "total"}
    assert summary["geometry"]["depth_median_abs"] < 0.05
    assert summary["iterations"] == 6
    assert summary["versions"]["torch"] == torch.__version__
    values, grid, extra = read_volume(finished / "volume.h5")
    assert values.shape == grid.shape == extra["albedo"].shape
    assert values.max() == pytest.approx(1)
    points = read_points(finished / "points.ply")
    assert len(points) > 100
    import open3d as o3d

    cloud = o3d.t.io.read_point_cloud(str(finished / "points.ply"))
    assert cloud.point.positions.shape[0] == len(points)
    for name in (
        "volume",
        "albedo",
        "transients",
        "kernel",
        "laser_sensor",
        "surface",
        "loss",
        "parameters",
        "depth_error",
    ):
        assert (finished / "figures" / f"{name}.png").stat().st_size > 5000


def test_refinement_is_exported_like_any_other_result(finished):
    refined = json.loads((finished / "summary.json").read_text())["refined"]
    phasor = json.loads((finished / "summary.json").read_text())["heldout"]
    assert refined["heldout"]["nmse"] < phasor["nmse"]["final"]
    assert refined["geometry"]["depth_median_abs"] < 0.05
    assert len(read_points(finished / "refined" / "points.ply")) == refined["surfels"]
    left = {path.name for path in (finished / "refined").iterdir()}
    assert left >= {"points.ply", "surfels.pt", "effects.pt", "transients.png", "surface.png"}


def test_effects_are_refined_along_and_open_again(finished):
    refined = json.loads((finished / "summary.json").read_text())["refined"]
    effects = refined["effects"]
    assert list(effects) == ["irf_tail", "wall_reflectance"]
    assert set(effects["irf_tail"]) == {"fraction", "decay", "quick", "quick_decay", "slow"}
    assert effects["irf_tail"]["decay"]["unit"] == "m"
    assert effects["wall_reflectance"]["rms"]["value"] > 0
    text = (finished / "train.log").read_text()
    assert f"wall_reflectance: rms {effects['wall_reflectance']['rms']['value']:.4g}\n" in text
    run = open_run(finished)
    model, extension = load_refined(finished, run.capture)
    assert report(extension.effects) == effects
    assert len(model) == refined["surfels"]
    scores = score_spots(model, run.capture, torch.from_numpy(run.data.heldout_spots), extension)
    assert dataclasses.asdict(scores) == pytest.approx(refined["heldout"], rel=1e-6)
    without = score_spots(model, run.capture, torch.from_numpy(run.data.heldout_spots))
    assert without.deviance_per_bin != pytest.approx(scores.deviance_per_bin, rel=1e-4)


def test_a_run_without_refinement_has_no_surfels_to_load(tmp_path):
    with pytest.raises(UserError, match=r"surfels\.pt is missing; run python train\.py with refine=true"):
        load_refined(tmp_path, None)


def test_tensorboard_events_hold_losses_parameters_and_figures(finished):
    events = EventAccumulator(str(finished / "tensorboard"))
    events.Reload()
    tags = events.Tags()
    wanted = {"loss/total", "loss/transient", "heldout/nmse", "parameters/omega_pf", "parameters/eta_s"}
    assert wanted <= set(tags["scalars"])
    assert len(events.Scalars("loss/total")) == 6
    assert {"volume", "albedo", "transients", "kernel", "surface"} <= set(tags["images"])
    assert len(events.Images("volume")) == 3  # before, after five iterations, at the end


def test_a_run_folder_opens_again(finished):
    run = open_run(finished)
    saved = json.loads((finished / "summary.json").read_text())
    assert run.module.imaging_parameters()["omega_pf"]["value"] == pytest.approx(
        saved["parameters"]["omega_pf"]["value"]
    )
    values, _, _ = read_volume(finished / "volume.h5")
    with torch.no_grad():
        assert np.abs(run.module.pipeline.phasor().numpy() - values).max() < 1e-5


def test_a_finished_folder_is_not_overwritten(finished):
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.is_file()}
    done = train("scene.iterations=1", folder=finished, check=False)
    assert done.returncode == 2
    assert (
        "already holds a finished run; choose another hydra.run.dir, or go on with it: "
        f"python train.py resume={finished}"
    ) in done.stderr
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.is_file()} == before


CTRL_C = """
import os, runpy, signal
from nlos_lit.training.callbacks import Checkpoint

def press(self, trainer, module):
    if trainer.current_epoch == 3:
        os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background inherit that it is ignored
Checkpoint.on_train_epoch_start = press
runpy.run_path("train.py", run_name="__main__")
"""


def test_resuming_gives_the_uninterrupted_result(finished, tmp_path):
    folder = tmp_path / "resumed"
    done = subprocess.run(
        [sys.executable, "-c", CTRL_C, *SMALL, "scene.iterations=6", "logger=none",
         f"hydra.run.dir={folder}"],
        cwd=ROOT, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    output = done.stdout + done.stderr
    assert done.returncode == 130, output
    line = shlex.split(output.split("interrupted; go on with: ")[1].splitlines()[0])
    assert line == ["python", "train.py", f"resume={folder}"]
    assert not (folder / "summary.json").exists()
    assert state(folder)["epoch"] == 2  # though spots were scored after 1 and 3
    kept = {name: (folder / name).read_bytes() for name in ("config.yaml", "overrides.json")}
    done = command(*line[1:], "seed=3")
    assert done.returncode == 2
    assert "was made with seed=0, this command has 3" in done.stderr.strip().splitlines()[-1]
    assert all((folder / name).read_bytes() == content for name, content in kept.items())
    done = command(*line[1:])
    assert done.returncode == 0, done.stderr
    resumed, straight = state(folder)["state_dict"], state(finished)["state_dict"]
    assert resumed.keys() == straight.keys()
    for name in straight:
        assert torch.equal(resumed[name], straight[name]), name
    one, two = (json.loads((f / "summary.json").read_text()) for f in (finished, folder))
    assert one["heldout"] == two["heldout"]
    assert two["iterations"] == 6


def test_two_processes_give_the_single_process_result(finished, tmp_path):
    """One iteration agrees to rounding. Later a ray's largest sample may flip between two near ties, so six
    agree to 1 %.
    """
    done = train("scene.iterations=6", "logger=none", "trainer=ddp", EACH, folder=tmp_path)
    assert "in each of 2 processes" not in done.stdout + done.stderr  # the field is whole
    for iterations, tolerance in ((1, 1e-6), (6, 1e-2)):
        alone, together = (state(folder, f"epoch={iterations - 1}") for folder in (finished, tmp_path))
        assert alone["global_step"] == together["global_step"] == iterations
        one, two = alone["state_dict"], together["state_dict"]
        for name in one:
            assert (two[name] - one[name]).norm() <= tolerance * one[name].norm(), name
    one, two = (json.loads((f / "summary.json").read_text())["heldout"] for f in (finished, tmp_path))
    assert two["nmse"]["final"] == pytest.approx(one["nmse"]["final"], rel=1e-3)
    assert two["deviance_per_bin"]["initial"] == pytest.approx(one["deviance_per_bin"]["initial"], rel=1e-5)


def test_the_ablation_grid_leaves_one_table(tmp_path):
    small = ("scene.iterations=1", "export.transients=1", "export.mesh_depth=5", "logger=none")
    train("-m", "ablation=glob(*)", *small, f"hydra.sweep.dir={tmp_path}")
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["ablation"] for row in rows} == {
        "phasor",
        "phasor_sensor",
        "albedo",
        "albedo_sensor",
        "phasor_albedo",
        "all",
    }
    assert all(float(row["MSE transient (held out)"]) > 0 for row in rows)
    assert (tmp_path / "table.md").read_text().count("\n") == 8


@pytest.mark.parametrize(
    ("ablation", "groups"),
    [
        ("phasor_sensor", {"phasor", "sensor"}),
        ("albedo", {"albedo"}),
        ("all", {"phasor", "sensor", "albedo"}),
    ],
)
def test_an_ablation_changes_its_parameters_alone(ablation, groups):
    run = prepare_run(compose("train", [*SMALL, f"ablation={ablation}"]))
    before = {name: value.clone() for name, value in run.module.state_dict().items()}
    optimizer = run.module.configure_optimizers()
    batch = next(iter(run.data.train_dataloader()))
    run.module.objective(batch)["loss"].backward()
    optimizer.step()
    changed = {
        name for name, value in run.module.state_dict().items() if not torch.equal(value, before[name])
    }
    prefixes = {"pipeline.phasor": "phasor", "pipeline.laser_sensor": "sensor", "pipeline.albedo": "albedo"}
    assert {
        group for prefix, group in prefixes.items() if any(name.startswith(prefix) for name in changed)
    } == groups


@pytest.mark.parametrize("profile", ["default", "paper", "reference_code"])
def test_every_profile_has_finite_losses_and_gradients(profile):
    run = prepare_run(compose("train", [*SMALL, f"model={profile}"]))
    terms = run.module.objective(next(iter(run.data.train_dataloader())))
    terms["loss"].backward()
    assert all(torch.isfinite(value) for value in terms.values())
    for group in run.module.groups.values():
        for parameter in group:
            assert torch.isfinite(parameter.grad).all()
            assert parameter.grad.abs().max() > 0


BAD = {
    "scene=bike": "needs bike/meas_10min.mat",
    "scene=su +scene.simulate.scan.nx=8": "scene.simulate lacks mesh and sensor: leave it out",
    "scene=su scene.simulate.scan.nx=8": "the config cannot be put together: Could not override",
    "scene=capture": "scene.path=FILE",
    "scene=capture scene.path=/nowhere/x.mat": "must be a file or folder that is there",
    "scene.gate=[200,200]": "scene.gate must be",
    "scene.volume.depth=[5,6]": "spans depths of 5 to 6 m, and light comes back from",
    "scene.volume.depth=[0.9,0.4]": "a < b, or null; found",
    "effects=[irf_tail,pileup]": "no effect 'pileup'; did you mean pile_up",
    "memory_budget=1MiB": "the budget is",
    "memory_budget=lots": "must be a size",
    "shard_field=true": "needs trainer=ddp and trainer.devices=2 or more; found trainer.devices=1",
    "callbacks.figures._target_=os.system": "callbacks.figures._target_=os.system is not built",
    "+model.nothing=1": "there is no key model.nothing; there are threshold",
    "~callbacks.history": "callbacks must hold History",
    "model.threshold=1.5": "model.threshold must be",
    "heldout.block=50": "hold out",
    "ckpt_path=nothing.ckpt": "ckpt_path must be",
    "scene.reader.bin_width_ps=4 scene.path=README.md": "README.md",
}


@pytest.mark.parametrize("overrides", BAD)
def test_what_cannot_work_is_one_sentence(overrides, tmp_path):
    done = train(*overrides.split(), folder=tmp_path / "bad", check=False)
    assert done.returncode == 2, done.stderr[-2000:]
    assert "Traceback" not in done.stderr
    sentence = done.stderr.strip().splitlines()[-1]
    assert sentence.startswith("error: ")
    assert BAD[overrides] in sentence
    assert not (tmp_path / "bad").exists()


def test_the_log_says_what_was_read_and_what_it_will_take(finished):
    text = (finished / "train.log").read_text()
    assert "144 spots x 256 bins of 32 ps, confocal" in text
    assert "GiB in all" in text
