"""What all commands share: errors as sentences, results that are not overwritten, the folder of a run."""

from __future__ import annotations

import functools
import logging
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nlos_lit.capture.errors import UserError


def sentence_errors(task: Callable[..., Any]) -> Callable[..., Any]:
    """Print a :class:`~nlos_lit.capture.errors.UserError` as one sentence and exit with status 2.

    Anything else keeps its traceback.
    """

    @functools.wraps(task)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return task(*args, **kwargs)
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)

    return wrapped


def refuse_finished_folder(arguments: list[str], diagnosis: bool = False) -> None:
    """Exit with status 2, before anything is written, where ``hydra.run.dir`` holds a finished run.

    It may where the run is resumed.

    Args:
        arguments: of the command line, ``key=value``.
        diagnosis: a folder that holds a diagnosis is refused, too.
    """
    given = _given(arguments)
    folder = given.get("hydra.run.dir")
    if diagnosis and folder is not None and (Path(folder) / "diagnosis" / "diagnosis.json").exists():
        print(f"error: {folder} already holds a diagnosis; choose another hydra.run.dir", file=sys.stderr)
        sys.exit(2)
    if folder is not None and (Path(folder) / "summary.json").exists() and "ckpt_path" not in given:
        print(
            f"error: {folder} already holds a finished run (summary.json); choose another hydra.run.dir, "
            "or ckpt_path=last to go on from it",
            file=sys.stderr,
        )
        sys.exit(2)


def stay_in_run(arguments: list[str]) -> None:
    """With ``run=FOLDER``, add arguments that keep log and config in it; exit where it is no run's folder."""
    given = _given(arguments)
    if given.get("run", "null") == "null":
        return
    folder = Path(given["run"].strip("'\""))
    if not (folder / "config.yaml").exists():
        print(f"error: {folder} is not the folder of a finished run: config.yaml is missing", file=sys.stderr)
        sys.exit(2)
    if "hydra.run.dir" not in given:
        arguments += [f"hydra.run.dir='{folder}'", "hydra.output_subdir=diagnosis/.hydra"]


def output_folder() -> Path:
    """Where Hydra puts what the running command writes."""
    return Path(HydraConfig.get().runtime.output_dir)


def _given(arguments: list[str]) -> dict[str, str]:
    return dict(item.split("=", 1) for item in arguments if "=" in item)


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


def write_config(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Resolve the config and keep it as ``config.yaml`` in the run's folder.

    Args:
        config: as Hydra composed it.
        folder: of the run; made where it is not there.

    Returns:
        The config as plain containers.
    """
    resolved = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(resolved)))
    return resolved


def quiet_libraries() -> None:
    """Silence advice that does not apply: an epoch is an iteration, a batch is gathered and not loaded."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*The number of training batches.*")
    warnings.filterwarnings("ignore", ".*Checkpoint directory .* exists and is not empty.*")
    warnings.filterwarnings("ignore", ".*isinstance\\(treespec, LeafSpec\\).*")
