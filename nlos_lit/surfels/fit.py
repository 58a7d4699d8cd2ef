"""The fit of surfels, response and effects to raw counts: Poisson likelihood on random batches of spots."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects.extension import Extension
from nlos_lit.metrics.transients import transient_scores
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.surfels.growth import Seeds, prune_and_grow
from nlos_lit.surfels.model import SurfelModel

Progress = Callable[[int, int], None]
WORTH = 0.02  # nats a parameter that another round must gain


@dataclass(frozen=True)
class RefineSettings:
    """How surfels are seeded and fitted.

    Args:
        floor: seeds are local maxima of the image of at least this share of its largest value …
        significance: … whose Poisson score against the scan's mean transient exceeds this many standard
            deviations.
        per_cell: seeds per lateral cell, so that partly hidden objects survive.
        max_seeds: the most significant are kept, and as many in reserve for growth.
        subdivide: surfels along each side of a voxel; None takes 2 where a voxel is wider than six bins, else
            1.
        quadrature: points along each side of a surfel; None spaces their arrivals by about two bins.
        rounds: between rounds surfels die, grow and are hidden anew. steps: batches a round; the last has
            twice as many.
        more: last rounds that may follow, see :meth:`SurfelFit.converge`.
        batch: spots a step.
        depth_rate: of Adam, in bins there and back. albedo_rate, normal_rate, response_rate: of the
            unconstrained values.
        effect_rate: of physical effects, in their own noticeable steps.
        tie: weight of :meth:`SurfelModel.bending`, nats per squared radian and pair.
        surfel_cost: nats that a surfel must be worth, see :meth:`SurfelModel.presence`.
        prune: surfels whose albedo is below this many of its standard deviations die.
        grow: places next to surfels, and unused seeds, whose score exceeds this many standard deviations get
            one.
        test_spots: random training spots on which scores are computed.
        visibility: surfels hide one another.
    """

    floor: float = 0.05
    significance: float = 5.0
    per_cell: int = 6
    max_seeds: int = 3000
    subdivide: int | None = None
    quadrature: int | None = None
    rounds: int = 4
    steps: int = 100
    more: int = 4
    batch: int = 48
    depth_rate: float = 0.15
    albedo_rate: float = 0.08
    normal_rate: float = 0.03
    response_rate: float = 0.03
    effect_rate: float = 0.1
    tie: float = 100.0
    surfel_cost: float = 0.0
    prune: float = 1.5
    grow: float = 3.5
    test_spots: int = 384
    visibility: bool = True

    def __post_init__(self) -> None:
        if min(self.rounds, self.steps, self.batch, self.per_cell, self.test_spots) < 1:
            raise UserError("surfels.rounds, steps, batch, per_cell and test_spots must be at least 1")
        if not 0 < self.floor < 1 or self.tie < 0:
            raise UserError(
                "surfels.floor must lie between 0 and 1 and surfels.tie be 0 or more; "
                f"found {self.floor} and {self.tie}"
            )


class SurfelFit:
    """A model on its way to the counts of the training spots.

    Args:
        model: where it begins.
        capture: that is fitted.
        grid: surfels stay within its depths.
        counts: ``[N, T_gate]`` of the training spots ``train`` ``[N]``.
        settings: of the fit.
        reserve: places that may grow a surfel, besides those next to surfels.
        extension: effects that are fitted along, in place.
        generator: draws the batches.
        order: ``[N]`` permutation of the training rows, the first of which are used to test surfels.
    """

    def __init__(
        self,
        model: SurfelModel,
        capture: Capture,
        grid: VolumeGrid,
        counts: Tensor,
        train: Tensor,
        settings: RefineSettings,
        reserve: Seeds,
        extension: Extension,
        generator: torch.Generator,
        order: Tensor,
    ) -> None:
        self.model, self.capture, self.grid, self.counts, self.train = model, capture, grid, counts, train
        self.settings, self.reserve, self.extension, self.generator = settings, reserve, extension, generator
        self.order, self.place, self.done = order, 0, 0  # done: batches so far
        self.tested = order[: settings.test_spots]

    def copy(self, extension: Extension, seed: int) -> SurfelFit:
        """The same fit to go on with other effects, from copies of the surfels.

        Args:
            extension: effects that are fitted along, in place.
            seed: of the batches.

        Returns:
            a fit that shares capture, counts and settings with this one.
        """
        model = copy.deepcopy(self.model)
        generator = torch.Generator().manual_seed(seed)
        parts = (self.capture, self.grid, self.counts, self.train, self.settings, self.reserve)
        return SurfelFit(
            model, *parts, extension, generator, torch.randperm(len(self.train), generator=generator)
        )

    def parts(self) -> dict[str, Any]:
        """All that the fit is made of, for :meth:`of_parts`, which goes on from there to the last digit."""
        names = ("capture", "grid", "counts", "train", "settings", "reserve", "extension", "order", "place")
        return {name: getattr(self, name) for name in names} | {
            "model": dict(self.model.state_dict()),
            "generator": self.generator.get_state(),
            "tested": self.tested,
            "done": self.done,
        }

    @classmethod
    def of_parts(cls, parts: dict[str, Any]) -> SurfelFit:
        """The fit that :meth:`parts` took apart."""
        held = dict(parts)
        after = {name: held.pop(name) for name in ("place", "tested", "done")}
        held["model"] = SurfelModel.from_state(held["capture"], held["model"])
        held["generator"] = torch.Generator().set_state(held["generator"])
        fit = cls(**held)
        fit.place, fit.tested, fit.done = after["place"], after["tested"], after["done"]
        return fit

    @torch.no_grad()
    def match_energy(self) -> None:
        """Set the intensity so that rendered light makes up for what the background does not count.

        Through all effects.
        """
        sensor, spots, counted = (
            self.model.laser_sensor,
            self.train[self.tested],
            self.counts[self.tested].sum(),
        )
        nothing = torch.zeros(len(spots), self.model.n_bins, device=spots.device)
        dark = self.model.detect(nothing, spots, self.extension)[:, self.model.gate[0] :].sum()
        light = self.model.light(spots, self.extension).sum()
        value = (
            float((counted - dark).clamp_min(0.01 * counted) / light.clamp_min(1e-30))
            * sensor.intensity().item()
        )
        sensor.intensity = BoundedParameter(value, value * 1e-3, value * 1e3, "counts m2")

    def _batch(self) -> Tensor:
        size = min(self.settings.batch, len(self.train))
        if self.place + size > len(self.order):
            self.order, self.place = torch.randperm(len(self.train), generator=self.generator), 0
        self.place += size
        return self.order[self.place - size : self.place]

    def run(
        self,
        rounds: int,
        progress: Progress | None = None,
        grow_first: bool = False,
        steps: int | None = None,
        settle: bool = True,
    ) -> list[dict[str, float]]:
        """Several rounds, the last twice as long; surfels die and grow between.

        Args:
            rounds: how many.
            progress: called with (batches done, of how many).
            grow_first: surfels die and grow before the first round, too.
            steps: batches a round; None takes those of the settings.
            settle: the first round comes from seeds, and the response waits for their places.

        Returns:
            one entry a round: surfels, mean loss over its last quarter, response.
        """
        s, history, begun = self.settings, [], self.done
        steps = steps or s.steps
        total = steps * (rounds + 1)
        for index in range(rounds):
            if index or grow_first:
                parts = (
                    self.model,
                    self.capture,
                    self.grid,
                    self.reserve,
                    self.counts,
                    self.train,
                    self.tested,
                )
                prune_and_grow(*parts, s.prune, s.grow, self.extension)
            if s.visibility:
                self.model.update_visibility()
            losses = []
            for loss in self._round(rounds - 1 - index, index == 0 and settle, steps):
                losses.append(loss)
                self.done += 1
                if progress is not None:
                    progress(self.done - begun, total)
            self.model.link()
            sensor = {name: p().item() for name, p in self.model.laser_sensor.named_children()}
            history.append(
                {"surfels": len(self.model), "loss": float(np.mean(losses[-len(losses) // 4 :])), **sensor}
            )
        return history

    def converge(self, progress: Progress | None = None) -> list[dict[str, float]]:
        """Last rounds anew, while the fit is above the noise and gains more than ``WORTH`` a parameter.

        Bright captures take longer to converge; where the fit is at the noise already, more batches would
        only fit the noise.

        Args:
            progress: goes on from the batches that were done before.

        Returns:
            one entry a round, ``more`` at most.
        """

        def told(done: int, total: int) -> None:
            if progress is not None:
                progress(self.done, self.done - done + total)

        history: list[dict[str, float]] = []
        parameters = sum(p.numel() for p in [*self.model.parameters(), *self.extension.parameters()])
        bins = self.counts.numel()
        before, noise = self._deviance()
        while len(history) < self.settings.more and before > noise:
            history += self.run(1, told, settle=False)
            after, noise = self._deviance()
            if (before - after) * bins / 2 < WORTH * parameters:
                break
            before = after
        return history

    @torch.no_grad()
    def _deviance(self) -> tuple[float, float]:
        """Per bin of the tested rows, and what noise alone would make."""
        expected = self.model.expected(self.train[self.tested], self.extension)
        scores = transient_scores(self.counts[self.tested], expected)
        return scores.deviance_per_bin, scores.deviance_noise

    def _round(self, left: int, settling: bool, steps: int) -> Iterator[float]:
        s, model = self.settings, self.model
        last = left == 0
        steps *= 2 if last else 1
        # The response waits for the places, the tie for the surface: both would otherwise settle around
        # errors of the seeds.
        response_rate = s.response_rate * (0.3 if settling else 1.0)
        per_count = 1 / (len(self.train) * self.counts.shape[1])  # nats over all spots to the mean over bins
        tie = s.tie * 0.3 ** max(0, left - 1) * per_count
        cost = s.surfel_cost * per_count
        groups = [
            {"params": [model.raw_depth], "lr": s.depth_rate},
            {"params": [model.raw_albedo], "lr": s.albedo_rate},
            {"params": [model.raw_normal], "lr": s.normal_rate},
            {"params": list(model.laser_sensor.parameters()), "lr": response_rate},
            {"params": list(self.extension.parameters()), "lr": s.effect_rate},
        ]
        optimizer = torch.optim.Adam([g for g in groups if g["params"]], betas=(0.9, 0.98))

        def rate(step: int) -> float:
            return max(0.01, 0.5 * (1 + math.cos(math.pi * step / steps))) if last else 1 - 0.7 * step / steps

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        for _ in range(steps):
            rows = self._batch()
            expected = model.render(self.train[rows], self.extension).clamp_min(1e-12)
            fit = (expected - torch.xlogy(self.counts[rows], expected)).mean()
            loss = (
                fit + tie * model.bending() + cost * model.presence() + per_count * self.extension.penalty()
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            self.extension.clamp()
            schedule.step()
            yield float(fit.detach())
