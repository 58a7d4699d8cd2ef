"""Files made to hang a reader, to fill the memory or to steer a terminal: one sentence each, at once."""

import json
import os
import re
import struct
import threading
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from conftest import ROOT
from omegaconf import OmegaConf

from data_modules.readers import detect_format, mat5, read_capture
from data_modules.readers.contents import open_contents
from data_modules.readers.radiance import read_radiance
from data_modules.simulate import load_truth
from nlos_lit.capture.errors import CaptureError, UserError
from nlos_lit.capture.foreign import archived
from nlos_lit.commands.view import page_of
from nlos_lit.io.tensors import write_tensors
from nlos_lit.io.views import read_view
from nlos_lit.runtime.claim import refuse_links
from nlos_lit.runtime.command_line import stay_in_run
from nlos_lit.runtime.plain_file import read_plain
from nlos_lit.training.configs import compose, run_config
from nlos_lit.training.folder import OVERRIDES, resume_run, take_folder
from nlos_lit.training.origin import check_origin, finished_checkpoint, read_checkpoint
from nlos_lit.training.sweep_table import run_rows

SIGNATURE = b"#?RADIANCE\n\n"


def bomb() -> str:
    """Nine aliases a line, nine lines: a billion entries in 500 bytes."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 10)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text", [bomb(), "[" * 100_000, "a: [1", "- a", "x: " + "y" * 2**20, "a: &a [*a]", "\x00", "a: ${oops"]
)
def test_a_foreign_config_is_refused(tmp_path, text):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(UserError, match=r"config\.yaml is damaged, or not written by this program"):
        run_config(tmp_path)


def test_a_pipe_is_not_waited_for(tmp_path):
    for name in ("capture.hdf5", "config.yaml", OVERRIDES):
        os.mkfifo(tmp_path / name)
    for read in (
        lambda: read_capture(tmp_path / "capture.hdf5"),
        lambda: run_config(tmp_path),
        lambda: resume_run(["train.py", f"resume={tmp_path}"]),
    ):
        found = []

        def attempt(read=read, found=found):
            try:
                read()
            except UserError as error:
                found.append(str(error))

        thread = threading.Thread(target=attempt, daemon=True)
        thread.start()
        thread.join(10)
        assert not thread.is_alive()
        assert len(found) == 1


@pytest.mark.parametrize("size", [b"-Y 999999999 +X 8\n", b"-Y 99999 +X 126\n", b"-Y 4 +X 32767\n"])
def test_a_small_picture_of_many_pixels_is_refused(tmp_path, size):
    (tmp_path / "a.hdr").write_bytes(SIGNATURE + size)
    with pytest.raises(CaptureError, match="is cut short: 0 bytes cannot hold"):
        read_radiance(tmp_path / "a.hdr")


def test_a_name_that_no_file_can_have_is_one_sentence():
    with pytest.raises(CaptureError, match="x cannot be read: File name too long"):
        read_capture("x" * 5000)


def test_a_picture_full_of_holes_is_not_read(tmp_path):
    (tmp_path / "a.hdr").write_bytes(SIGNATURE)
    os.truncate(tmp_path / "a.hdr", 20 * 2**30)
    with pytest.raises(CaptureError, match=r"a\.hdr has 21\.5 GB"):
        read_radiance(tmp_path / "a.hdr")


def test_a_text_without_its_bytes_is_refused_before_it_is_made(tmp_path):
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        file.create_dataset("scene_info", (), h5py.string_dtype(length=1_500_000_000))
    assert path.stat().st_size < 10_000
    with pytest.raises(CaptureError, match="claims 1500 MB"):
        open_contents(path).text("scene_info")


@pytest.mark.parametrize(("groups", "links"), [(1, 5000), (70, 70)])
def test_a_file_of_links_is_refused(tmp_path, groups, links):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["H"] = np.ones(3)
        for group in range(groups):
            place = file.create_group(f"g{group}")
            for link in range(links):
                place[f"l{link}"] = file["H"]
    with pytest.raises(CaptureError, match=r"holds .*[45]\d{3} arrays"):
        open_contents(tmp_path / "a.hdf5")


def test_a_number_in_a_chunk_that_fills_the_memory_is_refused(tmp_path):
    """Packed twice such a chunk is a file of some kB; HDF5 unpacks it as a whole for one number."""
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "t_start", (1,), "f8", maxshape=(None,), chunks=(500_000_000,), compression="gzip"
        )
    assert path.stat().st_size < 10_000
    with pytest.raises(CaptureError, match=r"t_start in a\.hdf5 has 8e-06 MB in a chunk of 4000 MB"):
        open_contents(path)


def test_a_matlab_file_that_takes_long_to_list_is_refused(tmp_path, monkeypatch):
    many = tmp_path / "many.mat"
    scipy.io.savemat(many, {"a": 1.0})
    head, one = many.read_bytes()[:128], many.read_bytes()[128:]
    many.write_bytes(head + 5000 * one)
    with pytest.raises(CaptureError, match=r"many\.mat holds more than 4096 arrays"):
        open_contents(many)
    fields = {f"f{number}": 1.0 for number in range(5000)}
    scipy.io.savemat(tmp_path / "fields.mat", {"held": fields})
    with pytest.raises(CaptureError, match=r"fields\.mat holds more than 4096 arrays"):
        open_contents(tmp_path / "fields.mat")
    packed = tmp_path / "packed.mat"
    scipy.io.savemat(packed, {n: {"a": np.zeros(9000)} for n in ("one", "two")}, do_compression=True)
    assert open_contents(packed).has("one.a", "two.a")
    monkeypatch.setattr(mat5, "_STRUCTS", 100_000)
    with pytest.raises(CaptureError, match=r"packed\.mat holds packed structs of more than 0\.0 GB"):
        open_contents(packed)


def test_what_a_file_says_does_not_reach_the_terminal_as_it_is(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["\x1b[2J\x1b]0;owned\x07"] = np.ones(3)
    with pytest.raises(CaptureError) as refused:
        detect_format(tmp_path / "a.hdf5")
    assert "\x1b" not in str(refused.value)
    assert "\\x1b[2J" in str(refused.value)


@pytest.mark.parametrize("open_run", [run_config, lambda folder: run_rows([folder, folder])])
@pytest.mark.parametrize("text", [bomb(), "a: [1", "scene: 7", "scene: {volume: [1]}", "- a"])
def test_each_command_refuses_a_foreign_config(tmp_path, open_run, text):
    (tmp_path / "config.yaml").write_text(text)
    (tmp_path / "summary.json").write_text("[[[")
    with pytest.raises(UserError, match=r"config\.yaml|summary\.json"):
        open_run(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("scene.iterations", "many", "must be a whole number"),
        ("scene.volume.depth", {"a": 1}, "must be"),
        ("heldout.block", [3], "must be a whole number"),
        ("optimizer.method", None, "another version"),
        ("batch_spots", None, "another version"),
        ("scene.simulate.mesh", None, "another version"),
    ],
)
def test_a_run_whose_config_was_altered_is_one_sentence(tmp_path, key, value, told):
    config = compose("train")
    *above, last = key.split(".")
    section = config
    for name in above:
        section = section[name]
    del section[last]
    if value is not None:
        section[last] = value
    OmegaConf.save(OmegaConf.create(config), tmp_path / "config.yaml")
    with pytest.raises(UserError, match=told):
        run_config(tmp_path)


def zipped(file: Path, size: int) -> Path:
    """An archive of a kilobyte for each megabyte of zeros in it."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("header.npy", "w") as part:
        for _ in range(size // 2**20):
            part.write(bytes(2**20))
    return file


def test_archives_that_unpack_to_much_are_refused_before_they_are_unpacked(tmp_path):
    file = zipped(tmp_path / "view.npz", 2**26)
    with pytest.raises(UserError, match="damaged"):
        read_plain(file)
    with pytest.raises(UserError, match="damaged"):
        read_checkpoint(file)
    with pytest.raises(UserError, match=r"unpacks to 0\.067 GB"):
        archived(file)
    assert archived(file, packed=True) == file
    claimed = file.read_bytes().replace(struct.pack("<I", 2**26), struct.pack("<I", 2**31))
    file.write_bytes(claimed)
    with pytest.raises(UserError, match=r"view\.npz is damaged: .* unpacks to 2\.1 GB"):
        read_view(tmp_path)


def test_files_of_holes_are_not_read(tmp_path):
    for name in ("overrides.json", "config.yaml", "a.ckpt"):
        (tmp_path / name).touch()
        os.truncate(tmp_path / name, 20 * 2**30)
    for read in (
        lambda: resume_run(["train.py", f"resume={tmp_path}"]),
        lambda: run_config(tmp_path),
        lambda: read_checkpoint(tmp_path / "a.ckpt"),
        lambda: read_plain(tmp_path / "a.ckpt"),
    ):
        with pytest.raises(UserError):
            read()


def test_checkpoints_that_hold_something_else_are_one_sentence(tmp_path):
    file = tmp_path / "checkpoints" / "last.ckpt"
    for state in ([], {"origin": 3}, {"origin": {"settings": 1, "capture": "a"}, "scores": 4}):
        write_tensors(file, state)
        with pytest.raises(UserError, match=r"last\.ckpt (is damaged|does not say)"):
            check_origin(file, {"settings": {}, "capture": "a"}, ("scene",))
    with pytest.raises(UserError, match=r"last\.ckpt is damaged"):
        finished_checkpoint(tmp_path)


def test_views_that_hold_something_else_are_one_sentence(tmp_path):
    header = {"largest": 1.0, "whole": True, "clouds": ["a"], "meshes": [], "grid": None, "path": [0, 1]}
    for arrays in ({}, {"counts": np.zeros(3)}, {"counts": np.zeros((2, 3)), "cloud0": np.zeros(7)}):
        np.savez_compressed(tmp_path / "view.npz", header=np.array(json.dumps(header)), **arrays)
        with pytest.raises(UserError, match=r"view\.npz is damaged"):
            read_view(tmp_path)


def test_links_out_of_a_runs_folder_are_not_written_through(tmp_path, monkeypatch):
    run, outside = tmp_path / "run", tmp_path / "outside"
    run.mkdir()
    outside.mkdir()
    for name in ("config.yaml", OVERRIDES):
        (run / name).write_text("[]")
    (run / "inside").symlink_to(run / "config.yaml")
    refuse_links(run)
    (run / "diagnosis").symlink_to(outside)
    for write in (
        lambda: stay_in_run(["diagnose.py", f"run={run}"]),
        lambda: take_folder(run, goes_on=True),
        lambda: page_of(run),
    ):
        with pytest.raises(UserError, match="diagnosis is a link out of its run's folder"):
            write()


def test_ground_truth_is_read_as_carefully_as_a_capture(tmp_path):
    inside = {
        "x": np.arange(2.0),
        "y": np.arange(3.0),
        "depth": np.ones((2, 3)),
        "normal": np.ones((2, 3, 3)),
    }

    def written(**changes) -> Path:
        with h5py.File(tmp_path / "truth.h5", "w") as file:
            for name, values in (inside | changes).items():
                file[name] = values
        return tmp_path / "truth.h5"

    assert load_truth(written()).depth.shape == (2, 3)
    link = h5py.ExternalLink(str(written()), "depth")
    with pytest.raises(UserError, match="lacks depth"):
        load_truth(written(depth=link))
    for name, values in (("depth", np.ones(4)), ("normal", np.ones((2, 3))), ("albedo", np.ones(2))):
        with pytest.raises(UserError, match=f"{name} in .* must be as large as x and y say"):
            load_truth(written(**{name: values}))
    with pytest.raises(UserError, match="does not hold real numbers"):
        load_truth(written(x=np.array([b"a", b"b"])))
    half = written().read_bytes()[:3000]
    (tmp_path / "truth.h5").write_bytes(half)
    with pytest.raises(UserError, match="damaged or truncated"):
        load_truth(tmp_path / "truth.h5")


def test_no_code_is_loaded_by_a_name_or_a_file_but_our_own():
    loads = re.compile(
        r"\bexec\(|(?<![.\w])eval\(|import_module|spec_from_file|runpy|pickle\.load|unsafe_load"
    )
    found = {
        str(file.relative_to(ROOT))
        for package in ("nlos_lit", "data_modules")
        for file in (ROOT / package).rglob("*.py")
        if loads.search(file.read_text(encoding="utf-8"))
    }
    # Modules of this package, by names that stand in its own lists.
    assert found == {
        "nlos_lit/effects/registry.py",
        "nlos_lit/commands/nlos.py",
        "nlos_lit/paper/workspace.py",
    }
