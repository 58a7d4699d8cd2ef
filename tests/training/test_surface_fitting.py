"""The surface under a Trainer: the same digits as without, stopped or not; its folder and its events."""

from __future__ import annotations

import copy
import json
import shlex
import subprocess
from pathlib import Path

import lightning as L
import numpy as np
import pytest
import torch
from forked import command
from pretended_device import DEVICE, pretended
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.commands.train import surface_settings
from nlos_lit.effects.strengths import bound_notes
from nlos_lit.functional.compiled import tensor_by_tensor
from nlos_lit.io.points import read_points
from nlos_lit.metrics.excess import Excess
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.runtime.command_line import quiet_libraries
from nlos_lit.surfels.fit import score_spots
from nlos_lit.surfels.fitted import fitted_surfels
from nlos_lit.training.callbacks import Checkpoint, History, ScoreHeldout
from nlos_lit.training.configs import compose
from nlos_lit.training.origin import START, finished_checkpoint
from nlos_lit.training.run_folder import Run, open_run, prepare_run
from nlos_lit.training.surface_fitting import SurfaceFitting, front
from nlos_lit.training.surface_run import excess_note, heldout_excess, load_refined, prepare_surface

SMALL = [
    "scene.simulate.scan.nx=12", "scene.simulate.scan.ny=12",
    "scene.volume.depth=[0.4,0.95]", "scene.volume.depth_pitch=0.0192",
    "model.rays=40", "batch_spots=8", "heldout.block=3", "heldout.monitor_spots=16", "export.spots=16",
    "trainer.check_val_every_n_epoch=5", "callbacks.checkpoint.every=1",
    "callbacks.figures.every=20", "surfels.contest=4", "surfels.rounds=2", "surfels.steps=8",
    "surfels.outlines=1", "surfels.more=1", "export.transients=2", "threads=1",
]  # fmt: skip
EFFECTS = "effects=[irf_tail,power_drift]"


def door(
    *overrides: str, folder: Path, script: str | Path = "train.py", check: bool = True
) -> subprocess.CompletedProcess:
    done = command(str(script), *SMALL, f"hydra.run.dir={folder}", *overrides)
    if check:
        assert done.returncode == 0, done.stderr[-3000:] + done.stdout[-2000:]
    return done


@pytest.fixture(scope="module")
def run() -> Run:
    return prepare_run(compose("train", [*SMALL, EFFECTS, "model=surface"]))


def seeded(run: Run) -> SurfaceFitting:
    torch.manual_seed(0)
    again = copy.copy(run)
    again.extension = copy.deepcopy(run.extension)
    return prepare_surface(again)


def trainer_of(folder: Path, epochs: int = -1) -> L.Trainer:
    quiet_libraries()
    return L.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        logger=False,
        callbacks=[
            ScoreHeldout(),
            History(),
            Checkpoint(folder, each=False, every=1),
        ],
        enable_progress_bar=False,
        enable_model_summary=False,
        check_val_every_n_epoch=5,
        num_sanity_val_steps=0,
        default_root_dir=folder,
    )


def same(first: object, second: object) -> bool:
    if torch.is_tensor(first):
        return torch.equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(v, second[k]) for k, v in first.items())
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(same, first, second))
    return first == second


def test_a_trainer_takes_the_same_steps_stopped_or_not(run, tmp_path):
    by_hand, whole, part = seeded(run), seeded(run), seeded(run)
    start = by_hand.fit.state()
    by_hand.fit.finish()
    assert len(by_hand.fit.history) == 4 + 1 + 1  # bodies were looked for, and a round was added
    trainer_of(tmp_path / "whole").fit(whole, datamodule=run.data)
    assert same(whole.fit.state(), by_hand.fit.state())
    assert not same(start["model"], by_hand.fit.state()["model"])
    stopped = (2, 9, 12, 40)  # in the contest, in a round, between two, in the added one
    for epochs in stopped:
        place, go_on = tmp_path / "part", tmp_path / "part" / "last.ckpt"
        trainer = trainer_of(place, epochs)
        before = go_on if go_on.exists() else None
        trainer.fit(part, datamodule=run.data, ckpt_path=before, weights_only=True if before else None)
        assert (part.fit.done, trainer.global_step) == (epochs, epochs)
        assert part.fit.in_round == (epochs != 12)
        part = seeded(run)
    trainer = trainer_of(place)
    trainer.fit(part, datamodule=run.data, ckpt_path=go_on, weights_only=True)
    assert same(part.fit.state(), by_hand.fit.state())
    assert part.scores == whole.scores
    assert part.scores["final"]["deviance_per_bin"] < part.scores["initial"]["deviance_per_bin"]
    assert trainer.callbacks[1].ran == part.fit.done - stopped[-1]
    again = seeded(run)
    trainer = trainer_of(place)
    trainer.fit(again, datamodule=run.data, ckpt_path=go_on, weights_only=True)
    assert trainer.callbacks[1].ran == 0
    assert same(again.fit.state(), by_hand.fit.state())
    assert again.scores == whole.scores


def test_a_fit_on_a_device_is_that_of_the_cpu(run):
    """From the contest to the end of the first round; later rounds turn on last digits."""
    here, there = seeded(run).fit, seeded(run).fit
    with pretended(), tensor_by_tensor():
        there.to(DEVICE)
        for fit in (here, there):
            while len(fit.history) < 2:
                if not fit.in_round:
                    fit.begin_round()
                fit.step()
                if fit.round_done:
                    fit.end_round()
    assert len(here.model) == len(there.model) > 50
    for mine, other in zip(here.history, there.history, strict=True):
        assert mine == pytest.approx(other, rel=1e-3)


def test_a_checkpoint_of_other_effects_or_of_no_surface_is_refused(run, tmp_path):
    module = seeded(run)
    trainer_of(tmp_path, 1).fit(module, datamodule=run.data)
    kept = torch.load(tmp_path / "last.ckpt", weights_only=True)
    other = copy.copy(run)
    other.extension = type(run.extension)([])
    with pytest.raises(UserError, match=r"effects with .*irf_tail|effects with .*raw.*this one with nothing"):
        prepare_surface(other).on_load_checkpoint(kept)
    with pytest.raises(UserError, match="not the checkpoint of a surface"):
        module.on_load_checkpoint({"state_dict": {}})


def test_scores_are_those_of_the_surfels(run):
    module = seeded(run)
    found = module.all_scores(run.data)
    model, extension = module.fit.model, module.fit.extension
    held = score_spots(model, run.capture, torch.from_numpy(run.data.heldout_spots), extension)
    assert found["nmse"] == pytest.approx(held.nmse, rel=1e-6)
    assert found["deviance_per_bin"] == pytest.approx(held.deviance_per_bin, rel=1e-6)
    reference = score_spots(model, run.capture, torch.from_numpy(run.data.reference), extension)
    assert found["loss"] == pytest.approx(reference.deviance_per_bin, rel=1e-6)


def test_the_front_is_the_nearest_surfel_of_each_cell_that_is_not_faint(run):
    model = seeded(run).fit.model
    origin, pitch = (np.array(v) for v in (model.lateral.origin, model.lateral.pitch))
    cells = np.array([[2, 3], [2, 3], [2, 3], [4, 1]])
    places = np.column_stack([origin + cells * pitch, [0.8, 0.6, 0.5, 0.7]])
    up = torch.tensor([0.0, 0.0, -1.0]).expand(4, 3)
    model.place(torch.from_numpy(places), up, torch.tensor([1.0, 0.5, 0.01, 0.9]))
    seen = front(model)
    assert seen.depth[2, 3] == pytest.approx(0.6)
    assert seen.albedo[2, 3] == pytest.approx(0.5)
    assert seen.depth[4, 1] == pytest.approx(0.7)
    assert seen.normals[2, 3] == pytest.approx([0, 0, -1])
    assert [np.isfinite(v).sum() for v in (seen.depth, seen.albedo, seen.normals)] == [2, 2, 6]
    assert (seen.x[2], seen.y[3]) == pytest.approx(tuple(places[0, :2]))


@pytest.mark.parametrize(
    ("ratio", "error", "along", "sentence"),
    [
        (1.03, 0.02, {"time": 0.9}, None),  # by chance, perhaps
        (1.019, 0.001, {"time": 0.9}, None),
        (
            1.3,
            0.001,
            {"level": 0.2, "time": 0.04},
            "30 % more than counting noise (of it 20 % in the overall level);",
        ),
        (
            1.1,
            0.03,
            {"time": 0.04, "scan": 0.0},
            "10 % more than counting noise (hardly any along time, wall,",
        ),
        (
            1.1,
            0.03,
            {"rate": 0.1, "wall": 0.2, "scan": 0.3},
            "(of it 30 % over the course of the scan, 20 % across the",
        ),
    ],
)
def test_a_surface_that_misses_the_noise_says_so(ratio, error, along, sentence):
    note = excess_note(Excess(0.1, ratio, error, along), Path("outputs/my run"))
    if sentence is None:
        assert note is None
    else:
        assert sentence in note
        assert note.endswith("; python diagnose.py 'run=outputs/my run' asks what is missing")


def test_a_gain_over_the_wall_that_no_surface_makes_is_told(run):
    """Counts drawn from the surfels are noise alone; a gain that grows to the right is the wall's."""
    module = seeded(run)
    capture = run.capture
    first, last = capture.gate
    found = fitted_surfels(module.fit, run.data.heldout_spots, 0.0)
    sensor = found.model.laser_sensor
    for name in ("intensity", "background"):  # many counts, so that little is left to chance
        value = 20 * getattr(sensor, name)().item()
        setattr(sensor, name, BoundedParameter(value, value / 10, value * 10, ""))
    mu = found.expected(torch.arange(capture.n_spots)).double()
    gain = 1 + 0.5 * Scan.of(capture).places[0][:, :1]
    along = []
    for true in (mu, gain * mu):
        counts = np.zeros(capture.counts.shape, dtype=np.float32)
        counts[:, first:last] = torch.poisson(true, generator=torch.Generator().manual_seed(0)).numpy()
        again = copy.copy(run)
        again.capture = capture.with_counts(counts)
        along.append(heldout_excess(again, found).along)
    assert max(along[0].values()) == 0
    assert max(along[1], key=along[1].get) == "wall"
    assert along[1]["wall"] > 0.7


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("surface") / "one"
    door("model=surface", EFFECTS, folder=folder)
    return folder


def test_the_door_leaves_a_surface(finished):
    summary = json.loads((finished / "summary.json").read_text())
    refined, heldout = summary["refined"], summary["heldout"]
    assert heldout["nmse"]["final"] < heldout["nmse"]["initial"]
    assert refined["heldout"]["nmse"] == pytest.approx(heldout["nmse"]["final"], rel=1e-3)
    assert summary["iterations"] == 4 + 8 + 32 + 8 + 32 + 32  # the last is an added one
    assert {"sigma_ls", "irf_tail.fraction", "power_drift.rms"} <= set(summary["parameters"])
    place = finished / "refined"
    assert {path.name for path in place.iterdir()} >= {
        "points.ply", "surfels.pt", "effects.pt", "transients.png", "surface.png", "overview.png",
    }  # fmt: skip
    excess, scored = refined["excess"], refined["heldout"]
    assert excess["ratio"] == pytest.approx(scored["deviance_per_bin"] / scored["deviance_noise"], rel=1e-5)
    assert set(excess["along"]) == {"level", "time", "wall", "scan", "rate"}
    assert (refined["note"] is None) == (excess["ratio"] <= 1 + max(0.02, 3 * excess["error"]))
    assert len(read_points(place / "points.ply")) == refined["surfels"]
    model, extension = load_refined(finished, prepare_run(compose("train", SMALL)).capture)
    assert (len(model), len(extension.effects)) == (refined["surfels"], 2)
    assert refined["at_bounds"] == bound_notes(extension.effects)


def test_events_hold_the_way_of_the_surface(finished):
    events = EventAccumulator(str(finished / "refined" / "tensorboard"), {"images": 0})  # all of them
    events.Reload()
    tags = events.Tags()
    assert {
        "loss/total", "loss/counts", "loss/bending", "deviance", "surfels", "heldout/deviance_per_bin",
        "parameters/sigma_ls", "parameters/irf_tail.fraction",
    } <= set(tags["scalars"])  # fmt: skip
    assert len(events.Scalars("deviance")) == 84 + 32
    assert events.Scalars("deviance")[-1].value < events.Scalars("deviance")[0].value
    assert {"overview", "surface", "transients", "laser_sensor"} <= set(tags["images"])
    assert len(events.Images("overview")) == 7  # at the start, after 20, 40, 60, 80 and 100, at the end


CTRL_C = """
import os, runpy, signal
from nlos_lit.training.surface_fitting import SurfaceFitting

whole = SurfaceFitting.training_step
def press(self, batch, batch_idx):
    if self.fit.done == 13:
        os.kill(os.getpid(), signal.SIGINT)
    return whole(self, batch, batch_idx)

SurfaceFitting.training_step = press
runpy.run_path("train.py", run_name="__main__")
"""


def test_an_interrupted_sequence_goes_on_in_its_second_half(tmp_path):
    sequence = ("refine=true", "scene.iterations=3", "logger=none")
    door(*sequence, folder=tmp_path / "straight")
    script = tmp_path / "stopped.py"
    script.write_text(CTRL_C)
    done = door(*sequence, folder=tmp_path / "stopped", script=script, check=False)
    output = done.stdout + done.stderr
    assert done.returncode == 130, output
    line = shlex.split(output.split("go on with: ")[1].splitlines()[0])
    assert line == ["python", "train.py", f"resume={tmp_path / 'stopped'}"]
    assert not (tmp_path / "stopped" / "summary.json").exists()
    again = command(*line[1:])
    assert again.returncode == 0, again.stderr
    folders = [tmp_path / name for name in ("straight", "stopped")]
    first, second = (torch.load(f / "refined" / "surfels.pt", weights_only=True) for f in folders)
    assert same(first, second)
    one, two = (json.loads((f / "summary.json").read_text()) for f in folders)
    for key in ("loss", "heldout", "parameters", "iterations"):
        assert one[key] == two[key]
    assert one["refined"]["heldout"] == two["refined"]["heldout"]


def test_the_surface_of_a_finished_run_starts_from_its_image_and_response(tmp_path):
    short = ("logger=none", "surfels.rounds=1", "surfels.steps=2", "surfels.more=0")
    first = tmp_path / "first"
    door("scene.iterations=2", *short, folder=first)
    door("model=surface", f"run={first}", *short, folder=tmp_path / "second")
    run = open_run(first)
    sensor = run.module.pipeline.laser_sensor
    module, untold = prepare_surface(run, sensor), prepare_surface(run)
    found = module.fit.model.laser_sensor
    assert found.kappa_s().item() == pytest.approx(sensor.kappa_s().item(), rel=1e-4)
    assert untold.fit.model.laser_sensor.kappa_s().item() != pytest.approx(found.kappa_s().item(), rel=1e-2)
    module.fit.begin_round()
    summary = json.loads((tmp_path / "second" / "summary.json").read_text())
    assert module.all_scores(run.data)["nmse"] == pytest.approx(
        summary["heldout"]["nmse"]["initial"], rel=1e-4
    )
    for changed, sentence in (
        ("heldout.block=4", "was made with heldout.block=3, this command has 4"),
        ("scene.sum_bins=2", "was made with scene.sum_bins=1, this command has 2"),
    ):
        with pytest.raises(UserError, match=sentence):
            prepare_run(compose("train", [*SMALL, changed]), opens={finished_checkpoint(first): START})
    with pytest.raises(UserError, match=r"of a finished self-calibration: checkpoints/last.ckpt is missing"):
        finished_checkpoint(tmp_path / "second")


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (["run=tests"], "to fit the surface of a finished run give model=surface run=FOLDER"),
        (["model=surface", "run=tests"], "tests is not the folder of a finished run"),
        (["model=surface", "trainer=ddp"], "is fitted in one process; found trainer.devices=2"),
    ],
)
def test_what_cannot_work_is_one_sentence(overrides, sentence, tmp_path):
    done = door(*overrides, folder=tmp_path, check=False)
    assert done.returncode == 2
    assert sentence in done.stderr.strip().splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_the_surfaces_trainer_is_the_runs_in_one_process():
    both = compose("train", ["trainer=ddp", "optimizer.clip=3", "+trainer.max_time=00:01:00:00"])
    found = surface_settings(both, alone=False)["trainer"]
    assert (found["devices"], found["strategy"], found["max_epochs"]) == (1, "auto", -1)
    assert (found["gradient_clip_val"], found["max_time"]) == (None, "00:01:00:00")
