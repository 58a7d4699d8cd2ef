"""Results on disk: volumes (HDF5), points (PLY), meshes (PLY) and JSON.

Every writer fills a hidden file beside its target and renames it: an interrupt leaves the old file or none, never half a file.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from nlos_lit.errors import UserError
from nlos_lit.grid import VolumeGrid

PLY_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Points:
    """Hidden surface points.

    Args:
        positions: ``[N, 3]``, m, world frame.
        normals: ``[N, 3]``, unit vectors towards the relay wall's side of the surface.
        albedo: ``[N]``, the model's albedo at the point.
        intensity: ``[N]`` phasor intensity at the point, where known.

    Raises:
        ValueError: shapes disagree, values are NaN or infinite, or normals are not unit vectors (within 1e-3).
    """

    positions: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    intensity: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.positions)
        for name, shape in {"positions": (n, 3), "normals": (n, 3), "albedo": (n,), "intensity": (n,)}.items():
            if name == "intensity" and self.intensity is None:
                continue
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != shape:
                raise ValueError(f"{name} must be {list(shape)}; found shape {values.shape}")
            if not np.isfinite(values).all():
                raise ValueError(f"{name} of the points holds NaN or infinite values")
            object.__setattr__(self, name, values)
        if n and np.abs(np.linalg.norm(self.normals, axis=1) - 1).max() > 1e-3:
            raise ValueError("normals of the points must be unit vectors")

    def __len__(self) -> int:
        return len(self.positions)


@contextlib.contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Yields a path of the target's suffix to write to; it becomes ``path`` when the block ends well, else it vanishes."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial-{os.getpid()}{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_volume(path: Path | str, values: np.ndarray, grid: VolumeGrid, **extra_datasets: np.ndarray) -> None:
    """HDF5 with ``volume`` [nz, nx, ny] float32, its axes ``x``, ``y``, ``z`` in metres, and a dataset for each extra volume.

    Raises:
        ValueError: ``values`` or an extra volume is not of the grid's shape.
    """
    volumes = {"volume": values, **extra_datasets}
    for name, array in volumes.items():
        if np.shape(array) != tuple(grid.shape):
            raise ValueError(f"{name} has shape {np.shape(array)}, its grid {tuple(grid.shape)}")
    with whole_file(path) as partial, h5py.File(partial, "w") as file:
        file.attrs["frame"] = "relay wall near z = 0, hidden scene at z > 0, right-handed, +y up; x, y, z are voxel centres"
        file.attrs["origin"] = grid.origin
        file.attrs["pitch"] = grid.pitch
        for name in AXES:
            file.create_dataset(name, data=getattr(grid, name))
            file[name].attrs["unit"] = "m"
        for name, array in volumes.items():
            single = np.asarray(array, dtype=np.float32)
            file.create_dataset(name, data=single, compression="gzip", compression_opts=1, shuffle=True)
            file[name].attrs["unit"] = "1"
            file[name].attrs["axes"] = "z, x, y"


def read_volume(path: Path | str) -> tuple[np.ndarray, VolumeGrid, dict[str, np.ndarray]]:
    """What ``write_volume`` wrote: ``volume`` [nz, nx, ny] float32, its grid, and the extra datasets by name.

    Raises:
        UserError: the file is missing, is not HDF5, or holds no volume on a grid.
    """
    try:
        with h5py.File(path, "r") as file:
            origin, pitch = (tuple(float(v) for v in file.attrs[name]) for name in ("origin", "pitch"))
            volumes = {name: file[name][()] for name in file if name not in AXES}
            volume = volumes.pop("volume")
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is not a volume.h5 (a dataset 'volume', its grid as attributes): {error}") from error
    if volume.ndim != 3 or len(origin) != 3 or len(pitch) != 3:
        raise UserError(f"the volume of {path} must be [nz, nx, ny] with a grid of three axes; found shape {volume.shape}")
    return volume, VolumeGrid(origin, pitch, tuple(volume.shape)), volumes


def write_points(path: Path | str, points: Points) -> None:
    """Binary PLY with position (m), normal, ``albedo`` and ``intensity`` as floats, and a grey colour for viewers."""
    columns = {name: points.positions[:, k] for k, name in enumerate(AXES)}
    columns |= {f"n{name}": points.normals[:, k] for k, name in enumerate(AXES)}
    columns["albedo"] = points.albedo
    if points.intensity is not None:
        columns["intensity"] = points.intensity
    kinds = [(name, "<f4") for name in columns] + [(name, "u1") for name in ("red", "green", "blue")]
    columns |= dict.fromkeys(("red", "green", "blue"), np.round(255 * grey_levels(points.albedo)))
    rows = np.empty(len(points), dtype=kinds)
    for name, values in columns.items():
        rows[name] = values
    words = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment metres; albedo is exact, the grey colour is for looking"]
    header += [f"element vertex {len(points)}", *(f"property {words[kind]} {name}" for name, kind in kinds), "end_header", ""]
    with whole_file(path) as partial:
        partial.write_bytes("\n".join(header).encode("ascii") + rows.tobytes())


def grey_levels(albedo: np.ndarray) -> np.ndarray:
    """``[N]`` brightness in 0 … 1 to look at; relative: the albedo's 98th percentile is white."""
    white = np.quantile(albedo, 0.98) if len(albedo) else 0.0
    return np.clip(albedo / white, 0, 1) if white > 0 else np.zeros(len(albedo))


def read_points(path: Path | str) -> Points:
    """What ``write_points`` wrote; colours are not read back.

    Raises:
        UserError: the file is missing, cut, not a binary little-endian PLY, or without normals or albedo.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise UserError(f"cannot read the points of {path}: {error.strerror}") from error
    head, found, body = content.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not found or lines[0] != ["ply"] or ["format", "binary_little_endian", "1.0"] not in lines:
        raise UserError(f"{path} is not a binary little-endian PLY file")
    counts = [line[2] for line in lines if line[:1] == ["element"] and line[1:2] == ["vertex"] and len(line) == 3]
    fields = [line[1:] for line in lines if line[:1] == ["property"]]
    names = [field[-1] for field in fields if len(field) == 2 and field[0] in PLY_TYPES]
    complete = len(set(names)) == len(fields) and {"x", "y", "z", "nx", "ny", "nz", "albedo"} <= set(names)
    if not complete or len(counts) != 1 or not counts[0].isdigit():
        raise UserError(f"{path} must hold one list of points with x, y, z, nx, ny, nz and albedo, all once; found {names}")
    kind, count = np.dtype([(field[1], PLY_TYPES[field[0]]) for field in fields]), int(counts[0])
    if len(body) < count * kind.itemsize:
        raise UserError(f"{path} is cut: its {count} points need {count * kind.itemsize} bytes, {len(body)} are there")
    rows = np.frombuffer(body, dtype=kind, count=count)
    positions, normals = (np.stack([rows[prefix + name] for name in AXES], axis=1) for prefix in ("", "n"))
    try:
        return Points(positions, normals, rows["albedo"], rows["intensity"] if "intensity" in names else None)
    except ValueError as error:
        raise UserError(f"{path} is damaged: {error}") from error


def write_json(path: Path | str, data: Any) -> None:
    """Strict JSON, two spaces deep; dataclasses, arrays and NumPy numbers become plain values, NaN and infinities become null."""
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
