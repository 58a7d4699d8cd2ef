"""The folder of a run: written by one process at a time, begun once, gone on with by its name alone."""

from __future__ import annotations

import json
import os
import re
import shlex
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import bounded
from nlos_lit.io.files import whole_file, write_json
from nlos_lit.runtime.claim import claim, refuse_links
from nlos_lit.runtime.command_line import given_values, typed

OUTPUTS = "outputs"  # where results go that no other folder is given for
OVERRIDES = "overrides.json"  # the settings that a training was begun with
# What a folder holds, by the first of these that is in it.
HOLDS = MappingProxyType(
    {
        "diagnosis/diagnosis.json": "a diagnosis",
        "summary.json": "a finished run",
        OVERRIDES: "an interrupted run",
    }
)
LARGEST_CONFIG = 2**19  # bytes of a run's config.yaml
DEEPEST_CONFIG = 32  # lists and mappings in each other
LEAST = 2**18  # bytes, of what a command writes before it knows how much it will write
LONGEST_NAME = 64  # characters of a capture's name
# Processes that help another with its run have a number above 0 in one of these.
RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
# Of a list of settings: neither an option of the command nor one of Hydra's own.
SETTING = re.compile(r"(\+\+|\+|~)?(?!hydra\b)\w[\w./@-]*(=.*)?\Z", re.DOTALL)
# Sections whose values may be places that are written to, and what names a place or may become one.
WRITERS = ("trainer", "logger", "callbacks")
PLACE = re.compile(r"[/\\~]|\.\.|\$\{")


def register_names() -> None:
    """Make ``${file_name:…}`` known to configs; to be called before one is composed."""
    OmegaConf.register_new_resolver("file_name", file_name, replace=True)


def file_name(path: str | None) -> str:
    """What a capture is called after its file, in titles and as a folder.

    Examples:
        >>> file_name("data/our lab, 3 May.hdf5"), file_name("cat.v2.mat"), file_name(None)
        ('our_lab_3_May', 'cat.v2', 'capture')
    """
    words = re.findall(r"[\w.-]+", "" if path is None else Path(path).stem)
    return "_".join(words).strip("._-")[:LONGEST_NAME] or "capture"


def take_folder(folder: Path, goes_on: bool = False) -> None:
    """Hold a folder for this process alone, and refuse one that holds an earlier run.

    Of several processes that share a run the first does so for all.

    Args:
        folder: that will be written to.
        goes_on: the command continues what is there.

    Raises:
        UserError: another process is at work there, it holds a run and is not to go on from it, or it goes on
            and holds links out of it.
    """
    if any(int(os.environ.get(name, 0)) for name in RANKS):
        return
    claim(folder)
    if goes_on:
        refuse_links(folder)
    found = next((what for name, what in HOLDS.items() if (folder / name).exists()), None)
    if found is not None and not goes_on:
        again = shlex.quote(f"resume={folder}")
        raise UserError(
            f"{folder} already holds {found}; choose another hydra.run.dir"
            + (f", or go on with it: {typed('train')} {again}" if (folder / OVERRIDES).exists() else "")
        )


def take_given_folder(arguments: list[str]) -> None:
    """:func:`take_folder` before Hydra writes anything, where the command line says ``hydra.run.dir``.

    Raises:
        UserError: as there, or nothing can be written where the run's folder is to be.
    """
    given = given_values(arguments)
    folder = Path(given.get("hydra.run.dir", OUTPUTS))
    there = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=there) as probe:  # the disk may be full, or no disk at all (/proc)
            probe.write(bytes(LEAST))
            probe.flush()
    except OSError as error:
        found = f"cannot be written to ({error.strerror})" if there.is_dir() else "is no folder"
        raise UserError(
            f"{there} {found}; give another folder for the results: hydra.run.dir=FOLDER"
        ) from error
    if "hydra.run.dir" in given and folder.is_dir():
        take_folder(folder, goes_on_in(folder, given.get("ckpt_path")))


def goes_on_in(folder: Path, ckpt_path: str | None) -> bool:
    """Whether a run that goes on from a checkpoint continues what its own folder holds.

    Args:
        folder: of the run.
        ckpt_path: ``last``, a file, or None where nothing is continued.

    Returns:
        False where it begins, or goes on from the checkpoint of another folder.
    """
    if ckpt_path in (None, "null"):
        return False
    return ckpt_path == "last" or folder.resolve() in Path(ckpt_path).resolve().parents


def resume_run(arguments: list[str]) -> None:
    """``resume=FOLDER`` → what the run there was begun with, and ``ckpt_path=last``, in place.

    Other arguments stand; one that is given replaces the run's own.

    Raises:
        UserError: it is no run's folder, its list is not one of settings alone, or one of them would write
            elsewhere.
    """
    given = given_values(arguments)
    if "resume" not in given:
        return
    folder = Path(given["resume"])
    if not (folder / OVERRIDES).is_file():
        raise UserError(f"{folder} is not the folder of a run that has begun: {OVERRIDES} is missing")
    now = [item for item in arguments[1:] if not item.startswith("resume=")]
    now += ["ckpt_path=last", f"hydra.run.dir='{folder}'"]
    replaced = {_key(item) for item in now}
    kept = [item for item in begun_with(folder) if _key(item) not in replaced]
    for item in kept:
        key, _, value = item.partition("=")
        if re.split(r"[.@/]", key.lstrip("+"))[0] in WRITERS and PLACE.search(value):
            raise UserError(
                f"{folder / OVERRIDES} sets {item}, and a run that goes on may write into itself alone; if "
                "it is yours and meant so, give that setting again on the command line"
            )
    arguments[1:] = [*kept, *now]


def begun_from(folder: Path) -> Path | None:
    """The checkpoint that the run in a folder was begun from; None where it began from nothing."""
    kept = given_values(begun_with(folder)).get("ckpt_path")
    return None if kept is None else Path(kept)


def begun_with(folder: Path) -> list[str]:
    """Settings of the run in a folder, as on a command line; the file may come from anywhere."""
    file = folder / OVERRIDES
    if not file.is_file():
        file = folder / ".hydra" / "overrides.yaml"  # a diagnosis of a capture
    altered = UserError(f"{file} was altered: it must be a list of settings such as scene.iterations=100")
    try:
        content = bounded(file)
        settings = json.loads(content) if file.suffix == ".json" else yaml.safe_load(content)
    except (ValueError, RecursionError, yaml.YAMLError, FileNotFoundError) as error:
        raise altered from error
    if not isinstance(settings, list) or not all(isinstance(s, str) and SETTING.match(s) for s in settings):
        raise altered
    return settings


def _key(override: str) -> str:
    return override.split("=", 1)[0].lstrip("+~")


def resolved(config: DictConfig) -> dict[str, Any]:
    """A config as Hydra composed it, as plain containers."""
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))


def write_config(settings: Mapping[str, Any], folder: Path) -> None:
    """Keep resolved settings as ``config.yaml``.

    Args:
        settings: plain containers.
        folder: of the run.
    """
    with whole_file(folder / "config.yaml") as partial:
        partial.write_text(OmegaConf.to_yaml(OmegaConf.create(dict(settings))), encoding="utf-8")


def plain_yaml(file: Path) -> dict[str, Any]:
    """A config that a run has written; the file may come from anywhere, and be made to take all memory.

    Raises:
        UserError: it is no YAML of ours.
    """
    foreign = UserError(f"{file} is damaged, or not written by this program")
    try:
        text = bounded(file, LARGEST_CONFIG).decode("utf-8", errors="replace")
        depth = 0
        for event in yaml.parse(text, yaml.CSafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            # An alias names what stands elsewhere: a few lines of them may stand for billions.
            if isinstance(event, yaml.AliasEvent) or depth > DEEPEST_CONFIG:
                raise foreign
        config = OmegaConf.to_container(OmegaConf.create(text))
    except (UserError, yaml.YAMLError, OmegaConfBaseException, RecursionError, ValueError) as error:
        raise foreign from error
    if not isinstance(config, dict):
        raise foreign
    return cast(dict[str, Any], config)


def begin_training(settings: Mapping[str, Any], folder: Path, checkpoint: Path | None) -> None:
    """Make a folder that of a training that is not finished: it keeps what the training is begun with.

    Args:
        settings: resolved.
        folder: of the run, taken by this process.
        checkpoint: that it goes on from; kept where it is another run's.
    """
    begun_with = [item for item in HydraConfig.get().overrides.task if _key(item) != "ckpt_path"]
    if checkpoint is not None and not goes_on_in(folder, str(checkpoint)):
        begun_with.append(f"ckpt_path={checkpoint.resolve()}")
    (folder / "summary.json").unlink(missing_ok=True)
    write_config(settings, folder)
    write_json(folder / OVERRIDES, begun_with)
