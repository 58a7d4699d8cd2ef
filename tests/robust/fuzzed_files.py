"""Damaged capture files of every format, each made of a few bytes: which file it is of, and what is changed.

Such bytes are what a fuzzer varies (``fuzz_readers.py``), and what ``corpus/`` keeps. They say: which of the
format's seeds is taken (a valid file, or one that lacks a part or has a part of another type or shape), then
changes: a number at the place of a stored value, a byte anywhere, or an end.
"""

from __future__ import annotations

import contextlib
import functools
import signal
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import reader_files
import scipy.io

from data_modules.examine import describe, examine
from data_modules.nonsense import nonsense
from data_modules.readers import ReaderOptions, detect_format, read_capture
from nlos_lit.capture.errors import CaptureError

HANG = 10  # s
MOST = 12  # changes of a file
LOOKED_AT = 32  # every n-th accepted capture is looked over as inspect_capture.py does
NUMBERS = (
    0.0, -1.0, 1.0, 0.5, 2.0, 3.0, 7.0, 255.0, 65536.0, 1e-40, 1e-300, 1e-6, 1e6, 9.9e5, 1e12, 1e38, 1e300,
    -1e300, 2.0**31, 2.0**63, float("nan"), float("inf"), float("-inf"),
)  # fmt: skip
FORMS = ("<f8", "<f4", "<u2", "<i4", "<u8", ">f8", "<u1")
UNITS = {"bin_width_ps": 10.0, "wall_size": 0.8}
# Format → its writers of reader_files, and what a user says beside.
FORMATS: dict[str, tuple[tuple[str, ...], dict[str, float]]] = {
    "ytal": (("ytal",), {}),
    "lct": (("lct",), {}),
    "fk": (("fk",), {}),
    "phasor_field": (("phasor_field",), {}),
    "zaragoza": (("zaragoza",), {}),
    "chen": (("chen",), {}),
    "tsai_ahn": (("ahn", "tsai", "cube"), UNITS),
    "cid": (("cid",), {}),
}
NEED = {"ahn": (), "tsai": ("bin_width_ps",), "cube": ("bin_width_ps", "wall_size")}
INSTEAD: tuple[Any, ...] = (
    None, "yes", np.bytes_(b"no"), 0, -1, 7, 0.3, np.nan, np.zeros(3), np.ones((2, 2)), np.zeros((0, 3)),
    np.ones((2, 3, 2, 3)), np.full((3, 2, 3), np.nan),
)  # fmt: skip


def arrays_of(name: str, folder: Path) -> list[str]:
    """Names of the arrays that a writer's file holds; none of a picture."""
    path = reader_files.WRITERS[name](folder)
    if path.suffix == ".hdr":
        return []
    if h5py.is_hdf5(path):
        with h5py.File(path) as held:
            return list(held)
    return [key for key in scipy.io.loadmat(path) if not key.startswith("__")]


def replaced(name: str, key: str, value: Any, folder: Path, packed: bool = False) -> bytes:
    """A writer's file with another value for one of its arrays; without it where that is None."""
    path = reader_files.WRITERS[name](folder)
    if h5py.is_hdf5(path):
        with h5py.File(path, "a") as held:
            del held[key]
            if value is not None:
                held[key] = value
        return path.read_bytes()
    held = {k: v for k, v in scipy.io.loadmat(path).items() if not k.startswith("__")} | {key: value}
    scipy.io.savemat(path, {k: v for k, v in held.items() if v is not None}, do_compression=packed)
    return path.read_bytes()


def made(name: str, folder: Path) -> list[bytes]:
    """A writer's file, and the same with each of its arrays replaced in turn."""
    path = reader_files.WRITERS[name](folder)
    whole = path.read_bytes()
    if path.suffix == ".hdr":
        plain = reader_files.chen(folder, run_length=False).read_bytes()
        return [whole, plain, whole.replace(b"-Y 48", b"-Y 47"), whole.replace(b"+X 8", b"+X 9")]
    packings = (False,) if h5py.is_hdf5(path) else (False, True)
    keys = arrays_of(name, folder)
    return [whole] + [
        replaced(name, key, value, folder, packed) for packed in packings for key in keys for value in INSTEAD
    ]


def beside(fmt: str, folder: Path) -> None:
    """The other files of a format that has several."""
    if fmt == "cid":
        reader_files.cid(folder)


@functools.cache
def seeds(fmt: str) -> list[tuple[str, bytes]]:
    """Name of the writer and bytes of each seed of a format."""
    found = []
    for name in FORMATS[fmt][0]:
        with tempfile.TemporaryDirectory() as folder:
            found += [(name, blob) for blob in made(name, Path(folder))]
    return found


@functools.cache
def places(blob: bytes) -> list[int]:
    """Where a file holds values: each distinct run of bytes that is no zeros, by eights."""
    return [at for at in range(0, len(blob) - 8, 4) if blob[at : at + 8].strip(b"\0")]


def file_of(fmt: str, data: bytes) -> tuple[str, bytes]:
    """The file that some bytes stand for.

    Args:
        fmt: of :data:`FORMATS`.
        data: any.

    Returns:
        name of its writer, and the file.
    """
    parts = iter(data)

    def number(below: int) -> int:
        value = 0
        for _ in range(1 if below <= 256 else 3):
            value = value << 8 | next(parts, 0)
        return value % below

    known = seeds(fmt)
    name, seed = known[number(len(known))]
    blob = bytearray(seed)
    at = places(seed)
    for _ in range(min(len(data) // 6, MOST)):
        kind = number(8)
        if kind < 4:
            form, value = FORMS[number(len(FORMS))], NUMBERS[number(len(NUMBERS))]
            place = at[number(len(at))]
            with np.errstate(all="ignore"):
                told = np.nan_to_num(value) if form[1] in "ui" else value
                item = np.array(told).astype(form).tobytes()
            blob[place : place + len(item)] = item
        elif kind < 6:
            blob[number(len(blob))] = number(256)
        elif kind == 6:
            place = number(len(blob))
            blob[place : place + 4] = struct.pack("<I", number(1 << 24))
        elif number(4) == 0:
            del blob[number(len(blob)) + 1 :]
    return name, bytes(blob)


class Hang(Exception):
    """A file took longer than ``HANG``."""


@contextlib.contextmanager
def no_hang() -> Iterator[None]:
    def stop(number: int, frame: Any) -> None:
        raise Hang(f"more than {HANG} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(HANG)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def outcome(fmt: str, data: bytes, folder: Path) -> str:
    """Read the file that some bytes stand for, as :func:`outcome_of_file`."""
    name, blob = file_of(fmt, data)
    return outcome_of_file(fmt, name, blob, folder, sum(data) % LOOKED_AT == 0)


def outcome_of_file(fmt: str, name: str, blob: bytes, folder: Path, look: bool = True) -> str:
    """Read a file, and look it over.

    Args:
        fmt: of :data:`FORMATS`.
        name: of the writer that the file comes from.
        blob: the file.
        folder: for it; the other parts of a format that has several lie there.
        look: whether its format is recognised and it is looked over, as ``inspect_capture.py`` does.

    Returns:
        ``read`` or ``refused``; every other end is an exception.
    """
    path = folder / ("sub_Sig.mat" if fmt == "cid" else "capture")
    path.write_bytes(blob)
    given = {key: FORMATS[fmt][1][key] for key in NEED.get(name, ())}
    if look:
        with no_hang(), contextlib.suppress(CaptureError):
            detect_format(folder if fmt == "cid" else path)
    try:
        with no_hang():
            capture = read_capture(path, fmt, options=ReaderOptions(**given))  # type: ignore[arg-type]
        with no_hang():
            nonsense(capture)
            if look:
                describe(capture, fmt, examine(capture))
    except CaptureError as error:
        sentence = str(error)
        assert sentence, "nothing said"
        assert sentence.isprintable(), repr(sentence)
        return "refused"
    return "read"
