"""Tiny captures, surfel models and fits for the tests of criticism."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.candidates import Candidate
from nlos_lit.inference.problem import Problem
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.surfels.fit import SurfelFit, SurfelSettings
from nlos_lit.surfels.growth import Seeds
from nlos_lit.surfels.model import Lateral, SurfelModel, spline_sensor

BIN, T_START, GATE = 0.02, 0.62, (6, 64)
BLOCK = np.repeat(np.arange(40), 3)  # wall blocks of 120 spots
# PyTorch's own first use of forward mode.
FORWARD_MODE = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


def double_precision() -> Iterator[None]:
    """For a fixture: double precision wherever nothing else is said, so that finite differences are sharp."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def capture_of(
    wall: np.ndarray, kind: str = "confocal", counts: np.ndarray | None = None, **options: object
) -> Capture:
    """Spots at ``wall`` ``[S, 2]``, ``confocal``, ``single`` (one laser point) or ``exhaustive`` (shuffled
    lasers).
    """
    rng = np.random.default_rng(5)
    sensor = np.column_stack([wall, np.zeros(len(wall))])
    laser = {
        "confocal": sensor,
        "single": np.broadcast_to([0.2, 0.1, 0.0], sensor.shape),
        "exhaustive": rng.permutation(sensor),
    }
    up = np.broadcast_to([0.0, 0.0, 1.0], sensor.shape)
    if counts is None:
        counts = rng.poisson(20, (len(wall), GATE[1]))
    order = options.pop("scan_order", rng.permutation(len(wall)))
    options = {"bin_length": BIN, "t_start": T_START, "gate": GATE, "scan_order": order} | options
    return Capture(counts.astype(np.uint32), laser[kind], sensor, up, up, **options)


def scattered(spots: int = 10) -> np.ndarray:
    """``[S, 2]`` m, centred beside the origin, wider along x."""
    return np.random.default_rng(4).uniform(-0.4, 0.4, (spots, 2)) * [1, 0.7] + [0.1, -0.05]


def raster(nx: int, ny: int | None = None, width: float = 0.8) -> np.ndarray:
    """``[nx·ny, 2]`` m, spot ``i·ny + j``; rows as far apart as columns."""
    ny = ny or nx
    x, y = ((np.arange(n) - (n - 1) / 2) * width / (nx - 1) for n in (nx, ny))
    return np.stack(np.meshgrid(x + 0.1, y - 0.05, indexing="ij"), -1).reshape(-1, 2)


def surfels(scene: Capture, number: int = 12, level: float = 1.0) -> SurfelModel:
    """Surfels on the two sides of a valley, the last so steep that it moves along its normal; counts grow
    with ``level``.
    """
    rng = np.random.default_rng(6)
    xy = rng.uniform(-0.25, 0.25, (number, 2))
    centre = np.column_stack([xy, 0.7 - 0.8 * np.abs(xy[:, 0])])
    normal = np.column_stack([-0.6 * np.sign(xy[:, 0]), 0.1 * xy[:, 1], np.full(number, -0.75)])
    normal[-1] = [0.2 - xy[-1, 0], -xy[-1, 1], -0.1]
    albedo = rng.uniform(0.3, 1.2, number)
    albedo[0] = 0.004  # far below the others: what counts as its own size is a share of the mean
    sensor = spline_sensor(
        scene,
        {
            "sigma_ls": BoundedParameter(1.1 * BIN, 0.59 * BIN, 3 * BIN, "m"),
            "kappa_s": BoundedParameter(0.6 / BIN, 0.1 / BIN, 50 / BIN, "1/m"),
            "intensity": BoundedParameter(24000.0 * level / number, 1.0, 1e6, "counts m2"),
            "background": BoundedParameter(0.4 * level, 1e-3, 1000.0, "counts/bin"),
        },
    )
    return SurfelModel(
        scene,
        centre=torch.tensor(centre),
        normal=torch.tensor(normal),
        albedo=torch.tensor(albedo),
        lateral=Lateral((-0.5, -0.5), (0.08, 0.08), (13, 13)),
        laser_sensor=sensor,
    )


def hide_some(model: SurfelModel) -> None:
    """From each wall point others hide a quarter of the surfels' points, but for some of the light."""
    gen, m = np.random.default_rng(8), len(model)
    shape = (1 if model.confocal else 2, len(model.laser), m, 4)
    hidden, by = gen.random(shape) > 0.75, gen.integers(1, m + 1, shape)
    model.hiders = torch.from_numpy(np.where(hidden, by, 0).astype(np.int32))
    model.set_opacity(torch.from_numpy(gen.uniform(0.3, 0.9, m)).to(model.raw_opacity))


def effect_of(name: str, scan: Scan, **values: float | Tensor) -> Effect:
    effect = next(e for e in [*EFFECTS, *FREE] if e.name == name)(scan)
    for parameter, value in values.items():
        effect.set(parameter, value)
    return effect


def uneven(effect: Effect) -> Effect:
    """Every amplitude a noticeable step and more off its null, no two alike; shapes beside their grid."""
    for p in effect.shapes:
        value = float(effect.value(p.name).detach())
        effect.set(p.name, 1.013 * value or 5 * p.scale)
    for p in effect.amplitudes:
        values = p.null + p.scale * torch.linspace(1.0, 1.5, p.size) * (1 if p.upper > p.null else -1)
        effect.set(p.name, values[0] if p.size == 1 else values)
    return effect


def drawn(
    model: SurfelModel, extension: Extension, scene: Capture, seed: int = 0, factor: Tensor | float = 1.0
) -> Capture:
    """The capture with counts drawn from the model times ``factor`` (broadcast to ``[S, T_gate]``), zeros
    before the gate.
    """
    expected = (model.expected(torch.arange(scene.n_spots), extension) * factor).double().numpy()
    counts = np.zeros(scene.counts.shape, dtype=np.uint32)
    counts[:, scene.gate[0] :] = np.random.default_rng(seed).poisson(expected)
    return Capture(
        counts,
        scene.laser,
        scene.sensor,
        scene.laser_normal,
        scene.sensor_normal,
        bin_length=scene.bin_length,
        t_start=scene.t_start,
        gate=scene.gate,
        scan_order=scene.scan_order,
    )


def problem_of(
    spots: Tensor,
    expected: Tensor,
    nuisance: Tensor,
    residual: Tensor,
    prior: Tensor | None = None,
    uneven: Tensor | None = None,
) -> Problem:
    """A least-squares problem without a model behind it."""
    prior = torch.zeros(nuisance.shape[1]) if prior is None else prior
    uneven = torch.zeros(len(nuisance), 0) if uneven is None else uneven
    lit = torch.ones(len(nuisance))
    given = {"extension": Extension([]), "spots": spots, "counts": expected, "expected": expected}
    given |= {"nuisance": nuisance, "residual": residual, "prior": prior, "uneven": uneven, "lit": lit}
    return Problem(**{f.name: given.get(f.name) for f in dataclasses.fields(Problem)})


def fit_of(
    model: SurfelModel, scene: Capture, extension: Extension | None = None, train: np.ndarray | None = None
) -> SurfelFit:
    """A fit of ``train`` spots (all, where not given) as it stands: nothing is run. They judge it, too."""
    rows = np.arange(scene.n_spots) if train is None else train
    counts = torch.from_numpy(scene.gated_counts()[rows])
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(rows), generator=generator)
    extension = Extension([]) if extension is None else extension
    nowhere = Seeds(torch.zeros(0, 3), torch.zeros(0, 3))
    known = (model, scene, None, counts, torch.from_numpy(rows), SurfelSettings(), nowhere)
    return SurfelFit(*known, extension, generator, order, torch.from_numpy(rows))


def candidate(name: str, evidence: float = 100.0, lit: float = 1.0) -> Candidate:
    """What the pool might have found, on a capture of twelve spots; nothing scatters."""
    effect = effect_of(name, Scan.of(capture_of(scattered(12))))
    size = sum(p.size for p in effect.amplitudes)
    return Candidate(effect, evidence, 0.5, 1.0, {}, torch.zeros(size), torch.ones(size), evidence, lit)


def per_spot(mean: float, scatter: float, seed: int = 0) -> Tensor:
    """Log-likelihoods of 120 spots that are ``mean`` each on average, exactly, and scatter from block to
    block.
    """
    values = np.repeat(np.random.default_rng(seed).standard_normal(40), 3)
    return torch.from_numpy(mean + scatter * (values - values.mean()) / values.std())
