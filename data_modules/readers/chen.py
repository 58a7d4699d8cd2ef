"""Confocal renders of Chen et al. (Learned feature embeddings, SIGGRAPH Asia 2020).

One Radiance HDR picture ``[T·N, N]``: T square frames, stacked downwards.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_modules.readers.assemble import COMMON_OPTIONS, assemble, bin_length_of, cell_centres, wall_points
from data_modules.readers.contents import Contents, open_contents
from data_modules.readers.options import ReaderOptions
from data_modules.readers.radiance import read_radiance
from nlos_lit.capture import SPEED_OF_LIGHT, Capture
from nlos_lit.capture.errors import CaptureError

NAME = "chen"
DESCRIPTION = (
    "Chen et al. renderer .hdr, confocal: bins of 0.01 m of path, wall 2 m × 2 m, expected values; "
    "rows from the top (-y), columns along -x"
)
EXPECTS = "a Radiance HDR picture of T square frames stacked downwards"
OPTIONS = COMMON_OPTIONS | {"bin_width_ps", "wall_size"}
BIN_LENGTH = 0.01  # m
WALL_SIZE = 2.0  # m


def matches(contents: Contents) -> bool:
    """Whether the file is a Radiance picture, or a video that `read` refuses with a reason."""
    return contents.container in ("radiance", "mp4")


def read(path: Path, options: ReaderOptions) -> Capture:
    """One HDR picture as a capture; frames are time bins from path zero.

    The value of a pixel is its grey by Rec. 601 luma (the renders are grey).

    Args:
        path: of the picture.
        options: what the user says, out of OPTIONS.

    Returns:
        a confocal capture of expected values.

    Raises:
        CaptureError: a video, another kind of file, a damaged picture, or one that is not made of square
            frames.
    """
    container = open_contents(path).container
    if container == "mp4":
        raise CaptureError(
            f"{path.name} is a video, lossy and 8-bit; read the renderer's own light-1-*.hdr instead"
        )
    if container != "radiance":
        raise CaptureError(f"{path.name} is not {EXPECTS}; found a {container} file")
    picture = read_radiance(path)
    rows, side = picture.shape[:2]
    if rows % side:
        raise CaptureError(
            f"{path.name} is {rows} × {side} pixels; expected T·N rows of N pixels, one N × N frame a time "
            "bin"
        )
    frames = (picture @ np.array([0.299, 0.587, 0.114], dtype=np.float32)).reshape(rows // side, side * side)
    length = bin_length_of(options.bin_width_ps) if options.bin_width_ps else BIN_LENGTH
    sides = options.wall_sides or (WALL_SIZE, WALL_SIZE)
    points = wall_points(-cell_centres(side, sides[1]), -cell_centres(side, sides[0]), "yx")
    return assemble(
        path,
        NAME,
        options,
        counts=np.ascontiguousarray(frames.T),
        laser=points,
        sensor=points,
        bin_length=length,
        shape=(side, side),
        is_counts=False,
        steps=[
            f"bins of {1e12 * length / SPEED_OF_LIGHT:.4g} ps, wall {sides[0]:g} m × {sides[1]:g} m, grey "
            "by Rec. 601 luma"
        ],
    )
