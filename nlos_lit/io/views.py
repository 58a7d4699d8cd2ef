"""What a run leaves to look at: transients over the wall, volume, points and mesh, fit for a page."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import archived
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.files import plain, whole_file
from nlos_lit.io.points import Points

FILE = "view.npz"
LEVELS = 65534  # steps of a stored transient; one more says that a bin was not recorded
NOT_RECORDED = 65535
FACES = 255  # steps of a stored voxel


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Args:
        vertices: ``[V, 3]``, m.
        triangles: ``[F, 3]`` rows of ``vertices``.
        grey: ``[V]`` brightness, 0 … 1.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    grey: np.ndarray


@dataclass(frozen=True)
class View:
    """The state of a run, or of a diagnosis, as a page shows it.

    Args:
        facts: JSON-serialisable: ``name``, ``status`` (running, interrupted or finished), ``said`` (sentences
            on what was found), where it came from.
        spots: ``[S]`` rows of the capture.
        places: ``[S, 2]`` scanned wall points, m.
        path: ``(start of the first bin, length of a bin)``, m of optical path.
        counts: ``[S, T]`` measured, NaN where a bin was not recorded.
        models: name → ``[S, T]`` expected counts, the plainest model first.
        clouds: name → points of the hidden surface.
        meshes: name → triangles.
        volume: ``[nz, nx, ny]`` intensity with its grid; None where there is none.
    """

    facts: dict[str, Any]
    spots: np.ndarray
    places: np.ndarray
    path: tuple[float, float]
    counts: np.ndarray
    models: Mapping[str, np.ndarray] = field(default_factory=dict)
    clouds: Mapping[str, Points] = field(default_factory=dict)
    meshes: Mapping[str, Mesh] = field(default_factory=dict)
    volume: tuple[np.ndarray, VolumeGrid] | None = None


def packed(view: View) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A view in few bytes.

    Transients become whole numbers of √(largest) / 65534, so that what is lost is the same small share of
    counting noise at all brightnesses; whole counts come back exactly where none is above 32 766. Voxels
    have 255 levels.

    Args:
        view: that is kept or shown.

    Returns:
        JSON-serialisable header, and arrays by name.
    """
    header: dict[str, Any] = {"facts": plain(view.facts), "path": list(view.path)}
    header["whole"] = bool((view.counts == np.floor(view.counts))[np.isfinite(view.counts)].all())
    largest = max([1e-30, *(float(np.nanmax(v, initial=0.0)) for v in (view.counts, *view.models.values()))])
    header["largest"] = largest
    arrays = {
        "spots": view.spots.astype(np.uint32),
        "places": view.places.astype(np.float32),
        "counts": _squeezed(view.counts, largest),
    }
    for kind, group in (("models", view.models), ("clouds", view.clouds), ("meshes", view.meshes)):
        header[kind] = list(group)
    for k, values in enumerate(view.models.values()):
        arrays[f"model{k}"] = _squeezed(values, largest)
    for k, points in enumerate(view.clouds.values()):
        columns = (points.positions, points.normals, points.albedo[:, None])
        arrays[f"cloud{k}"] = np.concatenate(columns, axis=1).astype(np.float32)
    for k, mesh in enumerate(view.meshes.values()):
        rows = np.concatenate((mesh.vertices, mesh.grey[:, None]), axis=1)
        arrays[f"vertices{k}"] = rows.astype(np.float32)
        arrays[f"triangles{k}"] = mesh.triangles.astype(np.uint32)
    header["grid"] = None
    if view.volume is not None:
        values, grid = view.volume
        top = float(values.max(initial=0.0)) or 1.0
        header["grid"] = {"origin": grid.origin, "pitch": grid.pitch, "shape": grid.shape, "largest": top}
        arrays["volume"] = np.round(np.clip(values / top, 0, 1) * FACES).astype(np.uint8)
    return header, arrays


def write_view(folder: Path | str, view: View) -> None:
    """Keep a view as ``view.npz`` of a run's folder, written whole or not at all.

    Args:
        folder: of the run.
        view: see :class:`View`.

    Examples:
        >>> import tempfile
        >>> wall, counts = np.zeros((1, 2)), np.array([[0.0, 3.0, np.nan]])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_view(folder, View({"name": "two bins"}, np.array([7]), wall, (1.0, 0.1), counts))
        ...     back = read_view(folder)
        >>> back.facts["name"], back.spots.tolist(), back.counts.tolist()
        ('two bins', [7], [[0.0, 3.0, nan]])
    """
    header, arrays = packed(view)
    content = io.BytesIO()  # zip files do not survive a disk that becomes full under their hands
    np.savez_compressed(content, header=np.array(json.dumps(header)), allow_pickle=False, **arrays)
    with whole_file(Path(folder) / FILE) as partial:
        partial.write_bytes(content.getbuffer())


def read_view(folder: Path | str) -> View:
    """Read what :func:`write_view` wrote.

    Args:
        folder: of the run.

    Returns:
        The view; transients and voxels within the steps that are kept.

    Raises:
        UserError: there is none, or it is damaged.
    """
    file = Path(folder) / FILE
    try:
        content = io.BytesIO(archived(file, packed=True).read_bytes())  # NumPy leaves a damaged file open
        with np.load(content, allow_pickle=False) as kept:
            header = json.loads(str(kept["header"]))
            arrays = {name: kept[name] for name in kept.files if name != "header"}
        return _unpacked(header, arrays)
    except FileNotFoundError as error:
        raise UserError(
            f"{folder} holds no {FILE}: it is no run's folder, or the run is of an earlier version; "
            "give the folder that a train or diagnose command has named at its end"
        ) from error
    except Exception as error:  # a foreign file may be wrong in any way
        raise UserError(f"{file} is damaged: {error}") from error


def _unpacked(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> View:
    largest, whole = float(header["largest"]), bool(header["whole"])
    counts = _stretched(arrays["counts"], largest)
    clouds, meshes = {}, {}
    for k, name in enumerate(header["clouds"]):
        rows = arrays[f"cloud{k}"].astype(np.float64)
        clouds[name] = Points(rows[:, :3], rows[:, 3:6], rows[:, 6])
    for k, name in enumerate(header["meshes"]):
        rows = arrays[f"vertices{k}"].astype(np.float64)
        meshes[name] = Mesh(rows[:, :3], arrays[f"triangles{k}"].astype(np.int64), rows[:, 3])
    volume = None
    if header["grid"] is not None:
        grid = header["grid"]
        where = VolumeGrid(*(tuple(grid[name]) for name in ("origin", "pitch", "shape")))
        volume = (arrays["volume"] * np.float32(grid["largest"] / FACES), where)
    return View(
        facts=header["facts"],
        spots=arrays["spots"].astype(np.int64),
        places=arrays["places"].astype(np.float64),
        path=(float(header["path"][0]), float(header["path"][1])),
        counts=np.round(counts) if whole else counts,
        models={name: _stretched(arrays[f"model{k}"], largest) for k, name in enumerate(header["models"])},
        clouds=clouds,
        meshes=meshes,
        volume=volume,
    )


def _squeezed(values: np.ndarray, largest: float) -> np.ndarray:
    steps = np.round(LEVELS * np.sqrt(np.clip(values, 0, None) / largest))
    return np.where(np.isfinite(values), steps, NOT_RECORDED).astype(np.uint16)


def _stretched(steps: np.ndarray, largest: float) -> np.ndarray:
    return np.where(steps == NOT_RECORDED, np.nan, largest * (steps / LEVELS) ** 2)
