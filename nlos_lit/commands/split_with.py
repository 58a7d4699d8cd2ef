"""``nlos diagnose A --split-with B``: another capture is asked which of the names that A leaves open stay."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from data_modules.load import load_scene, planned_scene, read_scene
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.inference.diagnose import split_of
from nlos_lit.inference.further import ask_further, open_terms
from nlos_lit.inference.result import Diagnosis
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.io.views import read_view
from nlos_lit.report.explore import page_html
from nlos_lit.report.page import report_html, write_report
from nlos_lit.report.together import told_apart
from nlos_lit.report.verdict import verdict
from nlos_lit.runtime.arguments import check_values
from nlos_lit.runtime.progress import StepTicker
from nlos_lit.training.configs import pipeline_of, settings_of
from nlos_lit.training.folder import file_name, plain_yaml
from nlos_lit.training.origin import flat
from nlos_lit.training.watched import retell

# Of the first capture's scene: not those of the second.
GIVEN_ANEW = ("scene.source", "scene.simulate", "scene.truth", "scene.path", "scene.name")
log = logging.getLogger(__name__)


class Second(NamedTuple):
    """Another capture of the same scene.

    Args:
        scene: its settings, planned.
        model: settings of its image.
        capture: ready to fit.
    """

    scene: dict[str, Any]
    model: dict[str, Any]
    capture: Capture


def second_capture(settings: dict[str, Any], folder: Path | None) -> Second:
    """Read the capture that ``split_with`` names.

    It is read, gated and summed as the first one was, but for what the command line says of the scene.

    Args:
        settings: of the command, resolved.
        folder: of the run whose scene is taken; None takes the command line's.

    Returns:
        The capture and its settings.

    Raises:
        UserError: it cannot be read, or not be diagnosed.
    """
    kept = settings if folder is None else plain_yaml(folder / "config.yaml")
    if folder is not None:
        check_kept(kept, settings, folder)
    scene, now = OmegaConf.create(kept["scene"]), OmegaConf.create({"scene": settings["scene"]})
    for item in HydraConfig.get().overrides.task:
        key = item.partition("=")[0]
        if key.startswith("scene."):
            OmegaConf.update(scene, key.removeprefix("scene."), OmegaConf.select(now, key), merge=False)
    path = settings["split_with"]
    own = {"path": path, "name": file_name(path), "simulate": None, "truth": None}
    given = cast(dict[str, Any], OmegaConf.to_container(scene)) | own
    raw = read_scene(given, settings["data_dir"])
    planned = planned_scene(given, settings["data_dir"], settings["force"], raw)[0]
    capture = load_scene(planned, settings["data_dir"], settings["seed"], settings["force"], raw)[0]
    split_of(capture)
    return Second(planned, kept["model"], capture)


def check_told(folder: Path) -> None:
    """See that a diagnosis, which may come from anywhere, leaves names open and can be told again.

    Args:
        folder: with ``diagnosis.json``, and the view of it.

    Raises:
        UserError: it leaves none open, or was altered.
    """
    diagnosis = Diagnosis.read(folder / "diagnosis.json")
    open_terms(diagnosis)
    try:
        report_html(diagnosis, {})
        page_html(read_view(folder))
    except UserError:
        raise
    except Exception as error:  # a foreign file may be wrong in any way
        raise UserError(f"the diagnosis in {folder} was altered; diagnose the capture again") from error


def check_kept(kept: dict[str, Any], settings: dict[str, Any], folder: Path) -> None:
    """See that a run's config, which may come from anywhere, holds a scene and a model.

    Args:
        kept: that config.
        settings: of this command, resolved.
        folder: of the run, for error messages.

    Raises:
        UserError: it does not, or values that cannot be.
    """
    if not all(isinstance(kept.get(name), dict) for name in ("scene", "model")):
        raise UserError(f"{folder} holds no config of a run: config.yaml lacks its scene or its model")
    wanted, found = (flat({"scene": config["scene"]}).keys() for config in (settings, kept))
    missing = sorted(name for name in wanted - found if not name.startswith(GIVEN_ANEW))
    if missing:
        raise UserError(f"{folder}/config.yaml was altered, or is of another version: it lacks {missing[0]}")
    try:
        check_values("diagnose", {name: kept[name] for name in ("scene", "model")})
    except UserError as error:
        raise UserError(f"{folder}/config.yaml: {error}") from error


def split_with(settings: dict[str, Any], folder: Path, second: Second, given: list[str]) -> None:
    """Ask the second capture, and write report, page and JSON of the first one's diagnosis anew.

    Args:
        settings: of the command, resolved.
        folder: of the run that was diagnosed.
        second: see :func:`second_capture`.
        given: settings of the command line that name the first capture's scene.
    """
    before = Diagnosis.read(folder / "diagnosis" / "diagnosis.json")
    if not any(term.confusable_with for term in before.effects):
        log.info("the diagnosis leaves no two names open: %s is not asked", settings["split_with"])
        return
    with StepTicker("second capture") as ticker:
        diagnosis = ask_further(
            before,
            second.capture,
            pipeline_of(settings, second.scene, second.model),
            settings_of(CriticismSettings, settings["criticism"], "criticism"),
            name=second.scene["name"],
            seed=settings["seed"],
            report=ticker.step,
        )
    retell(folder / "diagnosis", diagnosis, given)
    write_report(diagnosis, folder / "diagnosis", scene=given)
    for further in diagnosis.further[len(before.further) :]:
        log.info("%s", told_apart(further))
    log.info("%s", verdict(diagnosis))
