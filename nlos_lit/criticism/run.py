"""A whole diagnosis of one capture, from counts to verdict."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.criticism.base import BasePipeline
from nlos_lit.criticism.criticise import CriticismSettings, Findings, criticise
from nlos_lit.criticism.diagnosis import assemble
from nlos_lit.criticism.numerics import numerics
from nlos_lit.criticism.result import Diagnosis
from nlos_lit.criticism.split import split_spots
from nlos_lit.criticism.toys import run_toys
from nlos_lit.effects.base import Extension
from nlos_lit.effects.scan import Scan
from nlos_lit.errors import UserError
from nlos_lit.grid import VolumeGrid

Tell = Callable[[str], None]


def diagnose(
    capture: Capture,
    pipeline: BasePipeline,
    options: CriticismSettings,
    *,
    name: str,
    seed: int,
    image: tuple[Tensor, VolumeGrid] | None = None,
    toys_folder: Path | None = None,
    tell: Tell = lambda text: None,
) -> tuple[Diagnosis, Findings]:
    """Fit, criticise, measure.

    Args:
        capture: raw counts; nothing else about the measurement is known.
        image: ``[nz, nx, ny]`` and its grid, where a run has made it already.
        toys_folder: where toys are kept; needed with ``options.toys``.
        tell: what is being done now.

    Raises:
        UserError: the scan is too small to be split, the capture holds no counts but expectations, or no surface is found.
    """
    began = time.perf_counter()
    if not capture.is_counts:
        raise UserError("a diagnosis weighs photon counts; this capture holds expected values (a render): draw counts first")
    split, scan = split_spots(capture), Scan.of(capture)
    tell(f"{len(split.fit)} spots to fit, {len(split.select)} to select, {len(split.test)} untouched")
    if image is None:
        tell("imaging")
        image = pipeline.image(capture)

    def fit(extension: Extension):
        return pipeline.fit(capture, split, image, extension, seed)

    tell("fitting the base")
    base = fit(Extension([]))
    found = criticise(base, fit, split, scan, options, seed, tell)
    null = None
    if options.toys:
        null = run_toys(capture, base, pipeline, split, options, toys_folder, lambda done, of: tell(f"toy {done} of {of}"))
    checks = {}
    if options.numerics:
        tell("varying the numerics")
        checks = numerics(pipeline, capture, split, image, base, seed)
    seconds = time.perf_counter() - began
    return assemble(capture, found, split, scan, options, null, checks, name, seconds, seed), found
