"""Say what the simulation gets wrong about a capture."""

from __future__ import annotations

import json
import logging
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from data_modules.load import load_scene
from nlos_lit.capture.errors import UserError
from nlos_lit.commands.composed import compose_and_run
from nlos_lit.commands.split_with import check_told, second_capture, split_with
from nlos_lit.inference.diagnose import diagnose as diagnose_capture
from nlos_lit.inference.diagnose import split_of
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.report.diagnosis_figures import diagnosis_figures
from nlos_lit.report.page import log_figures, write_report
from nlos_lit.report.verdict import verdict
from nlos_lit.runtime.claim import claim
from nlos_lit.runtime.command_line import (
    output_folder,
    quote_numbers,
    sentence_errors,
    settings_as_words,
    stay_in_run,
    typed,
)
from nlos_lit.runtime.progress import StepTicker
from nlos_lit.runtime.threads import choose_threads
from nlos_lit.training.configs import pipeline_of, register_settings, settings_of
from nlos_lit.training.explored import mark_interrupted
from nlos_lit.training.folder import begun_with, resolved, take_folder, take_given_folder, write_config
from nlos_lit.training.run_folder import Run, open_run
from nlos_lit.training.watched import WatchedDiagnosis

log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command with the arguments of its command line; the exit status."""
    return compose_and_run("diagnose", prepare, diagnose, arguments)


@sentence_errors
def prepare(arguments: list[str]) -> None:
    """What must be done before Hydra reads the command line ``arguments``, in place."""
    quote_numbers(arguments)
    take_given_folder(arguments[1:])
    stay_in_run(arguments)
    register_settings()


def diagnose(config: DictConfig) -> None:
    """Diagnose a capture, or the one of a finished run, as ``conf/diagnose.yaml`` says, and write the report.

    Where ``split_with`` names another capture, it is asked which of the names that are open stay.

    Raises:
        UserError: the data or the settings cannot work, or there is a diagnosis already.
    """
    began = time.perf_counter()
    folder = output_folder() if config.run is None else Path(config.run)
    choose_threads(config.threads)
    settings = resolved(config)
    done = folder / "diagnosis" / "diagnosis.json"
    if config.split_with is None:
        diagnose_first(config, settings, folder)
    else:
        again = config.run is not None and done.exists()
        if again:
            claim(folder)
            check_told(done.parent)
        # What cannot be read is told before the first capture takes its time.
        second = second_capture(settings, None if config.run is None else folder)
        if not again:
            diagnose_first(config, settings, folder)
        split_with(settings, folder, second, scene_settings(config, folder))
    page = folder / "diagnosis" / "report.html"
    log.info("%.0f s; %s (%s %s)", time.perf_counter() - began, page, typed("view"), shlex.quote(str(folder)))


def diagnose_first(config: DictConfig, settings: dict[str, Any], folder: Path) -> None:
    """Diagnose one capture and write the report.

    Args:
        config: of the command.
        settings: the same, resolved.
        folder: of the run.

    Raises:
        UserError: the data or the settings cannot work, or there is a diagnosis already.
    """
    run = None
    if config.run is None:
        take_folder(folder)
        write_config(settings, folder)
        scene, model = settings["scene"], settings["model"]
        capture = load_scene(scene, settings["data_dir"], settings["seed"], settings["force"])[0]
    else:
        claim(folder)
        run = _undiagnosed(folder)
        scene, model, capture = run.config["scene"], run.config["model"], run.capture
    options = settings_of(CriticismSettings, settings["criticism"], "criticism")
    pipeline = pipeline_of(settings, scene, model)
    image = None
    if run is not None:
        with torch.no_grad():
            image = run.module.pipeline.phasor().cpu(), run.module.pipeline.phasor.grid
    kept = {
        "scene": scene,
        "model": model,
        **{key: settings[key] for key in ("surfels", "criticism", "seed")},
    }
    split_of(capture)  # what cannot be diagnosed leaves no page
    watched = WatchedDiagnosis(folder / "diagnosis", scene, capture)
    try:
        watched.begin()
        with StepTicker("diagnosis") as ticker:
            diagnosis, found = diagnose_capture(
                capture,
                pipeline,
                options,
                name=scene["name"],
                seed=settings["seed"],
                image=image,
                folder=folder / "diagnosis",
                settings=json.dumps(kept, indent=1, default=str),
                report=ticker.step,
                told=watched.told,
            )
    except KeyboardInterrupt:
        mark_interrupted(folder / "diagnosis")
        log.warning("interrupted; the same command with hydra.run.dir=%s goes on where it was", folder)
        sys.exit(130)
    given = scene_settings(config, folder)
    watched.finish(found, diagnosis, given)
    write_report(diagnosis, folder / "diagnosis", scene=given)
    shutil.rmtree(folder / "diagnosis" / "steps")
    log_figures(folder, diagnosis_figures(diagnosis))
    log.info("%s", verdict(diagnosis))


def scene_settings(config: DictConfig, folder: Path) -> list[str]:
    """What of a command line names the scene, to be given again.

    Args:
        config: of the diagnosis.
        folder: of the run.

    Returns:
        words of ``nlos train``.
    """
    given = HydraConfig.get().overrides.task if config.run is None else begun_with(folder)
    return settings_as_words("train", [item for item in given if item.startswith(("scene=", "scene."))])


def _undiagnosed(folder: Path) -> Run:
    if (folder / "diagnosis" / "diagnosis.json").exists():
        raise UserError(
            f"{folder} already holds a diagnosis; move {folder / 'diagnosis'} away to diagnose it anew"
        )
    return open_run(folder)
