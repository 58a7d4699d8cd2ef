"""A first look at a capture file: what it is, what seems wrong, three pictures, and what to do next."""

from __future__ import annotations

import logging
import math
import os
import shlex
import sys
import time
from pathlib import Path

from omegaconf import OmegaConf

from nlos_lit.api.measurement import Measurement, quoted
from nlos_lit.api.results import Picture
from nlos_lit.capture.errors import CaptureError, UserError, printable
from nlos_lit.commands.plan import plan
from nlos_lit.report.capture_figure import draw_capture
from nlos_lit.report.fronts import View, front_views
from nlos_lit.report.style import save_figure
from nlos_lit.runtime.command_line import sentence_errors, settings_as_words, typed
from nlos_lit.runtime.threads import choose_threads
from nlos_lit.training.configs import compose

METHODS = {"lct": "light-cone transform", "fk": "f-k migration", "phasor": "phasor field"}
VOXELS = 1.5e6  # of a picture, on which the three methods take less than a minute of two cores
DIAGNOSED = 16  # spots on a side that a diagnosis needs at least


def main(arguments: list[str]) -> int:
    """Look at the file that ``arguments`` name, and return the exit status."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    sentence_errors(look)(arguments)
    return 0


def look(arguments: list[str]) -> None:
    """Print what a file holds, picture it, and print the commands to go on with.

    Raises:
        UserError: there is no file, it cannot be used, or a setting does not exist.
    """
    given = [word for word in arguments if not word.startswith("out=")]
    if not given or ("=" in given[0] and not os.path.exists(given[0])):
        raise UserError(
            f"name a capture file: {typed('look')} FILE; found {' '.join(arguments) or 'nothing'}"
        )
    file, settings = given[0], given[1:]
    logging.getLogger("data_modules").setLevel(logging.WARNING)  # the plan is part of what is printed
    measured = Measurement(file, settings)
    choose_threads(None)
    print(printable(str(measured)))
    named = [word.removeprefix("out=") for word in arguments if word.startswith("out=")]
    folder = Path(named[-1]) if named else Path("outputs") / measured.name / "look"
    found = measured.findings
    draw_capture(measured.capture, found.mean, found.totals, folder / "capture.png")
    pictures = list(pictured(measured))
    if pictures:
        views = [View(f"{METHODS[p.method]}, {p.seconds:.1f} s", p.values, p.grid) for p in pictures]
        figure = front_views(views, threshold=pictures[0].threshold, title=measured.name)
        save_figure(figure, folder / "look.png")
        print(printable(f"pictures     {folder / 'look.png'}"))
    print(printable(f"capture      {folder / 'capture.png'}"))
    for line in following(measured):
        print(line)


def pictured(measured: Measurement) -> list[Picture]:
    """The capture by three methods, on as many spots as a minute allows; one that does not suit says why."""
    pictures = []
    for method in METHODS:
        try:
            began = time.perf_counter()
            picture = measured.reconstruct(method, *coarser(measured))
        except CaptureError as error:
            print(printable(f"{method:12s} {error}"))
            continue
        assert isinstance(picture, Picture)
        print(f"{method:12s} {time.perf_counter() - began:.1f} s")
        pictures.append(picture)
    return pictures


def coarser(measured: Measurement) -> list[str]:
    """Settings that bring the volume of a picture below ``VOXELS``; none where it is.

    Spots are summed in squares, as far as the scan is one of two sides that this divides.
    """
    shape, scene = measured.capture.scan_shape, measured.scene
    planned = measured.plan()
    if scene["sum_spots"] > 1 or shape is None or len(shape) != 2 or planned.depth is None:
        return []
    depth = scene["volume"]["depth"] or planned.depth
    for side in (1, 2, 4, 8, 16):
        if any(n % side for n in shape):
            break
        # Bins, and so planes, become as much coarser as the spots.
        voxels = math.prod(shape) / side**2 * (depth[1] - depth[0]) / (planned.depth_pitch * side)
        if voxels <= VOXELS:
            return [f"scene.sum_spots={side}"] if side > 1 else []
    return []


def following(measured: Measurement) -> list[str]:
    """The commands to go on with, as they are to be typed."""
    return [f"next         {text}" for text in (training(measured), diagnosing(measured))]


def training(measured: Measurement) -> str:
    """The command that fits the capture; with fewer spots where it would take more than an hour."""
    for more in ([], ["scene.sum_spots=2"], ["scene.sum_spots=4"], ["scene.sum_spots=8"]):
        settings = [*measured.settings, *more]
        try:
            plan(OmegaConf.create(compose("train", _scene(measured, settings))))
        except UserError:
            continue
        return _command("train", measured, settings)
    return _command("train", measured, [*measured.settings, "force=true"])


def diagnosing(measured: Measurement) -> str:
    """The command that asks what the simulation misses, or why the capture cannot be asked."""
    capture = measured.capture
    if not capture.is_counts:
        return f"({typed('diagnose')} weighs photon counts; these are expected values)"
    if capture.n_spots < DIAGNOSED**2:
        return f"({typed('diagnose')} needs {DIAGNOSED} × {DIAGNOSED} spots; there are {capture.n_spots})"
    return _command("diagnose", measured, list(measured.settings))


def _scene(measured: Measurement, settings: list[str]) -> list[str]:
    return ["scene=capture", f"scene.path={quoted(measured.path)}", *settings]


def _command(name: str, measured: Measurement, settings: list[str]) -> str:
    words = settings_as_words(name, _scene(measured, settings))
    return " ".join([typed(name), *map(shlex.quote, words)])
