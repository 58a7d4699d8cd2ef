"""Triangle meshes of bodies in their own coordinates: lathed, pulled out of a line, drawn with a pen.

Own coordinates are the world's with the body's centre at the origin: +y up, +z away from the wall. Closed
bodies have their normals outside; sheets look to the wall (-z).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from data_modules.simulate.mesh import Mesh, join
from nlos_lit.capture.errors import UserError

FEWEST_SEGMENTS = 24  # around a round body, however thin
MOST_STEPS = 2000  # along any line of a body


def steps(length: float, cell: float) -> int:
    """How many edges no longer than ``cell`` a length takes.

    Args:
        length: m.
        cell: m.

    Returns:
        1 or more.

    Raises:
        UserError: they are thousands.

    Examples:
        >>> steps(0.1, 0.03), steps(0.1, 1.0)
        (4, 1)
    """
    if length > MOST_STEPS * cell:
        raise UserError(
            f"cell={cell:g} cuts {length:g} m into {length / cell:.3g} pieces; {MOST_STEPS} are the most"
        )
    return max(1, int(np.ceil(length / cell - 1e-9)))


def arc(radius: float, start: float, stop: float, cell: float) -> np.ndarray:
    """Points on a circle about the origin.

    Args:
        radius: m.
        start: angle of the first point from the first axis towards the second, rad.
        stop: angle of the last point, rad.
        cell: longest edge, m.

    Returns:
        ``[N, 2]`` m, a point at least every 15°.

    Examples:
        >>> arc(2.0, 0.0, np.pi / 2, cell=10.0)[[0, -1]].round(9).tolist()
        [[2.0, 0.0], [0.0, 2.0]]
    """
    turn = abs(stop - start)
    n = max(steps(radius * turn, cell), int(np.ceil(turn / (2 * np.pi) * FEWEST_SEGMENTS - 1e-9)))
    angle = np.linspace(start, stop, n + 1)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def straight(corners: Sequence[Sequence[float]], cell: float) -> np.ndarray:
    """A line of straight pieces with points in between, so that what is made of it is not all splinters.

    Args:
        corners: ``[N, 2]`` m.
        cell: longest edge, m.

    Returns:
        ``[M, 2]`` m, the corners among them.

    Examples:
        >>> straight([[0.0, 0.0], [0.0, 1.0], [0.5, 1.0]], cell=0.5).tolist()
        [[0.0, 0.0], [0.0, 0.5], [0.0, 1.0], [0.5, 1.0]]
    """
    points = np.asarray(corners, dtype=np.float64)
    pieces = [
        np.linspace(start, end, steps(float(np.linalg.norm(end - start)), cell), endpoint=False)
        for start, end in pairwise(points)
    ]
    return np.concatenate([*pieces, points[-1:]])


def lathe(profile: np.ndarray, cell: float) -> Mesh:
    """The closed body that a profile sweeps when it is turned about the y axis.

    Args:
        profile: ``[N, 2]`` (distance from the axis, y), m. From the upper to the lower end on the axis, or
            a loop whose last point is its first, clockwise in (distance, y).
        cell: longest edge around the axis, m.

    Returns:
        a closed mesh, normals outside.

    Examples:
        Two cones, base to base, of radius 1 and height 1 each:

        >>> body = lathe(np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0]]), cell=0.05)
        >>> bool(np.isclose(body.volume, 2 * np.pi / 3, rtol=1e-3))
        True
    """
    radius, height = profile.T
    n = max(FEWEST_SEGMENTS, steps(2 * np.pi * radius.max(), cell))
    loop = bool(np.array_equal(profile[0], profile[-1]))
    # A point on the axis is one vertex; the others are a ring each.
    ring = np.where(radius > 0, n, 1)
    if loop:
        ring[-1] = 0
    first = np.cumsum(ring) - ring
    if loop:
        first[-1] = 0
    around = 2 * np.pi * np.arange(n) / n
    vertices = [
        np.stack([r * np.cos(around[:k]), np.full(k, h), r * np.sin(around[:k])], axis=1)
        for r, h, k in zip(radius, height, ring, strict=True)
    ]
    j = np.arange(n)
    index = first[:, None] + np.where(radius[:, None] > 0, j, 0)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    faces = np.stack([np.stack([a, c, b], axis=2), np.stack([a, d, c], axis=2)]).reshape(-1, 3)
    flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return Mesh(np.concatenate(vertices), faces[~flat], np.asarray(1.0))


def pulled(profile: np.ndarray, height: float, cell: float) -> Mesh:
    """The sheet that a line in the plane y = 0 sweeps when it is pulled along y.

    Args:
        profile: ``[N, 2]`` (x, z), m; a line along +x looks to the wall.
        height: extent along y, m, half of it on either side.
        cell: longest edge along y, m.

    Returns:
        a sheet, open at its rim.

    Examples:
        >>> sheet = pulled(np.array([[-0.5, 0.0], [0.5, 0.0]]), height=2.0, cell=2.0)
        >>> sheet.area, sheet.face_vectors.sum(axis=0).tolist()
        (2.0, [0.0, 0.0, -2.0])
    """
    rows, n = steps(height, cell), len(profile)
    y = np.linspace(-height / 2, height / 2, rows + 1)
    x, z = (np.broadcast_to(p, (rows + 1, n)) for p in profile.T)
    vertices = np.stack([x, np.broadcast_to(y[:, None], x.shape), z], axis=2).reshape(-1, 3)
    a = (n * np.arange(rows)[:, None] + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], axis=1), np.stack([a, a + n + 1, a + 1], axis=1)])
    return Mesh(vertices, faces, np.asarray(1.0))


def split(mesh: Mesh, value: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Cut faces where a function that is linear over each of them is zero.

    Args:
        mesh: any mesh.
        value: ``[V]`` the function at its vertices.

    Returns:
        the same surface, with vertices where edges cross zero, shared by neighbours; and ``[F]`` the side of
        each face, -1 or 1 (-1 where the function is zero on the whole face).

    Examples:
        >>> square = pulled(np.array([[-0.5, 0.0], [0.5, 0.0]]), height=1.0, cell=1.0)
        >>> halves, side = split(square, square.vertices[:, 0] - 0.25)
        >>> [round(float(np.linalg.norm(halves.face_vectors[side == s], axis=1).sum()), 9) for s in (-1, 1)]
        [0.75, 0.25]
    """
    sign = np.sign(np.where(np.abs(value) < 1e-9 * np.abs(value).max(), 0.0, value)).astype(int)
    faces, n = mesh.faces, len(mesh.vertices)
    at = sign[faces]
    crossed = (at.min(axis=1) < 0) & (at.max(axis=1) > 0)
    whole = faces[~crossed]
    whole_side = np.where(at[~crossed].max(axis=1) > 0, 1, -1)
    if not crossed.any():
        return mesh, whole_side
    # One corner is apart from the other two: it is on zero, or alone on its side.
    cut, at = faces[crossed], at[crossed]
    has_zero = (at == 0).any(axis=1)
    apart = np.where(
        has_zero, (at == 0).argmax(axis=1), (at == -np.sign(at.sum(axis=1))[:, None]).argmax(axis=1)
    )
    order = (apart[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(cut, order, axis=1).T
    a0, b0, c0 = (v[has_zero] for v in (a, b, c))
    a1, b1, c1 = (v[~has_zero] for v in (a, b, c))
    low = np.concatenate([np.minimum(b0, c0), np.minimum(a1, b1), np.minimum(c1, a1)])
    high = np.concatenate([np.maximum(b0, c0), np.maximum(a1, b1), np.maximum(c1, a1)])
    key, shared = np.unique(low * n + high, return_inverse=True)
    low, high = np.divmod(key, n)
    at_high = (value[low] / (value[low] - value[high]))[:, None]
    p0, p, q = np.split(n + shared, [len(a0), len(a0) + len(a1)])

    def between(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[low] + at_high * (values[high] - values[low])])

    parts = [(a0, b0, p0, b0), (a0, p0, c0, c0), (a1, p, q, a1), (p, b1, c1, b1), (p, c1, q, c1)]
    faces = np.concatenate([whole, *(np.stack(part[:3], axis=1) for part in parts)])
    side = np.concatenate([whole_side, *(sign[part[3]] for part in parts)])
    return Mesh(between(mesh.vertices), faces, between(mesh.albedo[:, None])[:, 0]), side


def pen(lines: Sequence[np.ndarray], width: float, cell: float) -> Mesh:
    """A flat sheet in the shape of lines drawn with a round pen.

    Args:
        lines: polylines ``[N, 2]`` of (x, y), m; one of a single point is a dot.
        width: of the pen, m.
        cell: edge of the grid from which the shape is cut, m; its outline is exact to the square of
            it, save at inner corners.

    Returns:
        a sheet in the plane z = 0.

    Examples:
        A line of length 0.4 with round ends:

        >>> sheet = pen([np.array([[0.0, 0.0], [0.4, 0.0]])], width=0.2, cell=0.01)
        >>> bool(np.isclose(sheet.area, 0.4 * 0.2 + np.pi * 0.1**2, rtol=2e-3))
        True
    """
    ends = np.concatenate(lines)
    low = ends.min(axis=0) - width / 2 - 1.5 * cell
    shape = [steps(length, cell) + 1 for length in ends.max(axis=0) + width / 2 + 1.5 * cell - low]
    i, j = (n.ravel() for n in np.meshgrid(*map(np.arange, shape), indexing="ij"))
    points = low + cell * np.stack([i, j], axis=1)
    distance = np.full(len(points), np.inf)
    for line in lines:
        for start, end in zip(line, line[1:] if len(line) > 1 else line, strict=False):
            along = end - start
            share = ((points - start) @ along / max(along @ along, 1e-300)).clip(0, 1)
            distance = np.minimum(distance, np.linalg.norm(points - start - share[:, None] * along, axis=1))
    corner = ((i < shape[0] - 1) & (j < shape[1] - 1)).nonzero()[0]
    right, up = corner + shape[1], corner + 1
    faces = np.concatenate(
        [np.stack([corner, up, up + shape[1]], axis=1), np.stack([corner, up + shape[1], right], axis=1)]
    )
    flat = Mesh(np.c_[points, np.zeros(len(points))], faces, np.asarray(1.0))
    whole, side = split(flat, distance - width / 2)
    used, inside = np.unique(whole.faces[side < 0], return_inverse=True)
    return Mesh(whole.vertices[used], inside.reshape(-1, 3), np.asarray(1.0))


def thickened(sheet: Mesh, depth: float) -> Mesh:
    """A flat sheet made into a slab.

    Args:
        sheet: in the plane z = 0, looking to the wall.
        depth: thickness along z, m, half of it on either side.

    Returns:
        a closed mesh, normals outside.

    Examples:
        >>> slab = thickened(pulled(np.array([[-0.5, 0.0], [0.5, 0.0]]), height=1.0, cell=1.0), 0.5)
        >>> slab.area, round(slab.volume, 9)
        (4.0, 0.5)
    """
    n = len(sheet.vertices)
    offset = np.array([0.0, 0.0, depth / 2])
    edges = np.concatenate([sheet.faces[:, [0, 1]], sheet.faces[:, [1, 2]], sheet.faces[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    a, b = edges[first[count == 1]].T
    walls = np.concatenate([np.stack([b, a, a + n], axis=1), np.stack([b, a + n, b + n], axis=1)])
    return Mesh(
        np.concatenate([sheet.vertices - offset, sheet.vertices + offset]),
        np.concatenate([sheet.faces, sheet.faces[:, ::-1] + n, walls]),
        np.asarray(1.0),
    )


def capsule_profile(radius: float, length: float, cell: float) -> np.ndarray:
    """Outline of a capsule about the y axis, for `lathe`.

    Args:
        radius: m.
        length: of the cylinder between the two half spheres, m; 0 is a sphere.
        cell: longest edge, m.

    Returns:
        ``[N, 2]`` (distance from the axis, y), m.

    Examples:
        >>> capsule_profile(1.0, 2.0, cell=2.0)[[0, 6, 7, -1]].round(9).tolist()
        [[0.0, 2.0], [1.0, 1.0], [1.0, -1.0], [0.0, -2.0]]
    """
    quarter = arc(radius, np.pi / 2, 0, cell)
    quarter[0, 0] = 0.0
    half = np.array([0.0, length / 2])
    upper, lower = quarter + half, quarter[::-1] * [1, -1] - half
    middle = straight([upper[-1], lower[0]], cell)[1:-1] if length else upper[:0]
    return np.concatenate([upper, middle, lower if length else lower[1:]])


def limb(start: ArrayLike, end: ArrayLike, radius: float, cell: float) -> Mesh:
    """A capsule between two points.

    Args:
        start: (x, y, z) of the middle of one half sphere, m.
        end: of the other, m.
        radius: m.
        cell: longest edge, m.

    Returns:
        a closed mesh, normals outside.

    Examples:
        >>> arm = limb((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), radius=0.1, cell=0.02)
        >>> arm.vertices.max(axis=0).round(3).tolist()
        [0.4, 0.1, 0.1]
    """
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    upright = lathe(capsule_profile(radius, length, cell), cell)
    up = along / length
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    axes = np.stack([side, up, np.cross(side, up)])
    middle = np.add(start, end) / 2
    return Mesh(upright.vertices @ axes + middle, upright.faces, np.asarray(1.0))


def person(height: float, arms: float, stride: float, cell: float) -> Mesh:
    """A figure of capsules and a sphere that touch and enter one another.

    Args:
        height: from the soles to the top of the head, m.
        arms: angle of the arms from hanging down, rad.
        stride: angle between the legs, to the sides, rad.
        cell: longest edge, m.

    Returns:
        seven closed parts in one mesh: head, trunk, shoulders, arms and legs.

    Examples:
        >>> figure = person(1.8, arms=0.5, stride=0.3, cell=0.05)
        >>> round(float(figure.vertices[:, 1].max()), 9)
        0.9
    """
    h = height
    sole = 0.04 * h  # radius of the legs
    hip, shoulder, head = -0.03 * h, 0.28 * h, 0.42 * h
    parts = [
        lathe(capsule_profile(0.08 * h, 0.0, cell), cell).moved((0.0, head, 0.0)),
        limb((0, hip + 0.02 * h, 0), (0, shoulder - 0.03 * h, 0), 0.095 * h, cell),
        limb((-0.11 * h, shoulder, 0), (0.11 * h, shoulder, 0), 0.055 * h, cell),
    ]
    for side in (-1, 1):
        hand = 0.34 * h * np.array([side * np.sin(arms), -np.cos(arms), 0])
        joint = np.array([side * 0.13 * h, shoulder, 0])
        parts.append(limb(joint, joint + hand, 0.035 * h, cell))
        leg = (0.5 * h + hip - sole) / np.cos(stride / 2)
        top = np.array([side * 0.05 * h, hip, 0])
        foot = top + leg * np.array([side * np.sin(stride / 2), -np.cos(stride / 2), 0])
        parts.append(limb(top, foot, sole, cell))
    return join(*parts)
