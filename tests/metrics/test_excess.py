"""Where counts depart from a model: nothing for noise alone, one axis for what lies along it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from nlos_lit.metrics.excess import excess_by_axis

SIDE, BINS = 16, 96
I, J = (v.ravel() for v in np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij"))
PLACES = torch.from_numpy(2 * np.stack([I, J], axis=1) / (SIDE - 1) - 1)
RUNS = torch.from_numpy(I)  # a raster: one row of the wall after the other
X, Y = PLACES.T


def expected() -> torch.Tensor:
    """Pulses of many heights on a background, at times that differ from spot to spot."""
    rng = np.random.default_rng(1)
    time, middle = np.arange(BINS), rng.uniform(20, 76, SIDE**2)[:, None]
    height = rng.permutation(np.geomspace(4, 200, SIDE**2))[:, None]
    return torch.from_numpy(4.0 + height * np.exp(-0.5 * ((time - middle) / 6) ** 2))


def drawn(true: torch.Tensor, seed: int = 0) -> torch.Tensor:
    return torch.poisson(true, generator=torch.Generator().manual_seed(seed))


def ripple() -> torch.Tensor:
    return 1 + 0.1 * torch.cos(2 * math.pi * torch.arange(BINS) / 4)


def rows() -> torch.Tensor:
    """A gain from row to row of the raster, too rough to be one of the wall."""
    return (1 + 0.15 * torch.tensor([1.0, -1.0]).repeat(SIDE // 2)[RUNS])[:, None]


@pytest.mark.parametrize("seed", range(8))
def test_noise_alone_is_no_excess(seed):
    found = excess_by_axis(drawn(expected(), seed), expected(), [PLACES], RUNS)
    assert found.along == dict.fromkeys(("level", "time", "wall", "scan", "rate"), 0.0)
    assert found.error == pytest.approx((2 / (SIDE**2 * BINS)) ** 0.5, rel=0.1)  # of chi-square, near enough
    assert found.ratio == pytest.approx(1, abs=4 * found.error)
    assert found.per_bin == pytest.approx(0, abs=0.03)


@pytest.mark.parametrize(
    ("axis", "change"),
    [
        ("level", lambda mu: 1.1 * mu),
        ("time", lambda mu: ripple() * mu),
        ("wall", lambda mu: (1 + 0.2 * X * Y)[:, None] * mu),
        ("scan", lambda mu: rows() * mu),
        ("rate", lambda mu: mu * (1.12 - 0.0015 * mu)),
    ],
)
def test_what_lies_along_an_axis_is_found_there(axis, change):
    mu = expected()
    true = change(mu)
    if axis != "level":
        true = true * (mu.sum() / true.sum())
    found = excess_by_axis(drawn(true), mu, [PLACES], RUNS)
    most = found.along.pop(axis)
    assert most > 0.7
    assert max(found.along.values()) < 0.2  # a rate lies a little along time and wall, where pulses are


def test_values_by_hand():
    """Two spots, two bins, 100 expected in each; 20 more in the first bin: R²/V = 2 · 40²/200, less 1."""
    mu = torch.full((2, 2), 100.0)
    counts = torch.tensor([[120.0, 80.0], [120.0, 80.0]])
    found = excess_by_axis(counts, mu, [torch.tensor([[-1.0, 0.0], [1.0, 0.0]])], torch.tensor([0, 1]))
    deviance = (2 * (120 * math.log(1.2) - 20) + 2 * (80 * math.log(0.8) + 20)) / 2
    noise = 1 + 1 / 600 + 1 / 60000
    assert found.per_bin == pytest.approx(deviance - noise)
    assert found.ratio == pytest.approx(deviance / noise)
    time = 15 / max(15, 4 * (deviance - noise))
    assert found.along == {"level": 0, "time": pytest.approx(time), "wall": 0, "scan": 0, "rate": 0}


def test_bins_that_were_not_recorded_say_nothing():
    mu = expected()
    observed = torch.ones(mu.shape, dtype=torch.bool)
    observed[: SIDE**2 // 2, 40:] = False
    observed[7] = False
    counts = torch.where(observed, drawn(mu), 0.0)
    assert max(excess_by_axis(counts, mu, [PLACES], RUNS, observed).along.values()) == 0
    assert excess_by_axis(counts, mu, [PLACES], RUNS).along["time"] > 0.1
    assert excess_by_axis(counts, mu, [PLACES], RUNS).along["wall"] > 0.1


def test_both_ends_of_the_paths_have_walls():
    """A gain over the laser's wall is found beside the sensor's."""
    mu, turned = expected(), PLACES[torch.randperm(SIDE**2, generator=torch.Generator().manual_seed(3))]
    counts = drawn(mu * (1 + 0.2 * turned[:, :1]))
    assert excess_by_axis(counts, mu, [PLACES], RUNS).along["wall"] < 0.2
    assert excess_by_axis(counts, mu, [PLACES, turned], RUNS).along["wall"] > 0.6
