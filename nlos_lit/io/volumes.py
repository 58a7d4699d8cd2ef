"""Volumes on disk: HDF5 with their axes in metres."""

from __future__ import annotations

import io
from pathlib import Path

import h5py
import numpy as np

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.files import whole_file

AXES = ("x", "y", "z")
PACKING = 1100  # deflate cannot shrink more than 1032-fold (zlib.net/zlib_tech.html)


def write_volume(
    path: Path | str, values: np.ndarray, grid: VolumeGrid, **extra_datasets: np.ndarray
) -> None:
    """Write a volume, its axes ``x``, ``y``, ``z`` in metres, and volumes that belong to it.

    Args:
        path: HDF5 file, written whole or not at all.
        values: ``[nz, nx, ny]``, kept as float32 under the name ``volume``.
        grid: where the voxels lie.
        extra_datasets: more volumes of the same shape, each under its name.

    Raises:
        ValueError: ``values`` or an extra volume is not of the grid's shape.
        UserError: one of them holds NaN or infinite values; nothing is written.

    Examples:
        >>> import tempfile
        >>> grid = VolumeGrid((0.0, 0.0, 0.5), (0.1, 0.1, 0.25), (2, 1, 2))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_volume(f"{folder}/volume.h5", np.arange(4).reshape(2, 1, 2), grid)
        ...     volume, where, extra = read_volume(f"{folder}/volume.h5")
        >>> volume.tolist(), where == grid, extra
        ([[[0.0, 1.0]], [[2.0, 3.0]]], True, {})
    """
    volumes = {"volume": values, **extra_datasets}
    for name, array in volumes.items():
        if np.shape(array) != tuple(grid.shape):
            raise ValueError(f"{name} has shape {np.shape(array)}, its grid {tuple(grid.shape)}")
        wrong = np.size(array) - np.count_nonzero(np.isfinite(array))
        if wrong:
            raise UserError(
                f"{wrong} of {np.size(array)} voxels of the {name} are NaN or infinite, which is no result: "
                "look for damaged values in the capture, or change the settings that led there"
            )
    content = io.BytesIO()  # HDF5 does not survive a disk that becomes full under its hands
    with h5py.File(content, "w") as file:
        file.attrs["frame"] = (
            "relay wall near z = 0, hidden scene at z > 0, right-handed, +y up; x, y, z are voxel centres"
        )
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
    with whole_file(path) as partial:
        partial.write_bytes(content.getbuffer())


def read_volume(path: Path | str) -> tuple[np.ndarray, VolumeGrid, dict[str, np.ndarray]]:
    """Read what :func:`write_volume` wrote.

    Args:
        path: HDF5 file.

    Returns:
        ``volume`` ``[nz, nx, ny]`` float32, its grid, and the extra volumes by name.

    Raises:
        UserError: the file is missing, is not HDF5, or holds no volume on a grid.
    """
    try:
        with h5py.File(path, "r") as file:
            origin, pitch = (tuple(float(v) for v in file.attrs[name]) for name in ("origin", "pitch"))
            own = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
            held = [file[name] for name in own if name not in AXES]
            most = PACKING * Path(path).stat().st_size
            if sum(item.nbytes for item in held) > most or any(item.external for item in held):
                raise ValueError("it claims more than it can hold")
            volumes = {item.name.removeprefix("/"): item[()] for item in held}
            volume = volumes.pop("volume")
    except Exception as error:  # a foreign file may be wrong in any way
        raise UserError(
            f"{path} is not a volume.h5 (a dataset 'volume', its grid as attributes): {error}"
        ) from error
    if volume.ndim != 3 or len(origin) != 3 or len(pitch) != 3:
        raise UserError(
            f"the volume of {path} must be [nz, nx, ny] with a grid of three axes; found shape {volume.shape}"
        )
    return volume, VolumeGrid(origin, pitch, tuple(volume.shape)), volumes
