"""y-tal's HDF5 captures (github.com/diegoroyo/tal), as its documentation and files show them.

`ytal_write` writes them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from data_modules.readers.assemble import COMMON_OPTIONS, assemble, remove_delays
from data_modules.readers.contents import Contents, open_contents
from data_modules.readers.frame import device_distances, wall_rotation
from data_modules.readers.options import ReaderOptions
from data_modules.readers.ytal_write import (
    OBSERVED,
    T_LI_SI,
    T_LX_LY_SX_SY,
    T_SI,
    T_SX_SY,
    layout,
    own_facts,
    whole,
)
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

NAME = "ytal"
DESCRIPTION = (
    "y-tal .hdf5, any scan: bin length and wall points (m) from the file, "
    "whole numbers are counts, others expected values"
)
EXPECTS = "H, delta_t, sensor_grid_xyz and laser_grid_xyz"
OPTIONS = COMMON_OPTIONS | {"raw_scale"}
_AXES = {T_SX_SY: 3, T_LX_LY_SX_SY: 5, T_SI: 2, T_LI_SI: 3}
_KEPT_TEXT = 16_384
_ALTERED = "the file was altered: without its line 'nlos_lit: …' it is read as any y-tal file"


def matches(contents: Contents) -> bool:
    """Whether the file holds H, its bin length and both grids of wall points."""
    return contents.has("H", "delta_t", "sensor_grid_xyz", "laser_grid_xyz")


def read(path: Path, options: ReaderOptions) -> Capture:
    """A y-tal file as a capture, in its own coordinates; turned only where its wall does not face +z.

    Where the times include laser → wall and wall → sensor, those ways are taken off each spot by whole bins.
    Where the values carry tal's raw scale (said by ``raw_scale``, or by a ``scene_info`` that `tal render`
    wrote), they are divided by π·cosθ_l/d_l², the irradiance of the laser at each wall point. What
    `write_capture` wrote comes back exactly as it was.

    Args:
        path: of the file.
        options: what the user says, out of OPTIONS.

    Returns:
        the capture; of counts where all values are whole numbers, unless the user or this project's own facts
        say otherwise.

    Raises:
        CaptureError: an array is missing or damaged, shapes do not fit H_format, or facts that a correction
            needs are not there.
    """
    contents = open_contents(path)
    contents.require("H", "delta_t", "sensor_grid_xyz", "laser_grid_xyz")
    laser, sensor, shape, counts = _spots(contents)
    normals = [_normals(contents, name, points) for name, points in (("laser", laser), ("sensor", sensor))]
    laser, sensor, *normals = _pair(shape, laser, sensor, *normals)
    length = contents.scalar("delta_t")
    if not 1e-6 < length < 10:
        raise CaptureError(f"delta_t in {path.name} must be a path length in metres; found {length}")
    t_start = contents.scalar("t_start") if contents.given("t_start") else 0.0
    text = contents.text("scene_info")
    ours = own_facts(text, path)
    geometry: dict[str, Any] = {
        "laser": laser,
        "sensor": sensor,
        "laser_normal": normals[0],
        "sensor_normal": normals[1],
        "bin_length": length,
    }
    if ours is not None:
        axes = contents.entries["H"].shape[1:]
        return _own(path, options, ours, counts, axes, geometry, t_start, _observed(contents))
    steps: list[str] = []
    devices = {name: _device(contents, name) for name in ("laser_xyz", "sensor_xyz")}
    whole_way = "t_accounts_first_and_last_bounces"
    if contents.given(whole_way) and contents.flag(whole_way):
        if devices["laser_xyz"] is None or devices["sensor_xyz"] is None:
            raise CaptureError(
                f"{path.name} counts time from laser to sensor but does not say where they are (laser_xyz, "
                "sensor_xyz)"
            )
        ways = device_distances(devices["laser_xyz"], laser) + device_distances(devices["sensor_xyz"], sensor)
        counts, offset, told = remove_delays(counts, ways / length)
        t_start += offset * length
        steps.append(f"first and last way: {told}")
    if options.raw_scale if options.raw_scale is not None else _tal_rendered(text):
        counts, told = _without_raw_scale(path, counts, devices["laser_xyz"], laser, normals[0])
        steps.append(told)
    else:
        steps.append("scale: taken as free of the laser's falloff over the wall")
    rotation = wall_rotation(normals[1])
    if not np.array_equal(rotation, np.eye(3)):
        for name in ("laser", "sensor", "laser_normal", "sensor_normal"):
            geometry[name] = geometry[name] @ rotation.T
        steps.append("turned so that the wall faces +z")
    facts: dict[str, Any] = {
        name: [float(v) for v in place] for name, place in devices.items() if place is not None
    }
    if 0 < len(text) <= _KEPT_TEXT:
        facts["scene_info"] = text
    return assemble(
        path,
        NAME,
        options,
        counts=counts,
        t_start=t_start,
        shape=shape if shape is not None and len(shape) > 1 else None,
        steps=steps,
        facts=facts,
        **geometry,
    )


def _own(
    path: Path,
    options: ReaderOptions,
    ours: dict[str, Any],
    counts: np.ndarray,
    axes: tuple[int, ...],
    geometry: dict[str, Any],
    t_start: float,
    observed: np.ndarray | None,
) -> Capture:
    """What `write_capture` wrote, exactly as it was, then the options.

    The facts are held against the arrays: a file that says both was altered where they disagree.
    """
    if options.raw_scale is not None:
        raise CaptureError(
            f"raw_scale has no meaning for {path.name}: it was written by this project, free of that scale"
        )
    dtype = ours.pop("dtype")
    if not _holds(dtype, counts):
        raise CaptureError(
            f"H in {path.name} holds {counts.min():g} to {counts.max():g}, which {dtype} does not hold as "
            f"scene_info says; {_ALTERED}"
        )
    if ours["is_counts"] and not whole(counts):
        raise CaptureError(
            f"H in {path.name} holds values that are no whole numbers where scene_info says photon counts; "
            f"{_ALTERED}"
        )
    provenance = ours.pop("provenance")
    fields = {
        **geometry,
        "counts": counts.astype(dtype),
        "t_start": t_start,
        "gate": ours.pop("gate"),
        "observed": observed,
    }
    capture = Capture(**fields, **ours, provenance=provenance)
    written = layout(capture)[1]
    if written != axes:
        raise CaptureError(
            f"H in {path.name} has spots {axes} where scan_shape {capture.scan_shape} of scene_info would be "
            f"written as {written}; {_ALTERED}"
        )
    if not options.given:
        return capture
    shape = ours.pop("scan_shape")
    steps = provenance.pop("steps", [])
    return assemble(
        path,
        NAME,
        options,
        **fields,
        **ours,
        shape=shape,
        find_observed=False,
        steps=steps,
        facts=provenance,
    )


def _holds(dtype: str, values: np.ndarray) -> bool:
    """Whether a type holds these values as they are."""
    kind = np.dtype(dtype)
    if kind.kind in "ui":
        limits = np.iinfo(kind)
        return whole(values) and values.min() >= limits.min and values.max() < limits.max + 1
    with np.errstate(over="ignore"):
        return np.array_equal(values.astype(kind), values, equal_nan=True)


def _observed(contents: Contents) -> np.ndarray | None:
    """``[S, T]`` what `write_capture` wrote beside H; None where every bin was recorded."""
    if OBSERVED not in contents:
        return None
    values = contents.read(OBSERVED)
    if values.shape != contents.entries["H"].shape or not np.isin(values, (0, 1)).all():
        raise CaptureError(
            f"{OBSERVED} in {contents.path.name} must be 0 or 1 for each value of H "
            f"{contents.entries['H'].shape}; found shape {values.shape}"
        )
    return np.ascontiguousarray(values.reshape(len(values), -1).T.astype(bool))


def _spots(contents: Contents) -> tuple[np.ndarray, np.ndarray, tuple[int, ...] | None, np.ndarray]:
    """Laser points ``[.., 3]``, sensor points ``[.., 3]``, the shape of H's spots and ``[S, T]`` values."""
    name = contents.path.name
    values = contents.counts("H")
    kind = {3: T_SX_SY, 5: T_LX_LY_SX_SY, 2: T_SI}.get(values.ndim, 0)
    if contents.given("H_format"):
        stated = contents.scalar("H_format")
        kind = int(stated) if stated in _AXES else 0
    if _AXES.get(kind) != values.ndim:
        raise CaptureError(
            f"H in {name} has shape {values.shape}, which its H_format does not fit (1: T_Sx_Sy … 4: T_Li_Si)"
        )
    laser, sensor = (contents.places(key) for key in ("laser_grid_xyz", "sensor_grid_xyz"))
    for key, points in (("laser_grid_xyz", laser), ("sensor_grid_xyz", sensor)):
        if points.ndim not in (2, 3) or points.shape[-1] != 3 or points.size == 0:
            raise CaptureError(f"{key} in {name} must be [X, Y, 3] or [N, 3]; found {points.shape}")
    lasers, sensors, shape = laser.size // 3, sensor.size // 3, values.shape[1:]
    paired = kind in (T_SX_SY, T_SI)
    spots = int(np.prod(shape))
    fits = (
        spots in (lasers, sensors) and {lasers, sensors} <= {1, spots}
        if paired
        else spots == lasers * sensors
    )
    if not fits or 0 in values.shape:
        raise CaptureError(
            f"H in {name} has shape {values.shape}, which does not fit {lasers} laser and {sensors} sensor "
            "points"
        )
    if kind in (T_SI, T_LI_SI):
        return (
            laser,
            sensor,
            (spots,) if paired else None,
            np.ascontiguousarray(values.reshape(len(values), -1).T),
        )
    if not paired:
        grids = [points.shape[:2] for points in (laser, sensor)]
        if any(points.ndim != 3 for points in (laser, sensor)) or shape != (*grids[0], *grids[1]):
            raise CaptureError(
                f"H in {name} has shape {values.shape}, which does not fit laser grid {grids[0]}, sensor "
                f"grid {grids[1]}"
            )
    return laser, sensor, shape, np.ascontiguousarray(values.reshape(len(values), -1).T)


def _pair(
    shape: tuple[int, ...] | None, laser: np.ndarray, sensor: np.ndarray, *normals: np.ndarray
) -> list[np.ndarray]:
    """Laser and sensor points and normals, ``[S, 3]`` each, one row a spot."""
    lasers, sensors = laser.size // 3, sensor.size // 3
    product = shape is None or len(shape) == 4
    spread = []
    for points, is_laser in ((laser, True), (sensor, False), (normals[0], True), (normals[1], False)):
        rows = points.reshape(-1, 3)
        if product:
            rows = np.repeat(rows, sensors, axis=0) if is_laser else np.tile(rows, (lasers, 1))
        spread.append(
            rows
            if product or len(rows) == max(lasers, sensors)
            else np.repeat(rows, max(lasers, sensors), axis=0)
        )
    return spread


def _normals(contents: Contents, name: str, points: np.ndarray) -> np.ndarray:
    """The file's normals; +z where it has none."""
    key = f"{name}_grid_normals"
    if not contents.given(key):
        return np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    normals = contents.places(key)
    if normals.shape != points.shape:
        raise CaptureError(
            f"{key} in {contents.path.name} is {normals.shape} where the points are {points.shape}"
        )
    return normals


def _device(contents: Contents, name: str) -> np.ndarray | None:
    if not contents.given(name):
        return None
    place = contents.places(name).ravel()
    return place if place.shape == (3,) else None


def _tal_rendered(text: str) -> bool:
    """Whether `tal render` wrote this scene_info.

    Its YAML has the top-level keys ``tal_version`` and ``config``, which are found as text.
    """
    return all(re.search(rf"^{key}:", text, re.MULTILINE) for key in ("tal_version", "config"))


def _without_raw_scale(
    path: Path, counts: np.ndarray, laser: np.ndarray | None, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, str]:
    if laser is None:
        raise CaptureError(
            f"{path.name} has tal's raw scale but no laser_xyz to take it off by; give raw_scale=false to "
            "keep it"
        )
    way = laser - points
    distance = np.linalg.norm(way, axis=1)
    cosine = (way * normals).sum(axis=1)
    if not (cosine > 1e-6 * distance).all() or distance.min() == 0:
        raise CaptureError(
            f"{path.name} has tal's raw scale, but its laser at {laser.tolist()} does not face every wall "
            "point"
        )
    factor = np.pi * cosine / distance**3
    told = f"divided by tal's raw scale π·cosθ_l/d_l², {factor.min():.3g} to {factor.max():.3g} over the wall"
    return (counts / factor[:, None]).astype(np.float32), told
