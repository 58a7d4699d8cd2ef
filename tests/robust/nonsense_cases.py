"""Captures that cannot be, in y-tal files: numbers in the wrong unit, turned, damaged, or no measurement.

``python tests/robust/nonsense_cases.py OUT.jsonl [seed=0]`` adds a row with what came of each.
"""

from __future__ import annotations

import functools
import logging
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from rows import add

from data_modules.load import load_scene
from nlos_lit.capture.errors import UserError
from nlos_lit.training.configs import compose

BINS, BIN = 200, 0.012
OURS = "data_modules"  # whose warnings count
Items = dict[str, Any]


def base(kind: str, seed: int) -> Items:
    """A capture as it should be: light of three points 0.5 to 0.8 m away, with a tail, over a background.

    Args:
        kind: ``confocal``, ``single`` (one sensor point), ``exhaustive`` or ``expected`` (no statistics).
        seed: of the counts.

    Returns:
        y-tal's arrays.
    """
    side = 4 if kind == "exhaustive" else 12
    line = 0.5 * ((np.arange(side) + 0.5) / side - 0.5)
    grid = np.stack(np.meshgrid(line, line, [0.0], indexing="ij"), axis=-1)[:, :, 0]
    other = np.array([[[0.05, -0.03, 0.0]]]) if kind == "single" else grid
    laser, sensor = grid.reshape(-1, 3), other.reshape(-1, 3)
    if kind == "exhaustive":
        laser, sensor = np.repeat(laser, side**2, axis=0), np.tile(sensor, (side**2, 1))
    time = BIN * (np.arange(BINS) + 0.5)
    mean = np.full((len(laser), BINS), 0.2)
    for x, y, z, albedo in ((-0.1, 0.1, 0.5, 1.0), (0.1, 0.0, 0.6, 1.5), (0.0, -0.1, 0.8, 2.0)):
        point = np.array([x, y, z])
        there, back = (np.linalg.norm(p - point, axis=1) for p in (laser, sensor))
        late = time - (there + back)[:, None]
        pulse = np.where(late > 0, np.exp(-late / 0.06) * (1 - np.exp(-late / 0.008)), 0.0)
        mean += 3 * albedo * pulse / (there * back)[:, None] ** 2
    values = mean if kind == "expected" else np.random.default_rng(seed).poisson(mean)
    shape = (side,) * (4 if kind == "exhaustive" else 2)
    return {
        "H": values.T.reshape(BINS, *shape).astype(np.float32),
        "H_format": np.array([2 if kind == "exhaustive" else 1], np.int32),
        "sensor_xyz": np.array([0.0, 0.0, 0.3]), "laser_xyz": np.array([0.0, 0.0, 0.3]),
        "sensor_grid_xyz": other, "laser_grid_xyz": grid,
        "sensor_grid_normals": np.broadcast_to([0.0, 0.0, 1.0], other.shape),
        "laser_grid_normals": np.broadcast_to([0.0, 0.0, 1.0], grid.shape),
        "delta_t": BIN, "t_start": 0.0, "t_accounts_first_and_last_bounces": np.bool_(False),
        "scene_info": "name: nonsense\n",
    }  # fmt: skip


def put(**changes: Any) -> Callable[[Items, np.random.Generator], Items]:
    return lambda items, rng: {**items, **changes}


def values(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Callable[..., Items]:
    return lambda items, rng: {**items, "H": change(items["H"], rng)}


def scaled(factor: float, *names: str) -> Callable[[Items, np.random.Generator], Items]:
    return lambda items, rng: {**items, **{name: factor * np.asarray(items[name]) for name in names}}


def one(value: float) -> Callable[..., Items]:
    def change(counts: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        counts = counts.astype(np.float64)
        counts.flat[rng.integers(counts.size)] = value
        return counts

    return values(change)


POINTS = ("sensor_grid_xyz", "laser_grid_xyz")
NORMALS = ("sensor_grid_normals", "laser_grid_normals")
CASES: dict[str, Callable[[Items, np.random.Generator], Items]] = {
    "counts a million million times too large": values(lambda h, r: 1e13 * h),
    "counts of 1e-40": values(lambda h, r: 1e-40 * h.astype(np.float64)),
    "one count of 1e38": one(1e38),
    "one count of 1e300": one(1e300),
    "one NaN": one(np.nan),
    "one infinite count": one(np.inf),
    "one negative count": one(-3.0),
    "no counts": values(lambda h, r: 0 * h),
    "1e9 in every bin": values(lambda h, r: np.full_like(h, 1e9)),
    "1 in every bin": values(lambda h, r: np.ones_like(h)),
    "Poisson noise of mean 5": values(lambda h, r: r.poisson(5, h.shape)),
    "Poisson noise of mean 0.05": values(lambda h, r: r.poisson(0.05, h.shape)),
    "Poisson noise of mean 1e8": values(lambda h, r: r.poisson(1e8, h.shape)),
    "evenly distributed noise": values(lambda h, r: r.random(h.shape)),
    "counts shuffled along time": values(lambda h, r: r.permuted(h, axis=0)),
    "time reversed": values(lambda h, r: h[::-1].copy()),
    "counts as text": put(H=np.array([b"12", b"13"])),
    "complex counts": values(lambda h, r: h * 1j),
    "one axis too few": values(lambda h, r: h[0]),
    "times of the arrival for counts": values(
        lambda h, r: np.broadcast_to(np.arange(len(h)).reshape(-1, *[1] * (h.ndim - 1)), h.shape) + 0.0
    ),
    "delta_t=9.9": put(delta_t=9.9),
    "delta_t=0.95": put(delta_t=0.95),
    "delta_t in seconds": put(delta_t=4e-12),
    "delta_t in ps": put(delta_t=40.0),
    "delta_t in ns": put(delta_t=4e-6),
    "delta_t of zero": put(delta_t=0.0),
    "delta_t negative": put(delta_t=-BIN),
    "delta_t NaN": put(delta_t=np.nan),
    "delta_t as text": put(delta_t="12 mm"),
    "delta_t of each bin": put(delta_t=np.full(BINS, BIN)),
    "t_start of 1e5 m": put(t_start=1e5),
    "t_start of -1e5 m": put(t_start=-1e5),
    "t_start NaN": put(t_start=np.nan),
    "t_start infinite": put(t_start=np.inf),
    "t_start as text": put(t_start="late"),
    "t_start of each spot": put(t_start=np.zeros(4)),
    "wall in millimetres": scaled(1e3, *POINTS),
    "wall in kilometres": scaled(1e-3, *POINTS),
    "wall in light years": scaled(1e16, *POINTS),
    "all spots at one point": scaled(0.0, *POINTS),
    "positions NaN": scaled(np.nan, *POINTS),
    "positions as text": put(laser_grid_xyz=np.array([b"here"])),
    "positions of another scan": put(sensor_grid_xyz=np.zeros((3, 5, 3))),
    "positions in two coordinates": put(laser_grid_xyz=np.zeros((12, 12, 2))),
    "laser normals against the sensor's": scaled(-1.0, "laser_grid_normals"),
    "laser normals along the wall": put(laser_grid_normals=None),
    "normals along the wall": put(),
    "normals of zero": scaled(0.0, *NORMALS),
    "normals NaN": scaled(np.nan, *NORMALS),
    "normals as text": put(laser_grid_normals=np.array([b"up"])),
    "normals of another scan": put(laser_grid_normals=np.ones((2, 3, 3))),
    "t_accounts_first_and_last_bounces='yes'": put(t_accounts_first_and_last_bounces="yes"),
    "t_accounts_first_and_last_bounces=7": put(t_accounts_first_and_last_bounces=7),
    "t_accounts_first_and_last_bounces NaN": put(t_accounts_first_and_last_bounces=np.nan),
    "time from a laser that is nowhere": put(
        t_accounts_first_and_last_bounces=True, laser_xyz=h5py.Empty("f8")
    ),
    "time from a laser 100 m away": put(
        t_accounts_first_and_last_bounces=True, laser_xyz=np.array([0.0, 0.0, 100.0])
    ),
    "H_format=7": put(H_format=np.array([7], np.int32)),
    "H_format=1.7": put(H_format=1.7),
    "H_format as text": put(H_format="T_Sx_Sy"),
    "light outside the gate": put(scene_gate=(2, 60)),
    "a gate that ends before it begins": put(scene_gate=(90, 40)),
    "a gate behind the last bin": put(scene_gate=(900, 1000)),
    "a volume 50 m away": put(scene_depth=(50.0, 52.0)),
    "a volume 2 cm away": put(scene_depth=(0.02, 0.04)),
}  # fmt: skip
CASES["laser normals along the wall"] = lambda items, rng: {
    **items, "laser_grid_normals": np.broadcast_to([-1.0, 0.0, -0.3], items["laser_grid_xyz"].shape),
}  # fmt: skip
CASES["normals along the wall"] = lambda items, rng: {
    **items, **{n: np.broadcast_to([1.0, 0.0, 0.0], items[n].shape) for n in NORMALS},
}  # fmt: skip
OF_COUNTS = {
    "roots of counts": values(lambda h, r: np.sqrt(h)),
    "counts over the largest": values(lambda h, r: h / h.max()),
    "counts times four": values(lambda h, r: 4 * h),
    "counts less a background": values(lambda h, r: np.maximum(h - 0.5, -0.5)),
    "counts that were smoothed and rounded": values(
        lambda h, r: np.rint((h + np.roll(h, 1, 0) + np.roll(h, -1, 0)) / 3)
    ),
    "counts cut at 12": values(lambda h, r: np.minimum(h, 12)),
}
ALL = {
    f"{kind}: {name}": (kind, change)
    for kind in ("confocal", "single", "exhaustive", "expected")
    for name, change in (CASES if kind == "expected" else {**CASES, **OF_COUNTS}).items()
}


@functools.cache
def of_a_file() -> dict[str, Any]:
    """``scene=capture`` as composed, its file left open."""
    scene: dict[str, Any] = compose("train", ["scene=capture"])["scene"]
    return scene


def scene_of(file: Path, items: Items) -> dict[str, Any]:
    """``scene=capture`` with a file, and the settings that belong to a case."""
    scene = {**of_a_file(), "path": str(file)}
    scene["gate"] = items.get("scene_gate")
    scene["volume"] = {**scene["volume"], "depth": items.get("scene_depth")}
    return scene


def outcome(items: Items, folder: Path, force: bool = False) -> tuple[str, str]:
    """What loading a capture comes to: refused, warned or accepted, and what was said."""
    file = folder / "capture.hdf5"
    with h5py.File(file, "w") as held:
        for name, value in items.items():
            if not name.startswith("scene_") or name == "scene_info":
                held[name] = value
    said: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger(OURS)
    logger.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            load_scene(scene_of(file, items), folder, 0, force)
    except UserError as error:
        return "refused", str(error)
    except Exception as error:
        return "failed", f"{type(error).__name__}: {error}"
    finally:
        logger.removeHandler(handler)
    return ("warned", said[0]) if said else ("accepted", "")


def main(arguments: list[str]) -> None:
    given = dict(argument.split("=", 1) for argument in arguments[1:])
    seed = int(given.get("seed", 0))
    counted: dict[str, int] = {}
    silent = []
    for number, (name, (kind, change)) in enumerate(ALL.items()):
        with tempfile.TemporaryDirectory() as folder:
            items = change(base(kind, seed), np.random.default_rng([seed, number]))
            came, said = outcome(items, Path(folder))
        counted[came] = counted.get(came, 0) + 1
        print(f"{came:9s}{name}: {said[:160]}")
        if came in ("accepted", "failed"):
            silent.append(f"{name}: {came} {said}")
    row = {"part": "nonsense", "seed": seed, "tried": len(ALL), **counted, "failures": silent}
    add(arguments[0], row)


if __name__ == "__main__":
    main(sys.argv[1:])
