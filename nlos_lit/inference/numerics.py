"""What moves when only the numerics change is not physics: the base again with other numbers."""

from __future__ import annotations

import math

from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.base_pipeline import BasePipeline
from nlos_lit.inference.refit import score
from nlos_lit.inference.split import Split
from nlos_lit.surfels.fit import SurfelFit


def numerics(
    pipeline: BasePipeline,
    capture: Capture,
    split: Split,
    image: tuple[Tensor, VolumeGrid],
    base: SurfelFit,
    seed: int,
    other: SurfelFit | None = None,
) -> dict[str, float]:
    """How much the select spots' deviance per bin changes with numerics alone.

    Args:
        pipeline: image and fit of the base.
        capture: that was fitted.
        split: of the spots.
        image: ``[nz, nx, ny]`` and its grid.
        base: the fit.
        seed: of the base.
        other: a fit with another seed, where there is one.

    Returns:
        changes by another seed, and by finer quadrature of the fitted surfels.
    """
    reference = score(base, split.select).deviance_per_bin
    if other is None:
        other = pipeline.fit(capture, split, image, Extension([]), seed + 1)
    finer = base.copy(base.extension, seed)
    finer.model.quadrature = math.ceil(1.5 * base.model.quadrature)
    return {
        "another random seed": score(other, split.select).deviance_per_bin - reference,
        "finer quadrature of surfels": score(finer, split.select).deviance_per_bin - reference,
    }
