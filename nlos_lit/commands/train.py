"""Reconstruct a hidden scene: by self-calibration, as a surface, or by the one and then the other."""

from __future__ import annotations

import logging
import math
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import lightning as L
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from nlos_lit.capture.errors import UserError
from nlos_lit.commands.composed import compose_and_run
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.runtime.command_line import (
    output_folder,
    quiet_libraries,
    quote_numbers,
    sentence_errors,
    typed,
)
from nlos_lit.runtime.memory import check_disk
from nlos_lit.runtime.threads import choose_threads
from nlos_lit.training.callbacks import History, ScoreHeldout
from nlos_lit.training.configs import register_settings, run_config
from nlos_lit.training.explored import mark_interrupted
from nlos_lit.training.folder import (
    OVERRIDES,
    begin_training,
    goes_on_in,
    resolved,
    resume_run,
    take_folder,
    take_given_folder,
)
from nlos_lit.training.instantiate import build_all, builder
from nlos_lit.training.origin import IMAGE, START, SURFACE, check_origin, finished_checkpoint
from nlos_lit.training.outcome import explore_results, write_results, write_surface_summary
from nlos_lit.training.run_folder import (
    Run,
    field_shards,
    find_checkpoint,
    load_fitted,
    prepare_run,
    run_disk_bytes,
)
from nlos_lit.training.surface_fitting import SurfaceFitting
from nlos_lit.training.surface_run import prepare_surface, write_surface

log = logging.getLogger(__name__)
C = TypeVar("C", bound=L.Callback)


def main(arguments: list[str]) -> int:
    """Run the command with the arguments of its command line; the exit status."""
    return compose_and_run("train", prepare, train, arguments)


@sentence_errors
def prepare(arguments: list[str]) -> None:
    """What must be done before Hydra reads the command line ``arguments``, in place."""
    quote_numbers(arguments)
    resume_run(arguments)
    take_given_folder(arguments[1:])
    register_settings()


def train(config: DictConfig) -> float | None:
    """Fit as ``conf/train.yaml`` says, export, and say what came out.

    That is a self-calibration, the surface, or with ``refine=true`` the one and then the other.

    Returns:
        The held-out NMSE after the fit, which a sweeper can bring down; None in processes that only help.

    Raises:
        UserError: the data, the geometry or the settings cannot work.
    """
    began = time.perf_counter()
    quiet_libraries()
    folder = output_folder()
    take_folder(folder, goes_on_in(folder, config.ckpt_path))
    alone = config.fit == "surface"
    if alone and config.run is not None:
        config.model = run_config(config.run)["model"]  # the image is formed as it was there
    if config.resume.change and (alone or config.ckpt_path is None):
        raise UserError(
            "resume.change names what a self-calibration does otherwise while it goes on: give it with "
            "resume=FOLDER, or leave it out"
        )
    place = "refined/checkpoints" if alone else "checkpoints"
    checkpoint = find_checkpoint(config.ckpt_path, folder, config.scene.name, place)
    config.folder = str(folder)
    settings = resolved(config)
    L.seed_everything(settings["seed"], verbose=False)
    choose_threads(settings["threads"], 1 if settings["trainer"]["devices"] in (1, "auto") else 2)
    config.folder = str(folder / "refined")
    of_surface = surface_settings(resolved(config), alone)
    fit = _surface_alone if alone else _self_calibration
    try:
        summary = fit(settings, of_surface, folder, checkpoint, began)
    except KeyboardInterrupt:
        mark_interrupted(folder)
        if (folder / OVERRIDES).exists():
            again = shlex.quote(f"resume={folder}")
            log.info("interrupted; go on with: %s %s", typed("train"), again)
        else:
            log.info("interrupted before the first iteration; begin again with the same command")
        sys.exit(130)
    if summary is None:
        return None
    _tell(summary, folder)
    return float(summary["heldout"]["nmse"]["final"])


def _self_calibration(
    settings: dict[str, Any], of_surface: dict[str, Any], folder: Path, checkpoint: Path | None, began: float
) -> dict[str, Any] | None:
    """Fit, then the surface where that is asked for; None in processes that only help."""
    if settings["fit"] != "volume" or settings["run"] is not None:
        raise UserError(
            f"found fit={settings['fit']} and run={settings['run']}: a self-calibration starts from nothing; "
            "to fit the surface of a finished run give model=surface run=FOLDER"
        )
    trainer = make_trainer(settings)
    history = callback_of(trainer, History)
    callback_of(trainer, ScoreHeldout)
    run = prepare_run(
        settings,
        device_of(settings),
        field_shards(settings),
        opened(checkpoint, IMAGE),
        change=settings["resume"]["change"],
    )
    if trainer.is_global_zero:
        check_disk(folder, run_disk_bytes(run.module.pipeline.phasor.grid.n_voxels), "this run")
        begin_training(settings, folder, checkpoint)
    fit_or_leave(trainer, run.module, run, checkpoint)
    if trainer.checkpoint_callbacks:  # also where the last iteration is none of every n-th
        trainer.save_checkpoint(folder / "checkpoints" / "last.ckpt")
    run.module.pipeline.phasor.hold()  # with the processes that end here
    if not trainer.is_global_zero:
        return None
    refined = surface = None
    if settings["refine"] or settings["effects"]:
        begun = folder / "refined" / "checkpoints" / "last.ckpt"
        goes_on = checkpoint is not None and history.ran == 0 and begun.exists()
        if goes_on:
            check_origin(begun, run.origin, SURFACE)
        refined, surface, _ = _surface(run, of_surface, folder, begun if goes_on else None)
    summary = write_results(run, history, folder, time.perf_counter() - began, refined)
    explore_results(run, folder, summary, surface)
    return summary


def _surface_alone(
    settings: dict[str, Any], of_surface: dict[str, Any], folder: Path, checkpoint: Path | None, began: float
) -> dict[str, Any]:
    """The surface of the phasor image with start values, or of the image of a finished run."""
    source = None if settings["run"] is None else finished_checkpoint(Path(settings["run"]))
    make_trainer(of_surface)  # what cannot work is said before the image is formed
    opens = {**opened(source, START), **opened(checkpoint, SURFACE)}
    run = prepare_run(settings, device_of(settings), opens=opens)
    begin_training(settings, folder, checkpoint)
    if source is not None:
        load_fitted(run, source)
    run.module.pipeline.phasor.hold()
    response = None if source is None else run.module.pipeline.laser_sensor
    refined, module, history = _surface(run, of_surface, folder, checkpoint, response)
    summary = write_surface_summary(run, module, history, folder, time.perf_counter() - began, refined)
    explore_results(run, folder, summary, module)
    return summary


def _surface(
    run: Run,
    of_surface: dict[str, Any],
    folder: Path,
    checkpoint: Path | None,
    response: LaserSensor | None = None,
) -> tuple[dict[str, Any], SurfaceFitting, History]:
    """Fit and export the surface of a run's image: the summary's entry, the module, the history."""
    began = time.perf_counter()
    trainer = make_trainer(of_surface)
    history = callback_of(trainer, History)
    callback_of(trainer, ScoreHeldout)
    module = prepare_surface(run, response)
    fit_or_leave(trainer, module, run, checkpoint)
    if trainer.checkpoint_callbacks:
        trainer.save_checkpoint(folder / "refined" / "checkpoints" / "last.ckpt")
    return write_surface(run, module, folder / "refined", began), module, history


def surface_settings(settings: dict[str, Any], alone: bool) -> dict[str, Any]:
    """Settings of the Trainer that fits the surface: one process, until the fit says that it is done.

    Args:
        settings: resolved, with the folder of the surface.
        alone: nothing is fitted before it.

    Returns:
        The same with another section ``trainer``.

    Raises:
        UserError: several processes were asked for, and there is only the surface to fit.
    """
    trainer = settings["trainer"]
    if alone and (trainer["devices"] not in (1, "auto") or settings["shard_field"]):
        raise UserError(
            f"model=surface is fitted in one process; found trainer.devices={trainer['devices']} and "
            f"shard_field={settings['shard_field']}: leave trainer=ddp and shard_field out"
        )
    one = {"devices": 1, "num_nodes": 1, "strategy": "auto", "precision": "32-true"}
    by_itself = {"max_epochs": -1, "gradient_clip_val": None}
    return {**settings, "trainer": {**trainer, **one, **by_itself}}


def device_of(settings: Mapping[str, Any]) -> str:
    """Where a Trainer with these settings puts a module, for what is made before it begins."""
    return "cuda" if settings["trainer"]["accelerator"] in ("gpu", "cuda") else "cpu"


def opened(checkpoint: Path | None, sections: Sequence[str]) -> dict[Path, Sequence[str]]:
    """As :func:`~nlos_lit.training.run_folder.prepare_run` takes it.

    Args:
        checkpoint: that is opened, if any.
        sections: of settings that it must share.

    Returns:
        one entry or none.
    """
    return {} if checkpoint is None else {checkpoint: sections}


def fit_or_leave(trainer: L.Trainer, module: L.LightningModule, run: Run, checkpoint: Path | None) -> None:
    """Fit.

    Args:
        trainer: as :func:`make_trainer` gives it.
        module: that is fitted.
        run: whose data are taken.
        checkpoint: to go on from.

    Raises:
        KeyboardInterrupt: the user stopped it.
    """
    try:
        trainer.fit(
            module, datamodule=run.data, ckpt_path=checkpoint, weights_only=True if checkpoint else None
        )
    except SystemExit as stopped:  # Lightning's answer to Ctrl-C
        raise KeyboardInterrupt from stopped


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
    noise = f" (noise {nmse['noise_floor']:.4f})" if math.isfinite(nmse["noise_floor"]) else ""
    log.info(
        "held-out NMSE %.4f -> %.4f%s, loss %.3e -> %.3e; results in %s",
        nmse["initial"], nmse["final"], noise, loss["initial"], loss["final"], folder,
    )  # fmt: skip
    if refined is not None:
        log.info("refined by %d surfels: held-out NMSE %.4f", refined["surfels"], refined["heldout"]["nmse"])
        for effect, reported in refined["effects"].items():
            values = (
                f"{name} {q['value']:.4g} {q['unit'].removeprefix('1')}".rstrip()
                for name, q in reported.items()
            )
            log.info("%s: %s", effect, ", ".join(values))
    log.info("to look at it: %s %s", typed("view"), shlex.quote(str(folder)))
