"""Loops over surfels and pairs of neighbours: what :mod:`~nlos_lit.functional.surfel_graph` says, and the
patches of :mod:`~nlos_lit.functional.surfel_paths`. Pairs are two arrays ``i`` and ``j`` of indices.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nlos_lit.functional.compiled import inlined, loop

SLIGHT = np.float32(1e-12)
ONE, TWO, HALF, ZERO = (np.float32(x) for x in (1, 2, 0.5, 0))


@loop
def carried(i, j, mean, own, shift, times) -> Any:
    """Averages of averages over neighbours. With i and j exchanged it is its own transpose.

    Args:
        i, j: ``[P]`` pairs of neighbours.
        mean, own: ``[P]`` shares of j in the average about i, and ``[M]`` of i itself.
        shift: ``[M]``.
        times: how often.

    Returns:
        ``[M]``.
    """
    for _ in range(times):
        now = own * shift
        for p in range(len(i)):
            now[i[p]] += mean[p] * shift[j[p]]
        shift = now
    return shift


@inlined
def _away(c, a, b):
    return c[b, 0] - c[a, 0], c[b, 1] - c[a, 1], c[b, 2] - c[a, 2]


@loop
def _leaning(normal, first, second, slope, facing, length) -> None:
    for m in range(len(normal)):
        x, y, z = (
            normal[m, 0] - slope[m, 0] * first[m, 0] - slope[m, 1] * second[m, 0],
            normal[m, 1] - slope[m, 0] * first[m, 1] - slope[m, 1] * second[m, 1],
            normal[m, 2] - slope[m, 0] * first[m, 2] - slope[m, 1] * second[m, 2],
        )
        length[m] = max(np.sqrt(x * x + y * y + z * z), SLIGHT)
        facing[m, 0], facing[m, 1], facing[m, 2] = x / length[m], y / length[m], z / length[m]


@loop
def _pull_leaning(first, second, facing, length, grad, of_slope) -> None:
    for m in range(len(first)):
        along = facing[m, 0] * grad[m, 0] + facing[m, 1] * grad[m, 1] + facing[m, 2] * grad[m, 2]
        for k in range(3):
            left = (grad[m, k] - facing[m, k] * along) / length[m]
            of_slope[m, 0] -= left * first[m, k]
            of_slope[m, 1] -= left * second[m, k]


@loop
def normals(i, j, centre, normal, first, second, share, rest, bow, rim) -> Any:
    """Normals of a sheet, see :func:`~nlos_lit.functional.surfel_graph.sheet_normals`.

    Args:
        i, j: ``[P]`` pairs of neighbours.
        centre: ``[M, 3]`` m, where surfels are now.
        normal, first, second, share, rest, bow: of the sheet.
        rim: ``[M]`` how much of their neighbours surfels lack.

    Returns:
        ``[M, 3]`` normals, ``[M, 3]`` those of the planes that were laid first, and ``[M]`` the lengths of
        these and of those before they were normalised.
    """
    m = len(normal)
    slope, plane, facing = (
        np.zeros((m, 2), np.float32),
        np.empty((m, 3), np.float32),
        np.empty((m, 3), np.float32),
    )
    length, length2 = np.empty(m, np.float32), np.empty(m, np.float32)
    for p in range(len(i)):
        a = i[p]
        dx, dy, dz = _away(centre, a, j[p])
        height = dx * normal[a, 0] + dy * normal[a, 1] + dz * normal[a, 2] - rest[p]
        slope[a, 0] += share[p, 0] * height
        slope[a, 1] += share[p, 1] * height
    _leaning(normal, first, second, slope, plane, length)
    for p in range(len(i)):
        a, b = i[p], j[p]
        dx, dy, dz = _away(centre, a, b)
        tx, ty, tz = _away(plane, a, b)
        more = rim[a] * ((tx * dx + ty * dy + tz * dz) * HALF - bow[p])
        slope[a, 0] += share[p, 0] * more
        slope[a, 1] += share[p, 1] * more
    _leaning(normal, first, second, slope, facing, length2)
    return facing, plane, length, length2


@loop
def pull_normals(
    i, j, centre, normal, first, second, share, rim, facing, plane, length, length2, grad
) -> Any:
    """Gradient of :func:`normals`.

    Args:
        i, j: ``[P]`` pairs of neighbours.
        centre, normal, first, second, share, rim: as there.
        facing, plane, length, length2: what it gives.
        grad: ``[M, 3]`` of the normals.

    Returns:
        ``[M, 3]`` of the places.
    """
    of_slope, of_plane, of_centre = (
        np.zeros((len(normal), 2), np.float32),
        np.zeros_like(normal),
        np.zeros_like(normal),
    )
    _pull_leaning(first, second, facing, length2, grad, of_slope)
    for p in range(len(i)):
        a, b = i[p], j[p]
        g = rim[a] * (share[p, 0] * of_slope[a, 0] + share[p, 1] * of_slope[a, 1]) * HALF
        for k in range(3):
            d, turn = centre[b, k] - centre[a, k], plane[b, k] - plane[a, k]
            of_plane[b, k] += g * d
            of_plane[a, k] -= g * d
            of_centre[b, k] += g * turn
            of_centre[a, k] -= g * turn
    _pull_leaning(first, second, plane, length, of_plane, of_slope)
    for p in range(len(i)):
        a, b = i[p], j[p]
        g = share[p, 0] * of_slope[a, 0] + share[p, 1] * of_slope[a, 1]
        for k in range(3):
            of_centre[b, k] += g * normal[a, k]
            of_centre[a, k] -= g * normal[a, k]
    return of_centre


@loop
def bending(i, j, centre, normal, weight, bend, stiffness) -> Any:
    """Cost of bends, see :func:`~nlos_lit.functional.surfel_graph.bending`, with its gradients.

    Args:
        i, j: ``[P]`` pairs of neighbours.
        centre, normal: ``[M, 3]`` m, and unit.
        weight: ``[M]`` trust.
        bend, stiffness: constants of the cost.

    Returns:
        nats, and ``[M, 3]`` gradients by places and by normals.
    """
    total, of_centre, of_normal = 0.0, np.zeros_like(centre), np.zeros_like(normal)
    for p in range(len(i)):
        a, b = i[p], j[p]
        dx, dy, dz = _away(centre, a, b)
        tx, ty, tz = _away(normal, a, b)
        mx, my, mz = normal[a, 0] + tx * HALF, normal[a, 1] + ty * HALF, normal[a, 2] + tz * HALF
        square = max(dx * dx + dy * dy + dz * dz, SLIGHT)
        out = mx * dx + my * dy + mz * dz
        misfit = out * out / square + stiffness * (tx * tx + ty * ty + tz * tz) / 4
        trust = weight[a] * weight[b]
        total += trust * np.log1p(misfit / bend**2) / 2
        g = np.float32(trust / (bend**2 + misfit) / 2)
        along, apart = TWO * g * out / square, -TWO * g * (out / square) ** 2
        turn = g * np.float32(stiffness) * HALF
        for k in range(3):
            d, t = centre[b, k] - centre[a, k], normal[b, k] - normal[a, k]
            of_d = along * (normal[a, k] + t * HALF) + apart * d
            of_centre[b, k] += of_d
            of_centre[a, k] -= of_d
            of_normal[a, k] += along * d * HALF - turn * t
            of_normal[b, k] += along * d * HALF + turn * t
    return total, of_centre, of_normal


@loop
def albedo_costs(i, j, albedo, level, evenness, bright, there, edge, alike, deviation, least) -> Any:
    """What albedos cost, see :func:`~nlos_lit.functional.surfel_graph.albedo_cost`, and the gradient.

    Args:
        i, j: ``[P]`` pairs of neighbours.
        albedo: ``[M]``.
        level: of the scene.
        evenness, bright, there: weights.
        edge, alike, deviation, least: constants of the costs.

    Returns:
        nats, and ``[M]`` the gradient.
    """
    total, of_albedo = 0.0, np.zeros_like(albedo)
    for p in range(len(i)):
        step = (albedo[i[p]] - albedo[j[p]]) / level
        root = np.sqrt(step * step + alike * alike)
        size = root - alike
        total += evenness * edge * np.log1p(size / edge) / 2
        g = evenness * edge / (edge + size) * step / root / level / 2
        of_albedo[i[p]] += g
        of_albedo[j[p]] -= g
    for m in range(len(albedo)):
        over = np.log(max(albedo[m] / level, 1.0)) / deviation
        total += bright * over * over / 2
        half = albedo[m] + least * level
        total += there * albedo[m] / half
        of_albedo[m] += there * least * level / half**2
        if over > 0:
            of_albedo[m] += bright * over / deviation / albedo[m]
    return total, of_albedo


@loop
def patches(normal, curvature, cell, offsets, steep, place, facing, share) -> None:
    """Points of patches, see :func:`~nlos_lit.functional.surfel_paths.patches`.

    Args:
        normal: ``[M, 3]`` unit.
        curvature: ``[M, 3, 3]`` 1/m, symmetric; ``[0, 3, 3]`` where patches are flat.
        cell: ``[2]`` lateral extents, m.
        offsets: ``[Q, 2]`` in cells.
        steep: cosine up to which a patch covers its cell.
        place, facing, share: ``[M, Q, 3]`` places and normals, ``[M, Q]`` areas, set.
    """
    curved = len(curvature) > 0
    for m in range(len(normal)):
        nx, ny, nz = normal[m, 0], normal[m, 1], normal[m, 2]
        stretch = ONE / max(-nz, steep)
        shrink = (-stretch * nz - ONE) / max(nx * nx + ny * ny, np.float32(1e-3))
        whole = cell[0] * cell[1] * stretch / np.float32(len(offsets))
        for q in range(len(offsets)):
            sx, sy = offsets[q, 0] * cell[0], offsets[q, 1] * cell[1]
            along = nx * sx + ny * sy
            x, y, z = sx + shrink * along * nx, sy + shrink * along * ny, stretch * along
            share[m, q] = whole
            fx, fy, fz, fallen = nx, ny, nz, ZERO
            if curved:
                c = curvature[m]
                tx = c[0, 0] * x + c[0, 1] * y + c[0, 2] * z
                ty = c[1, 0] * x + c[1, 1] * y + c[1, 2] * z
                tz = c[2, 0] * x + c[2, 1] * y + c[2, 2] * z
                fallen = (x * tx + y * ty + z * tz) * HALF
                fx, fy, fz = nx + tx, ny + ty, nz + tz
                length = max(np.sqrt(fx * fx + fy * fy + fz * fz), SLIGHT)
                fx, fy, fz = fx / length, fy / length, fz / length
                share[m, q] = whole * max(-nz, steep) / max(-fz, steep)
            place[m, q, 0], place[m, q, 1], place[m, q, 2] = x - fallen * nx, y - fallen * ny, z - fallen * nz
            facing[m, q, 0], facing[m, q, 1], facing[m, q, 2] = fx, fy, fz


@loop
def pull_patches(normal, curvature, cell, offsets, steep, of_place, of_facing, of_share) -> Any:
    """Gradient of :func:`patches`; curvature stands still.

    Args:
        normal, curvature, cell, offsets, steep: as there.
        of_place, of_facing, of_share: gradients of what it gives.

    Returns:
        ``[M, 3]`` of the normals.
    """
    found, curved = np.empty_like(normal), len(curvature) > 0
    for m in range(len(normal)):
        nx, ny, nz = normal[m, 0], normal[m, 1], normal[m, 2]
        upright, across = max(-nz, steep), max(nx * nx + ny * ny, np.float32(1e-3))
        stretch = ONE / upright
        shrink = (-stretch * nz - ONE) / across
        whole = cell[0] * cell[1] / np.float32(len(offsets))
        of_x, of_y, of_z, of_stretch, of_shrink = ZERO, ZERO, ZERO, ZERO, ZERO
        for q in range(len(offsets)):
            sx, sy = offsets[q, 0] * cell[0], offsets[q, 1] * cell[1]
            along = nx * sx + ny * sy
            x, y, z = sx + shrink * along * nx, sy + shrink * along * ny, stretch * along
            gx, gy, gz = of_place[m, q, 0], of_place[m, q, 1], of_place[m, q, 2]
            hx, hy, hz = of_facing[m, q, 0], of_facing[m, q, 1], of_facing[m, q, 2]
            g = of_share[m, q] * whole
            if not curved:
                of_x, of_y, of_z = of_x + hx, of_y + hy, of_z + hz
                of_stretch += g
            else:
                c = curvature[m]
                tx = c[0, 0] * x + c[0, 1] * y + c[0, 2] * z
                ty = c[1, 0] * x + c[1, 1] * y + c[1, 2] * z
                tz = c[2, 0] * x + c[2, 1] * y + c[2, 2] * z
                fallen = (x * tx + y * ty + z * tz) * HALF
                fx, fy, fz = nx + tx, ny + ty, nz + tz
                length = max(np.sqrt(fx * fx + fy * fy + fz * fz), SLIGHT)
                fx, fy, fz = fx / length, fy / length, fz / length
                # share = whole / max(-fz, steep): stretch and upright cancel
                if -fz > steep:
                    hz += g / (fz * fz)
                out = fx * hx + fy * hy + fz * hz
                hx, hy, hz = (hx - fx * out) / length, (hy - fy * out) / length, (hz - fz * out) / length
                of_fallen = -(gx * nx + gy * ny + gz * nz)
                of_x += hx - fallen * gx
                of_y += hy - fallen * gy
                of_z += hz - fallen * gz
                hx, hy, hz = hx + of_fallen * x, hy + of_fallen * y, hz + of_fallen * z
                gx += c[0, 0] * hx + c[1, 0] * hy + c[2, 0] * hz
                gy += c[0, 1] * hx + c[1, 1] * hy + c[2, 1] * hz
                gz += c[0, 2] * hx + c[1, 2] * hy + c[2, 2] * hz
            lateral = gx * nx + gy * ny
            of_along = shrink * lateral + stretch * gz
            of_shrink += along * lateral
            of_stretch += along * gz
            of_x += shrink * along * gx + of_along * sx
            of_y += shrink * along * gy + of_along * sy
        # shrink = (stretch upright - 1) / across, where upright is what -nz is, and stretch its inverse
        of_stretch -= of_shrink * nz / across
        of_z -= of_shrink * stretch / across
        if nx * nx + ny * ny > np.float32(1e-3):
            of_across = -of_shrink * shrink / across
            of_x += TWO * of_across * nx
            of_y += TWO * of_across * ny
        if -nz > steep:
            of_z += of_stretch * stretch * stretch
        found[m, 0], found[m, 1], found[m, 2] = of_x, of_y, of_z
    return found
