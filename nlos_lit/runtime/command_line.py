"""What all commands share: errors as sentences, results that are not overwritten, the folder of a run."""

from __future__ import annotations

import functools
import logging
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from nlos_lit.capture.errors import UserError


def sentence_errors(task: Callable[..., Any]) -> Callable[..., Any]:
    """Print a :class:`UserError` as one sentence and exit with status 2; anything else keeps its traceback."""

    @functools.wraps(task)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return task(*args, **kwargs)
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)

    return wrapped


def refuse_finished_folder(arguments: list[str], diagnosis: bool = False) -> None:
    """Exit before anything is written when ``hydra.run.dir`` names a folder that holds a finished run and
    nothing is resumed.

    ``diagnosis``: also when it holds a diagnosis.
    """
    given = dict(item.split("=", 1) for item in arguments if "=" in item)
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
    """``run=FOLDER`` keeps log and config in FOLDER/diagnosis, too; in place. Exit where FOLDER is not a
    run's.
    """
    given = dict(item.split("=", 1) for item in arguments if "=" in item)
    if given.get("run", "null") == "null":
        return
    folder = Path(given["run"].strip("'\""))
    if not (folder / "config.yaml").exists():
        print(f"error: {folder} is not the folder of a finished run: config.yaml is missing", file=sys.stderr)
        sys.exit(2)
    if "hydra.run.dir" not in given:
        arguments += [f"hydra.run.dir='{folder}'", "hydra.output_subdir=diagnosis/.hydra"]


def quote_numbers(arguments: list[str]) -> None:
    """``scene=34`` → ``scene='34'`` in place: Hydra would take a scene whose name is a number for a number."""
    for index, argument in enumerate(arguments):
        arguments[index] = re.sub(r"^(scene)=(\d+)$", r"\1='\2'", argument)


def write_config(config: Any, folder: Path) -> dict[str, Any]:
    """Resolve the config, keep it as ``config.yaml`` in the run's folder, return it as plain containers."""
    resolved = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(resolved)))
    return resolved


def quiet_libraries() -> None:
    """Silence advice that does not apply here (one epoch is one iteration; a batch is gathered, not loaded)."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*The number of training batches.*")
    warnings.filterwarnings("ignore", ".*Checkpoint directory .* exists and is not empty.*")
    warnings.filterwarnings("ignore", ".*isinstance\\(treespec, LeafSpec\\).*")
