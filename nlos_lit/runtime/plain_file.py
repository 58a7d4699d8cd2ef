"""Results on disk as numbers, words and arrays: whatever a file says, reading it runs none of it.

A file is a NumPy archive without pickles. Its entry ``tree`` is JSON and says how the other entries, arrays,
make up the result. An object is kept as the name of its class and its parts; a reader makes it again by its
own code, and only of kinds that it was told of.
"""

from __future__ import annotations

import inspect
import io
import json
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import archived

NO_OBJECTS: Mapping[str, Any] = MappingProxyType({})
# NumPy parses the head of an array as Python, which fails at times in Python 3.11 where two threads do it at
# once: "AST constructor recursion depth mismatch", python/cpython#106905.
ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Kind:
    """How objects of one class are taken apart and made again.

    Args:
        of: the class; its name is what a file holds.
        parts: of an object, by name.
        make: an object from its parts.
    """

    of: type
    parts: Callable[[Any], Mapping[str, Any]]
    make: Callable[[dict[str, Any]], Any]


def record(of: type) -> Kind:
    """The kind of a dataclass or named tuple, whose fields are its parts."""
    names = list(inspect.signature(of).parameters)
    return Kind(of, lambda value: {name: getattr(value, name) for name in names}, lambda parts: of(**parts))


def write_plain(
    file: Path, value: Any, kinds: Sequence[Kind] = (), shared: Mapping[str, Any] = NO_OBJECTS
) -> None:
    """Write a result; the file appears when it is whole.

    Args:
        file: to write.
        value: None, numbers, strings, tensors and arrays, in lists, tuples and dicts with string keys, and
            objects of ``kinds``.
        kinds: of objects; the first whose class fits is taken.
        shared: objects that are kept as names alone, wherever they occur in ``value``.

    Raises:
        TypeError: something in ``value`` is of no such type.
    """
    arrays: dict[str, np.ndarray] = {}
    names = {id(thing): name for name, thing in shared.items()}

    def apart(thing: Any) -> Any:
        if thing is None or isinstance(thing, (bool, int, float, str)):
            return thing
        if id(thing) in names:
            return {"shared": names[id(thing)]}
        if isinstance(thing, (Tensor, np.ndarray)):
            key = str(len(arrays))
            arrays[key] = thing if isinstance(thing, np.ndarray) else thing.detach().cpu().numpy()
            return {"array" if isinstance(thing, np.ndarray) else "tensor": key}
        for kind in kinds:
            if isinstance(thing, kind.of):
                return {"object": [kind.of.__name__, apart(dict(kind.parts(thing)))]}
        if type(thing) is dict and all(isinstance(key, str) for key in thing):
            return {"dict": {key: apart(part) for key, part in thing.items()}}
        if type(thing) in (list, tuple):
            return {type(thing).__name__: [apart(part) for part in thing]}
        raise TypeError(f"{type(thing).__name__} cannot be kept in a plain file")

    tree = json.dumps(apart(value)).encode()
    whole = io.BytesIO()
    np.savez(whole, tree=np.frombuffer(tree, np.uint8), **arrays)  # type: ignore[arg-type]  # arrays, not flags
    write_whole(file, whole.getvalue())


def write_whole(file: Path, content: bytes) -> None:
    """Write a file that appears when it is whole.

    Args:
        file: to write; missing folders are made.
        content: of it.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.{threading.get_ident()}.part")
    try:
        with part.open("wb") as written:
            written.write(content)
            written.flush()
            os.fsync(written.fileno())
        part.rename(file)
    except OSError as error:
        error.filename = error.filename or str(file)  # a write that fails names none
        raise
    finally:
        part.unlink(missing_ok=True)


def read_plain(file: Path, kinds: Sequence[Kind] = (), shared: Mapping[str, Any] = NO_OBJECTS) -> Any:
    """What :func:`write_plain` has written.

    Args:
        file: to read; it may come from anywhere.
        kinds: of objects that may be made.
        shared: objects by the names that they were kept as.

    Returns:
        The value that was written, tensors on the CPU.

    Raises:
        UserError: the file is damaged, or no such file.
    """
    makers = {kind.of.__name__: kind.make for kind in kinds}

    def together(tree: Any, arrays: Mapping[str, np.ndarray]) -> Any:
        if not isinstance(tree, dict):
            return tree
        ((what, held),) = tree.items()
        if what == "shared":
            return shared[held]
        if what in ("tensor", "array"):
            return torch.from_numpy(arrays[held]) if what == "tensor" else arrays[held]
        if what == "object":
            name, parts = held
            return makers[name](together(parts, arrays))
        if what == "dict":
            return {key: together(part, arrays) for key, part in held.items()}
        return {"list": list, "tuple": tuple}[what](together(part, arrays) for part in held)

    try:
        content = io.BytesIO(archived(file).read_bytes())
        with ONE_AT_A_TIME, np.load(content, allow_pickle=False) as archive:
            return together(json.loads(archive["tree"].tobytes()), archive)
    except Exception as error:  # a foreign file may be wrong in any way
        raise not_ours(file) from error


def not_ours(file: Path) -> UserError:
    """The refusal of a file that does not hold what it should."""
    return UserError(f"{file} is damaged, or not written by this program: move it away")
