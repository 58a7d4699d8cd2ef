"""Points on the hidden surface, and binary PLY files of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlos_lit.capture.errors import UserError
from nlos_lit.io.files import whole_file

PLY_TYPES = {
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
    "uchar": "u1",
    "uint8": "u1",
}


@dataclass(frozen=True)
class Points:
    """Hidden surface points.

    Args:
        positions: ``[N, 3]``, m, world frame.
        normals: ``[N, 3]``, unit vectors towards the relay wall's side of the surface.
        albedo: ``[N]``, the model's albedo at the point.
        intensity: ``[N]`` phasor intensity at the point, where known.

    Raises:
        ValueError: shapes disagree, values are NaN or infinite, or normals are not unit vectors (within
            1e-3).

    Examples:
        >>> points = Points(np.array([[0.0, 0.1, 0.8]]), np.array([[0.0, 0.0, -1.0]]), np.array([0.5]))
        >>> len(points), points.intensity is None
        (1, True)
    """

    positions: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    intensity: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.positions)
        for name, shape in {
            "positions": (n, 3),
            "normals": (n, 3),
            "albedo": (n,),
            "intensity": (n,),
        }.items():
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


def write_points(path: Path | str, points: Points) -> None:
    """Write points as binary PLY.

    Each has position (m), normal, ``albedo`` and, where known, ``intensity`` as floats, and a grey colour for
    viewers.

    Args:
        path: PLY file, written whole or not at all.
        points: any number of them, also none.

    Examples:
        >>> import tempfile
        >>> points = Points(np.array([[0.0, 0.25, 0.5]]), np.array([[0.0, 0.0, -1.0]]), np.array([0.5]))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_points(f"{folder}/points.ply", points)
        ...     back = read_points(f"{folder}/points.ply")
        >>> back.positions.tolist(), back.albedo.tolist()
        ([[0.0, 0.25, 0.5]], [0.5])
    """
    columns = {name: points.positions[:, k] for k, name in enumerate("xyz")}
    columns |= {f"n{name}": points.normals[:, k] for k, name in enumerate("xyz")}
    columns["albedo"] = points.albedo
    if points.intensity is not None:
        columns["intensity"] = points.intensity
    kinds = [(name, "<f4") for name in columns] + [(name, "u1") for name in ("red", "green", "blue")]
    columns |= dict.fromkeys(("red", "green", "blue"), np.round(255 * grey_levels(points.albedo)))
    rows = np.empty(len(points), dtype=kinds)
    for name, values in columns.items():
        rows[name] = values
    words = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment metres; albedo is exact, the grey colour is for looking",
    ]
    header += [
        f"element vertex {len(points)}",
        *(f"property {words[kind]} {name}" for name, kind in kinds),
        "end_header",
        "",
    ]
    with whole_file(path) as partial:
        partial.write_bytes("\n".join(header).encode("ascii") + rows.tobytes())


def grey_levels(albedo: np.ndarray) -> np.ndarray:
    """Brightness to look at: relative, the albedo's 98th percentile is white.

    Args:
        albedo: ``[N]``.

    Returns:
        ``[N]`` in 0 … 1.

    Examples:
        >>> grey_levels(np.array([0.0, 0.1, 0.2, 0.2])).tolist()
        [0.0, 0.5, 1.0, 1.0]
    """
    white = np.quantile(albedo, 0.98) if len(albedo) else 0.0
    return np.clip(albedo / white, 0, 1) if white > 0 else np.zeros(len(albedo))


def read_points(path: Path | str) -> Points:
    """Read what :func:`write_points` wrote; colours are not read back.

    Args:
        path: PLY file.

    Returns:
        The points, ``intensity`` only if the file has it.

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
    counts = [line[2] for line in lines if line[:2] == ["element", "vertex"] and len(line) == 3]
    fields = [line[1:] for line in lines if line[:1] == ["property"]]
    names = [field[-1] for field in fields if len(field) == 2 and field[0] in PLY_TYPES]
    complete = len(set(names)) == len(fields) and {"x", "y", "z", "nx", "ny", "nz", "albedo"} <= set(names)
    if not complete or len(counts) != 1 or not counts[0].isdigit():
        raise UserError(
            f"{path} must hold one list of points with x, y, z, nx, ny, nz and albedo, all once; "
            f"found {names}"
        )
    kind, count = np.dtype([(field[1], PLY_TYPES[field[0]]) for field in fields]), int(counts[0])
    if len(body) < count * kind.itemsize:
        raise UserError(
            f"{path} is cut: its {count} points need {count * kind.itemsize} bytes, {len(body)} are there"
        )
    rows = np.frombuffer(body, dtype=kind, count=count)
    positions, normals = (np.stack([rows[prefix + name] for name in "xyz"], axis=1) for prefix in ("", "n"))
    try:
        return Points(positions, normals, rows["albedo"], rows["intensity"] if "intensity" in names else None)
    except ValueError as error:
        raise UserError(f"{path} is damaged: {error}") from error
