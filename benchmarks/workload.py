"""Workloads for the speed benchmarks: captures of given sizes, and the training iteration of train.py.

Only torch and numpy.
The captures are cheap sums over the points of a surface (a dome in front of a tilted plate) with Poisson
noise: sizes, occupied volume and rays that meet something are those of real scenes, and that is what an
iteration's time depends on.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from nlos_lit.capture import Capture  # noqa: E402
from nlos_lit.capture.volume_grid import volume_grid  # noqa: E402
from nlos_lit.model.build import PipelineSettings, build_pipeline, match_energy, normalisation  # noqa: E402
from nlos_lit.model.objective import Objective, rated_groups  # noqa: E402
from nlos_lit.model.phasor import PhasorPlan  # noqa: E402
from nlos_lit.model.pipeline import Pipeline  # noqa: E402

RATES = {"phasor": 0.05, "sensor": 0.1, "albedo": 0.3}  # conf/optimizer/adam.yaml
LAMBDA_ALBEDO = 5e-3
PROFILES = {
    # conf/model: (settings beyond PipelineSettings' defaults, λ1)
    "default": ({}, 3e-3),
    "paper": (
        {
            "fine": 1,
            "relative_beta": False,
            "power": 2.0,
            "depth_exponent": 0.0,
            "conserve_energy": False,
            "subtract_splat": False,
            "background_start": 1e-3,
        },
        100.0,
    ),
}


@dataclass(frozen=True)
class Workload:
    """Sizes of one configuration; lengths in metres.

    Args:
        spots: (nx, ny) scanned wall points, ``pitch`` apart.
        confocal: otherwise one detector at the wall's centre and a scanned laser.
        depth, planes, plane_pitch: nearest voxel plane, their number and spacing.
        lateral: voxels along x and y; None takes one a spot.
        gate: first bin that is fitted.
        wavelength: m; None takes four spot spacings.
        batch, rays: spots an iteration, and the side of each one's square of rays.
        paper_hours: time the paper reports on an A100, None where it has no such configuration.
    """

    name: str
    spots: tuple[int, int]
    bins: int
    pitch: float
    bin_length: float
    depth: float
    planes: int
    plane_pitch: float
    confocal: bool = True
    lateral: tuple[int, int] | None = None
    gate: int = 0
    threshold: float = 0.2
    wavelength: float | None = None
    iterations: int = 100
    batch: int = 32
    rays: int = 200
    paper_hours: float | None = None


def _chen(name: str, depth: float, planes: int, iterations: int, hours: float) -> Workload:
    return Workload(
        name,
        (256, 256),
        1024,
        2 / 256,
        0.01,
        depth,
        planes,
        0.005,
        threshold=0.05,
        iterations=iterations,
        paper_hours=hours,
    )


def _liu(name: str, iterations: int, hours: float) -> Workload:
    return Workload(
        name, (130, 180), 4096, 0.01, 0.0012, 0.5, 417, 0.0048, confocal=False, lateral=(180, 180),
        iterations=iterations,
        paper_hours=hours,
    )  # fmt: skip


# Table 2 of the paper's supplement: scans, bins, volumes, iterations, hours. Lengths are those of conf/scene.
TABLE_2 = (
    _chen("Bunny", 0.5, 201, 100, 1.93),
    _chen("Dragon", 0.7, 128, 100, 1.28),
    _chen("Erato", 0.7, 128, 100, 1.28),
    _chen("Indonesian", 0.7, 128, 150, 1.93),
    Workload("34", (64, 64), 500, 1 / 64, 0.008, 0.2, 105, 0.004, iterations=300, paper_hours=1.05),
    Workload("Bike", (256, 256), 512, 2 / 256, 0.0096, 0.7, 64, 0.0126, iterations=170, paper_hours=1.73),
    Workload(
        "Resolution", (256, 256), 512, 2 / 256, 0.0096, 0.9, 26, 0.012, iterations=300, paper_hours=1.33
    ),
    Workload(
        "SU", (64, 64), 2048, 0.7 / 64, 0.0012, 0.5, 584, 0.0012, gate=800, iterations=200, paper_hours=6.10
    ),
    _liu("44i", 150, 3.76),
    _liu("NLOS", 180, 4.38),
)


def tiny(workload: Workload) -> Workload:
    """The same kind of scan at a size for tests: a sixteenth of the spots along each axis, few bins, planes
    and rays.
    """
    shrink = 16 if workload.confocal and workload.spots[0] > 64 else 8
    spots = tuple(max(6, n // shrink) for n in workload.spots)
    wall = workload.pitch * workload.spots[0]
    span = workload.planes * workload.plane_pitch
    return replace(
        workload,
        spots=spots,
        pitch=wall / spots[0],
        lateral=None,
        bins=128,
        gate=0,
        bin_length=workload.bins * workload.bin_length / 128,
        planes=12,
        plane_pitch=span / 12,
        batch=4,
        rays=24,
        iterations=2,
    )


def surface_points(workload: Workload, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points ``[P, 3]`` of a dome in front of a tilted plate, about ``spacing`` apart, and their albedos
    ``[P]``.
    """
    half = 0.5 * workload.pitch * min(workload.spots)
    near, span = workload.depth, workload.planes * workload.plane_pitch
    count = max(5, math.ceil(half / spacing))
    u, v = (
        c.ravel()
        for c in np.meshgrid(np.linspace(-0.5, 0.5, count), np.linspace(-0.5, 0.5, count), indexing="ij")
    )
    plate = np.stack([half * (u + 0.3), half * (v - 0.2), near + span * (0.7 + 0.25 * u)], axis=1)
    on = u**2 + v**2 < 0.2
    dome = np.stack(
        [half * (0.8 * u - 0.35), half * (0.8 * v + 0.3), near + span * (0.2 + 1.0 * (u**2 + v**2))], axis=1
    )[on]
    return np.concatenate([plate, dome]), np.concatenate([np.full(len(plate), 0.9), np.full(len(dome), 0.4)])


def synthetic_capture(workload: Workload, counts_per_spot: float = 3000.0, seed: int = 0) -> Capture:
    """Photon counts of the surface, ``counts_per_spot`` on average and a tenth of that as background."""
    nx, ny = workload.spots
    x, y = (workload.pitch * (np.arange(n) - (n - 1) / 2) for n in workload.spots)
    wall = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((nx, ny))], axis=-1).reshape(-1, 3)
    sensor = wall if workload.confocal else np.zeros_like(wall)
    points, albedo = (torch.from_numpy(a).float() for a in surface_points(workload, 1.3 * workload.pitch))

    def to_points(a: np.ndarray) -> Tensor:
        return torch.cdist(torch.from_numpy(a).float(), points, compute_mode="donot_use_mm_for_euclid_dist")

    generator = torch.Generator().manual_seed(seed)
    counts = np.empty((len(wall), workload.bins), dtype=np.uint16)
    for begin in range(0, len(wall), 512):
        rows = slice(begin, begin + 512)
        d_l, d_s = to_points(wall[rows]), to_points(sensor[rows])
        bins = ((d_l + d_s) / workload.bin_length).long()
        inside = bins < workload.bins
        strength = torch.where(inside, albedo / (d_l * d_s) ** 2, 0.0)
        expected = torch.zeros(len(d_l), workload.bins).scatter_add_(
            1, bins.clamp_max(workload.bins - 1), strength
        )
        if begin == 0:
            gain = counts_per_spot / expected.sum(1).mean()
        expected = expected * gain + 0.1 * counts_per_spot / workload.bins
        counts[rows] = torch.poisson(expected, generator=generator).numpy().astype(np.uint16)
    up = np.tile([0.0, 0.0, 1.0], (len(wall), 1))
    return Capture(
        counts,
        wall,
        sensor,
        up,
        up,
        workload.bin_length,
        gate=(workload.gate, workload.bins),
        scan_shape=workload.spots,
    )


class Training:
    """A pipeline with its optimiser; :meth:`step` is one iteration of train.py without its logging.

    Args:
        capture: as from :func:`synthetic_capture`.
        profile: "default" or "paper".
        budget: memory budget for the phasor field, bytes.
        shards: processes that share the field.
    """

    def __init__(
        self,
        workload: Workload,
        capture: Capture,
        *,
        profile: str = "default",
        budget: int = 12 << 30,
        device: torch.device | str = "cpu",
        seed: int = 0,
        shards: int = 1,
    ) -> None:
        self.workload, self.device = workload, torch.device(device)
        settings, sparsity = PROFILES[profile]
        last = workload.depth + (workload.planes - 1) * workload.plane_pitch
        grid = volume_grid(
            capture,
            depth=(workload.depth, last + 1e-9),
            depth_pitch=workload.plane_pitch,
            lateral=workload.lateral,
        )
        self.pipeline: Pipeline = build_pipeline(
            capture,
            grid,
            PipelineSettings(
                threshold=workload.threshold, rays=workload.rays, wavelength=workload.wavelength, **settings
            ),
        ).to(self.device)
        self.plan: PhasorPlan = self.pipeline.phasor.plan(capture, budget, shards)
        self.criterion = Objective(normalisation(capture), sparsity, LAMBDA_ALBEDO, 64, seed)
        self.capture, self.random, self.steps = capture, np.random.default_rng(seed), 0
        self.counts = torch.from_numpy(capture.gated_counts())

    def prepare(self) -> float:
        """Propagate the field, match the energy, make the optimiser; seconds that took."""
        began = time.perf_counter()
        self.pipeline.phasor.prepare(self.capture, self.plan)
        match_energy(
            self.pipeline, self.capture, torch.from_numpy(self._draw(2 * self.workload.batch)).to(self.device)
        )
        self.optimiser = torch.optim.Adam(rated_groups(self.pipeline, RATES, list(RATES)))
        self.synchronise()
        return time.perf_counter() - began

    def batch(self) -> tuple[Tensor, Tensor]:
        """Spots and their gated counts, on the device."""
        spots = torch.from_numpy(self._draw(self.workload.batch))
        return spots.to(self.device, non_blocking=True), self.counts[spots].to(self.device, non_blocking=True)

    def step(self) -> Tensor:
        """Forward, backward, Adam; the loss, still on the device."""
        return self.step_on(*self.batch())

    def terms(self, spots: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """Loss terms of a batch."""
        return self.criterion.terms(self.pipeline, spots, counts, self.steps)

    def step_on(self, spots: Tensor, counts: Tensor) -> Tensor:
        """:meth:`step` on a given batch."""
        self.optimiser.zero_grad()
        loss = self.terms(spots, counts)["loss"]
        loss.backward()
        self.optimiser.step()
        self.steps += 1
        return loss.detach()

    def synchronise(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _draw(self, count: int) -> np.ndarray:
        return np.sort(
            self.random.choice(self.capture.n_spots, min(count, self.capture.n_spots), replace=False)
        )
