"""Reconstruct a hidden scene by self-calibration."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import lightning as L
import torch
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from nlos_lit.capture.errors import UserError
from nlos_lit.runtime.command_line import (
    output_folder,
    quiet_libraries,
    quote_numbers,
    refuse_finished_folder,
    write_config,
)
from nlos_lit.training.callbacks import History, ScoreHeldout
from nlos_lit.training.configs import register_settings
from nlos_lit.training.instantiate import build_all, builder
from nlos_lit.training.outcome import refine_run, write_results
from nlos_lit.training.run_folder import field_shards, find_checkpoint, prepare_run

log = logging.getLogger(__name__)
C = TypeVar("C", bound=L.Callback)


def prepare(arguments: list[str]) -> None:
    """What must be done before Hydra reads the command line ``arguments``, in place."""
    quote_numbers(arguments)
    refuse_finished_folder(arguments[1:])
    register_settings()


def train(config: DictConfig) -> None:
    """Train as ``conf/train.yaml`` says, export, refine where that is asked for, and say what came out.

    Raises:
        UserError: the data, the geometry or the settings cannot work.
    """
    began = time.perf_counter()
    quiet_libraries()
    folder = output_folder()
    checkpoint = find_checkpoint(config.ckpt_path, folder, config.scene.name)
    config.folder = str(folder)
    settings = write_config(config, folder)
    L.seed_everything(settings["seed"], verbose=False)
    if settings["threads"]:
        torch.set_num_threads(settings["threads"])
    trainer = make_trainer(settings)
    history = callback_of(trainer, History)
    callback_of(trainer, ScoreHeldout)
    device = "cuda" if settings["trainer"]["accelerator"] in ("gpu", "cuda") else "cpu"
    run = prepare_run(settings, device, field_shards(settings))
    try:
        trainer.fit(
            run.module, datamodule=run.data, ckpt_path=checkpoint, weights_only=True if checkpoint else None
        )
    except SystemExit:  # Lightning's answer to Ctrl-C
        name = settings["scene"]["name"]
        log.info(
            "interrupted; go on with: python train.py scene=%s ckpt_path=last hydra.run.dir=%s", name, folder
        )
        sys.exit(130)
    run.module.pipeline.phasor.hold()  # with the processes that end here
    if not trainer.is_global_zero:
        return
    refined = refine_run(run, folder) if settings["refine"] or settings["effects"] else None
    summary = write_results(run, history, folder, time.perf_counter() - began, refined)
    _tell(summary, folder)


def make_trainer(settings: Mapping[str, Any]) -> L.Trainer:
    """Trainer, loggers and callbacks as the config names them.

    Args:
        settings: the resolved config.

    Returns:
        The trainer; it has not begun.

    Raises:
        UserError: a class that is not to be built, an argument that it does not have or cannot use.
    """
    for name in ("logger", "callbacks"):
        if name in settings["trainer"]:
            raise UserError(f"trainer.{name} is not read: set the group {name}, {name}.NAME._target_=CLASS")
    loggers: list[Logger] = build_all(settings["logger"], Logger, "logger")
    callbacks: list[L.Callback] = build_all(settings["callbacks"], L.Callback, "callbacks")
    build = builder(settings["trainer"], L.Trainer, "trainer")
    try:
        return build(logger=loggers or False, callbacks=callbacks)
    except (MisconfigurationException, ValueError, TypeError) as error:
        raise UserError(f"Lightning's Trainer cannot be made: {str(error).splitlines()[0]}") from error


def callback_of(trainer: L.Trainer, kind: type[C]) -> C:
    """The trainer's callback of a kind.

    Args:
        trainer: as :func:`make_trainer` gives it.
        kind: class of the callback.

    Returns:
        The first of them.

    Raises:
        UserError: there is none, and a run could not be summarised.
    """
    for callback in trainer.callbacks:  # type: ignore[attr-defined]  # set by Lightning's connector
        if isinstance(callback, kind):
            return callback
    raise UserError(f"the group callbacks must hold {kind.__name__}: summary.json is written from it")


def _tell(summary: Mapping[str, Any], folder: Path) -> None:
    nmse, loss, refined = summary["heldout"]["nmse"], summary["loss"], summary["refined"]
    log.info(
        "held-out NMSE %.4f -> %.4f (noise %.4f), loss %.3e -> %.3e; results in %s",
        nmse["initial"], nmse["final"], nmse["noise_floor"], loss["initial"], loss["final"], folder,
    )  # fmt: skip
    if refined is not None:
        log.info("refined by %d surfels: held-out NMSE %.4f", refined["surfels"], refined["heldout"]["nmse"])
        for effect, reported in refined["effects"].items():
            values = (
                f"{name} {q['value']:.4g} {q['unit'].removeprefix('1')}".rstrip()
                for name, q in reported.items()
            )
            log.info("%s: %s", effect, ", ".join(values))
