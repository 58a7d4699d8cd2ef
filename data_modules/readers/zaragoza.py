"""The Zaragoza NLOS synthetic dataset: HDF5 from MATLAB, all bounces.

Source: Galindo et al., *A dataset for benchmarking time-resolved non-line-of-sight imaging*, SIGGRAPH 2019
posters.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_modules.readers.assemble import COMMON_OPTIONS, assemble, remove_delays
from data_modules.readers.contents import Contents, open_contents
from data_modules.readers.frame import device_distances, wall_rotation
from data_modules.readers.options import ReaderOptions
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

NAME = "zaragoza"
DESCRIPTION = (
    "Zaragoza NLOS .hdf5, confocal, single or exhaustive: deltaT and positions (m) from the file, expected "
    "values, "
    "wall y = 0 facing -y"
)
EXPECTS = "data, deltaT, cameraGridPositions and laserGridPositions"
OPTIONS = COMMON_OPTIONS


def matches(contents: Contents) -> bool:
    """Whether the file holds transients of a rendered wall with its camera grid."""
    return contents.ndim("data") in (4, 5, 6, 7) and contents.has("cameraGridPositions", "deltaT")


def read(path: Path, options: ReaderOptions) -> Capture:
    """A rendered wall as a capture, bounces and colours summed.

    The ways laser → wall and wall → camera are taken off each spot by whole bins. Axes as h5py shows them:
    ``data`` [colour, T, bounce, sy, sx(, ly, lx)] with positions [3, y, x], or all in reverse.

    Args:
        path: of the file.
        options: what the user says, out of OPTIONS.

    Returns:
        a confocal, single or exhaustive capture of expected values.

    Raises:
        CaptureError: an array is missing or damaged, or data and positions do not fit together.
    """
    contents = open_contents(path)
    contents.require("data", "deltaT", "cameraGridPositions", "cameraPosition")
    if contents.ndim("data") not in (4, 5, 6, 7):
        raise CaptureError(
            f"data in {path.name} must have 4 to 7 axes; found {contents.entries['data'].shape}"
        )
    confocal = contents.ndim("data") < 6
    last = _coordinates_last(contents, confocal)
    camera = _grid(contents, "cameraGridPositions", last)
    normals = _normals(contents, "cameraGridNormals", camera, last)
    laser, laser_normals = camera, normals
    if not confocal:
        laser = _grid(contents, "laserGridPositions", last)
        laser_normals = _normals(contents, "laserGridNormals", laser, last)
    counts, colours, bounces = _transients(
        contents, camera.shape[:2], None if confocal else laser.shape[:2], last
    )
    toward = np.array([0.0, -1.0, 0.0])
    rotation = wall_rotation(toward if normals is None else normals)
    camera_at = contents.places("cameraPosition").ravel()
    laser_at = contents.places("laserPosition").ravel() if "laserPosition" in contents else camera_at
    if camera_at.shape != (3,) or laser_at.shape != (3,):
        raise CaptureError(f"cameraPosition and laserPosition in {path.name} must be three coordinates")
    shape = camera.shape[:2] if confocal else (*laser.shape[:2], *camera.shape[:2])
    spread = [_spread(grid, shape, axes) for grid, axes in ((laser, "laser"), (camera, "camera"))]
    spread_normals = [
        _spread(np.broadcast_to(toward, grid.shape) if given is None else given, shape, axes)
        for grid, given, axes in ((laser, laser_normals, "laser"), (camera, normals, "camera"))
    ]
    length = contents.scalar("deltaT")
    if not 1e-6 < length < 10:
        raise CaptureError(f"deltaT in {path.name} must be a path length in metres; found {length}")
    delays = (device_distances(laser_at, spread[0]) + device_distances(camera_at, spread[1])) / length
    counts, offset, told = remove_delays(counts, delays)
    if not confocal and 1 in (laser.shape[0] * laser.shape[1], camera.shape[0] * camera.shape[1]):
        shape = camera.shape[:2] if laser.shape[0] * laser.shape[1] == 1 else laser.shape[:2]
    return assemble(
        path,
        NAME,
        options,
        counts=counts,
        laser=spread[0] @ rotation.T,
        sensor=spread[1] @ rotation.T,
        laser_normal=spread_normals[0] @ rotation.T,
        sensor_normal=spread_normals[1] @ rotation.T,
        bin_length=length,
        t_start=(contents.scalar("t0") if "t0" in contents else 0.0) + offset * length,
        shape=shape,
        is_counts=False,
        steps=[
            f"summed {bounces} bounces, {colours} colours",
            f"first and last way: {told}",
            "turned so that the wall faces +z",
        ],
    )


def _coordinates_last(contents: Contents, confocal: bool) -> bool:
    """Whether the file's axes run spots first, coordinates and colour last (and not the other way round).

    Raises:
        CaptureError: data and positions fit together neither way.
    """
    data, points = contents.entries["data"].shape, contents.entries["cameraGridPositions"].shape
    if len(points) == 3:
        colour = len(data) % 2  # data may lack the axis of colours
        for last, grid, scanned in (
            (False, points[1:], data[2 + colour : 4 + colour]),
            (True, points[:2], data[:2] if confocal else data[2:4]),
        ):
            if points[2 if last else 0] == 3 and scanned == grid:
                return last
    raise CaptureError(
        f"data {data} in {contents.path.name} does not scan the grid of cameraGridPositions {points}"
    )


def _grid(contents: Contents, name: str, last: bool) -> np.ndarray:
    """``[a, b, 3]`` in the order of the data's axes."""
    values = contents.places(name)
    if values.ndim != 3 or values.shape[2 if last else 0] != 3:
        raise CaptureError(
            f"{name} in {contents.path.name} must be a grid of points; found shape {values.shape}"
        )
    return values if last else np.moveaxis(values, 0, -1)


def _normals(contents: Contents, name: str, points: np.ndarray, last: bool) -> np.ndarray | None:
    """``[a, b, 3]``, one at each point of a grid; None where the file has none."""
    if name not in contents:
        return None
    normals = _grid(contents, name, last)
    if normals.shape != points.shape:
        raise CaptureError(
            f"{name} in {contents.path.name} is {normals.shape[:2]} where the grid of points is "
            f"{points.shape[:2]}"
        )
    return normals


def _transients(
    contents: Contents, camera: tuple[int, int], laser: tuple[int, int] | None, last: bool
) -> tuple[np.ndarray, int, int]:
    """``[S, T]`` with spots in the order (laser grid,) camera grid.

    Also returns how many colours and bounces were summed.
    """
    data = contents.counts("data")
    grids = [*camera, *(laser or ())]
    if not last:
        if data.ndim == len(grids) + 2:
            data = data[None]
        colours, bins, bounces = data.shape[:3]
        found = data.shape[3:]
        axes = [5, 6, 3, 4] if laser else [3, 4]
        data = _sum(data, (0, 2)).transpose([*axes, 1, 0, 2])
    else:
        if data.ndim == len(grids) + 2:
            data = data[..., None]
        bounces, bins, colours = data.shape[-3:]
        found = (*data.shape[2:4], *data.shape[:2]) if laser else data.shape[:2]
        data = _sum(data, (-1, -3))
    if tuple(found) != tuple(grids):
        raise CaptureError(
            f"data in {contents.path.name} scans {tuple(found)} where the grid positions are "
            f"{tuple(grids)}; they must agree"
        )
    return data.reshape(-1, bins), colours, bounces


def _sum(data: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
    with np.errstate(over="ignore"):  # infinite sums are refused with the counts
        return data.sum(axis=axes, keepdims=True)


def _spread(grid: np.ndarray, shape: tuple[int, ...], device: str) -> np.ndarray:
    """``[S, 3]`` a device's value at each spot of a scan ``[(laser grid,) camera grid]``."""
    if len(shape) == 4:
        grid = grid[:, :, None, None] if device == "laser" else grid[None, None]
    return np.broadcast_to(grid, (*shape, 3)).reshape(-1, 3)
