"""A capture file and what can be done with it."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from data_modules.examine import Findings, describe, examine
from data_modules.load import load_scene, planned_scene, read_scene, reader_options
from data_modules.plan import Plan, plan_capture
from data_modules.readers import detect_format, read_capture
from nlos_lit.api.results import Diagnosed, Picture, Surface
from nlos_lit.baselines import METHODS, reconstruct_directed
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError, suggest
from nlos_lit.capture.volume_grid import volume_grid
from nlos_lit.inference.diagnose import diagnose
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.runtime.arguments import check_overrides
from nlos_lit.runtime.command_line import quoted
from nlos_lit.runtime.memory import parse_bytes
from nlos_lit.surfels.fit import SurfelSettings
from nlos_lit.surfels.fitted import fit_surfels
from nlos_lit.training.configs import compose, pipeline_of, settings_of
from nlos_lit.training.run_folder import prepare_run

PHASOR, SURFELS = "phasor", "surfels"


class Measurement:
    """A capture file, read once for each way in which it is gated and summed.

    Args:
        path: of the file, or a folder of files.
        settings: of its scene, as commands take them (``scene.reader.bin_width_ps=16``).

    Raises:
        UserError: the file is missing or not usable, or a setting does not exist.
    """

    def __init__(self, path: Path | str, settings: Sequence[str] = ()) -> None:
        self.path, self.settings = Path(path), tuple(settings)
        self.scene = self._config("reconstruct")["scene"]
        if not self.path.exists():
            raise UserError(f"{path} does not exist; give a capture file (docs/formats.md lists the formats)")
        self.format = detect_format(self.path) if self.scene["format"] == "auto" else self.scene["format"]
        options = reader_options(self.scene["reader"])
        self.capture: Capture = read_capture(self.path, self.scene["format"], options=options)
        self._load = functools.lru_cache(maxsize=2)(self._loaded_anew)

    @property
    def name(self) -> str:
        """What it is called after its file."""
        return str(self.scene["name"])

    @functools.cached_property
    def findings(self) -> Findings:
        """Direct pulse, first returns, and what looks wrong, in ``warnings``."""
        return examine(self.capture)

    def __str__(self) -> str:
        return describe(self.capture, self.format, self.findings)

    def plan(self) -> Plan:
        """Bins to sum, gate and depths that the file's own data ask for, with the settings given."""
        gate = self.scene["gate"]
        return plan_capture(
            self.capture.sum_spots(self.scene["sum_spots"]),
            self.scene["wavelength"],
            self.scene["sum_bins"],
            None if gate is None else (gate[0], gate[1]),
        )

    def reconstruct(self, method: str = "lct", *settings: str) -> Picture | Surface:
        """A picture by a classical method, or surfels fitted to the counts.

        Args:
            method: ``lct``, ``fk``, ``phasor`` (which is ``rsd``), ``dlct``, ``bp``, ``fbp``; or ``surfels``.
            settings: as ``nlos reconstruct`` takes them (``scene.volume.depth=[0.5,1.2]``), for surfels as
                ``nlos train`` does (``surfels.rounds=4``).

        Returns:
            A :class:`~nlos_lit.api.results.Picture`, or a :class:`~nlos_lit.api.results.Surface`.

        Raises:
            UserError: there is no such method or setting, or the capture does not suit the method.
        """
        if method == SURFELS:
            return self._surfels(settings)
        by = "rsd" if method == PHASOR else method
        if by not in METHODS:
            raise UserError(f"there is no method {method!r}; {suggest(method, [*METHODS, PHASOR, SURFELS])}")
        config = self._config("reconstruct", f"method={by}", *settings)
        capture, scene = self._loaded(config)
        grid = volume_grid(capture, **scene["volume"])
        began = time.perf_counter()
        volume, field = reconstruct_directed(
            capture,
            grid,
            by,
            budget_bytes=parse_bytes(config["memory_budget"]),
            **config["method"]["options"],
        )
        seconds = time.perf_counter() - began
        values = (volume / volume.max().clamp_min(1e-30)).numpy()
        along = None if field is None else field.numpy()
        return Picture(self.name, method, values, grid, scene["threshold"], seconds, along)

    def diagnose(self, *settings: str) -> Diagnosed:
        """What the simulation gets wrong about the capture.

        Args:
            settings: as ``nlos diagnose`` takes them (``criticism.most=2``).

        Returns:
            The diagnosis.

        Raises:
            UserError: there is no such setting, the scan is too small, or the file holds no photon counts.
        """
        config = self._config("diagnose", *settings)
        capture, scene = self._loaded(config)
        pipeline = pipeline_of(config, scene, config["model"])
        options = settings_of(CriticismSettings, config["criticism"], "criticism")
        found, _ = diagnose(capture, pipeline, options, name=self.name, seed=config["seed"])
        return Diagnosed(self.name, found)

    def _surfels(self, settings: Sequence[str]) -> Surface:
        config = self._config("train", "model=surface", *settings)
        raw = self._raw(config["scene"], config["data_dir"])
        scene = planned_scene(config["scene"], config["data_dir"], config["force"], raw)[0]
        run = prepare_run({**config, "scene": scene}, raw=raw)
        phasor = run.module.pipeline.phasor
        fitted = fit_surfels(
            run.capture,
            phasor().detach().cpu(),
            phasor.grid,
            settings_of(SurfelSettings, config["surfels"], "surfels"),
            run.data.train_spots,
            extension=run.extension,
            seed=config["seed"],
            heldout_spots=run.data.heldout_spots,
            scan_shapes=True,
        )
        return Surface(self.name, fitted)

    def _config(self, command: str, *settings: str) -> dict[str, Any]:
        """The config of a command for this file, composed and checked."""
        given = ["scene=capture", f"scene.path={quoted(self.path)}", *self.settings, *settings]
        check_overrides(command, given[2:])
        return compose(command, given)

    def _loaded(self, config: dict[str, Any]) -> tuple[Capture, dict[str, Any]]:
        return self._load(json.dumps(config["scene"]), config["data_dir"], config["seed"], config["force"])

    def _loaded_anew(
        self, scene: str, data_dir: str, seed: int, force: bool
    ) -> tuple[Capture, dict[str, Any]]:
        """The capture, ready to fit, and its scene, planned."""
        asked = json.loads(scene)
        raw = self._raw(asked, data_dir)
        planned = planned_scene(asked, data_dir, force, raw)[0]
        return load_scene(planned, data_dir, seed, force, raw)[0], planned

    def _raw(self, scene: Mapping[str, Any], data_dir: str) -> Capture:
        """The file as it is: read again only where it is to be read otherwise."""
        kept = all(scene[key] == self.scene[key] for key in ("path", "format", "reader"))
        return self.capture if kept else read_scene(scene, data_dir)
