"""Files made to hang a reader, to fill the memory or to steer a terminal: one sentence each, at once."""

import os
import threading

import h5py
import numpy as np
import pytest
import scipy.io

from data_modules.readers import detect_format, mat5, read_capture
from data_modules.readers.contents import open_contents
from data_modules.readers.radiance import read_radiance
from nlos_lit.capture.errors import CaptureError, UserError
from nlos_lit.training.configs import run_config
from nlos_lit.training.folder import OVERRIDES, resume_run

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
