"""A renderer of its own for the blind test: point elements of a mesh, with any weight on each path.

Third bounce: ``Σ_e A ρ/π³ · cosθ_l cosθ_e1 cosθ_e2 cosθ_s / (d1² d2²) · V`` at path ``d1 + d2``; fourth
bounce the same over pairs of elements with ``ρ/π · cosθ cosθ A / d²`` between them. Every element is a point;
the bins that are made of the fine ones do not show it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from data_modules.simulate import Mesh
from data_modules.simulate.visibility import Occluder

BLOCK_PATHS = 400_000  # so that a block's arrays stay in the cache


@dataclass(frozen=True)
class Elements:
    """A surface cut small.

    Centres ``[N, 3]`` m, unit normals ``[N, 3]``, areas ``[N]`` m² and albedos ``[N]``.
    """

    centre: np.ndarray
    normal: np.ndarray
    area: np.ndarray
    albedo: np.ndarray

    def of(self, chosen: np.ndarray) -> Elements:
        """Only those."""
        return Elements(self.centre[chosen], self.normal[chosen], self.area[chosen], self.albedo[chosen])

    def moved(self, offset: tuple[float, float, float]) -> Elements:
        """The same shifted by ``offset``, m."""
        return replace(self, centre=self.centre + offset)


@dataclass(frozen=True)
class Legs:
    """Both legs of the paths of some spots.

    ``to_laser`` and ``to_sensor`` are unit vectors from the element, 3 × ``[B, N]``.
    """

    d1: np.ndarray
    d2: np.ndarray
    laser: np.ndarray
    sensor: np.ndarray
    to_laser: tuple[np.ndarray, ...]
    to_sensor: tuple[np.ndarray, ...]
    cosine1: np.ndarray
    cosine2: np.ndarray
    elements: Elements


@dataclass(frozen=True)
class Axis:
    """Fine time axis: ``n`` bins of ``step`` m from path ``start``, m."""

    start: float
    step: float
    n: int

    @property
    def edges(self) -> np.ndarray:
        return self.start + self.step * np.arange(self.n + 1)


def cut(mesh: Mesh, size: float) -> Elements:
    """Every face as n² congruent triangles with edges no longer than ``size`` m."""
    parts = []
    corners = mesh.corners
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.maximum(1, np.ceil(edges / size - 1e-9)).astype(int)
    vectors = mesh.face_vectors
    for n in np.unique(pieces):
        # Barycentric centroids of the n² upright and inverted triangles.
        i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
        up, down = i + j < n, i + j < n - 1
        u = np.concatenate([i[up] + 1 / 3, i[down] + 2 / 3]) / n
        v = np.concatenate([j[up] + 1 / 3, j[down] + 2 / 3]) / n
        share = np.stack([1 - u - v, u, v])
        faces = np.flatnonzero((pieces == n) & (np.linalg.norm(vectors, axis=1) > 0))
        area = np.linalg.norm(vectors[faces], axis=1)
        parts.append(
            Elements(
                np.einsum("kp,fkc->fpc", share, corners[faces]).reshape(-1, 3),
                np.repeat(vectors[faces] / area[:, None], n * n, axis=0),
                np.repeat(area / n**2, n * n),
                np.einsum("kp,fk->fp", share, mesh.albedo[mesh.faces[faces]]).reshape(-1),
            )
        )
    return Elements(
        *(np.concatenate([getattr(p, k) for p in parts]) for k in ("centre", "normal", "area", "albedo"))
    )


def sight(mesh: Mesh, elements: Elements, wall: np.ndarray) -> np.ndarray:
    """``[S, N]`` whether wall point and element see each other."""
    occluder = Occluder(mesh)
    lifted = elements.centre + 0.05 * np.sqrt(elements.area)[:, None] * elements.normal
    seen = np.empty((len(wall), len(elements.area)), dtype=bool)
    for row, point in enumerate(wall):
        facing = np.flatnonzero(((point - elements.centre) * elements.normal).sum(axis=1) > 0)
        seen[row] = False
        seen[row, facing] = ~occluder.blocked(lifted[facing], np.broadcast_to(point, (len(facing), 3)))
    return seen


def _leg(wall: np.ndarray, elements: Elements) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """Distance ``[B, N]``, unit vector to the wall (3 × ``[B, N]``) and the cosine at the element."""
    x, y, z = (wall[:, k, None] - elements.centre[None, :, k] for k in range(3))
    distance = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / distance, y / distance, z / distance
    n = elements.normal
    return distance, (x, y, z), np.maximum(x * n[:, 0] + y * n[:, 1] + z * n[:, 2], 0)


def third_bounce(
    elements: Elements,
    laser: np.ndarray,
    sensor: np.ndarray,
    seen: np.ndarray,
    axis: Axis,
    weights: tuple[Callable[[Legs], np.ndarray], ...] = (),
) -> np.ndarray:
    """``[S, n]`` light of laser → wall → element → wall → sensor per fine bin; the wall's normals are +z.

    ``seen`` ``[S, N]`` is of both legs together, ``weights`` give a factor ``[B, N]`` each.
    """
    same = laser is sensor
    light = np.zeros((len(laser), axis.n))
    strength = elements.area * elements.albedo / np.pi**3
    size = max(1, BLOCK_PATHS // len(strength))
    for start in range(0, len(laser), size):
        block = slice(start, start + size)
        d1, unit1, cosine1 = _leg(laser[block], elements)
        d2, unit2, cosine2 = (d1, unit1, cosine1) if same else _leg(sensor[block], elements)
        energy = strength * seen[block] * (cosine1 * -unit1[2] / d1**2) * (cosine2 * -unit2[2] / d2**2)
        if weights:
            legs = Legs(d1, d2, laser[block], sensor[block], unit1, unit2, cosine1, cosine2, elements)
            for weight in weights:
                energy = energy * weight(legs)
        light[block] = _splat(d1 + d2, energy, axis)
    return light


def fourth_bounce(elements: Elements, wall: np.ndarray, seen: np.ndarray, axis: Axis) -> np.ndarray:
    """``[S, n]`` light of laser → wall → element a → element b → wall → sensor in a confocal scan.

    Elements see each other.
    """
    gap = elements.centre[None] - elements.centre[:, None]
    distance = np.linalg.norm(gap, axis=2)
    np.fill_diagonal(distance, 1)
    leave = np.einsum("abk,ak->ab", gap, elements.normal) / distance
    arrive = -np.einsum("abk,bk->ab", gap, elements.normal) / distance
    strength = elements.area * elements.albedo
    coupling = (
        np.maximum(leave, 0) * np.maximum(arrive, 0) / distance**2 * np.outer(strength, strength) / np.pi**4
    )
    a, b = np.nonzero(np.triu(coupling, 1))
    light = np.zeros((len(wall), axis.n))
    size = max(1, BLOCK_PATHS // max(1, len(a)))
    for start in range(0, len(wall), size):
        block = slice(start, start + size)
        d, unit, cosine = _leg(wall[block], elements)
        leg = seen[block] * cosine * -unit[2] / d**2
        # Each pair is walked in both directions, which take equally long.
        light[block] = _splat(
            d[:, a] + distance[a, b] + d[:, b], 2 * coupling[a, b] * leg[:, a] * leg[:, b], axis
        )
    return light


def _splat(length: np.ndarray, energy: np.ndarray, axis: Axis) -> np.ndarray:
    """Histogram ``[B, n]`` of paths ``[B, N]``; what falls outside the axis is lost."""
    place = np.floor((length - axis.start) / axis.step).astype(np.int64)
    energy = np.where((place >= 0) & (place < axis.n), energy, 0)
    place = np.clip(place, 0, axis.n - 1) + axis.n * np.arange(len(length))[:, None]
    return np.bincount(place.ravel(), energy.ravel(), len(length) * axis.n).reshape(len(length), axis.n)
