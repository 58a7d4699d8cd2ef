"""Confocal captures of f-k migration: ``meas``, with ``tofgrid`` beside it.

Source: Lindell, Wetzstein, O'Toole, *Wave-based non-line-of-sight imaging using fast f-k migration*, SIGGRAPH
2019.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_modules.readers.assemble import (
    COMMON_OPTIONS,
    assemble,
    bin_length_of,
    cell_centres,
    remove_delays,
    wall_points,
)
from data_modules.readers.contents import Contents, open_contents
from data_modules.readers.options import ReaderOptions
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

NAME = "fk"
DESCRIPTION = (
    "f-k migration .mat v7.3, confocal: bins of 32 ps, wall 2 m × 2 m, counts; "
    "rows from the top (-y), columns along -x"
)
EXPECTS = (
    "meas [rows, columns, T] in a MATLAB v7.3 file, "
    "with tofgrid [rows, columns] in it or in tof.mat beside it"
)
OPTIONS = COMMON_OPTIONS | {"bin_width_ps", "wall_size"}
BIN_WIDTH_PS = 32.0
WALL_SIZE = 2.0


def matches(contents: Contents) -> bool:
    """Whether a MATLAB v7.3 file holds a cube ``meas``."""
    return contents.container == "hdf5" and contents.ndim("meas") == 3


def read(path: Path, options: ReaderOptions) -> Capture:
    """A cube ``meas`` as a capture, each spot's delay taken off by whole bins.

    ``tofgrid`` (ps) is each spot's time from laser to wall to detector. Files that other programs than MATLAB
    wrote have their axes the other way round; there the first axis is the longest one, and holds the bins.

    Args:
        path: of the file.
        options: what the user says, out of OPTIONS.

    Returns:
        a confocal capture, gated behind the direct pulse.

    Raises:
        CaptureError: ``meas`` is missing or damaged, or ``tofgrid`` is of another scan.
    """
    contents = open_contents(path)
    contents.require("meas")
    if contents.ndim("meas") != 3:
        raise CaptureError(
            f"meas in {path.name} must be [rows, columns, bins]; found {contents.entries['meas'].shape}"
        )
    width = options.bin_width_ps or BIN_WIDTH_PS
    sides = options.wall_sides or (WALL_SIZE, WALL_SIZE)
    data = contents.counts("meas")
    steps = [f"bins of {width:g} ps, wall {sides[0]:g} m × {sides[1]:g} m"]
    if len(data) > max(data.shape[1:]):  # not written by MATLAB, which turns the order of axes round
        data = data.transpose(2, 1, 0)
        steps.append(f"time is the longest axis of meas: {list(data.shape)}")
    rows, columns, bins = data.shape
    counts = data.reshape(rows * columns, bins)
    t_start = 0.0
    delays = _delays(contents, (rows, columns))
    if delays is None:
        steps.append("no tofgrid: times taken as counted from the wall")
    else:
        counts, offset, told = remove_delays(counts, delays / width)
        t_start = offset * bin_length_of(width)
        steps.append(f"tofgrid: {told}")
    points = wall_points(-cell_centres(rows, sides[1]), -cell_centres(columns, sides[0]), "yx")
    return assemble(
        path,
        NAME,
        options,
        counts=counts,
        laser=points,
        sensor=points,
        bin_length=bin_length_of(width),
        t_start=t_start,
        shape=(rows, columns),
        behind_pulse=True,
        steps=steps,
    )


def _delays(contents: Contents, shape: tuple[int, int]) -> np.ndarray | None:
    """``[S]`` ps from the file itself, or from the ``tof.mat`` that the public data keep beside it."""
    source = contents
    if "tofgrid" not in contents:
        beside = contents.path.with_name("tof.mat")
        if not beside.is_file():
            return None
        source = open_contents(beside)
    delays = source.read("tofgrid")
    if delays.size == 0:
        return None
    if delays.shape != shape:
        raise CaptureError(
            f"tofgrid in {source.path.name} is {delays.shape} where meas scans {shape}; use the one of "
            "this scene"
        )
    return delays.ravel().astype(np.float64)
