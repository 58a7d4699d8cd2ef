"""Numeric arrays of MATLAB v5–v7.2 files, and those in their structs.

Written from The MathWorks' "MAT-File Format" document. Only numbers are ever decoded: cells, objects,
function handles and text are listed and skipped, every length is checked against the bytes there are, and
nothing in a file can run code. (General readers follow the file's lengths and types unchecked and can crash
the interpreter on a damaged file.)
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nlos_lit.capture.errors import CaptureError

_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}  # mi* codes
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 6, 14, 15
_STRUCT, _NUMBERS = 2, range(6, 16)  # mx* classes
_HEAD = 65536  # bytes that a matrix' name and shape lie in, packed or not
_STRUCTS = 2**30  # bytes of packed structs that are unpacked to list a file
_INFLATION = 1100  # deflate cannot exceed 1032-fold (zlib.net/zlib_tech.html)


@dataclass(frozen=True)
class Variable:
    """A matrix: its name, shape, class and the undecoded rest of its body."""

    name: str
    shape: tuple[int, ...]
    kind: int
    complex: bool
    rest: memoryview

    @property
    def numeric(self) -> bool:
        """Whether it holds real numbers."""
        return self.kind in _NUMBERS and not self.complex


def list_mat5(path: Path, most: int) -> dict[str, tuple[tuple[int, ...], bool]]:
    """Shape and whether it holds real numbers, by name; fields of scalar structs as ``struct.field``.

    Args:
        path: of the file.
        most: arrays that it may hold.

    Returns:
        name → shape, numeric.

    Raises:
        CaptureError: it holds more, or packed structs of a size that would take long to list.
        ValueError: the bytes are not what the file says they are (zlib's errors pass through, too).
    """
    found: dict[str, tuple[tuple[int, ...], bool]] = {}
    too_many = CaptureError(f"{path.name} holds more than {most} arrays; a capture holds a few")
    left = _STRUCTS
    with path.open("rb") as stream:
        order = _order(stream)
        for number, element in enumerate(_variables(stream, order)):
            if number == most:
                raise too_many
            variable = _peek(element.kind, element.read(_HEAD), order)
            if variable is None:
                continue
            found[variable.name] = (variable.shape, variable.numeric)
            if variable.kind == _STRUCT and math.prod(variable.shape) == 1:
                body = element.read()
                left -= _unpacked(body, order) if element.kind == _COMPRESSED else 0
                if left < 0:
                    raise CaptureError(
                        f"{path.name} holds packed structs of more than {_STRUCTS / 1e9:.1f} GB; save "
                        "the arrays by themselves, or without compression"
                    )
                for name, field in _fields(_whole(element.kind, body, order), order):
                    if len(found) > most:
                        raise too_many
                    found[f"{variable.name}.{name}"] = (field.shape, field.numeric)
    return found


def read_mat5(path: Path, name: str) -> np.ndarray:
    """One numeric array, in the type it is stored in (MATLAB stores whole doubles in fewer bytes).

    Args:
        path: of the file.
        name: of the array; ``struct.field`` for a field of a scalar struct.

    Returns:
        the array in MATLAB's axis order.

    Raises:
        CaptureError: it is not there any more.
        ValueError: the bytes are not what the file says they are (zlib's errors pass through, too).
    """
    wanted, _, member = name.partition(".")
    with path.open("rb") as stream:
        order = _order(stream)
        for element in _variables(stream, order):
            variable = _peek(element.kind, element.read(_HEAD), order)
            if variable is None or variable.name != wanted:
                continue
            variable = _whole(element.kind, element.read(), order)
            if member:
                variable = dict(_fields(variable, order))[member]
            return _numbers(variable, order)
    raise CaptureError(f"{path.name} lost {name} while it was read")


@dataclass(frozen=True)
class _Element:
    """A data element of the file: its type, and where its body lies.

    It is read and not mapped: a file that is cut while it is mapped would end the process by SIGBUS.
    """

    stream: BinaryIO
    kind: int
    start: int
    size: int

    def read(self, most: int | None = None) -> memoryview:
        """The body, or at ``most`` so many bytes of it."""
        wanted = self.size if most is None else min(self.size, most)
        self.stream.seek(self.start)
        found = self.stream.read(wanted)
        if len(found) < wanted:
            raise ValueError(f"an element of {self.size} bytes was cut short while it was read")
        return memoryview(found)


def _order(stream: BinaryIO) -> str:
    return ">" if stream.read(128)[126:128] == b"MI" else "<"


def _variables(stream: BinaryIO, order: str) -> Iterator[_Element]:
    """The elements of the file itself; compressed ones are not padded."""
    end, at = os.fstat(stream.fileno()).st_size, 128
    while at < end:
        stream.seek(at)
        kind, start, size, after = _tag(memoryview(stream.read(8)), 0, order, end - at)
        yield _Element(stream, kind, at + start, size)
        at += after if kind != _COMPRESSED else start + size


def _elements(view: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and body of each data element inside a matrix; bodies are padded to eight bytes."""
    at = 0
    while at < len(view):
        kind, start, size, after = _tag(view, at, order)
        yield kind, view[start : start + size]
        at = after


def _tag(view: memoryview, at: int, order: str, end: int | None = None) -> tuple[int, int, int, int]:
    """Type, start and size of the body at ``at``, and where the next element begins.

    Bodies end before ``end``; None: with the view.
    """
    end = len(view) if end is None else end
    if at + 8 > len(view):
        raise ValueError("an element's tag lies beyond the end")
    first, size = struct.unpack_from(f"{order}II", view, at)
    if first >> 16:  # small element: size, type and up to four bytes in one tag
        kind, size, start, after = first & 0xFFFF, first >> 16, at + 4, at + 8
        if size > 4:
            raise ValueError(f"a small element of {size} bytes")
    else:
        kind, start = first, at + 8
        after = start + size + -size % 8
    if start + size > end:
        raise ValueError(f"an element of {size} bytes where {end - start} are left")
    return kind, start, size, after


def _peek(kind: int, body: memoryview, order: str) -> Variable | None:
    """A top-level matrix' name and shape, unpacking no more than its head; None for other elements."""
    if kind == _COMPRESSED:
        head = memoryview(zlib.decompressobj().decompress(body, _HEAD))
        if len(head) < 8:
            raise ValueError("a compressed variable is cut short")
        inner, _ = struct.unpack_from(f"{order}II", head)
        return _matrix(head[8:], order) if inner == _MATRIX else None
    return _matrix(body, order) if kind == _MATRIX else None


def _unpacked(body: memoryview, order: str) -> int:
    """Bytes that a packed matrix says it has."""
    size: int = struct.unpack_from(f"{order}I", zlib.decompressobj().decompress(body, 8), 4)[0]
    return size


def _whole(kind: int, body: memoryview, order: str) -> Variable:
    if kind != _COMPRESSED:
        return _matrix(body, order)
    stream = zlib.decompressobj()
    stream.decompress(body, 8)  # the tag
    size = _unpacked(body, order)
    if size > _INFLATION * len(body):
        raise ValueError(f"{len(body)} compressed bytes cannot hold {size}")
    data = stream.decompress(stream.unconsumed_tail, size + 64)  # to the end, so that zlib checks its sum
    if len(data) < size or not stream.eof:
        raise ValueError("a compressed variable is cut short")
    return _matrix(memoryview(data)[:size], order)


def _matrix(body: memoryview, order: str) -> Variable:
    if len(body) == 0:  # an empty field
        return Variable("", (0, 0), 6, False, body)
    parts = []
    at = 0
    for expected in (_UINT32, _INT32, _INT8):
        kind, start, size, at = _tag(body, at, order)
        if kind != expected:
            raise ValueError(f"a matrix header with data type {kind} where {expected} belongs")
        parts.append(bytes(body[start : start + size]))
    flags, dimensions, name = parts
    if len(flags) != 8 or len(dimensions) % 4 or not 8 <= len(dimensions) <= 128:
        raise ValueError("a matrix header of the wrong length")
    shape = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
    if min(shape) < 0:
        raise ValueError(f"a matrix of shape {shape}")
    bits = struct.unpack(f"{order}II", flags)[0]
    return Variable(name.decode("latin-1").rstrip("\0"), shape, bits & 0xFF, bool(bits & 0x800), body[at:])


def _fields(variable: Variable, order: str) -> Iterator[tuple[str, Variable]]:
    """Names and matrices of a scalar struct."""
    parts = _elements(variable.rest, order)
    (_, length), (_, names) = next(parts), next(parts)
    width = struct.unpack(f"{order}i", length)[0]
    if width < 1 or len(names) % width:
        raise ValueError(f"struct field names of {width} bytes each")
    for at in range(0, len(names), width):
        kind, body = next(parts)
        if kind != _MATRIX:
            raise ValueError(f"a struct field of data type {kind}")
        name = bytes(names[at : at + width]).split(b"\0")[0].decode("latin-1")
        yield name, _matrix(body, order)


def _numbers(variable: Variable, order: str) -> np.ndarray:
    if len(variable.rest) == 0 and math.prod(variable.shape) == 0:
        return np.zeros(variable.shape)
    kind, start, size, _ = _tag(variable.rest, 0, order)
    if kind not in _TYPES:
        raise ValueError(f"numbers of data type {kind}")
    dtype = np.dtype(order + _TYPES[kind])
    if size != math.prod(variable.shape) * dtype.itemsize:
        raise ValueError(f"{size} bytes for an array of shape {variable.shape}")
    values = np.frombuffer(variable.rest, dtype, size // dtype.itemsize, start)
    return values.reshape(variable.shape, order="F").astype(dtype.newbyteorder("="))
