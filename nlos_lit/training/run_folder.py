"""A run, from config to fit: built by ``train.py``, opened again by later commands."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
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
from nlos_lit.training.instantiate import builder
from nlos_lit.training.self_calibration import SelfCalibration

log = logging.getLogger(__name__)

NOT_OF_THE_CAPTURE = ("iterations", "threshold", "wavelength")  # settings of a scene
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
    """

    config: dict[str, Any]
    capture: Capture
    truth: SurfaceTruth | None
    data: CaptureDataModule
    module: SelfCalibration
    setup_seconds: float
    estimated_bytes: int
    extension: Extension


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


def prepare_run(config: Mapping[str, Any], device: torch.device | str = "cpu", shards: int = 1) -> Run:
    """Everything before the first iteration: capture, volume, memory, propagated phasor field, start values.

    Args:
        config: resolved, of ``train.py``.
        device: where the phasor field and the parameters are put.
        shards: processes that share the field; where there are several, it and the start values are made when
            the fit begins.

    Returns:
        The run, ready to fit.

    Raises:
        UserError: the data, the geometry or the settings cannot work; nothing has been written then.
    """
    began = time.perf_counter()
    scene, seed = config["scene"], int(config["seed"])
    capture, truth = load_scene(scene, config["data_dir"], seed)
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
    run = Run(dict(config), capture, truth, data, module, time.perf_counter() - began, estimated, extension)
    return run


def open_run(folder: str | Path) -> Run:
    """A finished run as its folder holds it: resolved config, capture, fitted module.

    Args:
        folder: of the run.

    Returns:
        The run, on the CPU, its parameters as fitted.

    Raises:
        UserError: the folder is not a run's, has no checkpoint, or is of another version.
    """
    folder = Path(folder)
    config, checkpoint = run_config(folder), folder / "checkpoints" / "last.ckpt"
    if not checkpoint.exists():
        raise UserError(
            f"{folder} is not the folder of a finished run: {checkpoint.relative_to(folder)} is missing"
        )
    run = prepare_run(config)
    load_fitted(run, checkpoint)
    return run


def load_fitted(run: Run, checkpoint: Path) -> None:
    """Take over fitted parameters and scores.

    Args:
        run: with the settings of the fitted one; changed in place.
        checkpoint: of the fitted run.
    """
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    run.module.load_state_dict(state["state_dict"])
    run.module.scores = state["scores"]


def fitted_of(folder: Path, settings: Mapping[str, Any]) -> Path:
    """The checkpoint of a finished run whose image other settings are to start from.

    Args:
        folder: of the run.
        settings: resolved; they must be of the same capture and held-out spots.

    Returns:
        The file.

    Raises:
        UserError: it is the folder of no finished run, or of one with another capture or held-out spots.
    """
    theirs, checkpoint = run_config(folder), folder / "checkpoints" / "last.ckpt"
    if not checkpoint.exists():
        raise UserError(
            f"{folder} is the folder of no finished self-calibration: checkpoints/last.ckpt is missing"
        )
    kept = [f"scene.{key}" for key in settings["scene"] if key not in NOT_OF_THE_CAPTURE]
    for key in [*kept, *(f"heldout.{key}" for key in settings["heldout"]), "seed"]:
        section, _, name = key.partition(".")
        mine, other = (s[section][name] if name else s[section] for s in (settings, theirs))
        if mine != other:
            raise UserError(
                f"run={folder} was made with {key}={other}, this command has {mine}; give the same"
            )
    return checkpoint


def find_checkpoint(
    ckpt_path: str | None, folder: Path, scene: str, place: str = "checkpoints"
) -> Path | None:
    """The checkpoint file to go on from.

    Args:
        ckpt_path: a file, or ``last``: that of ``folder``, else of the newest run beside it; None for none.
        folder: of the run that is about to begin.
        scene: its scene's name, for the error message.
        place: where in a run's folder its checkpoints are.

    Returns:
        The file; None where nothing is resumed.

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
    others = sorted(folder.parent.glob(f"*/{place}/last.ckpt"), key=lambda path: path.stat().st_mtime)
    if not others:
        raise UserError(
            f"ckpt_path=last: neither {folder} nor another run of '{scene}' beside it has {place}/last.ckpt"
        )
    return others[-1]


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
