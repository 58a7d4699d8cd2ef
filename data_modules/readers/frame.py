"""Files that say where their wall is, in a frame of their own: from there to the world frame."""

from __future__ import annotations

import numpy as np

from nlos_lit.capture.errors import CaptureError


def wall_rotation(normals: np.ndarray) -> np.ndarray:
    """``[3, 3]`` proper rotation that turns the mean wall normal to +z and keeps the file's vertical up.

    The vertical is the file's y, or its z where the wall's normal runs along y. The identity for a normal
    along +z.
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
    """``[S]`` distances of wall points from the laser or detector, m."""
    return np.linalg.norm(points - device, axis=-1)
