"""A checkpoint is opened by what it was made of, and only when it is complete."""

import copy
import json
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from data_modules.load import load_scene
from data_modules.readers import write_capture
from nlos_lit.capture.errors import UserError
from nlos_lit.commands.train import fit_or_leave, make_trainer
from nlos_lit.runtime.command_line import quiet_libraries
from nlos_lit.training.configs import compose
from nlos_lit.training.origin import (
    CHANGE,
    IMAGE,
    START,
    SURFACE,
    changed_since,
    check_origin,
    finished_checkpoint,
    origin_of,
    read_checkpoint,
)
from nlos_lit.training.run_folder import find_checkpoint, open_run, prepare_run

SMALL = [
    "scene.volume.depth=[0.4,0.95]", "scene.volume.depth_pitch=0.03", "model.rays=20", "batch_spots=8",
    "heldout.block=3", "heldout.monitor_spots=8", "logger=none", "~callbacks.figures", "scene=capture",
    "scene.sum_bins=1",    "callbacks.checkpoint.every=1", "scene.iterations=2",
]  # fmt: skip


class Case:
    """A run in a folder: its settings, and the checkpoint that Lightning wrote after the last iteration."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / "mine.hdf5"
        scan = ["scene.simulate.scan.nx=8", "scene.simulate.scan.ny=8"]
        simulated = compose("train", scan)
        self.capture = load_scene(simulated["scene"], ".", 0)[0]
        write_capture(self.path, self.capture)
        self.config = self.changed()
        OmegaConf.save(OmegaConf.create(self.config), folder / "config.yaml")
        self.run = prepare_run(self.config)
        quiet_libraries()
        self.trainer = make_trainer(self.config)
        fit_or_leave(self.trainer, self.run.module, self.run, None)
        self.last = folder / "checkpoints" / "last.ckpt"

    def changed(self, *overrides: str) -> dict:
        return compose("train", [*SMALL, f"scene.path={self.path}", f"folder={self.folder}", *overrides])

    def origin(self, *overrides: str) -> dict:
        config = self.changed(*overrides)
        return origin_of(config, load_scene(config["scene"], ".", 0)[0])


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return Case(tmp_path_factory.mktemp("run"))


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("seed=3", "seed=0, this command has 3: give the same"),
        ("scene.volume.depth=[0.4,0.9]", r"scene.volume.depth=\[0.4, 0.95\], this command has \[0.4, 0.9\]"),
        ("optimizer.rates.phasor=0.5", "optimizer.rates.phasor=0.05, this command has 0.5"),
        ("optimizer.method._target_=torch.optim.RAdam", "optimizer.method._target_=torch.optim.Adam, this"),
        ("objective.lambda_sparsity=9", "objective.lambda_sparsity="),
        ("ablation=phasor", "ablation.optimise.albedo=True, this command has False"),
        ("heldout.block=2", "heldout.block=3, this command has 2"),
        ("batch_spots=4", "batch_spots=8, this command has 4"),
        ("model.rays=10", "model.rays=20, this command has 10"),
        ("scene.sum_bins=2", "scene.sum_bins=1, this command has 2; another capture"),
        ("scene.gate=[5,200]", r"scene.gate=None, this command has \[5, 200\]; another capture"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused_with_what_differs(case, override, told):
    with pytest.raises(UserError, match=f"last.ckpt was made with .*{told}"):
        check_origin(case.last, case.origin(override), IMAGE)


@pytest.mark.parametrize(
    "override", ["scene.iterations=9", "export.spots=3", "effects=[hum]", "surfels.steps=3", "trainer=ddp"]
)
def test_what_makes_no_other_fit_may_differ(case, override):
    check_origin(case.last, case.origin(override), IMAGE)


def test_each_command_compares_what_it_goes_on_from(case):
    with pytest.raises(UserError, match=r"effects=\[\], this command has \['hum'\]"):
        check_origin(case.last, case.origin("effects=hum"), SURFACE)
    check_origin(case.last, case.origin("optimizer.rates.phasor=0.5"), START)


def test_the_file_counts_and_not_its_name(case, tmp_path):
    same, other = tmp_path / "same.hdf5", tmp_path / "other.hdf5"
    write_capture(same, case.capture)
    counts = case.capture.counts.copy()
    counts[3, 100] += 1
    write_capture(other, case.capture.with_counts(counts))
    check_origin(case.last, case.origin(f"scene.path={same}"), IMAGE)
    sentence = "mine.hdf5, this command has .*other.hdf5; another capture"
    with pytest.raises(UserError, match=sentence):  # before the phasor field is propagated
        prepare_run(case.changed(f"scene.path={other}"), opens={case.last: IMAGE})


def test_every_setting_is_compared_or_makes_no_other_fit(case):
    of_this_command = {
        "folder",
        "data_dir",
        "fit",
        "run",
        "refine",
        "ckpt_path",
        "threads",
        "memory_budget",
        "force",
        "resume",
    }
    shown = {"shard_field", "export", "trainer", "callbacks", "logger", "experiment", "profile"}
    compared = {name.split(".")[0] for name in SURFACE} | {"scene"}
    assert set(case.config) <= compared | of_this_command | shown


def test_a_run_that_was_stopped_is_not_opened_as_finished(case):
    """The checkpoint is that of a run killed after its last iteration, while results are written."""
    assert "final" not in read_checkpoint(case.last)["scores"]
    with pytest.raises(UserError, match=r"was stopped after 2 iterations; finish it first: .*resume="):
        open_run(case.folder)


def test_a_run_killed_after_its_last_iteration_is_resumed_to_its_end(case):
    before = case.run.module.scores
    again = prepare_run(case.config, opens={case.last: IMAGE})
    quiet_libraries()
    trainer = make_trainer(case.config)
    fit_or_leave(trainer, again.module, again, case.last)
    assert again.module.scores == before
    assert set(before) == {"initial", "final"}
    trainer.save_checkpoint(case.folder / "checkpoints" / "last.ckpt")
    assert finished_checkpoint(case.folder) == case.last
    assert open_run(case.folder).module.scores == before
    assert [file.name for file in (case.folder / "checkpoints").iterdir()] == ["last.ckpt"]


def test_going_on_from_a_finished_run_is_unfinished_until_its_end(case):
    module = copy.copy(case.run.module)
    module.scores = {"initial": {}, "final": {}}
    score = next(callback for callback in case.trainer.callbacks if hasattr(callback, "on_fit_end"))
    score.on_train_start(case.trainer, module)
    assert set(module.scores) == {"initial"}


@pytest.mark.filterwarnings("ignore:The dirpath has changed")
def test_a_change_that_is_named_is_made_and_kept(case, tmp_path):
    new = ["optimizer.rates.albedo=0.01", "batch_spots=4", "scene.iterations=4", f"folder={tmp_path}"]
    config, change = case.changed(*new), ["batch_spots", "optimizer.rates.albedo"]
    sentence = r"or let it differ from here on: 'resume.change=\[batch_spots,optimizer.rates.albedo\]"
    with pytest.raises(UserError, match=sentence):
        check_origin(case.last, case.origin(*new), IMAGE)
    with pytest.raises(UserError, match=r"seed=0, this command has 1: give the same, or .* without it$"):
        check_origin(case.last, case.origin(*new, "seed=1"), IMAGE, change)
    again = prepare_run(config, opens={case.last: IMAGE}, change=change)
    quiet_libraries()
    trainer = make_trainer(config)
    fit_or_leave(trainer, again.module, again, case.last)
    rates = {group["name"]: group["lr"] for group in trainer.optimizers[0].param_groups}
    assert rates == {"phasor": 0.05, "sensor": 0.1, "albedo": 0.01}
    made = [
        {"setting": "batch_spots", "from": 8, "to": 4, "after": 2},
        {"setting": "optimizer.rates.albedo", "from": 0.3, "to": 0.01, "after": 2},
    ]
    last = tmp_path / "checkpoints" / "last.ckpt"
    assert again.origin["changed"] == read_checkpoint(last)["origin"]["changed"] == made
    check_origin(last, case.origin(*new), IMAGE)  # from here on as any run
    assert changed_since(last, case.origin(*new), change) == made
    back = [*made, {"setting": "batch_spots", "from": 4, "to": 8, "after": 4}]
    assert changed_since(last, case.origin(*new, "batch_spots=8"), change) == back


def test_of_an_earlier_version_or_a_stranger_nothing_else_is_taken_for_a_change(case, tmp_path):
    state, file = read_checkpoint(case.last), tmp_path / "last.ckpt"
    del state["origin"]["changed"]
    torch.save(state, file)
    assert changed_since(file, case.origin(), []) == []
    for strange in (3, [3], [{"setting": "seed"}], [dict.fromkeys(CHANGE, torch.zeros(2))]):
        state["origin"]["changed"] = strange
        torch.save(state, file)
        with pytest.raises(UserError, match="is damaged, or no checkpoint"):
            changed_since(file, case.origin(), [])


def test_what_is_no_checkpoint_of_ours_is_one_sentence(tmp_path):
    file = tmp_path / "last.ckpt"
    file.write_bytes(b"root:x:0:0")
    with pytest.raises(UserError, match="is damaged, or no checkpoint"):
        read_checkpoint(file)
    torch.save({"state_dict": {}, "epoch": 1}, file)
    with pytest.raises(UserError, match="does not say which capture and settings it was fitted with"):
        read_checkpoint(file)


def test_a_run_killed_before_its_first_checkpoint_goes_on_with_no_other(tmp_path):
    other = tmp_path / "other" / "checkpoints" / "last.ckpt"
    other.parent.mkdir(parents=True)
    other.touch()
    folder = tmp_path / "mine"
    folder.mkdir()
    assert find_checkpoint("last", folder, "x") == other
    (folder / "overrides.json").write_text("[]")
    assert find_checkpoint("last", folder, "x") is None
    (folder / "overrides.json").write_text(json.dumps([f"ckpt_path={tmp_path}/start.ckpt"]))
    assert find_checkpoint("last", folder, "x") == tmp_path / "start.ckpt"
