"""Configs as commands see them: classes state settings and their defaults, ``conf/*.yaml`` what differs.

A settings class becomes the config group ``schema/NAME``, which ``conf/NAME/default.yaml`` takes over: types
are checked and unknown keys refused when a command starts. Lightning's Trainer is stated by its signature.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

import hydra
import lightning as L
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import volume_grid
from nlos_lit.inference.base_pipeline import BasePipeline
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.model.build import PipelineSettings
from nlos_lit.places import CONF
from nlos_lit.runtime.arguments import check_values
from nlos_lit.runtime.keys import KEYS
from nlos_lit.runtime.memory import parse_bytes
from nlos_lit.surfels.fit import SurfelSettings
from nlos_lit.training.folder import plain_yaml, register_names
from nlos_lit.training.instantiate import arguments_of

SETTINGS: dict[str, type] = {
    "model": PipelineSettings,
    "surfels": SurfelSettings,
    "criticism": CriticismSettings,
}
STARTS = ("ckpt_path", "run")  # what a run came from, which need not be there any more
# Of a run's config: what opening the run does not read, or what may be null as a whole.
MADE = tuple(f"simulate.{name}" for name in ("mesh", "scan", "sensor"))
MADE += tuple(f"source.{name}" for name in ("file", "origin", "url", "sha256"))
UNREAD = (*STARTS, "resume.", "folder", "trainer", "scene.simulate.", "scene.source.")
GIVEN = ("self", "logger", "callbacks")  # of the Trainer's arguments: groups of their own
T = TypeVar("T")


def register_settings() -> None:
    """Make the groups ``schema/…`` and ``${file_name:…}`` known; to be called before a config is composed."""
    register_names()
    store = ConfigStore.instance()
    for name, kind in SETTINGS.items():
        node = OmegaConf.structured(kind)
        OmegaConf.set_readonly(node, None)  # frozen is the object that is made of it, not the config
        store.store(group="schema", name=name, node=node)
    parameters = inspect.signature(L.Trainer.__init__).parameters.values()
    trainer = {p.name: p.default for p in parameters if p.name not in GIVEN}
    store.store(group="schema", name="trainer", node=trainer)


def compose(command: str, overrides: Iterable[str] = ()) -> dict[str, Any]:
    """The config that a command would run with, resolved, without starting it.

    Args:
        command: ``train``, ``diagnose`` or ``reconstruct``.
        overrides: as on the command line, ``scene=su``.

    Returns:
        Plain containers.
    """
    register_settings()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        config = hydra.compose(command, overrides=list(overrides))
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))


def settings_of(kind: Callable[..., T], values: Mapping[str, Any], where: str, **given: Any) -> T:
    """A settings object from a section of a config.

    Args:
        kind: its class.
        values: the section.
        where: the section's name, for error messages.
        given: arguments that are not the config's.

    Returns:
        ``kind(**values, **given)``.

    Raises:
        UserError: the section holds a key that the class does not know, or lacks one.
    """
    accepted = [name for name in arguments_of(kind) or () if name not in given]
    unknown = [name for name in values if name not in accepted]
    if unknown:
        raise UserError(f"{where} has no setting {unknown[0]!r}; there are {', '.join(accepted)}")
    try:
        return kind(**values, **given)
    except TypeError as error:
        raise UserError(f"{where} is incomplete: {error}") from error


def pipeline_of(
    settings: Mapping[str, Any], scene: Mapping[str, Any], model: Mapping[str, Any]
) -> BasePipeline:
    """What a diagnosis fits with.

    Args:
        settings: of ``diagnose``, resolved.
        scene: of the capture, planned.
        model: of the image.

    Returns:
        Image and fit of the base.

    Raises:
        UserError: a section holds what there is not.
    """
    return BasePipeline(
        volume=scene["volume"],
        model=settings_of(PipelineSettings, model, "model"),
        surfels=settings_of(SurfelSettings, settings["surfels"], "surfels"),
        budget=parse_bytes(settings["memory_budget"]),
    )


def run_config(folder: str | Path) -> dict[str, Any]:
    """The resolved config that a run left in its folder.

    Args:
        folder: of the run.

    Returns:
        Plain containers with every section that opening the run reads.

    Raises:
        UserError: the folder is not a run's, another version of the project wrote it, or it holds values that
            cannot be.
    """
    file = Path(folder) / "config.yaml"
    if not file.is_file():
        raise UserError(f"{folder} is not the folder of a finished run: {file.name} is missing")
    config = plain_yaml(file)
    rules = [*(key for key in KEYS["train"] if not key.startswith(UNREAD)), "optimizer.method"]
    rules += [f"scene.{key}" for key in MADE if _section(config, f"scene.{key.split('.')[0]}")]
    missing = {key.split(".")[0] for key in rules} - set(config)
    missing |= {key for key in rules if key.split(".")[0] in config and not _is_in(config, key)}
    known = {
        **{
            name: [field.name for field in dataclasses.fields(SETTINGS[name])]
            for name in ("model", "surfels")
        },
        "scene.volume": inspect.signature(volume_grid).parameters,
    }
    unread = {
        f"{section}.{key}"
        for section in known
        for key in set(_section(config, section)) - set(known[section])
    }
    if missing or unread:
        found = [*(f"no {name}" for name in sorted(missing)), *sorted(unread)]
        raise UserError(
            f"{file} was written by another version of this project and cannot be opened (it has "
            f"{', '.join(found)}); train the scene again, or use the version that its summary.json names"
        )
    try:
        check_values("train", {key: value for key, value in config.items() if key not in STARTS})
    except UserError as error:
        raise UserError(f"{file}: {error}") from error
    return config


def _section(config: Any, name: str) -> dict[str, Any]:
    """A section by its dotted name; empty where it is missing or none."""
    for part in filter(None, name.split(".")):
        config = config.get(part) if isinstance(config, dict) else None
    return config if isinstance(config, dict) else {}


def _is_in(config: Mapping[str, Any], key: str) -> bool:
    section, _, name = key.rpartition(".")
    return name in _section(config, section)
