"""What lies in a file, seen without reading its arrays: the one place where file libraries are touched.

Nothing here can run code from a file: MATLAB objects and function handles, HDF5 references and Python objects
are never resolved, only plain numbers and text are read. Every failure of a library on a damaged file becomes
one `CaptureError`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import h5py
import numpy as np
import psutil

from data_modules.readers.mat5 import list_mat5, read_mat5
from nlos_lit.capture.capture import FARTHEST
from nlos_lit.capture.errors import CaptureError

OTHER_KINDS = MappingProxyType(
    {
        b"\x89PNG": "a PNG picture",
        b"\xff\xd8\xff": "a JPEG picture",
        b"GIF8": "a GIF picture",
        b"II*\0": "a TIFF picture",
        b"MM\0*": "a TIFF picture",
        b"%PDF": "a PDF",
        b"\x93NUMPY": "a NumPy array without geometry",
        b"PK\3\4": "a zip archive (such as .npz)",
    }
)
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
LARGEST = 1e30  # of a number that is read: sums of millions of them stand in single precision
_MOST = 4096  # arrays of a file that are listed
_SMALL = 2**20  # bytes that are there
_CHUNK = 2**26  # bytes that HDF5 may unpack of a smaller array
_DEFLATE_LIMIT = 1100  # deflate cannot shrink more than 1032-fold (zlib.net/zlib_tech.html)


@dataclass(frozen=True)
class Entry:
    """One array of a file, seen without reading it.

    Args:
        shape: in MATLAB's axis order where MATLAB wrote it.
        numeric: it holds real numbers.
        size: in full, bytes.
        empty: it stands for None (a null dataspace of HDF5).
    """

    shape: tuple[int, ...]
    numeric: bool
    size: int
    empty: bool = False


@dataclass(frozen=True)
class Contents:
    """The arrays of a file, or of the ``.mat`` files of a folder, by name.

    Args:
        path: the file or folder.
        container: ``hdf5``, ``mat5`` (MATLAB up to v7.2), ``radiance`` (HDR picture), ``mp4`` or ``folder``.
        entries: what each array is, by name; fields of a MATLAB struct as ``struct.field``.
        matlab: an HDF5 file written by MATLAB (v7.3), whose axes HDF5 shows in reverse.
        parts: for a folder, the contents of the file that each entry lies in.
    """

    path: Path
    container: str
    entries: dict[str, Entry]
    matlab: bool = False
    parts: dict[str, Contents] = field(default_factory=dict)

    def __contains__(self, name: str) -> bool:
        return name in self.entries

    def has(self, *names: str) -> bool:
        """Whether all of these arrays are there."""
        return all(name in self.entries for name in names)

    def given(self, name: str) -> bool:
        """Whether the file says anything under this name."""
        return name in self.entries and not self.entries[name].empty

    def ndim(self, name: str) -> int:
        """Number of axes of a numeric array; -1 where it is absent or not numeric."""
        entry = self.entries.get(name)
        return len(entry.shape) if entry is not None and entry.numeric else -1

    def require(self, *names: str) -> None:
        """Refuse a file that lacks an array.

        Raises:
            CaptureError: one of them is absent; the message says what there is.
        """
        missing = [name for name in names if name not in self.entries]
        if missing:
            raise CaptureError(f"{self.path.name} has no {', '.join(missing)}; it holds {self.summary()}")

    def summary(self) -> str:
        """The names and shapes, for messages."""
        if not self.entries:
            return f"no named arrays ({self.container} file)"
        shown = [
            f"{name} {'×'.join(map(str, entry.shape)) or 'scalar'}"
            for name, entry in list(self.entries.items())[:12]
        ]
        rest = len(self.entries) - len(shown)
        return ", ".join(shown) + (f" and {rest} more" if rest > 0 else "")

    def read(self, name: str) -> np.ndarray:
        """One numeric array, as stored.

        Raises:
            CaptureError: absent, not real numbers, claiming more data than the file can hold, or damaged.
        """
        self.require(name)
        if name in self.parts:
            return self.parts[name].read(name)
        entry = self.entries[name]
        if not entry.numeric:
            raise CaptureError(f"{name} in {self.path.name} does not hold real numbers")
        self._check_size(name, entry)
        with _damage(self.path):
            values = self._read_hdf5(name) if self.container == "hdf5" else read_mat5(self.path, name)
        values = np.asarray(values)
        if values.dtype.kind not in "uifb":
            raise CaptureError(
                f"{name} in {self.path.name} does not hold real numbers (found {values.dtype})"
            )
        if values.dtype.itemsize > 8:  # longer floats than any file of the field has
            with np.errstate(all="ignore"):
                return values.astype(np.float64)
        return values.astype(np.uint8) if values.dtype.kind == "b" else values

    def counts(self, name: str) -> np.ndarray:
        """One array of transients: not empty, finite, and of values whose sums stay finite.

        Raises:
            CaptureError: as of `read`, or empty, or NaN, infinite or such values in it.
        """
        values = self.read(name)
        if values.size == 0:
            raise CaptureError(f"{name} in {self.path.name} is empty ({'×'.join(map(str, values.shape))})")
        if not (np.isfinite(values.min()) and np.isfinite(values.max())):
            raise CaptureError(
                f"{name} in {self.path.name} holds NaN or infinite values; clean the file or mask those spots"
            )
        largest = max(abs(float(values.min())), abs(float(values.max())))
        if largest > LARGEST:
            raise CaptureError(
                f"the largest value of {name} in {self.path.name} is {largest:.3g}; usual are 1 to 100000 "
                "counts a bin: look for a damaged value, or give values in another unit"
            )
        return values

    def places(self, name: str) -> np.ndarray:
        """Coordinates or directions as float64: finite and below a thousand kilometres.

        Raises:
            CaptureError: as of `read`, or other values.
        """
        values = self.read(name).astype(np.float64)
        if values.size == 0 or not np.abs(values).max() < FARTHEST:
            raise CaptureError(f"{name} in {self.path.name} must hold finite coordinates in metres")
        return values

    def scalar(self, name: str) -> float:
        """A number within ±LARGEST stored as an array of one element.

        Raises:
            CaptureError: as of `read`, or several values, or beyond that.
        """
        values = self.read(name)
        if values.size != 1:
            raise CaptureError(
                f"{name} in {self.path.name} must be one finite number; found {values.size} values"
            )
        if not abs(value := float(values.reshape(()))) <= LARGEST:
            raise CaptureError(f"{name} in {self.path.name} must be one finite number; found {value:g}")
        return value

    def flag(self, name: str) -> bool:
        """A truth value, stored as true and false or as 1 and 0.

        Raises:
            CaptureError: as of `read`, or another value.
        """
        if self.ndim(name) < 0 or (value := self.scalar(name)) not in (0, 1):
            raise CaptureError(f"{name} in {self.path.name} must be true or false (1 or 0)")
        return bool(value)

    def text(self, name: str) -> str:
        """A string of an HDF5 file; empty where it is absent or not text."""
        if self.container != "hdf5" or name not in self.entries:
            return ""
        with _damage(self.path), h5py.File(self.path, "r") as file:
            dataset = file[name]
            kind = h5py.check_string_dtype(dataset.dtype)
            if dataset.shape != () or kind is None:
                return ""
            self._check_size(name, self.entries[name], 1)  # a single value is never packed
            place = dataset.id.get_offset()
            if kind.length is None and place and not heap_ends(self.path, place):
                raise CaptureError(f"{name} in {self.path.name} cannot be read; the file is damaged")
            return dataset[()].decode("utf-8", errors="replace")

    def _check_size(self, name: str, entry: Entry, packing: int = _DEFLATE_LIMIT) -> None:
        on_disk = self.path.stat().st_size
        if entry.size > packing * on_disk:
            raise CaptureError(
                f"{name} in {self.path.name} claims {entry.size / 1e6:.0f} MB in a file of "
                f"{on_disk / 1e6:.3g} MB; "
                "the file is damaged or truncated"
            )
        if entry.size > _SMALL and entry.size > (free := psutil.virtual_memory().available):
            raise CaptureError(
                f"{name} in {self.path.name} needs {entry.size / 1e9:.1f} GB and {free / 1e9:.1f} GB are "
                "free; use a smaller file"
            )

    def _read_hdf5(self, name: str) -> np.ndarray:
        with h5py.File(self.path, "r") as file:
            values = file[name.replace(".", "/")][()]
        return values.T if self.matlab and isinstance(values, np.ndarray) else values


def open_contents(path: str | Path) -> Contents:
    """List a file or folder without reading its arrays.

    (The structs of old MATLAB files, which have no table, are unpacked on the way.)

    Args:
        path: the file, or a folder of ``.mat`` files.

    Returns:
        what is there.

    Raises:
        CaptureError: nothing there, not readable, damaged, or of no known container.
    """
    path = Path(path)
    try:
        if path.is_dir():
            return open_folder(path)
        if not path.exists():
            raise CaptureError(f"there is no file {path}")
        if not path.is_file():
            raise CaptureError(
                f"{path} is a pipe or a device; a capture is a file, or a folder of .mat files"
            )
        with path.open("rb") as stream:
            head = stream.read(4096)
    except OSError as error:
        raise CaptureError(f"{path} cannot be read: {error.strerror or error}") from error
    if not head:
        raise CaptureError(f"{path.name} is empty")
    if any(head[offset : offset + 8] == _HDF5_SIGNATURE for offset in (0, 512, 1024, 2048)):
        return _list_hdf5(path, head)
    if head[126:128] in (b"IM", b"MI") and 1 in head[124:126]:
        return _list_mat5(path)
    if head.startswith((b"#?RADIANCE", b"#?RGBE")):
        return Contents(path, "radiance", {})
    if head[4:8] == b"ftyp":
        return Contents(path, "mp4", {})
    if head.startswith(b"MATLAB 7.3"):
        raise CaptureError(
            f"{path.name} begins like a MATLAB v7.3 file but holds no HDF5 data; it is damaged or truncated"
        )
    raise CaptureError(
        f"{path.name} is {_kind(head)}; a capture is an HDF5, MATLAB or Radiance HDR file "
        "(docs/own-data.md: how to write one)"
    )


def _kind(head: bytes) -> str:
    """What a file is that is no capture, by its first bytes."""
    for start, kind in OTHER_KINDS.items():
        if head.startswith(start):
            return kind
    if head.isascii() and not any(c < 32 and c not in b"\t\n\r" for c in head):
        return "a text file"
    return f"neither HDF5, MATLAB nor Radiance HDR: it begins with {head[:8]!r}"


def open_folder(path: Path) -> Contents:
    """The arrays of all ``.mat`` files of a folder together; unreadable files are passed over.

    Raises:
        CaptureError: there is no readable one.
    """
    parts: dict[str, Contents] = {}
    entries: dict[str, Entry] = {}
    for file in sorted(path.glob("*.mat"))[:64]:
        try:
            part = open_contents(file)
        except CaptureError:
            continue
        parts |= dict.fromkeys(part.entries, part)
        entries |= part.entries
    if not entries:
        raise CaptureError(f"{path} is a folder without readable .mat files; name the capture file itself")
    return Contents(path, "folder", entries, parts=parts)


def _list_hdf5(path: Path, head: bytes) -> Contents:
    entries: dict[str, Entry] = {}
    matlab = head.startswith(b"MATLAB 7.3")
    with _damage(path), h5py.File(path, "r") as file:
        for name, item in _hard_links(file):
            members = {name: item}
            if isinstance(item, h5py.Group):
                members = {f"{name}.{member}": value for member, value in _hard_links(item)}
            if len(entries) + len(members) > _MOST:
                raise CaptureError(f"{path.name} holds more than {_MOST} arrays; a capture holds a few")
            for label, dataset in members.items():
                if isinstance(dataset, h5py.Dataset) and not dataset.is_virtual and not dataset.external:
                    matlab = matlab or "MATLAB_class" in dataset.attrs
                    shape, dtype = dataset.shape or (), dataset.dtype
                    numeric = dataset.shape is not None and dtype.kind in "uifb"
                    size = math.prod(shape) * dtype.itemsize
                    chunks, limits = dataset.chunks or (), dataset.maxshape or ()
                    if any(
                        limit is not None and limit < chunk
                        for limit, chunk in zip(limits, chunks, strict=False)
                    ):
                        raise CaptureError(
                            f"{label} in {path.name} has chunks {chunks} where its shape is {limits} at "
                            "most; the file is damaged"
                        )
                    chunk = math.prod(chunks) * dtype.itemsize
                    if chunk > max(size, _CHUNK):
                        raise CaptureError(
                            f"{label} in {path.name} has {size / 1e6:.3g} MB in a chunk of {chunk / 1e6:.0f} "
                            "MB; store it in smaller chunks"
                        )
                    entries[label] = Entry(shape, numeric, size, dataset.shape is None)
    if matlab:
        entries = {name: replace(entry, shape=entry.shape[::-1]) for name, entry in entries.items()}
    return Contents(path, "hdf5", entries, matlab)


def _hard_links(group: h5py.Group) -> list[tuple[str, h5py.Group | h5py.Dataset]]:
    """What lies in the file itself; links to other places and files are not followed."""
    if len(group) > _MOST:
        raise CaptureError(f"a group holds {len(group)} arrays; a capture holds a few")
    return [(name, group[name]) for name in group if isinstance(group.get(name, getlink=True), h5py.HardLink)]


def _list_mat5(path: Path) -> Contents:
    with _damage(path):
        listed = list_mat5(path, _MOST)
    # whole doubles may be stored in single bytes, so the least size counts
    entries = {name: Entry(shape, numeric, math.prod(shape)) for name, (shape, numeric) in listed.items()}
    return Contents(path, "mat5", entries)


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Whatever a file library raises on a damaged file, as one sentence."""
    try:
        yield
    except CaptureError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise CaptureError(f"{path.name} is damaged or truncated ({reason})") from error


def heap_ends(path: Path, place: int) -> bool:
    """Whether HDF5 comes to the end of the heap in which a text of any length lies.

    It goes from object to object by the lengths that stand there, and never ends where one of no length
    follows. Addresses and lengths are taken for eight bytes long, as they are in all but very old files.

    Args:
        path: of the file.
        place: of the text's length (4 bytes) and its heap's address (8 bytes) in the file.

    Returns:
        False where it would go on for ever, or beyond the heap.
    """
    with path.open("rb") as file:

        def number(at: int, size: int = 8) -> int:
            file.seek(at)
            return int.from_bytes(file.read(size), "little")

        heap, at = number(place + 4), 16
        if not heap < path.stat().st_size:
            return True  # of that HDF5 itself takes notice
        size = number(heap + 8)
        while at + 16 <= size:
            index, length = number(heap + at, 2), number(heap + at + 8)
            need = 16 + -(-length // 8) * 8 if index else length
            if not 16 <= need <= size - at:
                return False
            at += need
        return True
