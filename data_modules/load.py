"""From a scene's config to its capture: find or simulate the data, read it, gate it, sum it down."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pooch
import yaml

from data_modules.nonsense import nonsense, volume_without_light
from data_modules.plan import plan_capture
from data_modules.readers import ReaderOptions, read_capture
from data_modules.simulate import SCENES, ScanPlan, SensorModel, Truth, load_truth, simulate_capture
from data_modules.suspicions import suspicions, whole_numbers
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.places import CONF

log = logging.getLogger(__name__)


def load_scene(
    scene: Mapping[str, Any],
    data_dir: str | Path,
    seed: int,
    force: bool = False,
    raw: Capture | None = None,
) -> tuple[Capture, SurfaceTruth | None]:
    """The scene's capture, ready to fit, and the true surface where it is known.

    What looks wrong in a file's counts is told in the log.

    Args:
        scene: a config of conf/scene.
        data_dir: folder in which downloaded files are looked for.
        seed: of the photon statistics of a simulated scene.
        force: what cannot be a capture of a hidden scene is told in the log, too, and not refused.
        raw: the scene's file, where it has been read already (:func:`read_scene`).

    Returns:
        Counts summed and gated as the scene says; the surface as seen from the wall, or None.

    Raises:
        UserError: the data are not there (says where they come from and where to put them) or not usable, or
            they cannot be a capture of a hidden scene (:func:`~data_modules.nonsense.nonsense`).
    """
    looks_wrong: list[str] = []
    simulated = scene["simulate"] is not None and scene["path"] is None
    if simulated:
        capture, truth = _simulate(scene["simulate"], seed)
    else:
        raw = read_scene(scene, data_dir) if raw is None else raw
        scene = planned_scene(scene, data_dir, force, raw)[0]
        capture, truth = raw, None
        looks_wrong += whole_numbers(capture)  # sums hide it
    if scene["truth"] is not None:
        truth = _truth(load_truth(Path(scene["truth"])))
    capture = capture.sum_bins(scene["sum_bins"]).sum_spots(scene["sum_spots"])
    if scene["gate"] is not None:
        capture = capture.with_gate(*scene["gate"])
    depth = scene["volume"]["depth"]
    wrong = nonsense(capture) or ([] if depth is None else volume_without_light(capture, tuple(depth)))
    _refuse(wrong, force)
    if not wrong and not simulated:
        looks_wrong += suspicions(capture)
    for sentence in wrong or dict.fromkeys(looks_wrong):
        log.warning("%s", sentence)
    return capture, truth


def read_scene(scene: Mapping[str, Any], data_dir: str | Path) -> Capture:
    """The scene's file as it is: not summed, and gated as its reader does.

    Args:
        scene: a config of conf/scene.
        data_dir: folder in which downloaded files are looked for.

    Returns:
        The capture.

    Raises:
        UserError: it is not there, or not usable.
    """
    path = find_file(scene, Path(data_dir))
    return read_capture(path, scene["format"], options=reader_options(scene["reader"]))


def planned_scene(
    scene: Mapping[str, Any], data_dir: str | Path, force: bool = False, raw: Capture | None = None
) -> tuple[dict[str, Any], Capture | None]:
    """A scene with what it leaves to its data filled in: bins to sum, gate, depths.

    Args:
        scene: a config of conf/scene; ``sum_bins`` or ``volume.depth`` may be null.
        data_dir: folder in which downloaded files are looked for.
        force: what cannot be a capture of a hidden scene is planned for, too.
        raw: as of :func:`load_scene`.

    Returns:
        The scene, and the capture as it will be fitted, where it had to be read.

    Raises:
        UserError: the data are not there, cannot be a capture of a hidden scene, or show no light to plan by.
    """
    depth = scene["volume"]["depth"]
    if scene["sum_bins"] is not None and depth is not None:
        return dict(scene), None
    path = find_file(scene, Path(data_dir))
    capture = (read_scene(scene, data_dir) if raw is None else raw).sum_spots(scene["sum_spots"])
    _refuse(nonsense(capture), force)
    plan = plan_capture(capture, scene["wavelength"], scene["sum_bins"], scene["gate"])
    capture = capture.sum_bins(plan.sum_bins).with_gate(*plan.gate)
    _refuse(nonsense(capture), force)
    if depth is None and plan.depth is None:
        raise UserError(
            f"{path.name}: no light that comes back stands out of the noise, so the depths of the volume "
            "cannot be told from the data; give them as 'scene.volume.depth=[NEAR,FAR]' (m)"
        )
    volume = {**scene["volume"], "depth": list(plan.depth or ()) if depth is None else depth}
    planned = {**scene, "sum_bins": plan.sum_bins, "gate": list(plan.gate), "volume": volume}
    near, far = volume["depth"]
    log.info(
        "plan for %s: %d bins summed to %.3g ps, gate [%d, %d), depth %.3g to %.3g m, planes %.3g mm apart, "
        "for a wavelength of %.3g cm; scene.sum_bins, scene.gate, scene.volume.depth, "
        "scene.volume.depth_pitch and scene.wavelength override it",
        path.name, plan.sum_bins, capture.bin_width_ps, *plan.gate, near, far,
        1e3 * (volume["depth_pitch"] or plan.depth_pitch), 100 * plan.wavelength,
    )  # fmt: skip
    return planned, capture


def _refuse(wrong: list[str], force: bool) -> None:
    if wrong and not force:
        raise UserError(f"{wrong[0]} (force=true goes on)")


def find_file(scene: Mapping[str, Any], data_dir: Path) -> Path:
    """The scene's file, downloaded where it is missing and a URL and a checksum are known.

    Only sources of conf/scene are downloaded: a run's folder, whose config says the scene, can be foreign.

    Args:
        scene: a config of conf/scene.
        data_dir: where it is looked for; ``scene.path`` comes first.

    Returns:
        A file, or a folder of files, that is there.

    Raises:
        UserError: it is not there, with where it comes from and where to put it.
    """
    if scene["path"] is not None:
        path = Path(scene["path"])
        if not path.exists():
            raise UserError(f"scene.path={path} does not exist")
        return path
    source = scene["source"]
    if source is None:
        raise UserError(
            f"the scene '{scene['name']}' takes any capture file: give it as scene.path=FILE "
            "(docs/formats.md lists the formats)"
        )
    path = data_dir / source["file"]
    if path.exists():
        return path
    if source["url"] is not None and source["sha256"] is not None:
        if dict(source) not in shipped_sources():
            raise UserError(
                f"{source['url']} is no address of this project's own scenes; nothing is downloaded from it: "
                f"fetch it by hand, put it at {path}, or give scene.path=FILE"
            )
        log.info("downloading %s from %s", source["file"], source["url"])
        try:
            fetched = pooch.retrieve(
                source["url"], f"sha256:{source['sha256']}", path.name, path.parent, progressbar=True
            )
        except Exception as problem:
            raise UserError(
                f"could not download {source['url']} ({problem}); fetch it by hand, put it at {path}, "
                "or give scene.path=FILE"
            ) from problem
        return Path(fetched)
    raise UserError(
        f"the scene '{scene['name']}' needs {source['file']}, which is not in {data_dir}/. "
        f"It comes from {source['origin']}. Download it there and put it at {path}, "
        "or give its place as scene.path=FILE"
    )


@functools.cache
def shipped_sources() -> list[dict[str, Any]]:
    """Where the data of this project's own scenes come from."""
    configs = (yaml.safe_load(file.read_text(encoding="utf-8")) for file in (CONF / "scene").glob("*.yaml"))
    return [config["source"] for config in configs if config.get("source")]


def reader_options(reader: Mapping[str, Any]) -> ReaderOptions:
    """What the section ``reader`` of a scene says."""
    values = dict(reader)
    if isinstance(values["wall_size"], list):
        values["wall_size"] = tuple(values["wall_size"])
    if isinstance(values["scan_order"], list):
        values["scan_order"] = np.array(values["scan_order"])
    return ReaderOptions(**values)


def _simulate(plan: Mapping[str, Any], seed: int) -> tuple[Capture, SurfaceTruth]:
    lacking = [name for name in ("mesh", "scan", "sensor") if name not in plan]
    if lacking:
        raise UserError(
            f"scene.simulate lacks {' and '.join(lacking)}: leave it out for a scene that comes from a file, "
            "or take scene=default"
        )
    mesh = plan["mesh"]
    if mesh not in SCENES:
        raise UserError(f"no procedural scene is called {mesh!r}; there are {', '.join(SCENES)}")
    capture, truth = simulate_capture(
        SCENES[mesh](), ScanPlan(**plan["scan"]), SensorModel(**plan["sensor"]), seed=seed, progress=True
    )
    return capture, _truth(truth)


def _truth(truth: Truth) -> SurfaceTruth:
    return SurfaceTruth(truth.x, truth.y, truth.depth, truth.normal, truth.albedo)
