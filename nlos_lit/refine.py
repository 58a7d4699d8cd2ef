"""Refinement: surfels seeded from the phasor image and fitted to the raw counts by Poisson likelihood.

The phasor image has the wavelength's resolution, the counts know depth far better. docs/refine.md tells what each step brought.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.errors import UserError
from nlos_lit.export import Points
from nlos_lit.grid import VolumeGrid
from nlos_lit.laser_sensor import LaserSensor
from nlos_lit.memory import check_machine
from nlos_lit.metrics import expected_deviance, nmse, nmse_noise_floor, poisson_deviance
from nlos_lit.parameters import BoundedParameter
from nlos_lit.surfel_seed import prune_and_grow, rank_one, score, start_response, volume_maxima
from nlos_lit.surfels import Lateral, SurfelModel

BYTES_PER_PATH = 160  # peak of forward and backward pass, measured
RESERVE = 0.4  # maxima down to this share of the floor are kept in reserve for growth
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class RefineSettings:
    """How surfels are seeded and fitted.

    Args:
        floor: seeds are local maxima of the image of at least this share of its largest value …
        significance: … whose Poisson score against the scan's mean transient exceeds this many standard deviations.
        per_cell: seeds per lateral cell, so that partly hidden objects survive.
        max_seeds: the most significant are kept, and as many in reserve for growth.
        subdivide: surfels along each side of a voxel; None takes 2 where a voxel is wider than six bins, else 1.
        quadrature: points along each side of a surfel; None spaces their arrivals by about two bins.
        rounds: between rounds surfels die, grow and are hidden anew. steps: batches a round; the last has twice as many.
        batch: spots a step.
        depth_rate: of Adam, in bins there and back. albedo_rate, normal_rate, response_rate: of the unconstrained values.
        tie: weight of :meth:`SurfelModel.bending`, nats per squared radian and pair.
        prune: surfels whose albedo is below this many of its standard deviations die.
        grow: places next to surfels, and unused seeds, whose score exceeds this many standard deviations get one.
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
    batch: int = 48
    depth_rate: float = 0.15
    albedo_rate: float = 0.08
    normal_rate: float = 0.03
    response_rate: float = 0.03
    tie: float = 100.0
    prune: float = 1.5
    grow: float = 3.5
    test_spots: int = 384
    visibility: bool = True

    def __post_init__(self) -> None:
        if min(self.rounds, self.steps, self.batch, self.per_cell, self.test_spots) < 1:
            raise UserError("refine.rounds, steps, batch, per_cell and test_spots must be at least 1")
        if not 0 < self.floor < 1 or self.tie < 0:
            raise UserError(f"refine.floor must lie between 0 and 1 and refine.tie be 0 or more; found {self.floor} and {self.tie}")


@dataclass(frozen=True)
class Scores:
    """How well spots are explained: ``noise_floor`` and ``noise`` are what the truth itself would score."""

    nmse: float
    nmse_noise_floor: float
    deviance_per_bin: float
    deviance_noise: float


@dataclass(frozen=True)
class Refined:
    """A fitted surfel model.

    ``heldout``: scores over the spots that were not trained on (None where all were). ``history``: one entry a round.
    """

    model: SurfelModel
    heldout: Scores | None
    parameters: dict[str, tuple[float, str]]
    history: list[dict[str, float]]
    seconds: float

    def expected(self, spots: Tensor) -> Tensor:
        """``[S, T_gate]`` expected counts."""
        return self.model.expected(spots)

    def points(self) -> Points:
        return self.model.points()


def refine(
    capture: Capture,
    intensity: Tensor,
    grid: VolumeGrid,
    settings: RefineSettings,
    train_spots: np.ndarray,
    laser_sensor_start: LaserSensor | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> Refined:
    """Fit surfels and response to the counts of ``train_spots``; the counts of other spots are only scored at the end.

    Args:
        capture: raw counts and scan.
        intensity: ``[nz, nx, ny]`` phasor image on ``grid``.
        train_spots: ``[N]`` rows of the capture.
        laser_sensor_start: start values of the response; None takes 1.2 bins and 0.7 per bin.
        progress: called with (steps done, of how many).
        seed: of batches and tested spots.

    Raises:
        UserError: shapes disagree, or no place of the image is significant in the counts.
        MemoryBudgetError: a step does not fit the free memory.
    """
    began = time.perf_counter()
    if tuple(intensity.shape) != tuple(grid.shape):
        raise UserError(
            f"the image has shape {tuple(intensity.shape)}, its grid {tuple(grid.shape)}; give the grid it was imaged on"
        )
    train = torch.as_tensor(np.asarray(train_spots), dtype=torch.long)
    fit = _Fit(capture, intensity.detach().cpu().float(), grid, settings, train, laser_sensor_start, seed)
    history = fit.run(progress)
    model = fit.model
    _normalise_albedo(model)
    held = np.setdiff1d(np.arange(capture.n_spots), np.asarray(train_spots))
    scores = score_spots(model, capture, torch.from_numpy(held)) if len(held) else None
    sensor = model.laser_sensor
    parameters = {name: (p().item(), p.unit) for name, p in sensor.named_children()}
    return Refined(model, scores, parameters, history, time.perf_counter() - began)


@torch.no_grad()
def score_spots(model: SurfelModel, capture: Capture, spots: Tensor) -> Scores:
    """Scores of ``spots`` with their noise levels."""
    first, last = capture.gate
    counts = torch.from_numpy(capture.counts[spots.numpy(), first:last].astype(np.float32))
    expected = model.expected(spots)
    values = (
        nmse(counts, expected),
        nmse_noise_floor(counts),
        poisson_deviance(counts, expected).mean(),
        expected_deviance(expected),
    )
    return Scores(*(v.item() for v in values))


class _Fit:
    """One run: everything but the arguments that its steps share."""

    def __init__(
        self,
        capture: Capture,
        intensity: Tensor,
        grid: VolumeGrid,
        settings: RefineSettings,
        train: Tensor,
        start: LaserSensor | None,
        seed: int,
    ) -> None:
        s = self.settings = settings
        self.capture, self.grid, self.train = capture, grid, train
        self.generator = torch.Generator().manual_seed(seed)
        first, last = capture.gate
        self.counts = torch.from_numpy(capture.counts[train.numpy(), first:last].astype(np.float32))
        if self.counts.sum() == 0:
            raise UserError("the training spots hold no counts inside the gate; check the gate and the held-out spots")
        widest, bins = max(abs(p) for p in grid.pitch[:2]), capture.bin_length
        subdivide = s.subdivide or (2 if widest > 6 * bins else 1)
        points = s.quadrature or int(np.clip(math.ceil(widest / subdivide * 0.55 / bins), 1, 8))
        pitch = tuple(p / subdivide for p in grid.pitch[:2])
        origin = tuple(o - (subdivide - 1) / 2 * p for o, p in zip(grid.origin[:2], pitch, strict=True))
        lateral = Lateral(origin, pitch, (grid.shape[1] * subdivide, grid.shape[2] * subdivide))
        sensor = start_response(capture, self.counts, start)
        self.order, self.place = self._permutation(), 0
        self.tested = self.order[: s.test_spots]
        candidates, value = volume_maxima(intensity, grid, RESERVE * s.floor, s.per_cell, lateral)
        null = rank_one(self.counts)[self.tested]
        tested = score(candidates, capture, lateral.pitch, 1, sensor, self.counts[self.tested], null, train[self.tested])
        significance = tested.significance * math.sqrt(len(train) / len(self.tested))
        keep = (significance > s.significance) & (value >= s.floor)
        if int(keep.sum()) > s.max_seeds:
            keep &= significance >= significance.topk(s.max_seeds).values[-1]
        if not keep.any():
            raise UserError(
                f"none of the image's {len(value)} maxima is significant in the counts: the capture may hold only noise, or "
                "scene.volume.depth or the gate misses the hidden scene (refine.significance sets the level)"
            )
        best = significance.topk(min(s.max_seeds, len(significance))).indices
        self.reserve, seeds = candidates.take(best), candidates.take(keep)
        step_bytes = int(keep.sum()) * points**2 * min(s.batch, len(train)) * BYTES_PER_PATH
        check_machine(step_bytes + 8 * self.counts.numel(), "one refinement step")
        self.model = SurfelModel(
            capture, centre=seeds.centre, normal=seeds.normal, albedo=value[keep] / value[keep].mean(), lateral=lateral,
            laser_sensor=sensor, quadrature=points,
        )  # fmt: skip
        self._match_energy()

    def _permutation(self) -> Tensor:
        return torch.randperm(len(self.train), generator=self.generator)

    @torch.no_grad()
    def _match_energy(self) -> None:
        sensor = self.model.laser_sensor
        rendered = (self.model.expected(self.train[self.tested]) - sensor.background()).sum()
        measured = (self.counts[self.tested] - sensor.background()).sum()
        value = float(measured.clamp_min(0.01 * self.counts[self.tested].sum()) / rendered.clamp_min(1e-30))
        sensor.intensity = BoundedParameter(value, value * 1e-3, value * 1e3, "counts m2")

    def _batch(self) -> Tensor:
        size = min(self.settings.batch, len(self.train))
        if self.place + size > len(self.order):
            self.order, self.place = self._permutation(), 0
        self.place += size
        return self.order[self.place - size : self.place]

    def run(self, progress: Progress | None) -> list[dict[str, float]]:
        s, history, done = self.settings, [], 0
        total = s.steps * (s.rounds + 1)
        for index in range(s.rounds):
            if index:
                prune_and_grow(
                    self.model, self.capture, self.grid, self.reserve, self.counts, self.train, self.tested, s.prune, s.grow
                )
            if s.visibility:
                self.model.update_visibility()
            steps = s.steps * (2 if index == s.rounds - 1 else 1)
            losses = []
            for loss in self._round(index, steps):
                losses.append(loss)
                done += 1
                if progress is not None:
                    progress(done, total)
            self.model.link()
            sensor = {name: p().item() for name, p in self.model.laser_sensor.named_children()}
            history.append({"surfels": len(self.model), "loss": float(np.mean(losses[-len(losses) // 4 :])), **sensor})
        return history

    def _round(self, index: int, steps: int) -> Iterator[float]:
        s, model = self.settings, self.model
        last = index == s.rounds - 1
        # The response waits for the places, the tie for the surface: both would otherwise settle around errors of the seeds.
        response_rate = s.response_rate * (0.3 if index == 0 else 1.0)
        tie = s.tie * 0.3 ** max(0, s.rounds - 2 - index) / (len(self.train) * self.counts.shape[1])
        groups = [
            {"params": [model.raw_depth], "lr": s.depth_rate},
            {"params": [model.raw_albedo], "lr": s.albedo_rate},
            {"params": [model.raw_normal], "lr": s.normal_rate},
            {"params": list(model.laser_sensor.parameters()), "lr": response_rate},
        ]
        optimizer = torch.optim.Adam(groups, betas=(0.9, 0.98))

        def rate(step: int) -> float:
            return max(0.01, 0.5 * (1 + math.cos(math.pi * step / steps))) if last else 1 - 0.7 * step / steps

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        for _ in range(steps):
            rows = self._batch()
            expected = model.render(self.train[rows]).clamp_min(1e-12)
            fit = (expected - torch.xlogy(self.counts[rows], expected)).mean()
            loss = fit + tie * model.bending()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            yield float(fit.detach())


@torch.no_grad()
def _normalise_albedo(model: SurfelModel) -> None:
    """Only albedo × intensity is known: the 98th percentile of the albedos becomes 1."""
    albedo = model.albedo()
    white = float(torch.quantile(albedo, 0.98))
    sensor = model.laser_sensor
    value = sensor.intensity().item() * white
    sensor.intensity = BoundedParameter(value, value * 1e-3, value * 1e3, "counts m2")
    model.set_albedo(albedo / white)
