"""Small views for the tests of the page to explore."""

from __future__ import annotations

import dataclasses

import numpy as np

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.points import Points
from nlos_lit.io.views import Mesh, View

NX, NY, BINS = 6, 5, 40
RENDERED, EXTENDED = "rendered", "extended by power_drift"


def places() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, NX), np.linspace(-0.4, 0.4, NY), indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


def view(**facts) -> View:
    """A wall of 6 × 5 spots that one bump sweeps over; brighter by a third than its first model says."""
    rng, wall = np.random.default_rng(4), places()
    delay = 15 + 10 * np.hypot(*wall.T)
    light = 60 * np.exp(-0.5 * ((np.arange(BINS) - delay[:, None]) / 2) ** 2) + 0.5
    counts = rng.poisson(light).astype(float)
    counts[3, 7] = np.nan
    ball = rng.normal(size=(200, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    volume = np.exp(-0.5 * np.linspace(-3, 3, 8)[:, None, None] ** 2) * np.ones((1, 4, 6))
    volume[5, 1, 2] = 2.0
    told = {"name": "bump", "status": "finished", "at": "2026-11-23T12:00:00+00:00", "said": ["A bump."]}
    return View(
        facts={**told, "counts": True, "kept": {"spots": "30 of 30"}, **facts},
        spots=np.arange(30) * 2 + 1,
        places=wall,
        path=(1.0, 0.03),
        counts=counts,
        models={RENDERED: light * 0.75, EXTENDED: light},
        clouds={"surfels": Points(0.2 * ball + [0, 0, 0.7], ball, np.linspace(0.1, 1, 200))},
        meshes={"mesh": Mesh(np.eye(3), np.array([[0, 1, 2]]), np.ones(3))},
        volume=(volume, VolumeGrid((-0.3, -0.25, 0.5), (0.2, 0.1, 0.05), (8, 4, 6))),
    )


def irregular() -> View:
    """Spots in no rows, no volume, no surface, no model: a run that has only begun."""
    whole = view(status="running")
    scattered = np.random.default_rng(1).uniform(-0.5, 0.5, (30, 2))
    return dataclasses.replace(
        whole, places=scattered, models={}, clouds={}, meshes={}, volume=None, facts={**whole.facts}
    )
