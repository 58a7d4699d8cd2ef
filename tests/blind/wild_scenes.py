"""Scenes drawn from a seed for the evaluation sets: seven families, and the small scan that sees each.

Six families are meshes, seen by the renderer of `blind_elements`; the seventh are path-traced renders, of
which a part of the scan is taken, mirrored and binned as drawn. Every window holds all of the light.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from blind_elements import Elements, Legs, cut, fourth_bounce, sight, third_bounce
from blind_scenes import RENDERS, Scene, Window, finer

from data_modules.readers import read_capture
from data_modules.simulate import Mesh, join, load_truth, wall_grid
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
)
from data_modules.simulate.draw import shares_seen

SIDE = 24  # spots along x and y
MOST = 36_000  # elements of a scene, its far sides included
FINEST = 0.006  # bin, m
ASIDE, NEAR, FAR = 0.5, 0.36, 1.15  # between them lies every body, m
SEEN = 0.25  # of its own outline each body shows to the wall, at least
TRIES = 400
LETTERS = "ABCDEFGHJKLMNPRSTUVXYZ2345679"
CONFOCAL_RENDERS = ("z_confocal_64_d3", "bunny_confocal_32_d3")
SINGLE_RENDERS = ("z_single_32_d3", "bunny_single_32_d3", "sphereplate_single_32_d3")


@dataclass(frozen=True)
class WildScene(Scene):
    """A scan and the light that it sees, confocal or with one laser point.

    Args:
        size: of elements, m.
        proxy: about where a render's surface is, all ``seen``; nothing that is measured hangs on it.
    """

    size: float = 0.01
    proxy: Elements | None = None

    @property
    def places(self) -> np.ndarray:
        """``[S, 2]`` the scanned points, from -1 to 1 over the wall."""
        points = self.sensor[:, :2]
        low, high = points.min(axis=0), points.max(axis=0)
        return (points - (low + high) / 2) / ((high - low).max() / 2)

    @property
    def own(self) -> bool:
        """Whether its surface is known, so that it can be seen anew."""
        return self.elements is not None

    def rendered(
        self,
        weights: tuple[Callable[[Legs], np.ndarray], ...] = (),
        wall: Callable[[np.ndarray], np.ndarray] | None = None,
        lift: float = 0.0,
    ) -> np.ndarray:
        """Light with weights on its paths, from true ``wall`` points, or ``lift`` m nearer to the wall.

        Args:
            weights: factors on paths.
            wall: where points ``[S, 3]`` of the file really are.
        """
        laser = self.laser if wall is None else wall(self.laser)
        sensor = laser if self.confocal else self.sensor if wall is None else wall(self.sensor)
        elements = self.elements.moved((0, 0, -lift))
        return third_bounce(elements, laser, sensor, self.seen, self.window.fine, weights)

    def fourth(self) -> np.ndarray:
        """Light of the fourth bounce in a confocal scan of an own scene."""
        coarse = cut(self.mesh, max(0.05, 4 * self.size))
        return fourth_bounce(coarse, self.laser, sight(self.mesh, coarse, self.laser), self.window.fine)


def texture(rng: np.random.Generator) -> dict[str, object]:
    """Albedo of a body: plain in half of the draws."""
    dark, bright = rng.uniform(0.15, 0.5), rng.uniform(0.55, 1.0)
    kind = str(rng.choice(["plain", "plain", "plain", "gradient", "halves", "stripes", "checker"]))
    if kind == "plain":
        return {"albedo": bright, "cell": 0.02}
    along = str(rng.choice(["x", "y"]))
    return {
        "albedo": (dark, bright),
        "texture": kind,
        "along": along,
        "period": rng.uniform(0.1, 0.22),
        "cell": 0.02,
    }


def _facing(rng: np.random.Generator, most: float, about_z: float = 180.0) -> tuple[float, float, float]:
    return (rng.uniform(-most, most), rng.uniform(-most, most), rng.uniform(-about_z, about_z))


def _any(rng: np.random.Generator) -> tuple[float, float, float]:
    return (rng.uniform(-90, 90), rng.uniform(-180, 180), rng.uniform(-180, 180))


def letters(rng: np.random.Generator) -> list[Body]:
    """A word of one to three letters, or two letters at two distances."""
    words = [1, 1] if rng.random() < 0.3 else [int(rng.integers(1, 4))]
    return [
        Text(
            text="".join(rng.choice(list(LETTERS), number)),
            size=rng.uniform(0.2, 0.34) / (1 + 0.22 * (number - 1)),
            depth=float(rng.choice([0.0, 0.03])),
            turn=_facing(rng, 30, 25),
            **texture(rng),
        )
        for number in words
    ]


def plates(rng: np.random.Generator) -> list[Body]:
    """One or two tilted plates."""
    return [
        Plate(
            width=rng.uniform(0.18, 0.45),
            height=rng.uniform(0.18, 0.45),
            turn=_facing(rng, 45),
            **texture(rng),
        )
        for _ in range(int(rng.integers(1, 3)))
    ]


def rounds(rng: np.random.Generator) -> list[Body]:
    """One to three spheres and cylinders."""
    bodies: list[Body] = []
    for _ in range(int(rng.integers(1, 4))):
        if rng.random() < 0.5:
            bodies.append(Sphere(radius=rng.uniform(0.07, 0.18), turn=_any(rng), **texture(rng)))
        else:
            radius, height = rng.uniform(0.05, 0.13), rng.uniform(0.15, 0.4)
            bodies.append(Cylinder(radius=radius, height=height, turn=_any(rng), **texture(rng)))
    return bodies


def sheet(rng: np.random.Generator) -> list[Body]:
    """A sheet, creased or bent."""
    width, height = rng.uniform(0.3, 0.6), rng.uniform(0.2, 0.42)
    turn, look = _facing(rng, 35), texture(rng)
    if rng.random() < 0.65:
        creases = int(rng.integers(1, 5))
        return [
            Fold(width=width, height=height, creases=creases, angle=rng.uniform(80, 280), turn=turn, **look)
        ]
    angle = float(rng.choice([-1, 1])) * rng.uniform(50, 170)
    return [Bend(width=width, height=height, angle=angle, turn=turn, **look)]


def figure(rng: np.random.Generator) -> list[Body]:
    """A person, or one or two capsules and cones."""
    if rng.random() < 0.4:
        turn = (rng.uniform(-25, 25), rng.uniform(-60, 60), rng.uniform(-25, 25))
        pose = {"arms": rng.uniform(10, 150), "stride": rng.uniform(10, 50), "turn": turn}
        return [Person(height=rng.uniform(0.5, 0.8), **pose, **texture(rng))]
    bodies: list[Body] = []
    for _ in range(int(rng.integers(1, 3))):
        if rng.random() < 0.5:
            size = {"radius": rng.uniform(0.05, 0.1), "length": rng.uniform(0.1, 0.32)}
            bodies.append(Capsule(**size, turn=_any(rng), **texture(rng)))
        else:
            radius = rng.uniform(0.09, 0.17)
            size = {"radius": radius, "top": radius * float(rng.choice([0, 0.5]))}
            bodies.append(Cone(**size, height=rng.uniform(0.16, 0.36), turn=_any(rng), **texture(rng)))
    return bodies


def torus(rng: np.random.Generator) -> list[Body]:
    """A ring, in half of the draws with a plate or a sphere that shows through or beside it."""
    ring = Torus(
        radius=rng.uniform(0.11, 0.2), tube=rng.uniform(0.03, 0.06), turn=_facing(rng, 50), **texture(rng)
    )
    if rng.random() < 0.5:
        return [ring]
    if rng.random() < 0.5:
        return [ring, Sphere(radius=rng.uniform(0.06, 0.12), **texture(rng))]
    size = {"width": rng.uniform(0.2, 0.4), "height": rng.uniform(0.2, 0.4)}
    return [ring, Plate(**size, turn=_facing(rng, 30), **texture(rng))]


OWN: dict[str, Callable[[np.random.Generator], list[Body]]] = {
    "letters": letters,
    "plates": plates,
    "rounds": rounds,
    "sheet": sheet,
    "figure": figure,
    "torus": torus,
}
FAMILIES = (*OWN, "render")


def placed(rng: np.random.Generator, family: str) -> list[Mesh]:
    """Bodies of a family somewhere before the wall, apart, each at least partly in view."""
    for _ in range(TRIES):
        meshes: list[Mesh] = []
        bodies = OWN[family](rng)
        for body in bodies:
            at = (*rng.uniform(-0.25, 0.25, 2), rng.uniform(0.48, 0.95))
            mesh = dataclasses.replace(body, at=at).mesh()
            if _inside(mesh) and all(_boxes_apart(mesh, other) for other in meshes):
                meshes.append(mesh)
        if len(meshes) == len(bodies) and shares_seen(meshes).min() > SEEN:
            return meshes
    raise ValueError(f"no room for {family} in {TRIES} tries")


def _inside(mesh: Mesh) -> bool:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return bool(max(-low[:2].min(), high[:2].max()) < ASIDE and low[2] > NEAR and high[2] < FAR)


def _boxes_apart(mesh: Mesh, other: Mesh) -> bool:
    a, b = mesh.vertices, other.vertices
    return bool(((a.min(axis=0) > b.max(axis=0)) | (b.min(axis=0) > a.max(axis=0))).any())


@lru_cache(maxsize=4)
def load(family: str, seed: int, confocal: bool = True, side: int = SIDE) -> WildScene:
    """A scene; the same arguments give the same. The arrays are shared, do not write into them.

    Args:
        family: one of `FAMILIES`.
        seed: of shapes, poses, albedos, the wall and the window.
        confocal: laser and sensor at one point; otherwise the laser's point stands still.
        side: spots along x and along y.
    """
    rng = np.random.default_rng([seed, 101])
    return _render(rng, confocal, side) if family == "render" else _own(rng, family, confocal, side)


def _own(rng: np.random.Generator, family: str, confocal: bool, side: int) -> WildScene:
    mesh = join(*placed(rng, family))
    width, n_bins = rng.uniform(0.75, 1.15), int(rng.integers(170, 241))
    sensor = wall_grid(side, side, width, width).reshape(-1, 3)
    spot = np.array([*rng.uniform(-0.3, 0.3, 2) * width, 0.0])
    laser = sensor if confocal else np.broadcast_to(spot, sensor.shape)
    low, high = _paths(mesh, laser, sensor)
    before, after = rng.uniform(9, 20), rng.uniform(16, 32)
    window = _window(low, high, n_bins, before, after)
    elements, size = _elements(mesh, window.bin_length)
    seen = sight(mesh, elements, sensor)
    if not confocal:
        seen &= sight(mesh, elements, laser[:1])
    lit = seen.any(axis=0)
    elements, seen = elements.of(lit), np.ascontiguousarray(seen[:, lit])
    clean = third_bounce(elements, laser, sensor, seen, window.fine)
    return WildScene(family, window, laser, sensor, clean, mesh, elements, seen, size=size)


def _window(low: float, high: float, n_bins: int, before: float, after: float) -> Window:
    """All paths from ``low`` to ``high`` m with so many bins to spare, at `FINEST` m a bin or more."""
    step = round(max(FINEST, (high - low) / (n_bins - before - after)), 4)
    return Window(step, n_bins, round(low - before * step, 4))


def _elements(mesh: Mesh, step: float) -> tuple[Elements, float]:
    """So fine that at 10 000 counts a spot their error's divergence is about 100 at most."""
    size = 0.8 * step
    while True:
        elements = cut(mesh, size)
        if len(elements.area) <= MOST:
            return elements, size
        size *= 1.15


def _paths(mesh: Mesh, laser: np.ndarray, sensor: np.ndarray) -> tuple[float, float]:
    """Shortest and longest path over the wall to a vertex, m."""
    one, other = (
        np.linalg.norm(mesh.vertices[None] - points[:, None], axis=2)
        for points in (laser[:: len(laser) // 64], sensor[:: len(sensor) // 64])
    )
    return float((one + other).min()), float((one + other).max())


def _render(rng: np.random.Generator, confocal: bool, side: int) -> WildScene:
    name = str(rng.choice(CONFOCAL_RENDERS if confocal else SINGLE_RENDERS))
    capture = read_capture(RENDERS / f"{name}.hdf5")
    whole = capture.scan_shape[0]
    # A part of the scan, mirrored and turned: that is a scan of the scene mirrored and turned.
    stride = max(1, whole // 32)
    first = rng.integers(0, whole // stride - side + 1, 2) * stride
    rows = np.arange(whole * whole).reshape(whole, whole)
    rows = rows[first[0] :: stride, first[1] :: stride][:side, :side]
    flip, swap = rng.choice([-1, 1], 2), bool(rng.integers(2))
    rows = rows[:: flip[0], :: flip[1]]
    rows = (rows.T if swap else rows).ravel()
    laser, sensor = (_mirrored(points[rows], flip, swap) for points in (capture.laser, capture.sensor))
    light = capture.counts[rows].astype(np.float64)
    arrived = np.cumsum(light.sum(axis=0)) / light.sum()
    low, high = (
        float(capture.t_start + capture.bin_length * k) for k in np.searchsorted(arrived, [1e-3, 0.9995])
    )
    n_bins, before, after = int(rng.integers(170, 241)), rng.uniform(9, 20), rng.uniform(16, 32)
    window = _window(low, high, n_bins, before, after)
    clean = finer(light, capture.t_start, capture.bin_length, window.fine)
    centre, normal, *rest = _surface(RENDERS / f"{name.split('_')[0]}_gt.h5")
    proxy = Elements(_mirrored(centre, flip, swap), _mirrored(normal, flip, swap), *rest)
    laser, seen = sensor if confocal else laser, np.ones((len(sensor), len(proxy.area)), dtype=bool)
    return WildScene("render", window, laser, sensor, clean, seen=seen, proxy=proxy)


def _surface(path: Path) -> tuple[np.ndarray, ...]:
    """Centres, normals, areas and albedos of a depth map's cells."""
    truth = load_truth(path)
    stride = max(1, len(truth.x) // 80)
    x, y = truth.x[::stride], truth.y[::stride]
    depth, normal = truth.depth[::stride, ::stride], truth.normal[::stride, ::stride]
    there = np.isfinite(depth) & (normal[..., 2] < -0.1)
    area = np.ptp(x) / (len(x) - 1) * np.ptp(y) / (len(y) - 1) / -normal[there][:, 2]
    grid = np.stack([*np.meshgrid(x, y, indexing="ij"), depth], axis=2)
    return grid[there], normal[there], area, np.ones(len(area))


def _mirrored(points: np.ndarray, flip: np.ndarray, swap: bool) -> np.ndarray:
    moved = points * [*flip, 1.0]
    return moved[:, [1, 0, 2]] if swap else moved
