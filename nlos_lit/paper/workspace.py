"""Where experiments keep what is expensive: captures, trainings, arrays, each made once and found again."""

from __future__ import annotations

import functools
import logging
import multiprocessing
import os
import runpy
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from data_modules.load import load_scene
from data_modules.simulate import Mesh, load_truth
from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import spot_spacing
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.capture.volume_grid import VolumeGrid, volume_grid
from nlos_lit.io.files import whole_file
from nlos_lit.places import HOME
from nlos_lit.training.configs import compose
from nlos_lit.training.folder import OVERRIDES

log = logging.getLogger(__name__)

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Subject:
    """A capture to work on.

    Args:
        name: in file names.
        label: in tables.
        overrides: settings by which ``train.py`` takes it.
    """

    name: str
    label: str
    overrides: tuple[str, ...]

    @property
    def short(self) -> str:
        """The label up to the number of spots."""
        return self.label.split(" spots")[0]


@dataclass(frozen=True)
class Scene:
    """A subject, loaded: as ``train.py`` would see it.

    Args:
        capture: ready to fit.
        truth: the true surface; None where it is not known.
        mesh: the true scene; None where it is not known.
        grid: the volume.
        falloff: power of distance with which counts fall, for LCT and f-k.
        threshold: share of the largest intensity below which there is no surface.
    """

    capture: Capture
    truth: SurfaceTruth | None
    mesh: Mesh | None
    grid: VolumeGrid
    falloff: float
    threshold: float

    @functools.cached_property
    def spacing(self) -> float:
        """Distance of neighbouring spots, m."""
        return spot_spacing(self.capture)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """First and last voxel centre along x and along y, m."""
        x, y = self.grid.x, self.grid.y
        return float(x[0]), float(x[-1]), float(y[0]), float(y[-1])


def run_training(arguments: list[str], output: Path) -> int:
    """``train.py`` in a process of its own.

    The process is forked from a server that has imported the libraries and done nothing else: imports take
    longer than a small training.

    Args:
        arguments: of its command line.
        output: file for what it prints.

    Returns:
        Its exit status.
    """
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(
        ["lightning", "hydra", "open3d", "nlos_lit.training.outcome", "nlos_lit.training.run_folder"]
    )
    process = server.Process(target=_train, args=(arguments, output))
    process.start()
    try:
        process.join()
    except BaseException:
        process.terminate()
        process.join()
        raise
    assert process.exitcode is not None  # it was joined
    return process.exitcode


def _end_with_parent() -> None:
    """Stop this process as ``kill`` does once the one that wanted it is gone, which may be killed itself."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a child
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


def _train(arguments: list[str], output: Path) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with output.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    os.chdir(HOME)
    sys.argv = ["nlos", "train", *arguments]
    runpy.run_module("nlos_lit", run_name="__main__")


class Workspace:
    """A folder of results of one size.

    Args:
        root: where everything goes.
        experiment: config of conf/experiment that trainings use.
        data: folders that are searched for captures and meshes.
    """

    def __init__(self, root: Path, experiment: str, data: Sequence[Path] = ()) -> None:
        self.root, self.experiment, self.data = Path(root), experiment, [Path(folder) for folder in data]

    def find(self, name: str) -> Path | None:
        """A file or folder of that name below the data folders; None where there is none."""
        found = (path for folder in self.data for path in sorted(folder.rglob(name)))
        return next(found, None)

    def needed(self, name: str) -> Path:
        """As :meth:`find`.

        Raises:
            UserError: it is not there.
        """
        path = self.find(name)
        if path is None:
            places = ", ".join(map(str, self.data)) or "no folder"
            raise UserError(
                f"this experiment needs {name}; found none below {places}. "
                "Give the folder that holds it: data=DIR"
            )
        return path

    def path(self, name: str) -> Path:
        """A file of the workspace, its folder made."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def kept(self, name: str, compute: Callable[[], dict[str, Any]]) -> Arrays:
        """Named arrays (or numbers), computed once and read from ``kept/NAME.npz`` from then on.

        Args:
            name: of the file.
            compute: makes them.

        Returns:
            Name → array.
        """
        path = self.path(f"kept/{name}.npz")
        if not path.exists():
            log.info("computing %s", name)
            arrays = {key: np.asarray(value) for key, value in compute().items()}
            with whole_file(path) as partial:
                np.savez_compressed(partial, **arrays)  # type: ignore[arg-type]  # its stub takes names for flags
        with np.load(path, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}

    def train(self, name: str, subject: Subject, *overrides: str, start: Path | None = None) -> Path:
        """The run folder of a training, trained unless it is there; an interrupted one goes on.

        Args:
            name: of the folder.
            subject: what is trained on.
            overrides: further settings of ``train.py``.
            start: a finished shorter run to go on from.

        Returns:
            The folder of the finished run.

        Raises:
            UserError: the training failed, or the stored one had other settings.
        """
        folder = self.root / "runs" / name
        wanted = [f"experiment={self.experiment}", *subject.overrides, *overrides]
        stored = folder / ".hydra" / "overrides.yaml"
        if stored.exists():
            used = [item for item in yaml.safe_load(stored.read_text()) if not item.startswith("ckpt_path=")]
            if used != wanted:
                raise UserError(
                    f"{folder} was trained with other settings ({used}, now {wanted}); "
                    "remove it to train anew"
                )
        if (folder / "summary.json").exists():
            return folder
        checkpoint = []
        if (folder / OVERRIDES).exists():
            checkpoint = ["ckpt_path=last"]
        elif start is not None:
            checkpoint = [f"ckpt_path={start}/checkpoints/last.ckpt"]
        folder.mkdir(parents=True, exist_ok=True)
        log.info("training %s", name)
        output = folder / "output.txt"
        status = run_training([*wanted, *checkpoint, f"hydra.run.dir={folder.resolve()}"], output)
        if status:
            last = output.read_text(errors="replace").strip().splitlines()[-1:]
            raise UserError(
                f"the training {name} failed ({' '.join(last)}); all of its output is in {output}"
            )
        return folder

    def open(self, subject: Subject, *overrides: str) -> Scene:
        """The subject's capture, truth and volume.

        Args:
            subject: what is opened.
            overrides: further settings of ``train.py``.

        Returns:
            What was read, with the volume that a training would image.

        Raises:
            UserError: the data are not there or not usable.
        """
        chosen = [f"experiment={self.experiment}", *subject.overrides, *overrides]
        config = compose("train", chosen)
        scene = config["scene"]
        capture, truth = load_scene(scene, config["data_dir"], config["seed"])
        mesh = load_truth(scene["truth"]).mesh if scene["truth"] is not None else None
        grid = volume_grid(capture, **scene["volume"])
        return Scene(capture, truth, mesh, grid, scene["falloff"], scene["threshold"])
