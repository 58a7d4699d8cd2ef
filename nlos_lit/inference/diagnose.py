"""A whole diagnosis of one capture, from counts to verdict."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.assemble import assemble
from nlos_lit.inference.base_pipeline import BasePipeline
from nlos_lit.inference.criticise import criticise
from nlos_lit.inference.distil import distil
from nlos_lit.inference.kept import kinds
from nlos_lit.inference.members import Findings, Member
from nlos_lit.inference.pool import lit_by
from nlos_lit.inference.result import Diagnosis
from nlos_lit.inference.scenes import Scenes
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.inference.split import Split, split_spots
from nlos_lit.inference.toys import run_toys
from nlos_lit.runtime.steps import Report, Steps
from nlos_lit.surfels.fit import SurfelFit

Progress = Callable[[tuple[Tensor, VolumeGrid], SurfelFit, SurfelFit, list[Member]], None]


def split_of(capture: Capture) -> Split:
    """How a diagnosis parts the spots of a capture.

    Args:
        capture: to be diagnosed.

    Returns:
        the parts.

    Raises:
        UserError: the scan is too small to be split, or the capture holds no counts but expectations.
    """
    if not capture.is_counts:
        raise UserError(
            "a diagnosis weighs photon counts; this capture holds expected values (a render): "
            "draw counts first"
        )
    return split_spots(capture)


def diagnose(
    capture: Capture,
    pipeline: BasePipeline,
    options: CriticismSettings,
    *,
    name: str,
    seed: int,
    image: tuple[Tensor, VolumeGrid] | None = None,
    folder: Path | None = None,
    settings: str = "",
    report: Report = lambda text, passed, left: None,
    told: Progress = lambda image, base, present, turns: None,
) -> tuple[Diagnosis, Findings]:
    """Fit, criticise, measure.

    Args:
        capture: raw counts; nothing else about the measurement is known.
        pipeline: image and fit of the base.
        options: of the criticism.
        name: of the capture, for the report.
        seed: of everything random.
        image: ``[nz, nx, ny]`` and its grid, where a run has made it already.
        folder: where finished steps and toys are kept, so that an interrupted diagnosis with the same
            arguments goes on; needed with ``options.toys``.
        settings: all that results depend on, see :class:`~nlos_lit.runtime.steps.Steps`.
        report: called as steps begin, see :class:`~nlos_lit.runtime.steps.Steps`.
        told: called before anything is asked, whenever terms come, and at the end, with the image and its
            grid, the fine fit without effects, the present one, and the terms so far.

    Returns:
        the diagnosis, and the fits behind it.

    Raises:
        UserError: the scan is too small to be split, the capture holds no counts but expectations, no surface
            is found, or kept steps are damaged or of other settings.
    """
    began = time.perf_counter()
    split, scan = split_of(capture), Scan.of(capture)
    steps = Steps(report, None if folder is None else folder / "steps", settings, kinds(scan))
    steps.share({"capture": capture, "settings": pipeline.surfels})
    steps.plan(image=image is None, fit=2, screen=1)
    if image is None:
        image = steps("image", "imaging", "image", lambda: pipeline.image(capture))
    base = steps(
        "fit",
        "fitting the base",
        "base",
        lambda: pipeline.fit(capture, split, image, Extension([]), seed),
    )
    scan = lit_by(base, scan)
    steps.know(kinds(scan))
    steps.share({"counts": base.counts, "grid": base.grid, "reserve": base.reserve})

    def rebuild(extension: Extension, with_seed: int) -> SurfelFit:
        again = pipeline.fit(capture, split, image, extension, with_seed)
        again.counts = base.counts
        return again

    scenes = Scenes(rebuild, pipeline.grow, split, seed, steps, options.processes)
    found = criticise(base, scenes, scan, options, partial(told, image))
    followers = distil(scenes, scan, found)
    null = None
    if options.toys:
        assert folder is not None, "toys are kept in a folder"
        null = run_toys(capture, base, pipeline, split, options, folder / "toys", report)
    seconds = time.perf_counter() - began + steps.earlier
    return assemble(capture, found, split, scan, options, null, name, seconds, seed, followers), found
