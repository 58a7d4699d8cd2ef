"""MATLAB captures of the CMU group.

Ahn et al. (ICCV 2019): ``NLOSDATA``. Tsai et al. (CVPR 2019): ``transient`` + ``lighting``. And plain
``meas`` cubes in MATLAB v5 files, which say nothing about their units.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_modules.readers.assemble import (
    COMMON_OPTIONS,
    assemble,
    bin_length_of,
    cell_centres,
    grid_of,
    wall_points,
)
from data_modules.readers.contents import Contents, open_contents
from data_modules.readers.options import ReaderOptions
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

NAME = "tsai_ahn"
DESCRIPTION = (
    "Tsai / Ahn .mat: delta (m) and points from NLOSDATA; "
    "other forms need bin_width_ps, and meas also wall_size"
)
EXPECTS = "NLOSDATA, or transient [S, T] with lighting [S, 3], or meas [x, y, T] in a MATLAB v5 file"
OPTIONS = COMMON_OPTIONS | {"bin_width_ps", "wall_size"}


def matches(contents: Contents) -> bool:
    """Whether the file holds one of the three forms."""
    if "NLOSDATA.transient" in contents:
        return True
    if contents.ndim("transient") == 2 and contents.ndim("lighting") == 2:
        return True
    return contents.container == "mat5" and contents.ndim("meas") == 3


def read(path: Path, options: ReaderOptions) -> Capture:
    """A struct ``NLOSDATA``, a list of transients, or a cube, as a capture.

    Args:
        path: of the file.
        options: what the user says, out of OPTIONS; a list needs ``bin_width_ps``, a cube ``wall_size``, too.

    Returns:
        the capture; a scanned grid where the points make one.

    Raises:
        CaptureError: an array is missing or damaged, shapes disagree, or a needed option is not given.
    """
    contents = open_contents(path)
    if "NLOSDATA.transient" in contents:
        return _read_struct(path, contents, options)
    if "transient" in contents:
        return _read_list(path, contents, options)
    return _read_cube(path, contents, options)


def _read_struct(path: Path, contents: Contents, options: ReaderOptions) -> Capture:
    """The hidden object is at the file's origin and the wall at z = target_dist.

    A half turn about y brings it to our frame.
    """
    laser, sensor = _points(contents, "NLOSDATA.l"), _points(contents, "NLOSDATA.s")
    distance = (
        contents.scalar("NLOSDATA.target_dist")
        if "NLOSDATA.target_dist" in contents
        else float(laser[:, 2].mean())
    )
    length = (
        bin_length_of(options.bin_width_ps) if options.bin_width_ps else contents.scalar("NLOSDATA.delta")
    )
    confocal = contents.flag("NLOSDATA.is_confocal") if "NLOSDATA.is_confocal" in contents else False
    data = contents.counts("NLOSDATA.transient")
    spots = len(laser) if confocal else len(laser) * len(sensor)
    shape: tuple[int, ...] | None = None
    counts = data.reshape(-1, data.shape[-1]) if data.ndim in (2, 3) else data
    if counts.ndim != 2 or len(counts) != spots:
        raise CaptureError(
            f"NLOSDATA.transient in {path.name} is {data.shape}; expected {spots} transients for "
            f"{len(laser)} laser and "
            f"{len(sensor)} sensor points"
        )
    laser, sensor = (np.stack([-p[:, 0], p[:, 1], distance - p[:, 2]], axis=1) for p in (laser, sensor))
    order = np.arange(spots)
    if confocal:
        sensor = laser
        found = grid_of(laser)
        if found is not None:
            order, shape = found
    else:
        laser_grid, sensor_grid = grid_of(laser), grid_of(sensor)
        if laser_grid is not None and sensor_grid is not None:
            (lasers, a), (sensors, b) = laser_grid, sensor_grid
            order = (lasers[:, None] * len(sensor) + sensors).ravel()
            shape = (*a, *b) if len(laser) > 1 and len(sensor) > 1 else (b if len(laser) == 1 else a)
        laser, sensor = np.repeat(laser, len(sensor), axis=0), np.tile(sensor, (len(laser), 1))
    return assemble(
        path,
        NAME,
        options,
        counts=counts[order],
        laser=laser[order],
        sensor=sensor[order],
        bin_length=length,
        shape=shape,
        listed=order,
        steps=[
            f"NLOSDATA: bins of {length:g} m, wall at {distance:g} m from the file's origin, turned about y"
        ],
    )


def _read_list(path: Path, contents: Contents, options: ReaderOptions) -> Capture:
    """Confocal points in the wall plane z = 0, x and y as they are.

    LCT data re-saved in this form have 4 ps bins.
    """
    _ask(path, options, "bin_width_ps")
    assert options.bin_width_ps is not None
    if options.wall_size is not None:
        raise CaptureError(
            f"wall_size has no meaning for {path.name}: its lighting array gives each wall point"
        )
    points = _points(contents, "lighting")
    counts = contents.counts("transient")
    if counts.ndim != 2 or len(counts) != len(points):
        raise CaptureError(
            f"transient in {path.name} is {counts.shape}; expected [{len(points)}, T], one row a lighting "
            "point"
        )
    order, shape = grid_of(points) or (np.arange(len(points)), None)
    return assemble(
        path,
        NAME,
        options,
        counts=counts[order],
        laser=points[order],
        sensor=points[order],
        bin_length=bin_length_of(options.bin_width_ps),
        shape=shape,
        listed=order,
        steps=[f"bins of {options.bin_width_ps:g} ps as asked"],
    )


def _read_cube(path: Path, contents: Contents, options: ReaderOptions) -> Capture:
    """Nothing says how the axes of such a cube run: taken as x, then y, both growing.

    ``flip_x``, ``flip_y`` and ``swap_xy`` say otherwise.
    """
    contents.require("meas")
    if contents.ndim("meas") != 3:
        raise CaptureError(
            f"meas in {path.name} must be [x, y, bins]; found {contents.entries['meas'].shape}"
        )
    _ask(path, options, "bin_width_ps", "wall_size")
    data = contents.counts("meas")
    nx, ny, bins = data.shape
    sides = options.wall_sides
    assert sides is not None
    assert options.bin_width_ps is not None
    points = wall_points(cell_centres(nx, sides[0]), cell_centres(ny, sides[1]), "xy")
    return assemble(
        path,
        NAME,
        options,
        counts=data.reshape(nx * ny, bins),
        laser=points,
        sensor=points,
        bin_length=bin_length_of(options.bin_width_ps),
        shape=(nx, ny),
        steps=[f"bins of {options.bin_width_ps:g} ps, wall {sides[0]:g} m × {sides[1]:g} m as asked"],
    )


def _points(contents: Contents, name: str) -> np.ndarray:
    points = contents.places(name)
    if points.ndim != 2 or points.shape[1] != 3:
        raise CaptureError(
            f"{name} in {contents.path.name} must be points [N, 3]; found shape {points.shape}"
        )
    return points


def _ask(path: Path, options: ReaderOptions, *names: str) -> None:
    """Refuse to go on without these options."""
    missing = [name for name in names if getattr(options, name) is None]
    if missing:
        raise CaptureError(
            f"{path.name} does not say {' and '.join(missing)}; give "
            f"{'them' if len(missing) > 1 else 'it'} as reader options "
            "(f-k migration data re-saved as MATLAB v5 are read with format fk)"
        )
