"""What is really there: depth, normals and albedo as seen from the wall along z."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from data_modules.readers.contents import open_contents
from data_modules.simulate.mesh import Mesh
from data_modules.simulate.visibility import Occluder
from data_modules.whole_hdf5 import whole_hdf5
from nlos_lit.capture.errors import UserError


@dataclass(frozen=True)
class Truth:
    """The hidden surface on a regular lattice of (x, y), NaN where there is nothing.

    Args:
        x: ``[nx]`` lattice, m.
        y: ``[ny]`` lattice, m.
        depth: ``[nx, ny]`` z of the first surface along +z, m.
        normal: ``[nx, ny, 3]`` its unit normal, on the side seen from the wall.
        albedo: ``[nx, ny]`` its reflectance; 0 where the black back of a one-sided face is seen.
        mesh: the surface itself, None where only the view of it is known.
        clean: ``[S, T]`` radiance per bin and laser power before the sensor, where asked for.
        expected: ``[S, T]`` expected counts (response, exposure and background in), where asked for.
        gain: counts per unit of ``clean``.
    """

    x: np.ndarray
    y: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray
    mesh: Mesh | None = None
    clean: np.ndarray | None = None
    expected: np.ndarray | None = None
    gain: float | None = None


def view_from_wall(mesh: Mesh, x: np.ndarray, y: np.ndarray, *, two_sided: bool = False) -> Truth:
    """Look at a mesh from the wall along z.

    Args:
        mesh: the hidden scene.
        x: ``[nx]`` lattice through which to look, m.
        y: ``[ny]`` lattice, m.
        two_sided: faces reflect from both sides; otherwise their backs are black.

    Returns:
        depth, normals and albedo of the first surface met.
    """
    start = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=2).reshape(-1, 3)
    distance, face, weights = Occluder(mesh).first_hit(start, np.broadcast_to([0.0, 0.0, 1.0], start.shape))
    hit = np.isfinite(distance)
    face, weights = face[hit], weights[hit]
    depth, albedo = np.full(len(start), np.nan), np.full(len(start), np.nan)
    normal = np.full(start.shape, np.nan)
    corners = mesh.corners[face]
    depth[hit] = (weights * corners[:, :, 2]).sum(axis=1)
    vectors = mesh.face_vectors[face]
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    behind = unit[:, 2] > 0
    normal[hit] = np.where(behind[:, None], -unit, unit)
    albedo[hit] = np.where(
        behind & (not two_sided), 0.0, (weights * mesh.albedo[mesh.faces[face]]).sum(axis=1)
    )
    shape = (len(x), len(y))
    return Truth(
        np.asarray(x),
        np.asarray(y),
        depth.reshape(shape),
        normal.reshape(*shape, 3),
        albedo.reshape(shape),
        mesh,
    )


def save_truth(path: str | Path, truth: Truth) -> None:
    """Write the truth as HDF5.

    The file holds ``depth``, ``normal``, ``albedo`` ``[nx, ny(, 3)]``, ``x``, ``y``, ``mesh/…`` and the
    transients, if any.

    Args:
        path: where to; a file there is replaced.
        truth: what to write.

    Raises:
        CaptureError: it cannot be written.
    """
    with whole_hdf5(Path(path)) as file:
        for name in ("x", "y", "depth", "normal", "albedo", "clean", "expected"):
            values = getattr(truth, name)
            if values is not None:
                file.create_dataset(name, data=values.astype(np.float32), compression="gzip")
        for name in ("vertices", "faces", "albedo") if truth.mesh is not None else ():
            file.create_dataset(f"mesh/{name}", data=getattr(truth.mesh, name), compression="gzip")
        if truth.gain is not None:
            file["gain"] = truth.gain


def load_truth(path: str | Path) -> Truth:
    """Read `save_truth`'s file, or one that has only ``depth``, ``normal``, ``x`` and ``y``.

    Args:
        path: of the file; where there is nothing, its depth is -1, 0 or NaN.

    Returns:
        the truth, NaN where there is nothing; albedo 1 where the file says none.

    Raises:
        UserError: no such file, not HDF5, damaged, or a key is missing.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"there is no ground-truth file {path}")
    if not h5py.is_hdf5(path):
        raise UserError(f"{path} is not an HDF5 file; ground truth is HDF5 with depth, normal, x and y")
    contents = open_contents(path)
    missing = [name for name in ("x", "y", "depth", "normal") if name not in contents]
    if missing:
        raise UserError(f"{path} lacks {', '.join(missing)}; ground truth holds depth, normal, x and y")
    data = {name: contents.read(name).astype(np.float64) for name in ("x", "y", "depth", "normal")}
    shape = (data["x"].size, data["y"].size)
    albedo = contents.read("albedo").astype(np.float64) if "albedo" in contents else np.ones(shape)
    wanted = {"depth": shape, "normal": (*shape, 3), "x": shape[:1], "y": shape[1:]}
    wrong = [name for name in wanted if data[name].shape != wanted[name]]
    if wrong or albedo.shape != shape:
        raise UserError(
            f"{', '.join(wrong or ['albedo'])} in {path} must be as large as x and y say, {shape}; the "
            "file is damaged"
        )
    nothing = ~(data["depth"] > 0)
    data["depth"][nothing] = np.nan
    data["normal"][nothing] = np.nan
    if "albedo" not in contents:
        albedo[nothing] = np.nan
    parts = [f"mesh.{name}" for name in ("vertices", "faces", "albedo")]
    try:
        mesh = Mesh(*map(contents.read, parts)) if contents.has(*parts) else None
    except ValueError as error:
        raise UserError(f"the mesh in {path} is damaged: {error}") from error
    extra = {name: contents.read(name) for name in ("clean", "expected") if name in contents}
    gain = contents.scalar("gain") if "gain" in contents else None
    return Truth(**data, albedo=albedo, mesh=mesh, **extra, gain=gain)
