"""Non-confocal captures of phasor-field imaging.

Source: Liu et al., Nature 2019, as prepared for Liu, Bauer, Velten, Nat. Commun. 2020.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_modules.readers.assemble import COMMON_OPTIONS, assemble, bin_length_of, wall_points
from data_modules.readers.contents import Contents, open_contents
from data_modules.readers.options import ReaderOptions
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

NAME = "phasor_field"
DESCRIPTION = (
    "phasor-field .mat, one detector: bin width ts (s), spots sampling_spacing (m) apart, counts; "
    "rows from the top (-y), columns along +x"
)
EXPECTS = "rect_data [rows, columns, T], ts, sampling_spacing or aperturefullsize, and SPAD_index"
OPTIONS = COMMON_OPTIONS | {"bin_width_ps", "wall_size"}


def matches(contents: Contents) -> bool:
    """Whether the file holds a cube ``rect_data`` with ``ts`` and ``SPAD_index``."""
    return contents.ndim("rect_data") == 3 and contents.has("ts", "SPAD_index")


def read(path: Path, options: ReaderOptions) -> Capture:
    """A cube ``rect_data`` as a capture: the laser scans the grid, the detector looks at one of its points.

    ``SPAD_index`` is that point's row and column, counted from 1. Times are taken as path from laser to
    detector point; the public demo adds 0.1 m to the depth term as an electrical delay, which ``t_start =
    -0.1`` would express.

    Args:
        path: of the file.
        options: what the user says, out of OPTIONS.

    Returns:
        a capture with one sensor point, gated behind the direct pulse.

    Raises:
        CaptureError: an array is missing or damaged, or its numbers make no sense.
    """
    contents = open_contents(path)
    contents.require("rect_data", "SPAD_index")
    if contents.ndim("rect_data") != 3:
        raise CaptureError(
            f"rect_data in {path.name} must be [rows, columns, bins]; found "
            f"{contents.entries['rect_data'].shape}"
        )
    width = options.bin_width_ps or 1e12 * contents.scalar("ts")
    if not 0.1 < width < 1e4:
        raise CaptureError(
            f"ts in {path.name} makes bins of {width:g} ps; expected seconds, about 4e-12 (or give "
            "bin_width_ps)"
        )
    data = contents.counts("rect_data")
    rows, columns, bins = data.shape
    row, column = _detector(contents, rows, columns)
    across, down = _spacing(contents, options, rows, columns)
    points = wall_points(
        down * ((rows - 1) / 2 - np.arange(rows)), across * (np.arange(columns) - (columns - 1) / 2), "yx"
    )
    counts = data.reshape(rows * columns, bins)
    return assemble(
        path,
        NAME,
        options,
        counts=counts,
        laser=points,
        sensor=np.broadcast_to(points[row * columns + column], points.shape),
        bin_length=bin_length_of(width),
        shape=(rows, columns),
        behind_pulse=True,
        steps=[
            f"bins of {width:g} ps, spots {across:g} × {down:g} m apart, detector at row {row + 1}, column "
            f"{column + 1}"
        ],
    )


def _detector(contents: Contents, rows: int, columns: int) -> tuple[int, int]:
    index = contents.read("SPAD_index").ravel()
    if index.size != 2 or not np.isfinite(index).all() or not np.array_equal(index, np.rint(index)):
        raise CaptureError(
            f"SPAD_index in {contents.path.name} must be (row, column), counted from 1; found "
            f"{index[:4].tolist()}"
        )
    row, column = (int(value) - 1 for value in index)
    if not (0 <= row < rows and 0 <= column < columns):
        raise CaptureError(
            f"SPAD_index {tuple(index)} in {contents.path.name} lies outside the {rows} × {columns} scan"
        )
    return row, column


def _spacing(contents: Contents, options: ReaderOptions, rows: int, columns: int) -> tuple[float, float]:
    """Distance of neighbouring spots along x and y, m."""
    if options.wall_sides is not None:
        return options.wall_sides[0] / columns, options.wall_sides[1] / rows
    if "sampling_spacing" in contents:
        spacing = contents.scalar("sampling_spacing")
    else:
        contents.require("aperturefullsize")
        aperture = contents.read("aperturefullsize").ravel()
        spacing = float(aperture[0]) / max(rows - 1, 1) if aperture.size else 0.0
    if not (np.isfinite(spacing) and spacing > 0):
        raise CaptureError(
            f"the spot spacing in {contents.path.name} must be a positive length; found {spacing}; give "
            "wall_size"
        )
    return spacing, spacing
