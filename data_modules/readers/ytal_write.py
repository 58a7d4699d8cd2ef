"""Write a capture as a y-tal HDF5 file, readable by tal.

What y-tal has no place for goes into ``scene_info``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from data_modules.whole_hdf5 import whole_hdf5
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

T_SX_SY, T_LX_LY_SX_SY, T_SI, T_LI_SI = 1, 2, 3, 4  # H_format
N_3, X_Y_3 = 1, 2  # *_grid_format
OBSERVED = "nlos_lit_observed"  # not a key of y-tal, which tal refuses: only where bins were not recorded
_OURS = "nlos_lit: "  # one line of YAML whose value is JSON, so that no YAML parser is needed to read it back
_COUNT_TYPES = {
    np.dtype(kind).name
    for kind in (np.uint8, np.uint16, np.uint32, np.uint64, np.int8, np.int16, np.int32, np.int64)
}
_VALUE_TYPES = {"float16", "float32", "float64"}


def write_capture(path: str | Path, capture: Capture, *, overwrite: bool = False) -> Path:
    """Write a capture so that reading it back gives the same capture.

    H is float32 as tal expects, so whole counts must not exceed 2²⁴ where they are odd. Scans are stored as
    T_Sx_Sy (confocal and one laser point), T_Lx_Ly_Sx_Sy (exhaustive, and one sensor point as a 1 × 1 sensor
    grid), T_Li_Si (irregular, every laser with every sensor point) or T_Si (irregular pairs). Which bins were
    recorded is an array of its own beside H, only where some were not: tal cannot read such a file. The file
    appears under its name only when complete.

    Args:
        path: where to.
        capture: what to write.
        overwrite: replace a file that is there.

    Returns:
        the path.

    Raises:
        CaptureError: the file exists and ``overwrite`` is false, it cannot be written, counts that float32
            cannot hold or that are no whole numbers, or provenance that is not JSON.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise CaptureError(f"{path} exists already; give another name or overwrite=True")
    values = capture.counts.astype(np.float32)
    if capture.counts.dtype.kind in "ui" and not np.array_equal(
        values.astype(np.float64), capture.counts.astype(np.float64)
    ):
        raise CaptureError(
            "counts above 16777216 do not fit y-tal's float32; split the exposure or sum fewer bins"
        )
    if capture.is_counts and not whole(values):
        raise CaptureError("photon counts are whole numbers; a capture of other values has is_counts=False")
    kind, shape, laser, sensor = layout(capture)
    items: dict[str, Any] = {
        "H": np.ascontiguousarray(values.T).reshape(capture.n_bins, *shape),
        "H_format": np.array([kind], dtype=np.int32),
        "delta_t": np.float64(capture.bin_length),
        "t_start": np.float64(capture.t_start),
        "t_accounts_first_and_last_bounces": np.bool_(False),
        "scene_info": _OURS + _facts(capture) + "\n",
        "volume_format": h5py.Empty(np.float64),
    }
    if capture.observed is not None:
        items[OBSERVED] = np.ascontiguousarray(capture.observed.T, dtype=np.uint8).reshape(items["H"].shape)
    for name, rows, points, normals in (
        ("laser", laser, capture.laser, capture.laser_normal),
        ("sensor", sensor, capture.sensor, capture.sensor_normal),
    ):
        place = capture.provenance.get(f"{name}_xyz")
        items[f"{name}_xyz"] = (
            h5py.Empty(np.float64) if place is None else np.asarray(place, dtype=np.float32)
        )
        items[f"{name}_grid_xyz"] = points[rows]
        items[f"{name}_grid_normals"] = normals[rows]
        items[f"{name}_grid_format"] = np.array([X_Y_3 if rows.ndim == 2 else N_3], dtype=np.int32)
    _write(path, items)
    return path


def own_facts(text: str, path: Path) -> dict[str, Any] | None:
    """The facts that `write_capture` put into ``scene_info``.

    Args:
        text: the file's ``scene_info``.
        path: of the file, for messages.

    Returns:
        `Capture` arguments and ``dtype``, by name; None for any other text.

    Raises:
        CaptureError: the facts are there and not as they were written.
    """
    line = (
        next((line for line in text.splitlines() if line.startswith(_OURS)), None) if _OURS in text else None
    )
    if line is None:
        return None
    broken = CaptureError(
        f"scene_info in {path.name} does not hold this project's facts as written; the file was altered"
    )
    try:
        facts = json.loads(line[len(_OURS) :])
        facts = {
            key: facts[key]
            for key in ("dtype", "gate", "scan_shape", "scan_order", "exposure_s", "is_counts", "provenance")
        }
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise broken from error
    whole = {
        "gate": facts["gate"],
        "scan_shape": facts["scan_shape"] or [],
        "scan_order": facts["scan_order"] or [],
    }
    if (
        facts["dtype"] not in _COUNT_TYPES | _VALUE_TYPES
        or any(
            not isinstance(v, list) or any(type(n) is not int or not 0 <= n < 2**40 for n in v)
            for v in whole.values()
        )
        or len(facts["gate"]) != 2
        or type(facts["is_counts"]) is not bool
        or not isinstance(facts["provenance"], dict)
        or not isinstance(facts["provenance"].get("steps", []), list)
        or not (facts["exposure_s"] is None or type(facts["exposure_s"]) in (int, float))
    ):
        raise broken
    facts["gate"] = tuple(facts["gate"])
    facts["scan_shape"] = None if facts["scan_shape"] is None else tuple(facts["scan_shape"])
    facts["scan_order"] = (
        None if facts["scan_order"] is None else np.asarray(facts["scan_order"], dtype=np.int64)
    )
    return facts


def _facts(capture: Capture) -> str:
    order = capture.scan_order
    facts = {
        "dtype": capture.counts.dtype.name,
        "gate": list(capture.gate),
        "scan_shape": capture.scan_shape,
        "scan_order": None if np.array_equal(order, np.arange(capture.n_spots)) else order.tolist(),
        "exposure_s": capture.exposure_s,
        "is_counts": capture.is_counts,
        "provenance": capture.provenance,
    }
    try:
        return json.dumps(facts, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise CaptureError(f"the capture's provenance cannot be written as JSON: {error}") from error


def whole(values: np.ndarray) -> bool:
    """Whether all are whole numbers."""
    return values.dtype.kind in "ui" or bool((values == np.rint(values)).all())


def layout(capture: Capture) -> tuple[int, tuple[int, ...], np.ndarray, np.ndarray]:
    """H_format, the axes of H after time, and the capture rows that give the laser and sensor grids."""
    rows, shape = np.arange(capture.n_spots), capture.scan_shape
    one_laser, one_sensor = (bool((points == points[0]).all()) for points in (capture.laser, capture.sensor))
    if shape is not None and len(shape) == 4:
        grid = rows.reshape(shape)
        if _is_product(capture, grid[:, :, 0, 0].ravel(), grid[0, 0].ravel()):
            return T_LX_LY_SX_SY, shape, grid[:, :, 0, 0], grid[0, 0]
    elif shape is not None:
        grid = rows.reshape(shape)
        if one_sensor and not one_laser:
            return T_LX_LY_SX_SY, (*shape, 1, 1), grid, rows[:1].reshape(1, 1)
        return T_SX_SY, shape, rows[:1].reshape(1, 1) if one_laser and not one_sensor else grid, grid
    if one_laser != one_sensor:
        return T_SI, (capture.n_spots,), rows[:1] if one_laser else rows, rows if one_laser else rows[:1]
    run = int(np.argmax((capture.laser != capture.laser[0]).any(axis=1))) or capture.n_spots
    if (
        1 < run < capture.n_spots
        and capture.n_spots % run == 0
        and _is_product(capture, rows[::run], rows[:run])
    ):
        return T_LI_SI, (capture.n_spots // run, run), rows[::run], rows[:run]
    return T_SI, (capture.n_spots,), rows, rows


def _is_product(capture: Capture, lasers: np.ndarray, sensors: np.ndarray) -> bool:
    """Whether the spots are every laser point with every sensor point, the sensor changing fastest."""
    slow, fast = (capture.laser, capture.laser_normal), (capture.sensor, capture.sensor_normal)
    return all(
        np.array_equal(values, np.repeat(values[lasers], len(sensors), axis=0)) for values in slow
    ) and all(np.array_equal(values, np.tile(values[sensors], (len(lasers), 1))) for values in fast)


def _write(path: Path, items: dict[str, Any]) -> None:
    with whole_hdf5(path) as file:
        for name, value in items.items():
            packed = name in ("H", OBSERVED)
            options = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if packed else {}
            file.create_dataset(name, data=value, **options)
