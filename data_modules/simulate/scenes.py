"""Hidden scenes without downloads: plates, spheres, strokes, and the embedded default scene.

Everything faces the wall (normals towards -z) unless turned. Letters read rightly as seen from the wall,
where +x is to the left and +y is up.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np

from data_modules.simulate.mesh import Mesh, join, load_mesh

READABLE = np.array([-1.0, 1.0])  # from (right, up) as seen from the wall to world (x, y)


def plate(
    centre: tuple[float, float, float],
    width: float,
    height: float,
    *,
    turn_x: float = 0,
    turn_y: float = 0,
    albedo: float = 1,
) -> Mesh:
    """A flat rectangle, turned about its centre.

    Args:
        centre: (x, y, z), m.
        width: extent along x before it is turned, m.
        height: extent along y, m.
        turn_x: angle about x, done first, rad.
        turn_y: angle about y, rad.
        albedo: reflectance.

    Returns:
        two faces that look to the wall unless turned away.

    Examples:
        >>> mesh = plate((0.0, 0.0, 0.5), width=0.2, height=0.4)
        >>> round(mesh.area, 9), mesh.face_vectors[0].round(9).tolist()
        (0.08, [0.0, 0.0, -0.04])
    """
    x, y = width / 2, height / 2
    corners = np.array([[-x, -y, 0], [-x, y, 0], [x, y, 0], [x, -y, 0]])
    cx, sx, cy, sy = np.cos(turn_x), np.sin(turn_x), np.cos(turn_y), np.sin(turn_y)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    turned = corners @ (about_y @ about_x).T + np.asarray(centre)
    return Mesh(turned, np.array([[0, 1, 2], [0, 2, 3]]), np.asarray(albedo))


def sphere(
    centre: tuple[float, float, float],
    radius: float,
    *,
    rings: int = 24,
    opening: float = np.pi,
    albedo: float = 1.0,
) -> Mesh:
    """A sphere of latitude rings about the pole nearest the wall.

    Args:
        centre: (x, y, z), m.
        radius: m.
        rings: from pole to ``opening``; there are twice as many segments around.
        opening: polar angle at which the sphere ends, rad (π/2: a dome).
        albedo: reflectance.

    Returns:
        faces that look outwards.
    """
    segments = 2 * rings
    polar = np.linspace(0, opening, rings + 1)[:, None]
    around = 2 * np.pi * np.arange(segments) / segments
    unit = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), -np.cos(polar)),
        axis=2,
    )
    i, j = (n.ravel() for n in np.meshgrid(np.arange(rings), np.arange(segments), indexing="ij"))
    a, b = i * segments + j, i * segments + (j + 1) % segments
    c, d = b + segments, a + segments
    faces = np.concatenate([np.stack([a, b, c], axis=1)[i > 0], np.stack([a, c, d], axis=1)])
    return Mesh(unit.reshape(-1, 3) * radius + np.asarray(centre), faces, np.asarray(albedo))


def strokes(
    lines: list[np.ndarray],
    *,
    depth: float,
    stroke: float,
    bevel: float = 0.0,
    cell: float = 0.01,
    albedo: float = 1.0,
) -> Mesh:
    """A plate in the shape of drawn lines, its rim bent back from the wall.

    Args:
        lines: polylines ``[N, 2]`` of (x, y), m, drawn with a round pen.
        depth: z of the plate, m.
        stroke: width of the lines, m.
        bevel: how far the outermost ``cell`` leans back, m.
        cell: grid of the outline, m.
        albedo: reflectance.

    Returns:
        faces that look to the wall, two a cell.
    """
    ends = np.concatenate(lines)
    low = ends.min(axis=0) - stroke / 2
    shape = np.ceil((np.ptp(ends, axis=0) + stroke) / cell - 1e-9).astype(int)
    centres = low + cell * (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=2) + 0.5)
    inside = np.zeros(shape, dtype=bool)
    for line in lines:
        for start, end in pairwise(line):
            along = (end - start) / np.linalg.norm(end - start)
            offset = centres - (start + end) / 2
            across = np.abs(offset @ np.array([-along[1], along[0]])) <= stroke / 2
            inside |= across & (np.abs(offset @ along) <= np.linalg.norm(end - start) / 2)
        inside |= (np.linalg.norm(centres[:, :, None] - line, axis=3) <= stroke / 2).any(axis=2)
    padded = np.pad(inside, 1)
    # Grid corners that touch the outside.
    rim = ~(padded[1:, 1:] & padded[:-1, 1:] & padded[1:, :-1] & padded[:-1, :-1])
    corner = low + cell * np.stack(np.meshgrid(*(np.arange(n + 1) for n in shape), indexing="ij"), axis=2)
    vertices = np.concatenate([corner, (depth + bevel * rim)[..., None]], axis=2).reshape(-1, 3)
    i, j = np.nonzero(inside)
    a = i * (shape[1] + 1) + j
    b, c, d = a + shape[1] + 1, a + shape[1] + 2, a + 1
    faces = np.concatenate([np.stack([a, d, c], axis=1), np.stack([a, c, b], axis=1)])
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], faces.reshape(-1, 3), np.asarray(albedo))


def default_scene() -> Mesh:
    """The embedded default: a bevelled letter F and, behind its lower right, a dome.

    The F has albedo 0.5 and lies at z = 0.5 m; it reads as an F from the wall, where +x is to the left. The
    dome has albedo 0.9 and reaches from z = 0.68 to 0.86 m; the F hides it from part of the wall. Nothing is
    symmetric in x or y.
    """
    f = [np.array([[-0.26, -0.28], [-0.26, 0.26], [0.10, 0.26]]), np.array([[-0.26, 0.04], [0.02, 0.04]])]
    letter = strokes(
        [line * READABLE for line in f], depth=0.5, stroke=0.10, bevel=0.01, cell=0.01, albedo=0.5
    )
    dome = sphere((-0.06, -0.20, 0.86), 0.18, rings=16, opening=np.pi / 2, albedo=0.9)
    return join(letter, dome)


def letters() -> Mesh:
    """An S at z = 0.6 m and, 0.3 m behind it and to its right, a U; the S is the darker one."""

    def arc(x: float, y: float, rx: float, ry: float, start: float, turn: float) -> np.ndarray:
        angle = np.deg2rad(start + turn * np.linspace(0, 1, 25))
        return np.stack([x + rx * np.cos(angle), y + ry * np.sin(angle)], axis=1)

    s = np.concatenate([arc(-0.18, 0.10, 0.1, 0.1, 18, 252), arc(-0.18, -0.10, 0.1, 0.1, 90, -252)])
    u = np.concatenate([[[0.06, 0.22]], arc(0.18, -0.08, 0.12, 0.10, 180, 180), [[0.30, 0.22]]])
    return join(
        strokes([s * READABLE], depth=0.6, stroke=0.07, albedo=0.5),
        strokes([u * READABLE], depth=0.9, stroke=0.08, albedo=1.0),
    )


def sphere_before_plate() -> Mesh:
    """A sphere of 0.25 m radius partly in front of a plate turned by 20° about y."""
    return join(
        sphere((-0.35, 0.2, 0.85), 0.25, rings=48), plate((0.35, -0.2, 1.3), 0.6, 0.6, turn_y=np.deg2rad(20))
    )


def bunny_two_albedo(mesh_path: str | Path) -> Mesh:
    """Any mesh in two albedos: 1.0 above the middle of its height, 0.3 below, as the paper's Bunny has."""
    mesh = load_mesh(mesh_path)
    height = mesh.corners[:, :, 1].mean(axis=1)
    middle = (mesh.vertices[:, 1].min() + mesh.vertices[:, 1].max()) / 2
    return Mesh.from_face_albedo(mesh.vertices, mesh.faces, np.where(height > middle, 1.0, 0.3))


SCENES: dict[str, Callable[[], Mesh]] = {
    "default": default_scene,
    "letters": letters,
    "sphere_before_plate": sphere_before_plate,
}
