"""A disk that becomes full, or that nothing may be written to: the old file or none, and a sentence.

A limit on the size of files (setrlimit(2)) stands for the full disk: it needs no rights, and a write beyond
it fails as one on a full disk does.
"""

import errno
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT

from nlos_lit.capture.errors import UserError
from nlos_lit.commands.composed import compose_and_run
from nlos_lit.io.files import whole_file
from nlos_lit.io.tensors import write_tensors
from nlos_lit.runtime.command_line import sentence_errors
from nlos_lit.runtime.memory import check_disk
from nlos_lit.training.callbacks import WholeCheckpoints
from nlos_lit.training.configs import compose, register_settings
from nlos_lit.training.folder import take_given_folder
from nlos_lit.training.instantiate import builder

WRITE = """
import resource, sys
from pathlib import Path
import numpy as np
import torch
from small_capture import fields
from data_modules.readers import write_capture
from data_modules.simulate.truth import Truth, save_truth
from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.tensors import write_tensors
from nlos_lit.io.volumes import write_volume
from nlos_lit.runtime.plain_file import write_plain

rng, folder, many = np.random.default_rng(0), Path(sys.argv[1]), np.zeros((12, 2000), dtype=np.uint16)
many[:] = rng.poisson(9, many.shape)
image = rng.random((40, 40))
grid = VolumeGrid((0, 0, 0), (1, 1, 1), (20, 20, 20))
writers = {
    "capture.hdf5": lambda file: write_capture(file, Capture(**fields(counts=many)), overwrite=True),
    "truth.h5": lambda file: save_truth(
        file, Truth(image[0], image[0], image, np.stack([image] * 3, -1), image, None)
    ),
    "volume.h5": lambda file: write_volume(file, rng.random((20, 20, 20)), grid),
    "last.ckpt": lambda file: write_tensors(file, {"a": torch.zeros(3000)}),
    "step.npz": lambda file: write_plain(file, {"a": many}),
}
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
for name, write in writers.items():
    try:
        write(folder / name)
    except Exception as error:
        print(name, type(error).__name__, error)
"""


def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path):
    names = ["capture.hdf5", "last.ckpt", "step.npz", "truth.h5", "volume.h5"]
    for name in names:
        (tmp_path / name).write_text("old")
    done = subprocess.run(
        [sys.executable, "-c", WRITE, str(tmp_path)],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT}/tests"}, capture_output=True, text=True,
        timeout=100,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert len(said) == len(names), done.stdout
    assert all(line.endswith("File too large") or "[Errno 27] File too large" in line for line in said)
    assert sorted(file.name for file in tmp_path.iterdir()) == names
    assert {file.read_text() for file in tmp_path.iterdir()} == {"old"}


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.ENOTDIR, errno.EEXIST])
def test_what_the_disk_refuses_is_one_sentence_with_the_file(tmp_path, capsys, code):
    @sentence_errors
    def command() -> None:
        with whole_file(tmp_path / "volume.h5"):
            raise OSError(code, os.strerror(code))

    with pytest.raises(SystemExit) as end:
        command()
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {tmp_path}/volume.h5: {os.strerror(code)}; ")


@pytest.mark.parametrize("where", ["hydra.core.utils._save_config", "logging.FileHandler._open"])
def test_a_disk_that_is_full_when_hydra_writes_is_one_sentence(tmp_path, monkeypatch, capsys, where):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(where, full)
    monkeypatch.setattr("sys.argv", ["reconstruct.py"])
    with pytest.raises(SystemExit) as end:
        compose_and_run(
            "reconstruct", lambda _: register_settings(), print, [f"hydra.run.dir={tmp_path}/run"]
        )
    assert end.value.code == 2
    assert capsys.readouterr().err.splitlines() == [
        "error: a result: No space left on device; make room, or write elsewhere"
    ]


def test_other_errors_of_the_system_keep_their_traceback():
    @sentence_errors
    def command() -> None:
        raise ChildProcessError(errno.ECHILD, "no child")

    with pytest.raises(ChildProcessError):
        command()


def test_results_that_have_no_place_are_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "taken").touch()
    with pytest.raises(UserError, match="taken is no folder; give another folder for the results"):
        take_given_folder([f"hydra.run.dir={tmp_path}/taken/run"])
    if Path("/proc/self").is_dir():
        with pytest.raises(
            UserError, match=r"/proc cannot be written to \(No such file or directory\); give"
        ):
            take_given_folder(["hydra.run.dir=/proc/run"])

    def full(**_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(UserError, match=r"cannot be written to \(No space left on device\); give another"):
        take_given_folder([f"hydra.run.dir={tmp_path}/run"])
    with pytest.raises(UserError, match="cannot be written to"):
        take_given_folder([])
    with pytest.raises(UserError, match=r"the run takes about 1125899906842624 MiB, .* MiB free; make room"):
        check_disk(tmp_path / "not" / "there", 2**70, "the run")
    check_disk(tmp_path / "not" / "there", 1, "the run")


def test_checkpoints_lie_beside_their_target_while_they_are_written(tmp_path, monkeypatch):
    (plugin,) = compose("train")["trainer"]["plugins"]
    keeper = builder(plugin, WholeCheckpoints, "plugin")()
    seen = []
    monkeypatch.setattr(os, "replace", lambda old, new: seen.append((old.parent, new)))
    keeper.save_checkpoint({"a": torch.ones(2)}, tmp_path / "checkpoints" / "last.ckpt")
    assert seen == [(tmp_path / "checkpoints", tmp_path / "checkpoints" / "last.ckpt")]
    monkeypatch.undo()
    write_tensors(tmp_path / "a.pt", {"a": torch.ones(2)})
    assert np.array_equal(torch.load(tmp_path / "a.pt", weights_only=True)["a"], [1, 1])
