"""What is wrong with a command line or a config, said before anything is read or written.

A command looks over its arguments before it loads the libraries it works with (:func:`look_over`), and over
the composed config before it begins (:func:`begun`), since values also come from files of ``conf/``.
"""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import yaml
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, QuotedString, Sweep
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nlos_lit.capture.errors import UserError, printable, suggest
from nlos_lit.places import CONF
from nlos_lit.runtime.command_line import as_typed, output_folder
from nlos_lit.runtime.hooks import take_hooks
from nlos_lit.runtime.keys import FOREIGN_SECTIONS, KEYS
from nlos_lit.runtime.meanings import meanings

OF_HYDRA = ("hydra", "profile")
RESUME = "resume"  # of train.py, and no key of its config: what was begun is read from that folder


def look_over(command: str, arguments: list[str], about: str) -> None:
    """Print help and exit, or exit with status 2 and a sentence where an argument cannot work.

    Args:
        command: the program's name, without ``.py``.
        arguments: of the command line.
        about: first lines of ``--help``.
    """
    take_hooks()
    for argument in arguments:
        if not argument.isascii() and any("\ud800" <= c <= "\udfff" for c in argument):
            told = printable(argument)
            print(f"error: cannot use {told}: it is no text in UTF-8; rename the file", file=sys.stderr)
            sys.exit(2)
    given = get_args_parser().parse_known_args(arguments)[0]
    if given.help:
        print(help_of(command, about))
        sys.exit(0)
    if given.config_dir or given.config_path or given.config_name:
        return  # a config of somebody's own, with keys of its own
    try:
        if (CONF / f"{command}.yaml").exists():
            check_overrides(command, given.overrides)
        elif command in KEYS:
            check_assignments(command, arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


@contextmanager
def begun(command: str, config: DictConfig) -> Iterator[None]:
    """What a command does with its config; where that cannot work, no folder is left behind.

    Args:
        command: as in :data:`~nlos_lit.runtime.keys.KEYS`.
        config: as Hydra composed it; it is checked first.

    Yields:
        Nothing.

    Raises:
        UserError: as the command raises it, or :func:`check_config`.
    """
    folder = output_folder()
    ours = _without_results(folder)
    try:
        check_config(command, config)
        yield
    except UserError:
        if ours and _without_results(folder):
            shutil.rmtree(folder, ignore_errors=True)  # another process of the same run may be first
        raise


def _without_results(folder: Path) -> bool:
    """Whether a folder holds nothing but how a command was begun."""
    kept = {".hydra", ".lock"}
    files = {".log", ".yaml"}
    return folder.is_dir() and all(path.name in kept or path.suffix in files for path in folder.iterdir())


def check_assignments(command: str, arguments: list[str]) -> None:
    """See that every ``KEY=VALUE`` of a command that Hydra does not run names something there is.

    Args:
        command: as in :data:`~nlos_lit.runtime.keys.KEYS`.
        arguments: of the command line; those with a dot in their key are left alone.

    Raises:
        UserError: an argument that is none, a key that there is not, or a value that it cannot have.

    Examples:
        >>> check_assignments("simulate", ["nx=8", "pile_up.detections=0.3"])
        >>> check_assignments("simulate", ["nx=0"])
        Traceback (most recent call last):
        nlos_lit.capture.errors.UserError: nx must be a whole number from 1 to 10000; found 0
    """
    rules = KEYS[command]
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if "." in key and equals:
            continue
        if key not in rules or not equals:
            raise UserError(
                f"there is no option {key!r}; {suggest(key, rules)}"
                if equals
                else f"cannot use {argument!r}: write KEY=VALUE; --help lists the keys"
            )
        if not text:
            raise UserError(f"{key} has no value; it must be {rules[key]}")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise UserError(f"cannot read {argument}: brackets, braces or quotes do not match") from error
        problem = rules[key].problem(value)
        if problem is not None:
            raise UserError(f"{key} must be {problem}")


def check_overrides(command: str, overrides: list[str]) -> None:
    """See that every ``key=value`` names something there is, with a value it can have.

    Args:
        command: as in :data:`~nlos_lit.runtime.keys.KEYS`.
        overrides: as on the command line; sweeps are looked at value by value.

    Raises:
        UserError: one does not.
    """
    keys = set()
    for text in overrides:
        if command == "train" and text.startswith(f"{RESUME}="):
            continue
        try:
            override = OverridesParser.create().parse_override(text)
        except HydraException as error:
            raise UserError(
                f"cannot read the argument {text!r} ({str(error).splitlines()[0]}): write KEY=VALUE, lists "
                "in quotes, 'KEY=[1,2]', and values with other characters in two sorts of them, \"KEY='a ü'\""
            ) from error
        keys.add(override.key_or_group)
        _check_override(command, override)
    run = "run" in keys and not any(text.endswith("run=null") for text in overrides)
    brought = sorted(key for key in keys if re.match(r"(scene|model)\b", key))
    if "split_with" in keys:  # whose scene may differ
        brought = [key for key in brought if not key.startswith("scene.")]
    if command == "diagnose" and run and brought:
        raise UserError(
            f"run=FOLDER brings its own scene and model; leave {', '.join(brought)} out, or leave run out"
        )


def _check_override(command: str, override: Override) -> None:
    key = override.key_or_group
    if key.split(".")[0].split("/")[0] in OF_HYDRA:
        return
    rules, groups = KEYS[command], groups_of(command)
    if key in groups:
        for value in _values(override):
            names = value if isinstance(value, list) else [value]
            for name in names:
                if name is not None and str(name) not in groups[key]:
                    raise UserError(f"there is no {key}={name}; {suggest(str(name), groups[key])}")
        return
    if any(f"{key}.".startswith(f"{section}.") for section in FOREIGN_SECTIONS):
        return
    sections = {known[: m.start()] for known in rules for m in re.finditer(r"\.", known)}
    if key in sections and key not in rules:
        return  # a whole section at once: looked at when it is composed
    if key not in rules:
        if override.is_add() and key.startswith("trainer."):
            return
        raise UserError(f"there is no key {key}; {_instead(key, dict.fromkeys([*rules, *groups]))}")
    if not override.is_delete():
        for value in _values(override):
            problem = None if _is_late(value) else rules[key].problem(value)
            if problem is not None:
                raise UserError(f"{key} must be {problem}")


def _instead(key: str, known: Iterable[str]) -> str:
    """The nearest keys of the same section; of all sections where there is no such section."""
    section, _, name = key.rpartition(".")
    start = f"{section}." if section else ""
    beside = dict.fromkeys(other[len(start) :].split(".")[0] for other in known if other.startswith(start))
    if section and beside:
        return suggest(name, beside, above=start)
    return suggest(
        key, dict.fromkeys([*known, *beside]), dict.fromkeys(other.split(".")[0] for other in known)
    )


def _values(override: Override) -> Iterator[Any]:
    """Every value that an override gives, as plain Python; none where it names them by a pattern."""
    value = override.value()
    if isinstance(value, ChoiceSweep):
        yield from (_plain(entry) for entry in value.list)
    elif not (isinstance(value, Sweep) or override.is_sweep_override() or override.is_delete()):
        yield _plain(value)


def _plain(value: Any) -> Any:
    if isinstance(value, QuotedString):
        return value.text
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    if isinstance(value, dict):
        return {str(_plain(key)): _plain(entry) for key, entry in value.items()}
    return value


def _is_late(value: Any) -> bool:
    return isinstance(value, str) and "${" in value


def check_config(command: str, config: DictConfig) -> None:
    """See that a composed config holds nothing that no code reads, and values in their ranges.

    Args:
        command: as in :data:`~nlos_lit.runtime.keys.KEYS`.
        config: as Hydra composed it.

    Raises:
        UserError: a key that there is not, or a value that it cannot have.
    """
    try:
        plain = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise UserError(f"the config cannot be put together: {str(error).splitlines()[0]}") from error
    check_values(command, cast(dict[str, Any], plain))


def check_values(command: str, config: Mapping[str, Any]) -> None:
    """As :func:`check_config`, of plain containers.

    Args:
        command: as there.
        config: sections may be missing; what is there is checked.

    Raises:
        UserError: as there.
    """
    rules = KEYS[command]
    for key, value in _leaves(rules, config):
        if any(f"{key}.".startswith(f"{section}.") for section in FOREIGN_SECTIONS):
            continue
        if value == "???":
            raise UserError(f"{key} is not set; it must be {rules[key]}")
        if key not in rules:
            if key.startswith("trainer."):
                continue  # Lightning refuses what it does not know
            raise UserError(f"there is no key {key}; {_instead(key, rules)}")
        problem = rules[key].problem(value)
        if problem is not None:
            raise UserError(f"{key} must be {problem}")


def _leaves(rules: Mapping[str, Any], config: Any, above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key → value of all that is no section."""
    for name, value in config.items():
        key = f"{above}{name}"
        section = isinstance(value, dict) and any(known.startswith(f"{key}.") for known in rules)
        if section or (isinstance(value, dict) and value and key not in rules):
            yield from _leaves(rules, value, f"{key}.")
        else:
            yield key, value


def groups_of(command: str) -> dict[str, list[str]]:
    """Config groups that a command takes, with the names of their choices."""
    groups = {}
    for folder in sorted(path for path in CONF.iterdir() if path.is_dir() and path.name not in OF_HYDRA):
        listed = re.search(rf"^ *- (optional )?{folder.name}:", (CONF / f"{command}.yaml").read_text(), re.M)
        if listed:
            names = sorted(path.stem for path in folder.glob("*.yaml"))
            groups[folder.name] = [name for name in names if not name.startswith("_")]
    return groups


def help_of(command: str, about: str) -> str:
    """The text of ``--help``: what the command does, examples, choices, and each key with what it may be.

    Args:
        command: the program's name, without ``.py``.
        about: first lines.

    Returns:
        Text of many lines.
    """
    lines = [about.strip()]
    config = CONF / f"{command}.yaml"
    if config.exists():
        head = [line[2:] for line in config.read_text(encoding="utf-8").splitlines() if line[:2] == "# "]
        lines += ["", *(f"  {line}" for line in head), "", "Choices, GROUP=NAME:"]
        lines += [f"  {group:12s} {', '.join(names)}" for group, names in groups_of(command).items()]
        lines += ["", "Also --multirun (-m) for sweeps, --cfg job for the values, --hydra-help."]
    if command in KEYS:
        lines += ["", "Settings, KEY=VALUE (lists in quotes: 'KEY=[1,2]'):"]
        meaning = meanings(command)
    for key, rule in KEYS.get(command, {}).items():
        told = meaning.get(key, meaning.get(key.rpartition(".")[0]))  # or what is said of its section
        lines.append(f"  {key}: {rule}" + (f"  # {told}" if told else ""))
    return as_typed("\n".join(lines))
