"""The base of a diagnosis: image, surfels, response, fitted to one part of the scan."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid, volume_grid
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.split import Split
from nlos_lit.model.build import PipelineSettings, build_pipeline
from nlos_lit.runtime.memory import check_machine
from nlos_lit.surfels.fit import SurfelFit, SurfelSettings
from nlos_lit.surfels.fitted import fit_surfels


@dataclass(frozen=True)
class BasePipeline:
    """From counts to fitted surfels; picklable, so that toys can go through all of it in other processes.

    Args:
        volume: arguments of :func:`~nlos_lit.capture.volume_grid.volume_grid`.
        model: of the image.
        surfels: of the fit.
        budget: bytes for the phasor field.
    """

    volume: Mapping[str, Any]
    model: PipelineSettings
    surfels: SurfelSettings
    budget: int

    def image(self, capture: Capture) -> tuple[Tensor, VolumeGrid]:
        """The phasor image of all spots, ``[nz, nx, ny]``, at the start values of Θ_pf."""
        grid = volume_grid(capture, **self.volume)
        phasor = build_pipeline(capture, grid, self.model).phasor
        plan = phasor.plan(capture, self.budget)
        check_machine(plan.total_bytes, "the phasor field")
        phasor.prepare(capture, plan)
        with torch.no_grad():
            return phasor().cpu(), grid

    def fit(
        self,
        capture: Capture,
        split: Split,
        image: tuple[Tensor, VolumeGrid],
        extension: Extension,
        seed: int,
    ) -> SurfelFit:
        """Surfels from new seeds, with the given effects.

        No rounds follow those of the plan: what the scene lacks is seen in the residual.

        Args:
            capture: raw counts.
            split: whose ``fit`` spots are fitted; its ``select`` spots say how fine the scene may become.
            image: ``[nz, nx, ny]`` and its grid, from :meth:`image`.
            extension: effects, fitted along in place.
            seed: of batches and tested spots.

        Returns:
            the fit, converged.
        """
        given = (capture, *image, replace(self.surfels, more=0), split.fit)
        return fit_surfels(*given, extension=extension, seed=seed, judge_spots=split.select).fit

    def grow(self, fit: SurfelFit, seed: int) -> SurfelFit:
        """A parsimonious fit gone on with, with surfels as many and as fine as the counts ask for.

        Args:
            fit: that is copied.
            seed: of batches and tested spots.

        Returns:
            the finer fit.
        """
        again = fit.copy(copy.deepcopy(fit.extension), seed)
        again.settings = self.surfels
        again.schedule([], self.surfels.more)
        again.finish()
        return again

    def __call__(self, capture: Capture, split: Split, seed: int) -> SurfelFit:
        """Image and parsimonious fit without effects."""
        return self.fit(capture, split, self.image(capture), Extension([]), seed)
