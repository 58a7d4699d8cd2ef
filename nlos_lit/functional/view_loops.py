"""Loops over views from the wall: what :mod:`~nlos_lit.functional.surfel_visibility` says."""

from __future__ import annotations

import numpy as np

from nlos_lit.functional.compiled import loop


@loop
def pictures(
    wall, rows, drawn, code, looked, front, middle, normal, level, names, behind, by, clear, steps
) -> None:
    """Which patch hides which point of targets from each wall point.

    A picture is drawn, what is nearer over what is farther, and looked at.

    Args:
        wall: ``[W, 3]`` m, of one height.
        rows: ``[W]`` of ``by``.
        drawn: ``[2, 3, D]`` of the points of patches, see ``surfel_visibility._seen_from``.
        code: ``[D]`` their depths, in ``steps`` a metre, times ``steps``, and the numbers of their patches,
            in falling order.
        looked: ``[2, 3, P]`` of the points of targets.
        front: ``[P]`` their depths, times ``steps``.
        middle: ``[P, 3]`` m, of their targets.
        normal, level: ``[M, 3]`` and ``[M]`` of the patches' planes.
        names: ``[M]`` of the patches.
        behind: ``[V']`` of the targets in ``by``.
        by: ``[…, V, K]`` int32, set where something hides.
        clear: m behind a patch's plane up to which it hides nothing.
        steps: see ``code``.
    """
    u, v = np.empty(looked.shape[2], np.int32), np.empty(looked.shape[2], np.int32)
    a, b = np.empty(drawn.shape[2], np.int32), np.empty(drawn.shape[2], np.int32)
    eye, picture = np.empty(len(level), np.float32), np.empty(0, np.int32)
    for w in range(len(wall)):
        _columns_of(wall[w], looked, u, v)
        _columns_of(wall[w], drawn, a, b)
        # One pixel of a rim on either side takes what lies beside the targets' window.
        left, low = u.min() - 1, v.min() - 1
        wide, high = u.max() - left + 2, v.max() - low + 2
        if len(picture) < wide * high:
            picture = np.empty(wide * high, np.int32)
        picture[: wide * high] = -1
        for p in range(len(a)):
            picture[min(max(a[p] - left, 0), wide - 1) * high + min(max(b[p] - low, 0), high - 1)] = p
        for m in range(len(level)):
            eye[m] = (
                wall[w, 0] * normal[m, 0] + wall[w, 1] * normal[m, 1] + wall[w, 2] * normal[m, 2] - level[m]
            )
        each = by.shape[2]
        for p in range(len(u)):
            at = picture[(u[p] - left) * high + v[p] - low]
            if at >= 0 and code[at] < front[p]:
                m = code[at] % steps
                own = middle[p, 0] * normal[m, 0] + middle[p, 1] * normal[m, 1] + middle[p, 2] * normal[m, 2]
                own -= level[m]
                if own * eye[m] < 0 and abs(own) > clear:
                    by[rows[w], behind[p // each], p % each] = names[m]


@loop
def _columns_of(wall, seen, u, v) -> None:
    """Column and row of each of some points in the picture from a wall point."""
    x, y = -wall[0], -wall[1]
    for p in range(len(u)):
        u[p] = np.int32(np.floor(x * seen[0, 0, p] + seen[0, 1, p] + np.float32(0.5)))
        v[p] = np.int32(np.floor(y * seen[1, 0, p] + seen[1, 1, p] + np.float32(0.5)))
