"""What may be written into a folder that something is in, and how a run goes on by its folder's name."""

import json

import pytest

from nlos_lit.capture.errors import UserError
from nlos_lit.training.folder import OVERRIDES, goes_on_in, resume_run, take_folder, take_given_folder


@pytest.mark.parametrize(
    ("left", "sentence"),
    [
        ("summary.json", "already holds a finished run; choose another hydra.run.dir$"),
        ("diagnosis/diagnosis.json", "already holds a diagnosis; "),
        (
            OVERRIDES,
            r"already holds an interrupted run; .*, or go on with it: python train.py 'resume=.*my run'",
        ),
    ],
)
def test_a_folder_with_a_run_is_taken_by_what_goes_on_from_it_alone(tmp_path, left, sentence):
    folder = tmp_path / "my run"
    file = folder / left
    file.parent.mkdir(parents=True)
    take_folder(folder)
    (folder / "train.log").touch()  # of a command that was refused
    (folder / "config.yaml").touch()
    take_folder(folder)
    file.touch()
    with pytest.raises(UserError, match=sentence):
        take_folder(folder)
    with pytest.raises(UserError, match=sentence):
        take_given_folder(["seed=1", f"hydra.run.dir='{folder}'"])
    take_given_folder(["ckpt_path=last", f"hydra.run.dir='{folder}'"])
    take_folder(folder, goes_on=True)


def test_a_folder_that_is_not_there_is_not_made_before_hydra_has_read_the_settings(tmp_path):
    take_given_folder([f"hydra.run.dir={tmp_path}/new"])
    take_given_folder(["seed=1"])
    assert list(tmp_path.iterdir()) == []


def test_processes_that_help_take_no_folder(tmp_path, monkeypatch):
    (tmp_path / OVERRIDES).touch()
    monkeypatch.setenv("LOCAL_RANK", "1")
    take_folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [OVERRIDES]  # no lock either


def test_a_run_goes_on_in_its_own_folder_alone(tmp_path):
    assert goes_on_in(tmp_path, "last")
    assert goes_on_in(tmp_path, f"{tmp_path}/checkpoints/last.ckpt")
    for other in (None, "null", f"{tmp_path}2/checkpoints/last.ckpt"):
        assert not goes_on_in(tmp_path, other)


def test_a_folder_is_all_that_resuming_takes(tmp_path):
    (tmp_path / OVERRIDES).write_text(
        json.dumps(["scene=capture", "scene.path=a b.mat", "~callbacks.figures"])
    )
    arguments = ["train.py", f"resume={tmp_path}", "scene.iterations=200", "+scene.path=c.mat"]
    resume_run(arguments)
    assert arguments == [
        "train.py", "scene=capture", "~callbacks.figures", "scene.iterations=200", "+scene.path=c.mat",
        "ckpt_path=last", f"hydra.run.dir='{tmp_path}'",
    ]  # fmt: skip
    resume_run(arguments)
    assert len(arguments) == 7


@pytest.mark.parametrize(
    "begun_with",
    [
        ["hydra.run.dir=/elsewhere"], ["+hydra.callbacks.x._target_=os.system"], ["--config-dir=/elsewhere"],
        ["-m"], ["seed=1", 3], {"seed": 1}, None,
    ],
)  # fmt: skip
def test_a_foreign_folder_sets_settings_and_nothing_else(tmp_path, begun_with):
    (tmp_path / OVERRIDES).write_text(json.dumps(begun_with))
    with pytest.raises(UserError, match=r"overrides.json was altered"):
        resume_run(["train.py", f"resume={tmp_path}"])


@pytest.mark.parametrize(
    "setting",
    [
        "callbacks.checkpoint.dirpath=/elsewhere", "callbacks.checkpoint.dirpath=../..",
        "+logger.other={_target_: lightning.pytorch.loggers.CSVLogger, save_dir: ~}",
        "+logger.other.save_dir='${oc.env:HOME}'", "trainer.default_root_dir=a/b", "++logger@x.save_dir=/x",
    ],
)  # fmt: skip
def test_a_foreign_folder_names_no_other_place_to_write_to(tmp_path, setting):
    (tmp_path / OVERRIDES).write_text(json.dumps(["trainer.max_steps=3", "~callbacks.figures", setting]))
    with pytest.raises(UserError, match=r"may write into itself alone; .* again on the command line"):
        resume_run(["train.py", f"resume={tmp_path}"])
    if "other=" not in setting:
        arguments = ["train.py", f"resume={tmp_path}", setting]
        resume_run(arguments)
        assert arguments.count(setting) == 1


def test_only_a_run_can_be_resumed(tmp_path):
    with pytest.raises(
        UserError, match=r"is not the folder of a run that has begun: overrides\.json is missing"
    ):
        resume_run(["train.py", f"resume={tmp_path}"])
    (tmp_path / OVERRIDES).write_text("[" * 100_000)
    with pytest.raises(UserError, match="was altered"):
        resume_run(["train.py", f"resume={tmp_path}"])
