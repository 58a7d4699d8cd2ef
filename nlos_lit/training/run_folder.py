"""A run, from config to results: built by ``train.py``, opened again by later commands."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

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
from nlos_lit.model.phasor import PhasorPlan
from nlos_lit.runtime.memory import check_machine, parse_bytes, resident_bytes
from nlos_lit.runtime.progress import planes_progress
from nlos_lit.training.self_calibration import SelfCalibration

log = logging.getLogger(__name__)

LATER_LIBRARIES = 100 * 2**20  # what logging, figures and export load after the estimate

_MODULE_KEYS = ("rates", "clip", "lambda_sparsity", "lambda_albedo", "albedo_planes")


@dataclass
class Run:
    """A capture with the module that is fitted to it, and effects, at their nulls, that are fitted with the
    surfels.
    """

    config: dict[str, Any]
    capture: Capture
    truth: SurfaceTruth | None
    data: CaptureDataModule
    module: SelfCalibration
    setup_seconds: float
    estimated_bytes: int
    extension: Extension


def pipeline_settings(model: Mapping[str, Any]) -> PipelineSettings:
    """What the pipeline takes of a ``model`` config; the rest is the optimiser's."""
    return PipelineSettings(**{name: value for name, value in model.items() if name not in _MODULE_KEYS})


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
            "shard_field=true divides the phasor field among processes, which needs trainer=ddp and trainer.devices=2 or more; "
            f"found trainer.devices={devices}"
        )
    return devices


def prepare_run(config: Mapping[str, Any], device: torch.device | str = "cpu", shards: int = 1) -> Run:
    """Everything before the first iteration: capture, volume, memory estimate, propagated phasor field, start
    values.

    Where several processes share the field (``shards``), it and the start values are made when the fit
    begins.

    Raises:
        UserError: the data, the geometry or the settings cannot work; nothing has been written then.
    """
    began = time.perf_counter()
    scene, seed = config["scene"], int(config["seed"])
    capture, truth = load_scene(scene, config["data_dir"], seed)
    effects = config.get("effects", [])  # of older runs' folders: none
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
    settings = pipeline_settings(config["model"])
    pipeline = build_pipeline(capture, grid, settings).to(device)
    plan = pipeline.phasor.plan(capture, parse_bytes(config["memory_budget"]), shards)
    rays = settings.rays**2 * config["batch_spots"]
    planned = run_bytes(plan, grid.n_voxels, rays) + LATER_LIBRARIES
    check_machine(planned * shards, "this run")
    estimated = planned + resident_bytes()
    log.info(
        "%s: %d spots x %d bins of %.3g ps, %s; volume %d x %d x %d voxels, depth %.3g to %.3g m",
        scene["name"], capture.n_spots, capture.n_bins, capture.bin_width_ps, capture.kind, *grid.shape[1:], grid.shape[0],
        grid.z[0], grid.z[-1],
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
    model, optimise = config["model"], config["ablation"]["optimise"]
    module = SelfCalibration(
        pipeline,
        normalisation(capture),
        optimise=optimise,
        rates=model["rates"],
        lambda_sparsity=model["lambda_sparsity"],
        lambda_albedo=model["lambda_albedo"],
        albedo_planes=model["albedo_planes"],
        clip=model["clip"],
        seed=seed,
        prepare=prepare_shared if shards > 1 else None,
    )
    run = Run(dict(config), capture, truth, data, module, time.perf_counter() - began, estimated, extension)
    return run


def open_run(folder: str | Path) -> Run:
    """A finished run as its folder holds it: resolved config, capture, fitted module.

    Raises:
        UserError: the folder is not a run, or has no checkpoint.
    """
    folder = Path(folder)
    config_file, checkpoint = folder / "config.yaml", folder / "checkpoints" / "last.ckpt"
    for needed in (config_file, checkpoint):
        if not needed.exists():
            raise UserError(
                f"{folder} is not the folder of a finished run: {needed.relative_to(folder)} is missing"
            )
    run = prepare_run(OmegaConf.to_container(OmegaConf.load(config_file)))
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    run.module.load_state_dict(state["state_dict"])
    run.module.scores = state["scores"]
    return run


def find_checkpoint(ckpt_path: str | None, folder: Path, scene: str) -> Path | None:
    """The checkpoint file to go on from; ``last`` is that of ``folder``, else of the scene's newest run
    beside it.

    Raises:
        UserError: there is none.
    """
    if ckpt_path is None:
        return None
    if ckpt_path != "last":
        if not Path(ckpt_path).is_file():
            raise UserError(f"ckpt_path={ckpt_path} does not exist; give a checkpoint file or ckpt_path=last")
        return Path(ckpt_path)
    own = folder / "checkpoints" / "last.ckpt"
    if own.exists():
        return own
    others = sorted(folder.parent.glob("*/checkpoints/last.ckpt"), key=lambda path: path.stat().st_mtime)
    if not others:
        raise UserError(
            f"ckpt_path=last: neither {folder} nor another run of '{scene}' beside it has checkpoints/last.ckpt"
        )
    return others[-1]


_SCRATCH = 100 * 2**20  # runs of samples that are worked on at once


def run_bytes(plan: PhasorPlan, n_voxels: int, rays: int) -> int:
    """What a run takes beyond what its process holds before the field is propagated.

    Measured parts: a voxel costs an iteration about 18 numbers (intensity, albedo, gradients, Adam's
    moments), a ray 120 bytes of directions, tables and the tenth of rays that meet something. Matching the
    energy looks at twice the spots without gradients.

    Args:
        n_voxels: of the volume.
        rays: of all spots of an iteration together.
    """
    iterating = 72 * n_voxels + 120 * rays
    matching = 24 * n_voxels + 180 * rays
    return max(plan.total_bytes, plan.resident_bytes + max(iterating, matching) + _SCRATCH)
