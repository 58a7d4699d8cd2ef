"""Results on disk: volumes (HDF5), points (PLY), meshes (PLY) and JSON.

Every writer fills a hidden file beside its target and renames it: an interrupt leaves the old file or none,
never half a file.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np


@contextlib.contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Yields a path of the target's suffix to write to; it becomes ``path`` when the block ends well, else it
    vanishes.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial-{os.getpid()}{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path | str, data: Any) -> None:
    """Strict JSON, two spaces deep; dataclasses, arrays and NumPy numbers become plain values, NaN and
    infinities become null.
    """
    text = json.dumps(plain(data), indent=2, ensure_ascii=False, allow_nan=False)
    with whole_file(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


def plain(data: Any) -> Any:
    """``data`` in JSON's own types; raises TypeError for anything that has no plain form."""
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
