"""Any pairs of laser and detector points as ``C_i``, ``C_d``, ``sub_Sig``.

Source: Liu et al., Nat. Commun. 14, 3230, 2023.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_modules.readers.assemble import COMMON_OPTIONS, assemble, bin_length_of, grid_of
from data_modules.readers.contents import Contents, open_contents, open_folder
from data_modules.readers.options import ReaderOptions
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

NAME = "cid"
DESCRIPTION = (
    "C_i / C_d / sub_Sig .mat files: bins of 16 ps, wall coordinates in 0.01 m, counts; "
    "second column +x, third +y"
)
EXPECTS = "C_i [S, 3], C_d [S, 3] and sub_Sig [S, T], in one .mat file or three of one folder"
OPTIONS = COMMON_OPTIONS | {"bin_width_ps", "wall_size"}
BIN_WIDTH_PS = 16.0
UNIT = 0.01  # m
_KEYS = ("C_i", "C_d", "sub_Sig")


def matches(contents: Contents) -> bool:
    """Whether the file holds one of the three arrays, or the folder all of them."""
    if contents.container == "folder":
        return contents.has(*_KEYS)
    return any(contents.ndim(key) == 2 for key in _KEYS)


def read(path: Path, options: ReaderOptions) -> Capture:
    """Three arrays, in one file or in several of one folder, as a capture.

    Times are paths from laser to detector point. The bins that the file leaves empty at both ends are outside
    the gate.

    Args:
        path: the file, one of the three files, or their folder.
        options: what the user says, out of OPTIONS.

    Returns:
        the capture; a scanned grid where the points make one.

    Raises:
        CaptureError: an array is missing or damaged, or shapes disagree.
    """
    contents = open_contents(path)
    if not contents.has(*_KEYS) and contents.container != "folder":
        contents = open_folder(path.parent)
    contents.require(*_KEYS)
    laser, sensor, counts = contents.places("C_i"), contents.places("C_d"), contents.counts("sub_Sig")
    if counts.ndim != 2 or laser.shape != (len(counts), 3) or sensor.shape != laser.shape:
        raise CaptureError(
            f"{path.name} must hold C_i [S, 3], C_d [S, 3] and sub_Sig [S, T]; found {laser.shape}, "
            f"{sensor.shape}, {counts.shape}"
        )
    width = options.bin_width_ps or BIN_WIDTH_PS
    laser, sensor, scale = _world(laser, sensor, options)
    fixed_laser, fixed_sensor = (bool((points == points[0]).all()) for points in (laser, sensor))
    one_scan = fixed_laser or fixed_sensor or np.array_equal(laser, sensor)
    grid = grid_of(sensor if fixed_laser else laser) if one_scan else None
    order, shape = grid or (np.arange(len(counts)), None)
    gate, told = _kept_bins(counts)
    return assemble(
        path,
        NAME,
        options,
        counts=counts[order],
        laser=laser[order],
        sensor=sensor[order],
        bin_length=bin_length_of(width),
        shape=shape,
        gate=gate,
        listed=order,
        cropped=True,
        steps=[f"bins of {width:g} ps, wall coordinates × {scale[0]:g} m, × {scale[1]:g} m, centred", *told],
    )


def _world(
    laser: np.ndarray, sensor: np.ndarray, options: ReaderOptions
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Columns (depth, horizontal, vertical) to (x, y, z) in metres, and the scale of both wall axes.

    The scanned rectangle's middle comes to lie at the origin.
    """
    scanned = laser if np.ptp(laser, axis=0).max() >= np.ptp(sensor, axis=0).max() else sensor
    low, high = scanned[:, 1:].min(axis=0), scanned[:, 1:].max(axis=0)
    scale = (UNIT, UNIT)
    if options.wall_sides is not None:
        steps = [len(np.unique(scanned[:, 1 + k])) for k in (0, 1)]
        spans = [(high[k] - low[k]) * steps[k] / max(steps[k] - 1, 1) for k in (0, 1)]
        if min(spans) <= 0:
            raise CaptureError("wall_size needs a scan that extends along both wall axes")
        scale = tuple(side / span for side, span in zip(options.wall_sides, spans, strict=True))
    middle = (low + high) / 2

    def turn(points: np.ndarray) -> np.ndarray:
        return np.stack(
            [
                (points[:, 1] - middle[0]) * scale[0],
                (points[:, 2] - middle[1]) * scale[1],
                points[:, 0] * UNIT,
            ],
            axis=1,
        )

    return turn(laser), turn(sensor), scale


def _kept_bins(counts: np.ndarray) -> tuple[tuple[int, int] | None, list[str]]:
    """First to last bin with any counts, and that in words."""
    filled = np.flatnonzero(counts.any(axis=0))
    if len(filled) == 0:
        return None, []
    gate = (int(filled[0]), int(filled[-1]) + 1)
    return gate, [f"bins {gate[0]} to {gate[1] - 1} hold counts and are the gate unless another is given"]
