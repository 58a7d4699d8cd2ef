"""The MATLAB v5 reader against SciPy's writer, and the page on one's own data against the readers."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from data_modules.readers import mat5, read_capture
from data_modules.readers.contents import open_contents
from nlos_lit.capture.errors import CaptureError

TYPES = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]


@pytest.mark.parametrize("packed", [False, True])
def test_numbers_of_every_type_come_back(tmp_path, packed):
    rng = np.random.default_rng(0)
    arrays = {f"v_{kind}": (100 * rng.random((3, 2, 4))).astype(kind) for kind in TYPES}
    arrays |= {
        "one": np.array(2.5),
        "long_name_of_a_variable": np.arange(5),
        "empty": np.zeros((0, 3)),
        "flag": np.array([True, False]),
    }
    scipy.io.savemat(tmp_path / "a.mat", arrays, do_compression=packed)
    contents = open_contents(tmp_path / "a.mat")
    for name, values in arrays.items():
        read = contents.read(name)
        expected = np.atleast_2d(values)
        assert contents.entries[name].shape == expected.shape
        np.testing.assert_array_equal(read, expected, err_msg=name)
        assert read.dtype == (np.uint8 if values.dtype.kind == "b" else expected.dtype)


@pytest.mark.parametrize("packed", [False, True])
def test_structs_are_listed_and_the_rest_is_never_decoded(tmp_path, packed):
    cell = np.empty(2, dtype=object)
    cell[:] = [np.ones(3), "text"]
    arrays = {
        "s": {"a": np.arange(6.0).reshape(2, 3), "name": "spot", "deep": {"b": 1.0}},
        "cell": cell,
        "text": "abc",
        "z": np.ones(2) * 1j,
    }
    scipy.io.savemat(tmp_path / "a.mat", arrays, do_compression=packed)
    contents = open_contents(tmp_path / "a.mat")
    np.testing.assert_array_equal(contents.read("s.a"), np.arange(6.0).reshape(2, 3))
    assert {name for name, entry in contents.entries.items() if entry.numeric} == {"s.a"}
    for name in ("cell", "text", "z", "s", "s.name", "s.deep"):
        with pytest.raises(CaptureError, match="real numbers"):
            contents.read(name)


def test_a_flipped_bit_in_packed_data_is_noticed(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(
        path,
        {"rect_data": np.random.default_rng(0).integers(0, 9, (8, 8, 64)).astype("u2"), "width": 0.3},
        do_compression=True,
    )
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 16
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="damaged"):
        read_capture(path)


def test_the_page_on_own_data_works(tmp_path, monkeypatch):
    page = (Path(__file__).resolve().parents[2] / "docs" / "own-data.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    plain, own = read_capture("mine.hdf5"), read_capture("mine_counts.hdf5")
    for capture in (plain, own):
        assert (capture.kind, capture.scan_shape, capture.n_bins) == ("confocal", (32, 32), 512)
        np.testing.assert_array_equal(capture.counts[5 * 32 + 7], names["counts"][5, 7])
        np.testing.assert_allclose(capture.laser[5 * 32 + 7, :2], (names["x"][5], names["y"][7]), rtol=1e-12)
        assert capture.bin_width_ps == pytest.approx(16.0)
    assert (plain.is_counts, own.is_counts, own.gate, own.exposure_s) == (True, True, (150, 512), 0.1)


@pytest.mark.parametrize("packed", [False, True])
def test_a_file_that_is_cut_while_it_is_read_is_one_sentence(tmp_path, monkeypatch, packed):
    """Mapped into memory it would end the process."""
    path, peek = tmp_path / "a.mat", mat5._peek
    values = np.random.default_rng(0).random((300, 300))
    scipy.io.savemat(path, {"rect_data": values}, do_compression=packed)
    contents = open_contents(path)

    def cut(*given):
        os.truncate(path, 4096)
        return peek(*given)

    monkeypatch.setattr(mat5, "_peek", cut)
    with pytest.raises(CaptureError, match="cut short while it was read"):
        contents.read("rect_data")
