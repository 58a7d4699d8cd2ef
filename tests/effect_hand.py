"""Effects, scans and single paths to work out by hand."""

from __future__ import annotations

import dataclasses

import torch
from effect_contract import registered, scene
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.functional.surfel_paths import Paths


def effect(name: str, kind: str = "confocal", scan: Scan | None = None, **values: float | Tensor) -> Effect:
    built = registered(name)(scene(kind)[1] if scan is None else scan)
    for parameter, value in values.items():
        built.set(parameter, value)
    return built


def hand_scan(laser: list[list[float]], sensor: list[list[float]] | None = None) -> Scan:
    """A scan of given wall points, everything else as in the contract's scenes."""
    points = torch.tensor(laser)
    other = points if sensor is None else torch.tensor(sensor)
    base = scene("confocal")[1]
    moving = (points,) if sensor is None else (points, other)
    return dataclasses.replace(
        base,
        places=tuple(p[:, :2] / 0.5 for p in moving),
        half=0.5,
        rank=torch.linspace(-1, 1, len(points)),
        laser=points,
        sensor=other,
        confocal=sensor is None,
    )


def hand_paths(
    laser_leg=1.0,
    sensor_leg=1.0,
    laser_cosine=1.0,
    sensor_cosine=1.0,
    centre=(0.0, 0.0, 1.0),
    normal=(0.0, 0.0, -1.0),
) -> Paths:
    """One spot, one surfel, one point; throughput and length are not looked at by any hook."""
    numbers = [
        torch.full((1, 1, 1), float(v)) for v in (1, 0, laser_leg, sensor_leg, laser_cosine, sensor_cosine)
    ]
    return Paths(*numbers, torch.tensor([centre]), torch.tensor([normal]), torch.tensor([0.01]))


ONE, SPOT = torch.ones(1, 1, 1), torch.tensor([0])
