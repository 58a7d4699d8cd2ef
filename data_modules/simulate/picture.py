"""The bodies as the wall sees them: ``python -m data_modules.simulate.picture docs/images/bodies.png``."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np

from data_modules.simulate.bodies import (
    Bend,
    Body,
    Capsule,
    Cone,
    Cylinder,
    Fold,
    Person,
    Plate,
    Sphere,
    Text,
    Torus,
    assemble,
)
from data_modules.simulate.draw import draw_scene
from data_modules.simulate.plan import wall_grid
from data_modules.simulate.truth import Truth, view_from_wall

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIGHT = np.array([0.45, 0.5, -0.74])  # from the body to the lamp of the picture: above, left, before
SHOWN: dict[str, Body] = {
    "sphere, checker": Sphere(texture="checker", albedo=(0.3, 0.95), period=0.08, turn=(20, 30, 0)),
    "capsule, stripes": Capsule(texture="stripes", albedo=(0.3, 0.95), period=0.08, turn=(25, 0, 40)),
    "cylinder, halves": Cylinder(texture="halves", albedo=(0.35, 0.95), turn=(-30, 0, 20)),
    "cone, gradient": Cone(texture="gradient", albedo=(0.25, 1.0), turn=(-20, 0, -15)),
    "torus": Torus(turn=(35, 25, 0)),
    "plate, checker": Plate(texture="checker", albedo=(0.3, 0.95), period=0.15, turn=(0, 35, 10)),
    "fold, 4 creases": Fold(creases=4, width=0.5, angle=80, turn=(15, 10, 0)),
    "bend": Bend(angle=170, turn=(10, 25, 0)),
    "text": Text(text="NLOS", size=0.11, depth=0.03, turn=(0, -25, 0)),
    "person": Person(height=0.4, arms=60, turn=(0, 20, 0)),
}
DRAWN = (0, 4, 9, 16, 21)  # seeds


def shaded(truth: Truth) -> np.ndarray:
    """What is seen from the wall, under a lamp.

    Returns:
        ``[ny, nx]`` brightness, up at the top and +x at the left; NaN where there is nothing.
    """
    light = 0.25 + 0.75 * np.maximum(truth.normal @ (LIGHT / np.linalg.norm(LIGHT)), 0)
    return (truth.albedo * light)[::-1, ::-1].T


def picture(views: dict[str, Truth], columns: int) -> Figure:
    """Views of several scenes under one another.

    Args:
        views: of each scene, by title.
        columns: how many stand side by side.

    Returns:
        the figure.
    """
    from matplotlib.figure import Figure

    rows = -(-len(views) // columns)
    figure = Figure(figsize=(1.9 * columns, 2.1 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, (title, truth) in zip(axes, views.items(), strict=False):
        axis.imshow(shaded(truth), cmap="gray", vmin=0, vmax=1)
        axis.set_title(title, fontsize=9)
    return figure


def main(path: str) -> None:
    """Write the picture of all bodies and of some random scenes."""
    small, wall = (wall_grid(240, 240, width, width) for width in (0.46, 1.0))
    views = {
        title: view_from_wall(body.mesh(), small[:, 0, 0], small[0, :, 1]) for title, body in SHOWN.items()
    }
    for seed in DRAWN:
        bodies = draw_scene(seed).bodies
        views[f"random={seed}"] = view_from_wall(assemble(bodies), wall[:, 0, 0], wall[0, :, 1])
    picture(views, 5).savefig(path, dpi=90)


if __name__ == "__main__":
    main(sys.argv[1])
