"""Files that say where their wall is, in a frame of their own: from there to the world frame."""

from __future__ import annotations

import numpy as np

from nlos_lit.capture.errors import CaptureError


def wall_rotation(normals: np.ndarray) -> np.ndarray:
    """The rotation that turns the mean wall normal to +z and keeps the file's vertical up.

    The vertical is the file's y, or its z where the wall's normal runs along y.

    Args:
        normals: ``[.., 3]`` wall normals in the file's frame, towards the hidden scene.

    Returns:
        ``[3, 3]`` proper rotation, for column vectors; the identity for a normal along +z.

    Raises:
        CaptureError: the normals cancel or are missing.

    Examples:
        A wall that faces -y, with z up:

        >>> turn = wall_rotation(np.array([[0.0, -1.0, 0.0]]))
        >>> (turn @ [0.0, -1.0, 0.0]).round(9).tolist(), (turn @ [0.0, 0.0, 1.0]).round(9).tolist()
        ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    """
    mean = normals.reshape(-1, 3).astype(np.float64).mean(axis=0)
    length = np.linalg.norm(mean)
    if not length > 0.1:
        raise CaptureError(
            "the wall's normals cancel or are missing; they must point from the wall to the hidden scene"
        )
    forward = mean / length
    if forward[2] > 1 - 1e-9:
        return np.eye(3)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[1]) > 0.7 else np.array([0.0, 1.0, 0.0])
    x = np.cross(up, forward)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(forward, x), forward])


def device_distances(device: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances of wall points from the laser or detector.

    Args:
        device: ``[3]`` its place, m.
        points: ``[S, 3]`` wall points in the same frame, m.

    Returns:
        ``[S]``, m.

    Examples:
        >>> device_distances(np.array([0.0, 0.0, 4.0]), np.array([[0.0, 3.0, 0.0]])).tolist()
        [5.0]
    """
    return np.linalg.norm(points - device, axis=-1)
