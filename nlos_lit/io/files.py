"""Whole files, and JSON.

Every writer of results fills a hidden file beside its target, waits until it is on the disk, and renames it:
an interrupt or a full disk leaves the old file or none, never half a file.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np


@contextlib.contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Write a file that appears under its name when it is complete, and otherwise not at all.

    Args:
        path: the target; missing folders are made, an old file is replaced.

    Yields:
        A hidden path beside the target, with its suffix, to write to; it becomes ``path`` when the block ends
        well and vanishes when it raises.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_file(f"{folder}/note.txt") as partial:
        ...         _ = partial.write_text("all of it")
        ...     [path.name for path in Path(folder).iterdir()]
        ['note.txt']
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial-{os.getpid()}{path.suffix}")
    try:
        yield partial
        with partial.open("rb") as written:
            os.fsync(written.fileno())
        os.replace(partial, path)
    except OSError as error:
        error.filename = error.filename or str(path)  # a write that fails names none
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path | str, data: Any) -> None:
    """Write strict JSON, two spaces deep.

    Args:
        path: the target, written whole or not at all.
        data: anything that :func:`plain` takes.

    Raises:
        TypeError: ``data`` holds something that has no plain form; nothing is written.
    """
    text = json.dumps(plain(data), indent=2, ensure_ascii=False, allow_nan=False)
    with whole_file(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


def write_depth(path: Path | str, depth: np.ndarray) -> None:
    """Write a depth map as ``.npy``.

    Args:
        path: the target, written whole or not at all.
        depth: ``[nx, ny]`` z, m, NaN where nothing is seen; kept as float32.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_depth(f"{folder}/depth.npy", np.array([[0.5, np.nan]]))
        ...     np.load(f"{folder}/depth.npy").tolist()
        [[0.5, nan]]
    """
    content = io.BytesIO()
    np.save(content, depth.astype(np.float32), allow_pickle=False)
    with whole_file(path) as partial:
        partial.write_bytes(content.getbuffer())


def plain(data: Any) -> Any:
    """``data`` in JSON's own types.

    Dataclasses, arrays and NumPy numbers become plain values, paths strings, NaN and infinities None.

    Raises:
        TypeError: something has no plain form.

    Examples:
        >>> plain({"depth": np.array([0.5, np.nan]), 3: Path("run")})
        {'depth': [0.5, None], '3': 'run'}
    """
    if dataclasses.is_dataclass(data) and not isinstance(data, type):
        return plain({field.name: getattr(data, field.name) for field in dataclasses.fields(data)})
    if isinstance(data, dict):
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [plain(value) for value in data]
    if isinstance(data, (np.ndarray, np.generic)):
        return plain(data.tolist())
    if isinstance(data, Path):
        return str(data)
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if data is None or isinstance(data, (str, int)):
        return data
    raise TypeError(f"{type(data).__name__} has no JSON form")
