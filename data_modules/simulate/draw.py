"""Random scenes to develop on: bodies that curve, hide one another and touch, without any physical effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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
    one_line,
)
from data_modules.simulate.capture import simulate_capture
from data_modules.simulate.mesh import Mesh, join
from data_modules.simulate.plan import ScanPlan, wall_grid
from data_modules.simulate.sensor import SensorModel
from data_modules.simulate.truth import Truth
from data_modules.simulate.visibility import Occluder
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError

WALL = 1.0  # edge of the scanned wall, m
NEAR, FAR = 0.35, 1.05  # between them lies every body, m
ASIDE = 0.48  # farthest from the axis along x and along y, m
SEEN = 0.3  # of its own outline each body shows to the wall, at least
SOFTEST = 40.0  # sheets are turned by no more than this about x and y, degrees
CELL = 0.02  # of curved parts, m: coarse, so that a capture takes seconds; the truth is the mesh itself
TRIES = 200
LETTERS = "ABCDEFGHJKLMNPRSTUVXYZ2345679"


@dataclass(frozen=True)
class DrawnScene:
    """A random scene, how it is scanned, and what is measured.

    Args:
        seed: it was drawn with.
        bodies: of the scene.
        scan: wall points and time bins; all light of the scene falls into them.
        sensor: response, exposure, background.
    """

    seed: int
    bodies: tuple[Body, ...]
    scan: ScanPlan
    sensor: SensorModel

    def mesh(self) -> Mesh:
        """All bodies as one mesh."""
        return assemble(self.bodies)

    def line(self) -> str:
        """The bodies as one argument of ``simulate.py``."""
        return one_line(self.bodies)

    def measure(self, detail: float = 0.5) -> tuple[Capture, Truth]:
        """Photon counts and what is really there, as of `simulate_capture`, in a few seconds.

        Args:
            detail: 2 halves the patches' edges.

        Returns:
            the capture, and the truth.
        """
        return simulate_capture(self.mesh(), self.scan, self.sensor, self.seed, detail=detail)


def draw_scene(seed: int, spots: int | None = None) -> DrawnScene:
    """A random scene: one to four bodies of drawn kind, size, pose and texture, apart, behind or in touch.

    The wall is 1 m wide, the scan confocal. Drawn are also the counts a spot (500 … 10 000), the response
    and the background.

    Args:
        seed: the same seed gives the same scene.
        spots: along x and along y; None draws 32 or 64.

    Returns:
        the scene, not yet measured.

    Examples:
        >>> scene = draw_scene(7)
        >>> scene == draw_scene(7), scene.bodies != draw_scene(8).bodies
        (True, True)
    """
    rng = np.random.default_rng(seed)
    drawn_spots = int(rng.choice([32, 64]))
    n = spots or drawn_spots
    sensor = SensorModel(
        sigma=_digits(rng.uniform(0.005, 0.015)),
        kappa=_digits(rng.uniform(40, 120)),
        background=_digits(np.exp(rng.uniform(np.log(0.01), np.log(0.3)))),
        mean_counts=_digits(np.exp(rng.uniform(np.log(500), np.log(10_000)))),
    )
    bodies = draw_bodies(rng, int(rng.integers(1, 5)))
    return DrawnScene(seed, bodies, ScanPlan(nx=n, ny=n, width=WALL, n_bins=384), sensor)


def draw_bodies(rng: np.random.Generator, number: int) -> tuple[Body, ...]:
    """Bodies of random kind, size, pose and texture; each shows a part of itself to the wall.

    Args:
        rng: source of randomness.
        number: of bodies.

    Returns:
        the bodies.

    Raises:
        UserError: no room was found for one of them.
    """
    bodies: list[Body] = []
    meshes: list[Mesh] = []
    for _ in range(TRIES):
        body = _placed(rng, draw_body(rng), bodies, meshes)
        mesh = body.mesh()
        if _inside(mesh) and _apart(mesh, meshes) and shares_seen([*meshes, mesh]).min() > SEEN:
            bodies.append(body)
            meshes.append(mesh)
        if len(bodies) == number:
            return tuple(bodies)
    raise UserError(f"found room for {len(bodies)} of {number} bodies in {TRIES} tries; take another seed")


def draw_body(rng: np.random.Generator) -> Body:
    """A body of random kind, size, turn and texture."""
    return DRAWS[int(rng.integers(len(DRAWS)))](rng, _texture(rng))


def _digits(value: float) -> float:
    """Three significant digits, so that the scene is a readable line."""
    return float(f"{value:.3g}")


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return _digits(rng.uniform(low, high))


def _texture(rng: np.random.Generator) -> dict[str, Any]:
    kind = str(rng.choice(["plain", "plain", "gradient", "halves", "stripes", "checker"]))
    dark, bright = _between(rng, 0.15, 0.5), _between(rng, 0.5, 1.0)
    if kind == "plain":
        return {"cell": CELL, "albedo": bright}
    texture = {"cell": CELL, "texture": kind, "albedo": (dark, bright)}
    if kind in ("stripes", "checker"):
        texture["period"] = _between(rng, 0.08, 0.2)
    if kind != "checker":
        texture["along"] = str(rng.choice(["x", "y"]))
    return texture


def _any_turn(rng: np.random.Generator) -> tuple[float, float, float]:
    return (_between(rng, -90, 90), _between(rng, -180, 180), _between(rng, -180, 180))


def _facing(rng: np.random.Generator, about_z: float) -> tuple[float, float, float]:
    return (
        _between(rng, -SOFTEST, SOFTEST),
        _between(rng, -SOFTEST, SOFTEST),
        _between(rng, -about_z, about_z),
    )


def _sphere(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    return Sphere(radius=_between(rng, 0.06, 0.16), turn=_any_turn(rng), **texture)


def _capsule(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    return Capsule(
        radius=_between(rng, 0.04, 0.09), length=_between(rng, 0.1, 0.3), turn=_any_turn(rng), **texture
    )


def _cylinder(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    return Cylinder(
        radius=_between(rng, 0.05, 0.12), height=_between(rng, 0.12, 0.36), turn=_any_turn(rng), **texture
    )


def _cone(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    radius = _between(rng, 0.08, 0.16)
    top = float(rng.choice([0.0, _digits(radius / 2)]))
    return Cone(radius=radius, top=top, height=_between(rng, 0.14, 0.34), turn=_any_turn(rng), **texture)


def _torus(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    return Torus(
        radius=_between(rng, 0.09, 0.16), tube=_between(rng, 0.025, 0.05), turn=_facing(rng, 180), **texture
    )


def _plate(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    return Plate(
        width=_between(rng, 0.15, 0.4), height=_between(rng, 0.15, 0.4), turn=_facing(rng, 180), **texture
    )


def _fold(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    return Fold(
        width=_between(rng, 0.25, 0.55),
        height=_between(rng, 0.15, 0.4),
        creases=int(rng.integers(1, 6)),
        angle=_between(rng, 80, 280),
        turn=_facing(rng, 180),
        **texture,
    )


def _bend(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    return Bend(
        width=_between(rng, 0.25, 0.5),
        height=_between(rng, 0.15, 0.4),
        angle=float(rng.choice([-1, 1])) * _between(rng, 40, 180),
        turn=_facing(rng, 180),
        **texture,
    )


def _text(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    word = "".join(rng.choice(list(LETTERS), int(rng.integers(1, 4))))
    return Text(
        text=word,
        size=_between(rng, 0.15, 0.28),
        depth=float(rng.choice([0.0, 0.03])),
        turn=_facing(rng, 30),
        **texture,
    )


def _person(rng: np.random.Generator, texture: dict[str, Any]) -> Body:
    return Person(
        height=_between(rng, 0.4, 0.75),
        arms=_between(rng, 10, 150),
        stride=_between(rng, 10, 50),
        turn=(_between(rng, -30, 30), _between(rng, -60, 60), _between(rng, -30, 30)),
        **texture,
    )


DRAWS: tuple[Callable[[np.random.Generator, dict[str, Any]], Body], ...] = (
    _sphere,
    _capsule,
    _cylinder,
    _cone,
    _torus,
    _plate,
    _fold,
    _bend,
    _text,
    _person,
)


def _placed(rng: np.random.Generator, body: Body, others: list[Body], meshes: list[Mesh]) -> Body:
    """The body somewhere, behind the last one or in touch with it."""
    place = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(0.45, 0.9)])
    relation = rng.choice(["apart", "behind", "touching"]) if others else "apart"
    if relation == "behind":
        last = np.array(others[-1].at)
        place = last + np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.15, 0.35)])
    elif relation == "touching":
        angle = rng.uniform(0, 2 * np.pi)
        away = np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.7, 0.7)])
        start = np.array(others[-1].at) + 2 * away
        here = _moved(body, start).mesh()
        gap = way_to_touch(here, meshes[-1], -away)
        place = start - (gap if np.isfinite(gap) else 1.8) * away
    return _moved(body, place)


def _moved(body: Body, place: np.ndarray) -> Body:
    import dataclasses

    x, y, z = (float(f"{v:.4f}") for v in place)
    return dataclasses.replace(body, at=(x, y, z))


def way_to_touch(mesh: Mesh, other: Mesh, direction: np.ndarray) -> float:
    """How far a mesh can move before one of its vertices, or one of the other's, meets the other mesh.

    Args:
        mesh: the one that moves.
        other: stands still.
        direction: ``[3]`` of the motion.

    Returns:
        way in units of ``direction``; infinite where they never meet.

    Examples:
        >>> ball, wall = Sphere(radius=0.1, at=(0, 0, 0)).mesh(), Plate(at=(0, 0, 0.5)).mesh()
        >>> round(way_to_touch(ball, wall, np.array([0.0, 0.0, 1.0])), 3)
        0.4
    """
    ways = [
        Occluder(b).first_hit(a.vertices, np.broadcast_to(d, a.vertices.shape))[0].min()
        for a, b, d in ((mesh, other, direction), (other, mesh, -direction))
    ]
    return float(min(ways))


def _inside(mesh: Mesh) -> bool:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return bool(max(-low[:2].min(), high[:2].max()) < ASIDE and low[2] > NEAR and high[2] < FAR)


def _apart(mesh: Mesh, others: list[Mesh]) -> bool:
    """No edge of one goes through a face of the other by more than rounding of places."""
    return not any(_pierces(a, b) for other in others for a, b in ((mesh, other), (other, mesh)))


def _pierces(mesh: Mesh, other: Mesh) -> bool:
    corners = mesh.corners
    middle = corners.mean(axis=1, keepdims=True)
    # Places are rounded to a tenth of a millimetre: bodies in touch may enter one another by that.
    inner = middle + (corners - middle) * 0.98
    start, end = inner.reshape(-1, 3), np.roll(inner, -1, axis=1).reshape(-1, 3)
    return bool(Occluder(other).blocked(start, end).any())


def shares_seen(meshes: list[Mesh]) -> np.ndarray:
    """How much of its own outline each mesh shows to the wall along z, front sides only.

    Args:
        meshes: of the scene.

    Returns:
        ``[N]`` shares in [0, 1]; 0 for one that is no wider than the lattice's step of 1 cm.

    Examples:
        >>> front = Plate(width=0.2, height=0.4, at=(0.1, 0, 0.5)).mesh()
        >>> shares_seen([front, Plate(width=0.4, height=0.4, at=(0, 0, 0.7)).mesh()]).round(9).tolist()
        [1.0, 0.5]
    """
    start = wall_grid(100, 100, WALL, WALL).reshape(-1, 3)
    along = np.broadcast_to([0.0, 0.0, 1.0], start.shape)
    whole = join(*meshes)
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    distance, face, _ = Occluder(whole).first_hit(start, along)
    lit = face[np.isfinite(distance)]
    lit = lit[whole.face_vectors[lit, 2] < 0]
    seen = np.bincount(owner[lit], minlength=len(meshes))
    own = np.array([np.isfinite(Occluder(mesh).first_hit(start, along)[0]).sum() for mesh in meshes])
    return seen / np.maximum(own, 1)
