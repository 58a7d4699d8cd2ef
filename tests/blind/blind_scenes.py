"""The scenes of the blind test: light without sensor on a fine time axis, and the scan that sees it.

A scan is 32 × 32 spots; the time window holds all the light with a margin. Own scenes are rendered by
`blind_elements`, the others are path-traced renders (expected values with Monte-Carlo noise of a few per cent
a bin), made finer in time by a monotone cubic interpolation of the cumulative light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from blind_elements import Axis, Elements, Legs, cut, fourth_bounce, sight, third_bounce
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter

from data_modules.readers import read_capture, write_capture
from data_modules.simulate import SCENES as MESHES
from data_modules.simulate import Mesh, join, wall_grid
from data_modules.simulate.scenes import plate
from nlos_lit.capture import Capture

RENDERS = Path(__file__).resolve().parents[3] / "shared" / "data" / "rendered"
SIDE = 32  # spots along x and y
FINE = 8  # fine bins in a bin
PAD = 16  # bins beyond either end of the window, from which light can be moved or smeared into it


def corner() -> Mesh:
    """Two plates that face each other and the wall, like the inside of an opened book.

    Much light bounces twice.
    """
    left = plate((0.18, 0.03, 0.76), 0.44, 0.40, turn_y=np.deg2rad(42), albedo=0.9)
    right = plate((-0.15, -0.02, 0.78), 0.34, 0.46, turn_y=np.deg2rad(-36), albedo=0.6)
    return join(left, right)


@dataclass(frozen=True)
class Window:
    """``n_bins`` bins of ``bin_length`` m from path ``t_start`` m."""

    bin_length: float
    n_bins: int
    t_start: float

    @property
    def fine(self) -> Axis:
        """The fine axis, `PAD` bins longer at either end."""
        return Axis(
            self.t_start - PAD * self.bin_length, self.bin_length / FINE, FINE * (self.n_bins + 2 * PAD)
        )

    @property
    def middle(self) -> float:
        return self.t_start + self.n_bins * self.bin_length / 2


@dataclass(frozen=True)
class Plan:
    """How a scene is made.

    ``mesh`` and ``width`` (m) of the scanned wall, or the name of a ``render``; element ``size``, m.
    """

    window: Window
    mesh: Callable[[], Mesh] | None = None
    width: float = 0.0
    size: float = 0.01
    render: str = ""


PLANS: dict[str, Plan] = {
    "default": Plan(Window(0.008, 224, 0.92), MESHES["default"], 0.8, 0.0145),
    "letters": Plan(Window(0.008, 224, 1.10), MESHES["letters"], 0.8),
    "sphere_before_plate": Plan(Window(0.010, 256, 1.10), MESHES["sphere_before_plate"], 1.2, 0.018),
    "corner": Plan(Window(0.008, 208, 1.10), corner, 0.8, 0.012),
    "z_confocal": Plan(Window(0.006, 232, 0.006 * 172), render="z_confocal_64_d3"),
    "bunny_confocal": Plan(Window(0.012, 208, 0.006 * 322), render="bunny_confocal_32_d3"),
    "z_single": Plan(Window(0.006, 160, 0.006 * 172), render="z_single_32_d3"),
}


@dataclass(frozen=True)
class Scene:
    """A scan and the light that it sees.

    Args:
        laser, sensor: ``[S, 3]`` wall points, m; the same array where confocal.
        clean: ``[S, n]`` light on the fine axis.
        mesh, elements, seen: of own scenes.
        bounces: ``[S, n]`` light of the fourth and later bounces, where a render gives it.
    """

    name: str
    window: Window
    laser: np.ndarray
    sensor: np.ndarray
    clean: np.ndarray
    mesh: Mesh | None = None
    elements: Elements | None = None
    seen: np.ndarray | None = None
    bounces: np.ndarray | None = None

    @property
    def places(self) -> np.ndarray:
        """``[S, 2]`` the scanned points, from -1 to 1 over the wall's larger side."""
        points = (self.laser if self.confocal else self.sensor)[:, :2]
        low, high = points.min(axis=0), points.max(axis=0)
        return (points - (low + high) / 2) / ((high - low).max() / 2)

    @property
    def confocal(self) -> bool:
        return self.laser is self.sensor

    def rendered(
        self,
        weights: tuple[Callable[[Legs], np.ndarray], ...] = (),
        wall: np.ndarray | None = None,
        lift: float = 0.0,
    ) -> np.ndarray:
        """Light of an own scene with weights on its paths, true ``wall`` points, or lifted.

        A scene that is lifted lies ``lift`` m nearer to the wall.
        """
        wall = self.laser if wall is None else wall
        return third_bounce(
            self.elements.moved((0, 0, -lift)), wall, wall, self.seen, self.window.fine, weights
        )

    def apart(self, sensor: np.ndarray) -> np.ndarray:
        """Light of an own scene where the sensor looks at points of its own.

        They are ``sensor`` ``[S, 3]``, instead of the laser's.
        """
        seen = self.seen & sight(self.mesh, self.elements, sensor)
        return third_bounce(self.elements, self.laser, sensor, seen, self.window.fine)

    def fourth(self) -> np.ndarray:
        """Light of the fourth bounce (and later ones, in renders)."""
        if self.bounces is not None:
            return self.bounces
        coarse = cut(self.mesh, 6.0 * PLANS[self.name].size)
        return fourth_bounce(coarse, self.laser, sight(self.mesh, coarse, self.laser), self.window.fine)


def available() -> list[str]:
    """Scenes whose data are there."""
    return [
        name for name, plan in PLANS.items() if not plan.render or (RENDERS / f"{plan.render}.hdf5").exists()
    ]


@lru_cache(maxsize=8)
def load(name: str) -> Scene:
    """A scene by name; the arrays are shared, do not write into them."""
    plan = PLANS[name]
    return _own(name, plan) if plan.mesh else _render(name, plan)


def _own(name: str, plan: Plan) -> Scene:
    mesh = plan.mesh()
    wall = wall_grid(SIDE, SIDE, plan.width, plan.width).reshape(-1, 3)
    elements = cut(mesh, plan.size)
    seen = sight(mesh, elements, wall)
    lit = seen.any(axis=0)
    elements, seen = elements.of(lit), np.ascontiguousarray(seen[:, lit])
    clean = third_bounce(elements, wall, wall, seen, plan.window.fine)
    return Scene(name, plan.window, wall, wall, clean, mesh, elements, seen)


def _render(name: str, plan: Plan) -> Scene:
    capture = read_capture(RENDERS / f"{plan.render}.hdf5")
    side = capture.scan_shape[0]
    kept = np.arange(side * side).reshape(side, side)[:: side // SIDE, :: side // SIDE].ravel()
    laser = capture.laser[kept]
    sensor = laser if capture.confocal else capture.sensor[kept]
    clean = finer(capture.counts[kept], capture.t_start, capture.bin_length, plan.window.fine)
    bounces = None
    every = RENDERS / f"{plan.render.removesuffix('d3')}d8.hdf5"
    if every.exists() and capture.confocal:
        more = read_capture(every).counts[kept].astype(np.float64) - capture.counts[kept]
        # The difference of two renders is noisy; what is left after smoothing is the bounces'.
        smooth = gaussian_filter(more.reshape(SIDE, SIDE, -1), (1.5, 1.5, 6)).reshape(more.shape)
        # No way is shorter than the shortest third bounce.
        late = np.cumsum(capture.counts[kept], axis=1) > 0
        bounces = finer(np.maximum(smooth, 0) * late, capture.t_start, capture.bin_length, plan.window.fine)
    return Scene(name, plan.window, laser, sensor, clean, bounces=bounces)


def finer(light: np.ndarray, t_start: float, bin_length: float, axis: Axis) -> np.ndarray:
    """Light ``[S, T]`` in bins as light on a fine axis ``[S, n]``; nothing is negative, energies stay."""
    edges = t_start + bin_length * np.arange(light.shape[1] + 1)
    total = np.concatenate([np.zeros((len(light), 1)), np.cumsum(light, axis=1, dtype=np.float64)], axis=1)
    at = PchipInterpolator(edges, total, axis=1)(np.clip(axis.edges, edges[0], edges[-1]))
    return np.maximum(np.diff(at, axis=1), 0)


def scan_order(name: str, side: int) -> np.ndarray:
    """``[S]`` rank of each spot ``i·side + j``."""
    rank = np.arange(side**2).reshape(side, side)
    if name == "serpentine":
        rank[1::2] = rank[1::2, ::-1].copy()
    elif name == "columns":
        rank = rank.T.copy()
    elif name != "raster":
        raise ValueError(f"scan order {name!r} is none of raster, serpentine and columns")
    return rank.ravel()


def write_scan(path: str | Path, scene: Scene, counts: np.ndarray, order: np.ndarray) -> None:
    """A y-tal file (replaced if it exists) of photons ``[S, T]``, which tells nothing of what is in it."""
    normals, side = np.broadcast_to([0.0, 0.0, 1.0], scene.laser.shape), round(len(order) ** 0.5)
    capture = Capture(
        counts=counts.astype(np.uint32),
        laser=scene.laser,
        sensor=scene.sensor,
        laser_normal=normals,
        sensor_normal=normals,
        bin_length=scene.window.bin_length,
        t_start=scene.window.t_start,
        scan_shape=(side, side),
        scan_order=order,
        provenance={"source": "blind test", "steps": []},
    )
    write_capture(path, capture, overwrite=True)
