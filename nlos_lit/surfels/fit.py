"""The fit of surfels, response and effects to raw counts: Poisson likelihood on random batches of spots."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.capture.wall_blocks import by_block, wall_blocks
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.hooks import NOTHING, Hooks
from nlos_lit.functional.surfel_graph import BEND, Sheet
from nlos_lit.metrics.transients import Scores, transient_scores
from nlos_lit.surfels.effect_start import choose_shapes
from nlos_lit.surfels.growth import PlaceTest, Seeds, begin_bodies, prune_and_grow
from nlos_lit.surfels.model import SurfelModel, points_along, unknown_opacity
from nlos_lit.surfels.outlines import MEND, SEARCH, cut_back, extend, solve_albedos

Progress = Callable[[int, int], None]
PLAIN = (
    "order",
    "place",
    "tested",
    "done",
    "more",
    "bodies",
    "before",
    "undo",
    "latest",
    "rival",
    "finer",
    "priced",
    "area",
    "bend",
    "history",
    "losses",
)
PATCHES = 16  # along each side of the wall: spots are set aside, and their gains scatter, by patches
FINEST = 1.5  # bins: surfels no wider are not divided; light of neighbours arrives about a bin apart
AGAIN = 25  # batches after which it is asked again how rough sheets are
PLAN, DIVISION, ROUND, UNDONE = "plan", "division", "round without", "round undone"  # see schedule
LAST = 4  # times as many batches as in other rounds: in the last of a plan, and in each that follows
LOST = 0.01  # of the bright albedo: seeds below it have lost the contest


@dataclass(frozen=True)
class SurfelSettings:
    """How surfels are seeded and fitted.

    Args:
        floor: seeds are local maxima of the image of at least this share of its largest value …
        significance: … whose Poisson score against the scan's mean transient exceeds this many standard
            deviations.
        per_cell: seeds per lateral cell, so that partly hidden objects survive.
        max_seeds: the most significant are kept, and as many in reserve for growth.
        subdivide: surfels along each side of a voxel; None makes them at most four bins of path wide, and
            finer where that predicts more …
        most: … and makes no more surfels than this.
        quadrature: points along each side of a surfel; None spaces their arrivals by about two bins.
        contest: batches in which seeds and response stand still, and albedos and effects are fitted, but for
            those that move light in time.
        rounds: in which sheets are found; between them surfels die and grow one by one.
        outlines: rounds that follow, before which sheets are extended all around and cut back.
        steps: batches a round; the last has ``LAST`` times as many.
        more: last rounds that may follow, see :meth:`SurfelFit.schedule`.
        batch: spots a step.
        depth_rate: of Adam, in bins there and back.
        albedo_rate, opacity_rate, response_rate: of the unconstrained values.
        roll_rate: of how far rims roll off.
        effect_rate: of physical effects, in their own noticeable steps.
        bending: weight against neighbours that do not fit one surface (:meth:`SurfelModel.bending`); 1 takes
            it for the logarithm of a prior.
        evenness: weight against albedos that differ between neighbours …
        brightness: … or are beyond the scene's own level (:meth:`SurfelModel.albedo_cost`).
        lean: nats that each surfel costs that is there, however faint, while sheets find their outlines. In
            rounds that follow surfels are fitted without, but their area must be worth as much.
        surfel_cost: nats that a surfel must be worth, see
            :func:`~nlos_lit.surfels.growth.prune_and_grow`.
        test_spots: random training spots on which scores are computed.
        visibility: surfels hide one another.
    """

    floor: float = 0.1
    significance: float = 5.0
    per_cell: int = 3
    max_seeds: int = 3000
    subdivide: int | None = None
    most: int = 12000
    quadrature: int | None = None
    contest: int = 150
    rounds: int = 3
    outlines: int = 3
    steps: int = 100
    more: int = 8
    batch: int = 24
    depth_rate: float = 0.15
    albedo_rate: float = 0.08
    opacity_rate: float = 0.2
    roll_rate: float = 0.05
    response_rate: float = 0.03
    effect_rate: float = 0.1
    bending: float = 0.5
    evenness: float = 0.7
    brightness: float = 1.0
    lean: float = 3.0
    surfel_cost: float = 1.5
    test_spots: int = 384
    visibility: bool = True

    def __post_init__(self) -> None:
        if min(self.rounds, self.steps, self.batch, self.per_cell, self.test_spots) < 1:
            raise UserError("surfels.rounds, steps, batch, per_cell and test_spots must be at least 1")
        weights = (self.bending, self.evenness, self.brightness, self.lean, self.surfel_cost)
        least = min(self.contest, self.outlines, self.more, *weights)
        if not 0 < self.floor < 1 or least < 0:
            raise UserError(
                "surfels.floor must lie between 0 and 1, and surfels.contest, outlines, more, bending, "
                "evenness, brightness, lean and surfel_cost be 0 or more; found "
                f"floor={self.floor} and {least}"
            )


@dataclass(frozen=True)
class Round:
    """One round of a fit; surfels come and go and are hidden anew between rounds only.

    Args:
        steps: batches.
        left: rounds that follow by plan; the last one cools down.
        settling: it comes from seeds; the response, what moves light in time and the shapes of effects wait
            for their places.
        contest: surfels and response stand still; those that come out faint are left out afterwards.
        parts: into which each side of a surfel is divided before it, if ``most`` surfels allow it.
        grow: surfels die and grow before it, one by one.
        outline: sheets are extended and cut back before it.
        shapes: scanned parameters of effects start anew before it, where the counts ask for them.
        onward: it goes on where a fit ended: who is whose neighbour and who hides whom stays as it is, and
            normals begin as they are.
    """

    steps: int
    left: int = 0
    settling: bool = False
    contest: bool = False
    parts: int = 1
    grow: bool = False
    outline: bool = False
    shapes: bool = False
    onward: bool = False


def plan_from_seeds(settings: SurfelSettings, parts: int, scan_shapes: bool) -> list[Round]:
    """The rounds from seeds to the fitted scene, without those that may follow.

    Args:
        settings: of the fit.
        parts: into which each side of a seed is divided once the seeds have contested.
        scan_shapes: scanned parameters of effects are started after a first round of places.

    Returns:
        the plan, whose last round is ``LAST`` times as long.

    Examples:
        >>> plan = plan_from_seeds(SurfelSettings(rounds=2, outlines=1), 1, scan_shapes=False)
        >>> [(each.steps, each.left, each.grow, each.outline) for each in plan]
        [(150, 3, False, False), (100, 2, False, False), (100, 1, True, False), (400, 0, False, True)]
    """
    s = settings
    plan = [Round(s.contest, settling=True, contest=True)] if s.contest else []
    plan.append(Round(s.steps, settling=True, parts=parts))
    coarse = max(s.rounds, 2) if scan_shapes else s.rounds
    plan += [Round(s.steps, grow=True, shapes=scan_shapes and k == 0) for k in range(coarse - 1)]
    plan += [Round(s.steps, outline=True)] * s.outlines
    plan[-1] = replace(plan[-1], steps=LAST * s.steps)
    return [replace(each, left=len(plan) - 1 - k) for k, each in enumerate(plan)]


class SurfelFit:
    """A model on its way to the counts of the training spots.

    What is to be done is a plan of rounds (:meth:`schedule`), and each round a number of batches::

        while not fit.finished:
            if not fit.in_round:
                fit.begin_round()
            fit.step()
            if fit.round_done:
                fit.end_round()

    Between any two of these calls :meth:`state` is all that the fit is; one that is restored from it goes on
    to the last digit.

    Args:
        model: where it begins.
        capture: that is fitted.
        grid: surfels stay within its depths.
        counts: ``[N, T_gate]`` of the training spots ``train`` ``[N]``; bins that the capture does not
            hold as observed take part in nothing.
        settings: of the fit.
        reserve: places where a body may be that is missing.
        extension: effects that are fitted along, in place.
        generator: draws the batches.
        order: ``[N]`` permutation of the training rows, the first of which are used to test surfels.
        judged: ``[J]`` rows of the capture that are not trained; by them it is judged whether bodies are
            missing, and how fine the surfels are to be. Without any no rounds follow those of the plan.

    Attributes:
        done: batches so far.
        plan: the present round, if any, and those that follow.
        history: one entry a finished round: surfels, mean loss over its last quarter, response.
        losses: of the batches of the present round.
        optimizer: of the present round; None between rounds.
    """

    def __init__(
        self,
        model: SurfelModel,
        capture: Capture,
        grid: VolumeGrid,
        counts: Tensor,
        train: Tensor,
        settings: SurfelSettings,
        reserve: Seeds,
        extension: Extension,
        generator: torch.Generator,
        order: Tensor,
        judged: Tensor,
    ) -> None:
        self.model, self.capture, self.grid, self.counts, self.train = model, capture, grid, counts, train
        self.settings, self.reserve, self.extension, self.generator = settings, reserve, extension, generator
        self.order, self.place, self.done = order, 0, 0
        self.tested, self.judged = order[: settings.test_spots], judged
        seen = capture.gated_observed()
        self.observed = None if seen is None else torch.from_numpy(seen)[train.cpu()].to(counts.device)
        self.plan: list[Round] = []
        self.more, self.bodies = 0, 0  # rounds that may follow, and those before which bodies are begun
        self.before = torch.zeros(0)  # nats before the latest of them
        self.undo: dict[str, Any] | None = None  # what that began with
        self.latest = PLAN  # what came last of PLAN, DIVISION, ROUND and UNDONE
        self.rival: dict[str, Any] | None = None  # what dividing them again came to, until it is judged
        self.priced = True  # no round was judged yet: surfels cost something while they are fitted
        self.area = math.inf  # m², of surfels when a round is first judged: what is as wide costs `lean`
        self.finer = True  # surfels may be divided before one of them
        self.bend = BEND  # rad, by how much neighbours are taken to misfit
        self.history: list[dict[str, float]] = []
        self.losses: list[float] = []
        self.optimizer: torch.optim.Optimizer | None = None

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
        order = torch.randperm(len(self.train), generator=generator)
        other = SurfelFit(model, *parts, extension, generator, order, self.judged)
        other.priced, other.area = self.priced, self.area
        return other

    def parts(self) -> dict[str, Any]:
        """All that the fit is made of, for :meth:`of_parts`, which goes on from there to the last digit."""
        names = ("capture", "grid", "counts", "train", "settings", "extension", "judged")
        return {name: getattr(self, name) for name in names} | {"state": self.state()}

    @classmethod
    def of_parts(cls, parts: dict[str, Any]) -> SurfelFit:
        """The fit that :meth:`parts` took apart."""
        state = parts["state"]
        held = {name: part for name, part in parts.items() if name != "state"}
        fit = cls(
            SurfelModel.from_state(held["capture"], state["model"]),
            reserve=Seeds(*state["reserve"]),
            generator=torch.Generator(),
            order=state["order"],
            **held,
        )
        fit.restore(state)
        return fit

    def state(self) -> dict[str, Any]:
        """A copy of all that changes while the fit goes on, as tensors, numbers and plain containers."""
        return copy.deepcopy(
            {name: getattr(self, name) for name in PLAIN}
            | {
                "model": dict(self.model.state_dict()),
                "pairs": self.model.pairs,
                "sheet": None if self.model.sheet is None else tuple(self.model.sheet[1:]),
                "extension": dict(self.extension.state_dict()),
                "reserve": tuple(self.reserve),
                "generator": self.generator.get_state(),
                "plan": [astuple(each) for each in self.plan],
                "optimizer": None if self.optimizer is None else _moments(self.optimizer),
            }
        )

    def restore(self, state: dict[str, Any]) -> None:
        """Become what :meth:`state` held, on the device of the counts.

        Surfels are other objects from then on, effects keep theirs.

        Raises:
            UserError: it is the state of a fit with other effects, or of another version's.
        """
        lacking = [name for name in PLAIN if name not in state]
        if lacking:
            raise UserError(
                f"the kept surface fit was left by another version of this project (it lacks {lacking[0]}); "
                "begin anew"
            )
        own, kept = self.extension.state_dict().keys(), state["extension"].keys()
        if own != kept:
            raise UserError(
                f"the kept surface fit has effects with {sorted(kept) or 'nothing'}, this one with "
                f"{sorted(own) or 'nothing'}; go on with the same effects, or begin anew"
            )
        device, state = self.counts.device, copy.deepcopy(state)
        for name in PLAIN:
            setattr(self, name, state[name])
        self.model = SurfelModel.from_state(self.capture, state["model"])
        self.extension.load_state_dict(state["extension"])
        self.reserve, self.generator = Seeds(*state["reserve"]), torch.Generator()
        self.generator.set_state(state["generator"])
        self.plan = [Round(*each) for each in state["plan"]]
        self.optimizer = None
        if state["sheet"] is not None:
            self.model.sheet = Sheet(state["pairs"], *state["sheet"])
        self.model.pairs = state["pairs"]
        self.to(device)
        if state["optimizer"] is not None:
            self.optimizer = self._new_optimizer()
            for parameter, moments in zip(_parameters(self.optimizer), state["optimizer"], strict=True):
                if moments:
                    # Adam counts its steps on the CPU, wherever its moments are.
                    self.optimizer.state[parameter] = {
                        name: value.to(device) if value.dim() else value for name, value in moments.items()
                    }

    def to(self, device: torch.device | str) -> None:
        """Move surfels, effects and counts; an optimiser that is under way stays where it is."""
        self.model.to(device)
        self.extension.to(device)
        self.counts, self.train = self.counts.to(device), self.train.to(device)
        self.judged = self.judged.to(device)
        if self.observed is not None:
            self.observed = self.observed.to(device)
        self.reserve = Seeds(*(part.to(device) for part in self.reserve))
        first, second = self.model.pairs
        self.model.pairs = first.to(device), second.to(device)
        if self.model.sheet is not None:
            self.model.sheet = Sheet(self.model.pairs, *(part.to(device) for part in self.model.sheet[1:]))

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
        sensor.set_intensity(value)

    def schedule(self, plan: Sequence[Round], more: int = 0, bodies: int = 0) -> None:
        """Say what is to be done next; it takes the place of what was.

        Last rounds of outlines are added while the fit is above the noise. Each must predict the judged spots
        better by more than what surfels that it adds cost by their area and the standard error that patches
        of the wall leave of it, or is undone. Before the first of them bodies are begun that are missing
        (:func:`~nlos_lit.surfels.growth.begin_bodies`), as long as there are any and it helps. Before the
        others, since bright captures take longer to converge and show finer detail, surfels are divided in
        four while they may be. To be divided once more must predict better than a round without it, from the
        same surfels, in the same way; where it does not, it waits until such rounds are undone. Where a
        division was undone surfels stay as they are, and where a round without it was, too, none follows.

        Args:
            plan: the rounds.
            more: last rounds that may be added, at most …
            bodies: … and before them those that look for missing bodies.
        """
        self.plan, self.more, self.bodies = list(plan), more, bodies
        self.undo, self.rival, self.latest = None, None, PLAN
        self.finer = self.settings.subdivide is None
        self._add_round()

    def _add_round(self) -> None:
        if self.plan or not len(self.judged) or not (self.more or self.bodies or self.undo):
            return
        nats, above_noise = self._predicted()
        tried, self.undo = self.undo, None
        if tried is not None:
            divided, stays = self.model.lateral.shape != tried["cells"], self._better(nats, self.before)
            if divided and stays and self.latest == DIVISION and self.more:
                self.more -= 1
                self.rival = {**self._kept(), "predicted": (nats, above_noise)}
                self._take_back(tried)
                self._plan_one(1, self.before, tried)
                return
            if not stays:
                nats, above_noise = self.before, True
                self._take_back(tried)
            if self.rival is not None:
                rival, self.rival = self.rival, None
                if self._better(rival["predicted"][0], nats):
                    self._take_back(rival)
                    nats, above_noise = rival["predicted"]
                else:
                    self.latest = ROUND
            elif self.bodies:
                self.bodies = self.bodies - 1 if stays else 0
            elif stays:
                self.latest = DIVISION if divided else ROUND
            elif divided:
                self.finer = False
            else:
                self.latest = UNDONE
        if not above_noise or not (self.more or self.bodies):
            return
        begin, parts = self._kept(), 1
        if self.bodies and not self._begin_bodies():
            self.bodies = 0
        if not self.bodies:
            s, wide = self.settings, float(self.model.cell.max()) > FINEST * self.model.bin_length
            divide = self.finer and wide and 4 * len(self.model) <= s.most
            if not self.more or (self.latest == UNDONE and not divide):
                return
            self.more -= 1
            parts = 2 if divide and self.latest != ROUND else 1
        self._plan_one(parts, nats, begin)

    def _kept(self) -> dict[str, Any]:
        """A copy of surfels, response and effects."""
        model, extension = dict(self.model.state_dict()), dict(self.extension.state_dict())
        return copy.deepcopy({"model": model, "extension": extension, "cells": self.model.lateral.shape})

    def _plan_one(self, parts: int, nats: Tensor, begin: dict[str, Any]) -> None:
        """A round of outlines, to go back to what it begins with unless it gains on ``nats``."""
        self.priced, self.before, self.undo = False, nats, begin
        self.plan = [Round(LAST * self.settings.steps, parts=parts, outline=True)]

    def _begin_bodies(self) -> int:
        return begin_bodies(self.model, self.grid, self._place_test(), self.reserve)

    def _place_test(self) -> PlaceTest:
        """Of places, by the tested spots; bins that were not recorded ask for nothing."""
        spots, counts = self.train[self.tested], self.counts[self.tested]
        expected = self.model.expected(spots, self.extension).clamp_min(1e-9)
        return PlaceTest(self.model, self.capture, spots, counts, expected, self.extension)

    def _take_back(self, undo: dict[str, Any]) -> None:
        """Surfels, response and effects as they were before a round."""
        self.model = SurfelModel.from_state(self.capture, undo["model"])
        self.extension.load_state_dict(undo["extension"])
        self.to(self.counts.device)

    @property
    def finished(self) -> bool:
        """Nothing of the plan is left."""
        return not self.plan

    @property
    def in_round(self) -> bool:
        """A round has begun and not ended."""
        return self.optimizer is not None

    @property
    def round_done(self) -> bool:
        """All batches of the present round are done."""
        return self.in_round and len(self.losses) == self.plan[0].steps

    @property
    def ahead(self) -> int:
        """Batches of the plan that are left."""
        return sum(each.steps for each in self.plan) - len(self.losses)

    def begin_round(self) -> None:
        """What happens between rounds: neighbours, shapes, death and growth, who hides whom; a new optimiser.

        Normals follow the places of neighbours until the round ends.
        """
        now = self.plan[0]
        if not now.onward:
            self._arrange(now)
        self.model.lay(as_it_is=now.onward)
        self._roughen()
        self.optimizer = self._new_optimizer()

    def _roughen(self) -> None:
        """Once sheets are found they are held to be as rough as they are."""
        if self._outlined:
            self.bend = self.model.bend()

    def _arrange(self, now: Round) -> None:
        """Neighbours, shapes, death and growth, outlines, who hides whom."""
        s, spots, counts = self.settings, self.train[self.tested], self.counts[self.tested]
        self.model.link()
        if now.shapes:
            choose_shapes(self.model, self.extension, spots, counts)
        if now.grow:
            share = len(self.tested) / len(self.train)
            prune_and_grow(self.model, self.grid, self._place_test(), share, s.surfel_cost)
            self._begin_bodies()
        if now.parts > 1 and (now.settling or now.parts**2 * len(self.model) <= s.most):
            self.model.divide(now.parts)
        widest = float(self.model.cell.max())
        points = s.quadrature or points_along(widest, self.model.bin_length)
        self.model.quadrature = 1 if now.contest else points
        if now.settling or now.grow:  # surfels come and go: what they were taken to hide says little
            self.model.set_opacity(unknown_opacity(self.model.albedo().detach()))
        self._hide(now.outline)
        if now.outline:
            before = self.model.albedo().detach()
            extend(self.model, self.grid, spots)
            solve_albedos(self.model, spots, counts, self._albedo_weights(), SEARCH, self.extension)
            cut_back(self.model, before)
            self._hide()
            solve_albedos(self.model, spots, counts, self._albedo_weights(), MEND, self.extension)

    def _hide(self, tested_only: bool = False) -> None:
        """Who hides whom; with ``tested_only`` for the tested spots: the others see all until then."""
        if self.settings.visibility:
            self.model.update_hiders(self.train[self.tested] if tested_only else None)

    def _new_optimizer(self) -> torch.optim.Optimizer:
        """With the rates of the next batch of the present round."""
        s, model = self.settings, self.model
        # The response waits for the places: it would otherwise settle around errors of the seeds. Rims wait
        # until sheets are found, which would end before they reach as far as they do.
        response_rate = s.response_rate * (0.3 if self.plan[0].settling else 1.0)
        settled = [
            {"params": [model.raw_depth, model.raw_shift], "lr": s.depth_rate},
            {"params": [model.raw_opacity], "lr": s.opacity_rate},
            {"params": [model.roll] if self._outlined else [], "lr": s.roll_rate},
            {"params": [*model.laser_sensor.parameters()], "lr": response_rate},
        ]
        groups = [
            {"params": [model.raw_albedo], "lr": s.albedo_rate},
            {"params": self._effect_parameters(), "lr": s.effect_rate},
            *([] if self.plan[0].contest else settled),
        ]
        kept = [group | {"highest": group["lr"]} for group in groups if group["params"]]
        optimizer = _Reined(kept, self.extension.reach())
        self._set_rates(optimizer)
        return optimizer

    @property
    def _outlined(self) -> bool:
        """The present round finds outlines, or goes on from some."""
        return any(now.outline or now.onward for now in self.plan[:1])

    def _effect_parameters(self) -> list[torch.nn.Parameter]:
        """Those that a round fits: where a disc is, or how late an echo, waits for the scene to settle, as
        does all that moves light in time: it would settle around errors of the seeds.
        """
        still = self.plan[0].settling
        return [
            getattr(effect, f"raw_{p.name}")
            for effect in self.extension.effects
            if not (still and effect.stage == "time")
            for p in (effect.amplitudes if still else effect.declared.values())
        ]

    def _set_rates(self, optimizer: torch.optim.Optimizer) -> None:
        now, step = self.plan[0], len(self.losses)
        rate = 1 - 0.7 * step / now.steps
        if not now.left:
            rate = max(0.01, 0.5 * (1 + math.cos(math.pi * step / now.steps)))
        for group in optimizer.param_groups:
            group["lr"] = group["highest"] * rate

    def next_rows(self) -> Tensor:
        """Draw the next batch: ``[B]`` rows of the training counts."""
        size = min(self.settings.batch, len(self.train))
        if self.place + size > len(self.order):
            self.order, self.place = torch.randperm(len(self.train), generator=self.generator), 0
        self.place += size
        return self.order[self.place - size : self.place]

    def loss(self, rows: Tensor) -> dict[str, Tensor]:
        """What a batch minimises, per bin.

        Args:
            rows: ``[B]`` of the training counts.

        Returns:
            ``loss`` and its terms: ``counts`` (Poisson, without ln k!), ``bending``, ``albedos``,
            ``effects``.
        """
        s, model = self.settings, self.model
        per_count = 1 / (len(self.train) * self.counts.shape[1])  # nats over all spots to the mean over bins
        laid = model.laid()
        expected = model.render(self.train[rows], self.extension, model.leaning(laid)).clamp_min(1e-12)
        terms = {
            "counts": (expected - torch.xlogy(self.counts[rows], expected)).mean(),
            "bending": s.bending * per_count * model.bending(laid, self.bend),
            "albedos": per_count * model.albedo_cost(*self._albedo_weights()),
            "effects": per_count * torch.as_tensor(self.extension.penalty()),
        }
        return {"loss": sum(terms.values(), torch.zeros(())), **terms}

    def _albedo_weights(self) -> tuple[float, float, float]:
        """Of what albedos cost in the present round."""
        s = self.settings
        return s.evenness, s.brightness, s.lean if self.priced and self._outlined else 0.0

    def step(self) -> None:
        """One batch."""
        assert self.optimizer is not None  # a round has begun
        terms = self.loss(self.next_rows())
        self.optimizer.zero_grad()
        terms["loss"].backward()
        self.optimizer.step()
        self.stepped(terms)

    def stepped(self, terms: dict[str, Tensor]) -> None:
        """Count a batch whose gradient step has been taken: bounds, rates, how rough sheets are.

        Args:
            terms: of the batch, as :meth:`loss` gave them.
        """
        assert self.optimizer is not None  # a round has begun
        self.extension.clamp()
        self.losses.append(float(terms["counts"].detach()))
        self.done += 1
        self._set_rates(self.optimizer)
        if len(self.losses) % AGAIN == 0:
            self._roughen()

    def end_round(self) -> None:
        """Note the round, and see whether another follows."""
        self.model.lift()
        if self.plan[0].contest:
            self._drop_faint()
        sensor = {name: p().item() for name, p in self.model.laser_sensor.named_children()}
        loss = float(np.mean(self.losses[-len(self.losses) // 4 :]))
        self.history.append({"surfels": len(self.model), "loss": loss, **sensor})
        self.plan, self.losses, self.optimizer = self.plan[1:], [], None
        self._add_round()

    @torch.no_grad()
    def _drop_faint(self) -> None:
        model = self.model
        albedo = model.albedo()
        model.keep(albedo > LOST * torch.quantile(albedo, 0.99))

    def finish(self, progress: Progress | None = None) -> list[dict[str, float]]:
        """Do all that is planned, from wherever the fit is.

        Args:
            progress: called with (batches done, of how many) since the call.

        Returns:
            entries of ``history`` that came along.
        """
        begun, known = self.done, len(self.history)
        while not self.finished:
            if not self.in_round:
                self.begin_round()
            self.step()
            if progress is not None:
                progress(self.done - begun, self.done - begun + self.ahead)
            if self.round_done:
                self.end_round()
        return self.history[known:]

    def go_on(self, steps: int) -> list[dict[str, float]]:
        """Some more batches from where the fit ended, at falling rates.

        Args:
            steps: batches.

        Returns:
            the entry of ``history``.
        """
        self.schedule([Round(steps, onward=True)])
        return self.finish()

    @torch.no_grad()
    def _predicted(self) -> tuple[Tensor, bool]:
        """``[J]`` nats of the judged spots, less their share of what surfels cost, by area; and whether more
        than noise is left there.
        """
        counts, expected, seen = _beside(self.model, self.capture, self.judged, self.extension)
        scores = transient_scores(counts, expected, seen)
        nats = (torch.xlogy(counts, expected.clamp_min(1e-9)) - expected).double().sum(1)
        own = float(self.model.cell.prod())
        self.area = own if self.area == math.inf else self.area
        cost = float(self.model.albedo_cost(0.0, 0.0, self.settings.lean * own / self.area))
        nats -= cost / len(self.train)
        return nats, scores.deviance_per_bin > scores.deviance_noise

    def _better(self, nats: Tensor, before: Tensor) -> bool:
        """Whether spots are likelier by more than the standard error that patches of the wall leave of it.

        By patches, since neighbours err alike: what the model has wrong is smooth over the wall.
        """
        gain = nats - before
        patch = wall_blocks(self.capture, PATCHES)[self.judged.cpu()]
        return float(gain.sum()) > float(np.linalg.norm(by_block(gain - gain.mean(), patch)))


@torch.no_grad()
def score_spots(model: SurfelModel, capture: Capture, spots: Tensor, hooks: Hooks = NOTHING) -> Scores:
    """Scores of some spots with their noise levels.

    Args:
        model: fitted surfels.
        capture: whose gated counts are compared.
        spots: ``[S]`` rows of the capture.
        hooks: effects that act on the expected counts.

    Returns:
        means over the spots' gated bins.
    """
    return transient_scores(*_beside(model, capture, spots, hooks))


def _beside(
    model: SurfelModel, capture: Capture, spots: Tensor, hooks: Hooks
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Gated counts, expected ones, and which were observed, where some were not."""
    first, last = capture.gate
    rows = spots.cpu().numpy()
    counts = torch.from_numpy(capture.counts[rows, first:last].astype(np.float32))
    observed = capture.gated_observed()
    seen = None if observed is None else torch.from_numpy(observed[rows])
    return counts, model.expected(spots, hooks).cpu(), seen


class _Reined(torch.optim.Adam):
    """Adam, but numbers that a prior expects to be small take steps as small.

    Adam moves each number about as far, however little the counts say of it. Where there are a hundred of one
    effect, its field would shake by ten times as much, and go astray where no spots are fitted.

    Args:
        groups: of parameters.
        reach: share of a step, of each number of some of them.
    """

    def __init__(self, groups: list[dict[str, Any]], reach: dict[torch.nn.Parameter, Tensor]) -> None:
        super().__init__(groups, betas=(0.9, 0.98))
        held = {parameter for group in groups for parameter in group["params"]}
        self.reach = {parameter: share for parameter, share in reach.items() if parameter in held}

    def step(self, closure: Any = None) -> Any:
        before = [parameter.detach().clone() for parameter in self.reach]
        loss = super().step(closure)
        with torch.no_grad():
            for (parameter, share), old in zip(self.reach.items(), before, strict=True):
                parameter.copy_(torch.lerp(old, parameter, share))
        return loss


def _parameters(optimizer: torch.optim.Optimizer) -> list[Tensor]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _moments(optimizer: torch.optim.Optimizer) -> list[dict[str, Tensor]]:
    """What an optimiser remembers of each parameter, in order; empty where a parameter has not moved."""
    return [dict(optimizer.state.get(parameter, {})) for parameter in _parameters(optimizer)]
