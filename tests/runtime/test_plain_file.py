"""Plain files: what goes in comes out, and what is foreign is refused without being run."""

from __future__ import annotations

import json
import math
import os
import pickle
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from nlos_lit.capture.errors import UserError
from nlos_lit.runtime.plain_file import Kind, read_plain, record, write_plain
from nlos_lit.runtime.steps import Steps


class Pair(NamedTuple):
    left: object
    right: object


@dataclass(frozen=True)
class Grid:
    origin: tuple[float, ...]


class Counter:
    def __init__(self, start: int) -> None:
        self.value = start


KINDS = [record(Pair), record(Grid), Kind(Counter, vars, lambda parts: Counter(parts["value"]))]


def test_values_come_back_to_the_last_digit(tmp_path):
    file, big = tmp_path / "deep" / "x.npz", torch.arange(9.0)
    value = {
        "numbers": [1, True, None, 0.1 + 0.2, math.inf, -1e-310, "ψ"],
        "tensors": (torch.rand(3, 4).T, torch.tensor(2.5, dtype=torch.float64), torch.tensor([True]), big),
        "pair": Pair(Grid((1.0, 2.0)), np.arange(6, dtype=np.uint16).reshape(2, 3)),
        "nan": float("nan"),
        "counter": Counter(7),
    }
    write_plain(file, value, KINDS, {"big": big})
    again = read_plain(file, KINDS, {"big": big})
    assert again["numbers"] == value["numbers"]
    assert [type(v) for v in again["numbers"]] == [type(v) for v in value["numbers"]]
    for old, new in zip(value["tensors"], again["tensors"], strict=True):
        assert (new.dtype, new.shape, new.stride()) == (old.dtype, old.shape, old.stride())
        assert torch.equal(new, old)
    assert again["tensors"][3] is big
    assert again["pair"].left == Grid((1.0, 2.0))
    assert again["pair"].right.dtype == np.uint16
    assert np.array_equal(again["pair"].right, value["pair"].right)
    assert math.isnan(again["nan"])
    assert again["counter"].value == 7
    assert [p.name for p in file.parent.iterdir()] == ["x.npz"]


@pytest.mark.parametrize("value", [object(), Pair(1, 2), {1: "one"}, {1, 2}, Path("x")])
def test_what_has_no_plain_form_is_not_written(tmp_path, value):
    with pytest.raises(TypeError, match="cannot be kept in a plain file"):
        write_plain(tmp_path / "x.npz", value)
    assert not list(tmp_path.iterdir())


class Bomb:
    """Unpickling it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def archive(file: Path, tree: object, **arrays: np.ndarray) -> None:
    np.savez(file, tree=np.frombuffer(json.dumps(tree).encode(), np.uint8), **arrays)


FOREIGN = {
    "pickle": lambda file, bomb: file.write_bytes(pickle.dumps(bomb)),
    "torch": lambda file, bomb: torch.save(bomb, file),
    "object array": lambda file, bomb: np.savez(file, tree=np.array([bomb], dtype=object)),
    "object inside": lambda file, bomb: archive(
        file, {"array": "0"}, **{"0": np.array([bomb], dtype=object)}
    ),
    "single array": lambda file, bomb: np.save(file.open("wb"), np.arange(3)),
    "half": lambda file, bomb: (archive(file, [1, 2]), file.write_bytes(file.read_bytes()[:-40])),
    "empty": lambda file, bomb: file.write_bytes(b""),
    "no tree": lambda file, bomb: np.savez(file, other=np.arange(3)),
    "no json": lambda file, bomb: np.savez(file, tree=np.frombuffer(b"1 + 1", np.uint8)),
    "unknown class": lambda file, bomb: archive(file, {"object": ["os.mkdir", {"dict": {"path": "x"}}]}),
    "unknown parts": lambda file, bomb: archive(file, {"object": ["Pair", {"dict": {"left": 1, "up": 2}}]}),
    "unknown word": lambda file, bomb: archive(file, {"eval": "1 + 1"}),
    "two words": lambda file, bomb: archive(file, {"list": [], "tuple": []}),
    "unknown name": lambda file, bomb: archive(file, {"shared": "capture"}),
    "missing array": lambda file, bomb: archive(file, {"tensor": "0"}),
}


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("what", FOREIGN)
def test_foreign_files_are_refused_and_not_run(tmp_path, what):
    file, folder = tmp_path / "base.npz", tmp_path / "ran"
    FOREIGN[what](file, Bomb(folder))
    sentence = r"base\.npz is damaged, or not written by this program: move it away$"
    with pytest.raises(UserError, match=sentence):
        read_plain(file, KINDS)
    with pytest.raises(UserError, match=sentence):
        Steps(folder=tmp_path)("fit", "fitting", "base", lambda: 1)
    assert not folder.exists()


def test_threads_read_one_after_the_other(tmp_path, monkeypatch):
    """Two that parse heads of arrays at once may each find the other's file damaged."""
    within, most, load = [], [], np.load

    def slow(*given, **named):
        within.append(1)
        most.append(len(within))
        time.sleep(0.02)
        archive = load(*given, **named)
        within.pop()
        return archive

    write_plain(tmp_path / "one.npz", torch.arange(3))
    monkeypatch.setattr(np, "load", slow)
    with ThreadPoolExecutor(4) as several:
        found = list(several.map(read_plain, [tmp_path / "one.npz"] * 8))
    assert all(torch.equal(one, torch.arange(3)) for one in found)
    assert most == [1] * 8


def test_a_plain_file_that_is_no_step_is_refused(tmp_path):
    write_plain(tmp_path / "base.npz", [1, 2])
    with pytest.raises(UserError, match=r"base\.npz is damaged, or not written by this program"):
        Steps(folder=tmp_path)("fit", "fitting", "base", lambda: 1)
