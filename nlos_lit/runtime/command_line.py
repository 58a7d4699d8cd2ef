"""What all commands share: errors as sentences, arguments, the folder that Hydra chose."""

from __future__ import annotations

import errno
import functools
import logging
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hydra.core.hydra_config import HydraConfig

from nlos_lit.capture.errors import UserError
from nlos_lit.places import INSTALLED, STARTED
from nlos_lit.runtime.claim import refuse_links

_FULL = "make room, or write elsewhere"
_CLOSED = "change who may write there, or give another place"
_NAMED = "move away what is there, or give another place"
# What the disk may answer, and what to do.
REFUSED = MappingProxyType(
    {errno.ENOSPC: _FULL, errno.EDQUOT: _FULL, errno.EFBIG: _FULL}
    | {errno.EROFS: _CLOSED, errno.EACCES: _CLOSED, errno.EPERM: _CLOSED}
    | {errno.ENOTDIR: _NAMED, errno.EISDIR: _NAMED, errno.EEXIST: _NAMED, errno.ENAMETOOLONG: _NAMED}
    | {errno.ELOOP: _NAMED}
)


OF_CAPTURES = ("train", "diagnose", "reconstruct")  # commands whose settings name a capture
SPLIT_WITH = "--split-with"
FILES = MappingProxyType({"inspect": "inspect_capture"})  # at the top of a checkout, where named otherwise


def typed(command: str) -> str:
    """How a command is started: as ``nlos`` does, or by its file at the top of a checkout.

    Examples:
        >>> typed("inspect")
        'python inspect_capture.py'
    """
    program = Path(sys.argv[0])
    if INSTALLED or program.stem == "nlos" or program.parts[-2:] == ("nlos_lit", "__main__.py"):
        return f"nlos {command}"
    return f"python {FILES.get(command, command)}.py"


def this_command() -> str:
    """The command that this process carries out, to be typed again."""
    name = os.environ.get(STARTED) or Path(sys.argv[0]).stem
    return " ".join([typed(name), *map(shlex.quote, settings_as_words(name, sys.argv[1:]))])


def as_typed(text: str) -> str:
    """A text whose commands, ``nlos NAME`` or ``python NAME.py``, are written as the user started this one.

    Examples:
        >>> as_typed("nlos train scene=su; python train.py scene=su")
        'python train.py scene=su; python train.py scene=su'
    """
    names = {file: command for command, file in FILES.items()}
    return re.sub(r"\b(?:nlos|python) (\w+)\b(?:\.py)?", lambda m: typed(names.get(m[1], m[1])), text)


def sentence_errors(task: Callable[..., Any]) -> Callable[..., Any]:
    """Print a :class:`~nlos_lit.capture.errors.UserError` as one sentence and exit with status 2.

    So is what the disk refuses. Ctrl-C is one word and status 130. Anything else keeps its traceback.
    """

    @functools.wraps(task)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return task(*args, **kwargs)
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)
        except OSError as error:
            advice = REFUSED.get(error.errno or 0)
            if advice is None:
                raise
            where = error.filename or "a result"  # other libraries' writers do not say which
            print(f"error: {where}: {error.strerror}; {advice}", file=sys.stderr)
            sys.exit(2)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            sys.exit(130)

    return wrapped


def stay_in_run(arguments: list[str]) -> None:
    """With ``run=FOLDER``, add arguments that keep log and config in it.

    Raises:
        UserError: it is no run's folder, or holds links out of it.
    """
    given = given_values(arguments)
    if given.get("run", "null") == "null":
        return
    folder = Path(given["run"])
    if not (folder / "config.yaml").exists():
        raise UserError(f"{folder} is not the folder of a finished run: config.yaml is missing")
    refuse_links(folder)
    if "hydra.run.dir" not in given:
        arguments += [f"hydra.run.dir='{folder}'", "hydra.output_subdir=diagnosis/.hydra"]


def output_folder() -> Path:
    """Where Hydra puts what the running command writes."""
    return Path(HydraConfig.get().runtime.output_dir)


def given_values(arguments: list[str]) -> dict[str, str]:
    """``key=value`` arguments by key, without quotes around the value.

    Examples:
        >>> given_values(["-m", "seed=1,2", "hydra.run.dir='my run'"])
        {'seed': '1,2', 'hydra.run.dir': 'my run'}
    """
    pairs = (item.split("=", 1) for item in arguments if "=" in item)
    return {key: value.strip("'\"") for key, value in pairs}


def quoted(path: Path | str) -> str:
    """A path as a value on Hydra's command line.

    Examples:
        >>> quoted("data/a.mat"), quoted("our lab's.mat")
        ('data/a.mat', "'our lab\\\\'s.mat'")
    """
    text = str(path)
    if all(c.isalnum() or c in "/._-" for c in text) and text.isascii():
        return text
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def words_as_settings(command: str, arguments: list[str]) -> list[str]:
    """What may be said without naming the setting, as settings.

    The first word may be a capture file; of ``diagnose`` also the folder of a run, and ``--split-with FILE``.

    Args:
        command: as ``nlos`` names it.
        arguments: of its command line.

    Returns:
        Arguments that Hydra reads.

    Raises:
        UserError: there is no such file, or none is named.

    Examples:
        >>> words_as_settings("train", ["scene=su"]), words_as_settings("train", [__file__])[0]
        (['scene=su'], 'scene=capture')
        >>> words_as_settings("diagnose", ["run=outputs/a", "--split-with", "second.hdf5"])
        ['run=outputs/a', 'split_with=second.hdf5']
    """
    if command not in OF_CAPTURES:
        return arguments
    first, rest = arguments[:1], arguments[1:]
    if first and not first[0].startswith(("-", "~", "+")) and "=" not in first[0]:
        path = first[0]
        if not os.path.exists(path):
            raise UserError(f"{path} does not exist; give a capture file, or settings KEY=VALUE: --help")
        is_run = os.path.exists(os.path.join(path, "config.yaml"))
        if command == "diagnose" and is_run:
            first = [f"run={quoted(path)}"]
        else:
            _refuse_folder(command, path, is_run)
            first = ["scene=capture", f"scene.path={quoted(path)}"]
    if command != "diagnose":
        return first + rest
    found, words = [], iter(first + rest)
    for word in words:
        flag, equals, file = word.partition("=")
        if flag == SPLIT_WITH:
            file = file if equals else next(words, "")
            if not file:
                raise UserError(f"{SPLIT_WITH} needs a capture file behind it")
            word = f"split_with={quoted(file)}"
        found.append(word)
    return found


def _refuse_folder(command: str, path: str, is_run: bool) -> None:
    """Refuse a folder in which no reader would look for a capture."""
    if not os.path.isdir(path) or any(name.endswith(".mat") for name in os.listdir(path)):
        return
    if command == "train" and is_run:
        instead = f"to go on with that run say resume={path}"
    else:
        instead = "give a capture file" + (", or a finished run's folder" if command == "diagnose" else "")
    raise UserError(f"{path} is a folder without a capture (no .mat file is in it); {instead}")


def settings_as_words(command: str, settings: list[str]) -> list[str]:
    """The inverse of :func:`words_as_settings`: a capture's file by itself, where that says the same.

    Args:
        command: as ``nlos`` names it.
        settings: that Hydra reads; of a capture's file they begin as that function made them.

    Returns:
        Words of a command line.

    Examples:
        >>> settings_as_words("train", ["scene=capture", f"scene.path={quoted(__file__)}"]) == [__file__]
        True
        >>> settings_as_words("train", ["scene=su", "seed=1"])
        ['scene=su', 'seed=1']
    """
    if settings[:1] == ["scene=capture"] and settings[1:] and settings[1].startswith("scene.path="):
        value = settings[1].removeprefix("scene.path=")
        path = re.sub(r"\\(.)", r"\1", value[1:-1]) if value.startswith("'") else value
        words = [path, *settings[2:]]
        if os.path.exists(path) and words_as_settings(command, words) == settings:
            return words
    return settings


def quote_numbers(arguments: list[str]) -> None:
    """``scene=34`` → ``scene='34'`` in place: Hydra would take the scene's name for a number.

    Examples:
        >>> arguments = ["train.py", "scene=34", "seed=1"]
        >>> quote_numbers(arguments)
        >>> arguments
        ['train.py', "scene='34'", 'seed=1']
    """
    for index, argument in enumerate(arguments):
        arguments[index] = re.sub(r"^(scene)=(\d+)$", r"\1='\2'", argument)


def quiet_libraries() -> None:
    """Silence advice that does not apply: an epoch is an iteration, a batch is gathered and not loaded."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*The number of training batches.*")
    warnings.filterwarnings("ignore", ".*Checkpoint directory .* exists and is not empty.*")
    warnings.filterwarnings("ignore", ".*isinstance\\(treespec, LeafSpec\\).*")
