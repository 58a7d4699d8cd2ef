"""A run, from config to fit: built by ``train.py``, opened again by later commands."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch.optim import Optimizer

from data_modules.load import load_scene
from data_modules.spots import CaptureDataModule
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.capture.volume_grid import volume_grid
from nlos_lit.effects import build_effects
from nlos_lit.effects.extension import Extension
from nlos_lit.model.build import PipelineSettings, build_pipeline, match_energy, normalisation
from nlos_lit.model.objective import Objective
from nlos_lit.model.phasor import PhasorPlan
from nlos_lit.runtime.memory import SMALLER, check_machine, parse_bytes, resident_bytes
from nlos_lit.runtime.progress import planes_progress
from nlos_lit.training.configs import run_config, settings_of
from nlos_lit.training.folder import OVERRIDES, begun_from
from nlos_lit.training.instantiate import builder
from nlos_lit.training.origin import (
    IMAGE,
    changed_since,
    check_origin,
    finished_checkpoint,
    origin_of,
    read_checkpoint,
    sound,
)
from nlos_lit.training.self_calibration import SelfCalibration

log = logging.getLogger(__name__)

NO_CHECKPOINTS: Mapping[Path, Sequence[str]] = MappingProxyType({})
LATER_LIBRARIES = 100 * 2**20  # what logging, figures and export load after the estimate


@dataclass
class Run:
    """A capture with the module that is fitted to it.

    Args:
        config: resolved, as ``config.yaml`` of the run's folder holds it.
        capture: the measurement.
        truth: the true surface; None where it is not known.
        data: batches of spots, held-out spots.
        module: what is fitted.
        setup_seconds: from the config to the first iteration.
        estimated_bytes: largest memory the run is expected to take.
        extension: effects, at their nulls, that are fitted with the surfels.
        origin: what the fit comes from, see :func:`~nlos_lit.training.origin.origin_of`.
    """

    config: dict[str, Any]
    capture: Capture
    truth: SurfaceTruth | None
    data: CaptureDataModule
    module: SelfCalibration
    setup_seconds: float
    estimated_bytes: int
    extension: Extension
    origin: dict[str, Any]


def field_shards(config: Mapping[str, Any]) -> int:
    """Processes that share the phasor field of a ``train.py`` config.

    Raises:
        UserError: shared by a single process, or by an unknown number of them.
    """
    devices = config["trainer"]["devices"]
    if not config["shard_field"]:
        return 1
    if not isinstance(devices, int) or devices < 2:
        raise UserError(
            "shard_field=true divides the phasor field among processes, which needs trainer=ddp and "
            f"trainer.devices=2 or more; found trainer.devices={devices}"
        )
    return devices


def prepare_run(
    config: Mapping[str, Any],
    device: torch.device | str = "cpu",
    shards: int = 1,
    opens: Mapping[Path, Sequence[str]] = NO_CHECKPOINTS,
    raw: Capture | None = None,
    change: Sequence[str] = (),
) -> Run:
    """Everything before the first iteration: capture, volume, memory, propagated phasor field, start values.

    Args:
        config: resolved, of ``train.py``.
        device: where the phasor field and the parameters are put.
        shards: processes that share the field; where there are several, it and the start values are made when
            the fit begins.
        opens: checkpoints that the run is to go on from → sections of settings that they must share.
        raw: the scene's file, where it has been read already.
        change: settings that may differ from those of the checkpoints.

    Returns:
        The run, ready to fit.

    Raises:
        UserError: the data, the geometry or the settings cannot work, or a checkpoint is of something else;
            nothing has been written then.
    """
    began = time.perf_counter()
    scene, seed = config["scene"], int(config["seed"])
    capture, truth = load_scene(scene, config["data_dir"], seed, config["force"], raw)
    origin = origin_of(config, capture)
    for file, sections in opens.items():
        check_origin(file, origin, sections, change)
        if sections == IMAGE:
            origin["changed"] = changed_since(file, origin, change)
    effects = config["effects"]
    extension = Extension(build_effects([effects] if isinstance(effects, str) else effects, Scan.of(capture)))
    grid = volume_grid(capture, **scene["volume"])
    data = CaptureDataModule(
        capture,
        batch=config["batch_spots"],
        block=config["heldout"]["block"],
        every=config["heldout"]["every"],
        monitor_spots=config["heldout"]["monitor_spots"],
        seed=seed,
    )
    settings = settings_of(PipelineSettings, config["model"], "model")
    method = builder(config["optimizer"]["method"], Optimizer, "optimizer.method")
    pipeline = build_pipeline(capture, grid, settings).to(device)
    plan = pipeline.phasor.plan(capture, parse_bytes(config["memory_budget"]), shards)
    rays = settings.rays**2 * config["batch_spots"]
    planned = run_bytes(plan, grid.n_voxels, rays) + LATER_LIBRARIES
    check_machine(planned * shards, "this run", f"{SMALLER}, or lower batch_spots")
    estimated = planned + resident_bytes()
    log.info(
        "%s: %d spots x %d bins of %.3g ps, %s; volume %d x %d x %d voxels, depth %.3g to %.3g m",
        scene["name"], capture.n_spots, capture.n_bins, capture.bin_width_ps, capture.kind,
        *grid.shape[1:], grid.shape[0], grid.z[0], grid.z[-1],
    )  # fmt: skip
    log.info("%s; about %.1f GiB in all", plan, estimated / 2**30)
    imaged = None if config["heldout"]["imaging"] else data.train_spots
    start = np.random.default_rng([seed, 1]).permutation(data.train_spots)[: config["batch_spots"] * 2]

    def prepare() -> None:
        with planes_progress("propagating the phasor field") as progress:
            pipeline.phasor.prepare(capture, plan, spots=imaged, progress=progress)
        match_energy(pipeline, capture, torch.from_numpy(np.sort(start)).to(device))

    def prepare_shared() -> None:
        began = time.perf_counter()
        prepare()
        run.setup_seconds += time.perf_counter() - began

    if shards == 1:
        prepare()
    scale = normalisation(capture)
    module = SelfCalibration(
        pipeline,
        settings_of(Objective, config["objective"], "objective", scale=scale, seed=seed),
        optimise=config["ablation"]["optimise"],
        optimizer=method,
        rates=config["optimizer"]["rates"],
        prepare=prepare_shared if shards > 1 else None,
    )
    module.origin = origin
    seconds = time.perf_counter() - began
    run = Run(dict(config), capture, truth, data, module, seconds, estimated, extension, origin)
    return run


def open_run(folder: str | Path) -> Run:
    """A finished run as its folder holds it: resolved config, capture, fitted module.

    Args:
        folder: of the run.

    Returns:
        The run, on the CPU, its parameters as fitted.

    Raises:
        UserError: the folder is not a run's, the run was not carried through, is of another version, or of
            what its capture's file held before.
    """
    config, checkpoint = run_config(folder), finished_checkpoint(Path(folder))
    run = prepare_run(config, opens={checkpoint: IMAGE})
    load_fitted(run, checkpoint)
    return run


def load_fitted(run: Run, checkpoint: Path) -> None:
    """Take over fitted parameters and scores.

    Args:
        run: with the settings of the fitted one; changed in place.
        checkpoint: of the fitted run.
    """
    state = read_checkpoint(checkpoint)
    with sound(checkpoint):
        run.module.load_state_dict(state["state_dict"])
        run.module.scores = state["scores"]


def find_checkpoint(
    ckpt_path: str | None, folder: Path, scene: str, place: str = "checkpoints"
) -> Path | None:
    """The checkpoint file to go on from.

    Args:
        ckpt_path: a file, or ``last``: that of ``folder`` where a run was begun there, else of the newest run
            beside it; None for none.
        folder: of the run that is about to begin.
        scene: its scene's name, for the error message.
        place: where in a run's folder its checkpoints are.

    Returns:
        The file; None where nothing is resumed. A run that was stopped before its own first one begins again
        from what it was begun from.

    Raises:
        UserError: there is none.
    """
    if ckpt_path is None:
        return None
    if ckpt_path != "last":
        if not Path(ckpt_path).is_file():
            raise UserError(f"ckpt_path={ckpt_path} does not exist; give a checkpoint file or ckpt_path=last")
        return Path(ckpt_path)
    own = folder / place / "last.ckpt"
    if own.exists():
        return own
    if (folder / OVERRIDES).exists():
        log.info("%s holds no checkpoint yet: the run begins again", folder)
        return begun_from(folder)
    others = sorted(folder.parent.glob(f"*/{place}/last.ckpt"), key=lambda path: path.stat().st_mtime)
    if not others:
        raise UserError(
            f"ckpt_path=last: neither {folder} nor another run of '{scene}' beside it has {place}/last.ckpt"
        )
    return others[-1]


_PICTURES = (
    36 * 2**20
)  # figures as files and in TensorBoard, points, mesh, two pages (one replaces the other)
_SCRATCH = 100 * 2**20  # runs of samples that are worked on at once


def run_bytes(plan: PhasorPlan, n_voxels: int, rays: int) -> int:
    """What a run takes beyond what its process holds before the field is propagated.

    Measured parts: a voxel costs an iteration about 18 numbers (intensity, albedo, gradients, Adam's
    moments), a ray 120 bytes of directions, tables and the tenth of rays that meet something. Matching the
    energy looks at twice the spots without gradients.

    Args:
        plan: what the propagated field takes.
        n_voxels: of the volume.
        rays: of all spots of an iteration together.

    Returns:
        Bytes at the run's peak.
    """
    iterating = 72 * n_voxels + 120 * rays
    matching = 24 * n_voxels + 180 * rays
    return max(plan.total_bytes, plan.resident_bytes + max(iterating, matching) + _SCRATCH)


def run_disk_bytes(n_voxels: int) -> int:
    """What a run writes: three checkpoints (one while it replaces another), volume and albedo, pictures.

    A checkpoint holds three numbers a voxel: its albedo and Adam's two moments.

    Args:
        n_voxels: of the volume.

    Returns:
        Bytes.
    """
    return (3 * 12 + 8) * n_voxels + _PICTURES
