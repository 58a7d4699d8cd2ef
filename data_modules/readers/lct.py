"""Confocal captures of the light-cone transform: ``rect_data``, ``width``.

Source: O'Toole, Lindell, Wetzstein, *Confocal non-line-of-sight imaging based on the light-cone transform*,
Nature 2018.
"""

from __future__ import annotations

from pathlib import Path

from data_modules.readers.assemble import COMMON_OPTIONS, assemble, bin_length_of, cell_centres, wall_points
from data_modules.readers.contents import Contents, open_contents
from data_modules.readers.options import ReaderOptions
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

NAME = "lct"
DESCRIPTION = (
    "LCT .mat, confocal: bins of 4 ps, wall side 2·width, counts; first axis along +x, second along -y"
)
EXPECTS = "rect_data [nx, ny, T] and width"
OPTIONS = COMMON_OPTIONS | {"bin_width_ps", "wall_size"}
BIN_WIDTH_PS = 4.0


def matches(contents: Contents) -> bool:
    """Whether the file holds ``rect_data`` and ``width``, and no ``ts`` as phasor-field files have."""
    return contents.ndim("rect_data") == 3 and "width" in contents and "ts" not in contents


def read(path: Path, options: ReaderOptions) -> Capture:
    """A cube ``rect_data`` as a capture; spots are the centres of equal cells of the square.

    Bin 0 holds the direct pulse's peak, so path zero is its start.

    Args:
        path: of the file.
        options: what the user says, out of OPTIONS.

    Returns:
        a confocal capture, gated behind the direct pulse.

    Raises:
        CaptureError: an array is missing or damaged, or the wall's width is not positive.
    """
    contents = open_contents(path)
    contents.require("rect_data")
    if contents.ndim("rect_data") != 3:
        raise CaptureError(
            f"rect_data in {path.name} must be [nx, ny, bins]; found {contents.entries['rect_data'].shape}"
        )
    sides = options.wall_sides
    if sides is None:
        half = contents.scalar("width")
        if half <= 0:
            raise CaptureError(f"width in {path.name} must be half the wall's side in metres; found {half}")
        sides = (2 * half, 2 * half)
    data = contents.counts("rect_data")
    nx, ny, bins = data.shape
    counts = data.reshape(nx * ny, bins)
    width = options.bin_width_ps or BIN_WIDTH_PS
    points = wall_points(cell_centres(nx, sides[0]), -cell_centres(ny, sides[1]), "xy")
    return assemble(
        path,
        NAME,
        options,
        counts=counts,
        laser=points,
        sensor=points,
        bin_length=bin_length_of(width),
        shape=(nx, ny),
        behind_pulse=True,
        steps=[f"bins of {width:g} ps, wall {sides[0]:g} m × {sides[1]:g} m"],
    )
