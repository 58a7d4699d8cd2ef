"""Third-bounce transients of a triangle mesh, as expected values.

Radiance leaving the wall at the sensor's point per unit laser power at the laser's point, integrated over
each time bin:

    H = Σ_patches A ρ_w² ρ_p / π³ · cosθ_l cosθ_p1 cosθ_p2 cosθ_s / (d1² d2²) · V(l, p) V(p, s)        at path
    d1 + d2

(three Lambertian reflections: wall, patch, wall). The mesh is split into patches that are small against their
distance and over which the path length is linear to a fraction of a bin. Each patch's energy is then spread
over its path lengths as a linear path length over a triangle spreads it: its density is a triangle from the
nearest to the farthest corner with its peak at the middle one. So a patch may cover several bins, energy is
conserved and bins do not ripple.

Nothing here is shared with the renderer that is fitted to captures.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from rich.progress import track

from data_modules.simulate.mesh import Mesh, subdivide
from data_modules.simulate.visibility import Occluder
from nlos_lit.capture.errors import CaptureError, MemoryBudgetError, UserError

log = logging.getLogger(__name__)

BLOCK_PAIRS = 1 << 18  # (spot, patch) pairs at a time: a few MB an array, so that they stay in the cache
TABLE_BYTES = 1 << 28  # legs kept for wall points that several spots share (exhaustive scans)
PAIRS_PER_SECOND = 4e6  # on one ordinary core; only to say how long a run will take
LONG_SECONDS = 5.0  # above this a progress bar is shown


@dataclass(frozen=True)
class Work:
    """What a simulation costs.

    Args:
        patches: faces after splitting.
        pairs: of spot and patch.
        seconds: rough, on one ordinary core.
        bytes: at the peak.
        keep_legs: the legs of all wall points are computed once, because spots share them (exhaustive scans).
    """

    patches: int
    pairs: int
    seconds: float
    bytes: int
    keep_legs: bool


class Patches:
    """A mesh split so finely that each face can be treated as one patch.

    Args:
        mesh: the hidden scene.
        wall: ``[N, 3]`` wall points, for the distances.
        bin_length: optical path of one bin, m.
        detail: 2 halves all edge lengths.
    """

    def __init__(self, mesh: Mesh, wall: np.ndarray, bin_length: float, detail: float) -> None:
        low, high = wall.min(axis=0), wall.max(axis=0)

        def longest_edge(centroids: np.ndarray) -> np.ndarray:
            nearest = np.linalg.norm(centroids - np.clip(centroids, low, high), axis=1)
            # Path length bends by e²/(4 d) over an edge e: keep that below a tenth of a bin.
            return (
                np.minimum(0.025 * nearest, np.sqrt(0.4 * bin_length * nearest)).clip(1e-4 * self.scale)
                / detail
            )

        self.scale = float(np.ptp(mesh.vertices, axis=0).max())
        self.mesh = split = subdivide(mesh, longest_edge)
        self.occluder = Occluder(mesh)
        vectors = split.face_vectors
        self.area = np.linalg.norm(vectors, axis=1)
        self.normal = vectors / self.area[:, None]
        self.centroid = split.corners.mean(axis=1)
        self.albedo = split.albedo[split.faces].mean(axis=1)
        # Rays start off the surface by a little of the patch's own size, but by no less than single precision
        # resolves.
        lift = np.maximum(
            1e-3 * np.sqrt(self.area), 2e-6 * max(self.scale, float(np.abs(mesh.vertices).max()))
        )
        offset = lift[:, None] * self.normal
        self.front, self.back = ((self.centroid + side * offset).astype(np.float32) for side in (1, -1))

    def __len__(self) -> int:
        return len(self.area)

    def legs(
        self, points: np.ndarray, normals: np.ndarray, two_sided: bool, occlusion: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """One leg of the path: from wall points to all patches.

        Args:
            points: ``[U, 3]`` wall points, m.
            normals: ``[U, 3]`` unit wall normals there.
            two_sided: faces reflect from both sides.
            occlusion: faces hide what is behind them.

        Returns:
            signed factor cosθ_wall cosθ_patch / d² of every patch ``[U, P]``, 1/m², zero where unlit and
            negative where the patch is reached from behind; distance to every vertex ``[U, V]``, m.
        """
        distance = np.sqrt(_squared_distance(points, self.mesh.vertices))
        at_wall = _dots(normals, self.centroid) - (normals * points).sum(axis=1)[:, None]
        at_patch = _dots(points, self.normal) - (self.normal * self.centroid).sum(axis=1)
        row, patch = np.nonzero((at_wall > 0) & ((at_patch != 0) if two_sided else (at_patch > 0)))
        product = at_wall[row, patch] * at_patch[row, patch]
        if occlusion:
            clear = ~self.occluder.blocked(
                np.where((product > 0)[:, None], self.front[patch], self.back[patch]), points[row]
            )
            row, patch, product = row[clear], patch[clear], product[clear]
        factor = np.zeros(at_wall.shape)
        factor[row, patch] = product / _squared_distance(points, self.centroid)[row, patch] ** 2
        return factor, distance


def simulate_transients(
    mesh: Mesh,
    laser: np.ndarray,
    sensor: np.ndarray,
    laser_normal: np.ndarray,
    sensor_normal: np.ndarray,
    *,
    bin_length: float,
    n_bins: int,
    t_start: float = 0.0,
    wall_albedo: float = 1.0,
    two_sided: bool = False,
    occlusion: bool = True,
    detail: float = 1.0,
    progress: bool = False,
) -> np.ndarray:
    """Expected third-bounce transients ``[S, T]`` of a mesh, without sensor, background or photon statistics.

    Args:
        mesh: the hidden scene.
        laser: ``[S, 3]`` lit wall points, m.
        sensor: ``[S, 3]`` observed wall points, m.
        laser_normal: ``[S, 3]`` unit wall normals at ``laser``, towards the hidden scene.
        sensor_normal: ``[S, 3]`` the same at ``sensor``.
        bin_length: optical path of one bin, m.
        n_bins: number of bins T.
        t_start: path length at which bin 0 begins, m.
        wall_albedo: reflectance of the wall.
        two_sided: faces reflect from both sides; otherwise only from the one their normal points to, and the
            other is black.
        occlusion: faces hide what is behind them.
        detail: 2 halves the patches' edges (four times the work).
        progress: show a progress bar when it takes more than a few seconds.

    Returns:
        radiance per bin and unit laser power, 1/(m² sr); energy outside the bins is dropped.

    Raises:
        UserError: no face is turned towards any wall point, or the shapes or numbers make no sense.
        MemoryBudgetError: the result and its work space do not fit this machine's free memory.
    """
    histogram = simulate_with_rest(
        mesh,
        laser,
        sensor,
        laser_normal,
        sensor_normal,
        bin_length=bin_length,
        n_bins=n_bins,
        t_start=t_start,
        wall_albedo=wall_albedo,
        two_sided=two_sided,
        occlusion=occlusion,
        detail=detail,
        progress=progress,
    )
    return histogram[:, 1:-1]


def simulate_with_rest(
    mesh: Mesh,
    laser: np.ndarray,
    sensor: np.ndarray,
    laser_normal: np.ndarray,
    sensor_normal: np.ndarray,
    *,
    bin_length: float,
    n_bins: int,
    t_start: float = 0.0,
    wall_albedo: float = 1.0,
    two_sided: bool = False,
    occlusion: bool = True,
    detail: float = 1.0,
    progress: bool = False,
) -> np.ndarray:
    """As `simulate_transients`, with what falls before and after the bins.

    Args:
        mesh: the hidden scene.
        laser: ``[S, 3]`` lit wall points, m.
        sensor: ``[S, 3]`` observed wall points, m.
        laser_normal: ``[S, 3]`` unit wall normals at ``laser``.
        sensor_normal: ``[S, 3]`` the same at ``sensor``.
        bin_length: optical path of one bin, m.
        n_bins: number of bins T.
        t_start: path length at which bin 0 begins, m.
        wall_albedo: reflectance of the wall.
        two_sided: faces reflect from both sides.
        occlusion: faces hide what is behind them.
        detail: 2 halves the patches' edges.
        progress: show a progress bar when it takes more than a few seconds.

    Returns:
        ``[S, T + 2]`` radiance per bin and unit laser power, 1/(m² sr); the first column holds what falls
        before the bins, the last what falls after them.

    Raises:
        CaptureError: points and normals are not ``[S, 3]`` each.
        UserError: a number that must be positive is not, or no face is seen from any wall point.
        MemoryBudgetError: it does not fit this machine's free memory.
    """
    laser, sensor, laser_normal, sensor_normal = (
        np.asarray(a, dtype=np.float64) for a in (laser, sensor, laser_normal, sensor_normal)
    )
    for name, value in {
        "sensor": sensor,
        "laser_normal": laser_normal,
        "sensor_normal": sensor_normal,
    }.items():
        if laser.ndim != 2 or laser.shape[1] != 3 or value.shape != laser.shape:
            raise CaptureError(f"laser and {name} must both be [S, 3]; found {laser.shape} and {value.shape}")
    if not (bin_length > 0 and n_bins > 0 and detail > 0):
        raise UserError(
            f"bin_length, n_bins and detail must be positive; found {bin_length}, {n_bins} and {detail}"
        )
    ends = np.concatenate([np.c_[laser, laser_normal], np.c_[sensor, sensor_normal]])
    points, rows = np.unique(ends, axis=0, return_inverse=True)
    laser_row, sensor_row = rows.reshape(2, -1)
    patches = Patches(mesh, points[:, :3], bin_length, detail)
    cost = _work(patches, len(laser), len(points), n_bins)
    _check_memory(cost)
    log.info(
        "simulating %d spots × %d patches, about %.0f s, %.1f GiB",
        len(laser),
        cost.patches,
        cost.seconds,
        cost.bytes / 2**30,
    )

    def legs(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return patches.legs(points[index, :3], points[index, 3:], two_sided, occlusion)

    table = legs(np.arange(len(points))) if cost.keep_legs else None
    weight = patches.area * patches.albedo * (wall_albedo**2 / np.pi**3)
    size = max(1, BLOCK_PAIRS // len(patches))
    starts = range(0, len(laser), size)
    histogram = np.empty((len(laser), n_bins + 2))
    bar = track(
        starts, f"transients of {len(patches)} patches", disable=not progress or cost.seconds < LONG_SECONDS
    )
    for start in bar:
        block = slice(start, start + size)
        if table is None:
            used, local = np.unique(
                np.concatenate([laser_row[block], sensor_row[block]]), return_inverse=True
            )
            factor, distance = legs(used)
            l, s = local.reshape(2, -1)
        else:
            factor, distance = table
            l, s = laser_row[block], sensor_row[block]
        energy = factor[l] * factor[s] * weight
        bins = (distance[l] + distance[s] - t_start) / bin_length
        histogram[block] = spread_triangles(energy, bins, patches.mesh.faces, n_bins)
    if not histogram.any():
        raise UserError(
            "no face of the mesh is turned towards the wall and visible from it; flip its faces or use "
            "two_sided"
        )
    return histogram


def spread_triangles(energy: np.ndarray, bins: np.ndarray, faces: np.ndarray, n_bins: int) -> np.ndarray:
    """Histogram of triangles whose arrival time is linear over their area.

    Args:
        energy: ``[B, P]`` energy of each triangle; those ≤ 0 are left out.
        bins: ``[B, V]`` arrival time at each vertex, in bins.
        faces: ``[P, 3]`` vertices of each triangle.
        n_bins: number of bins T.

    Returns:
        ``[B, T + 2]``, what falls before bin 0 in column 0 and what falls after the last in the last; rows
        sum to ``energy``'s.

    Examples:
        A triangle whose corners arrive at 0, 1 and 2 bins: its density is a triangle over two bins.

        >>> corners = np.array([[0, 1, 2]])
        >>> spread_triangles(np.array([[1.0]]), np.array([[0.0, 1.0, 2.0]]), corners, n_bins=3).tolist()
        [[0.0, 0.5, 0.5, 0.0, 0.0]]
    """
    n_rows, n_vertices = bins.shape
    row, patch = np.nonzero(energy > 0)
    energy = energy[row, patch]
    if len(energy) == 0:
        return np.zeros((n_rows, n_bins + 2))
    base = row * n_vertices
    flat = bins.ravel()
    a, b, c = (flat[base + faces[patch, i]] for i in range(3))
    first, last = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    middle = a + b + c - first - last
    # Everything starts in its first bin; then, at each bin edge it crosses, the part beyond that edge moves
    # one bin on.
    start = np.floor(first).astype(np.int64)
    width = n_bins + 2
    shape = n_rows * width
    spread = np.bincount(row * width + np.clip(start + 1, 0, n_bins + 1), energy, shape)
    edge = np.maximum(start + 1, 0)
    beyond = np.zeros(shape)
    alive = np.flatnonzero((edge < last) & (edge <= n_bins))
    while len(alive):
        e, row, energy, first, middle, last = (v[alive] for v in (edge, row, energy, first, middle, last))
        rising = 1 - (e - first) ** 2 / np.maximum((last - first) * (middle - first), 1e-300)
        falling = (last - e) ** 2 / np.maximum((last - first) * (last - middle), 1e-300)
        beyond += np.bincount(row * width + e, energy * np.where(e <= middle, rising, falling), shape)
        edge = e + 1
        alive = np.flatnonzero((edge < last) & (edge <= n_bins))
    histogram, beyond = spread.reshape(n_rows, width), beyond.reshape(n_rows, width)
    histogram[:, 1:] += beyond[:, :-1]
    histogram[:, :-1] -= beyond[:, :-1]
    return np.maximum(histogram, 0)  # rounding leaves -1e-17 of a neighbour here and there


def work(
    mesh: Mesh, laser: np.ndarray, sensor: np.ndarray, *, bin_length: float, n_bins: int, detail: float = 1.0
) -> Work:
    """What `simulate_transients` of these arguments would cost.

    Args:
        mesh: the hidden scene.
        laser: ``[S, 3]`` lit wall points, m.
        sensor: ``[S, 3]`` observed wall points, m.
        bin_length: optical path of one bin, m.
        n_bins: number of bins.
        detail: 2 halves the patches' edges.

    Returns:
        patches, pairs, time and memory.
    """
    points = np.concatenate([laser, sensor])
    return _work(
        Patches(mesh, points, bin_length, detail), len(laser), len(np.unique(points, axis=0)), n_bins
    )


def _work(patches: Patches, n_spots: int, n_points: int, n_bins: int) -> Work:
    pairs = n_spots * len(patches)
    legs = n_points * (len(patches) + len(patches.mesh.vertices))
    keep_legs = 2 * n_points <= n_spots and 8 * legs <= TABLE_BYTES
    # The legs are worked out with a few arrays of their size, a block with a few dozen.
    numbers = n_spots * (n_bins + 2) + 40 * max(BLOCK_PAIRS, len(patches)) + (6 * legs if keep_legs else 0)
    return Work(len(patches), pairs, pairs / PAIRS_PER_SECOND, 8 * numbers, keep_legs)


def _check_memory(cost: Work) -> None:
    import psutil

    free = psutil.virtual_memory().available
    if cost.bytes > free:
        raise MemoryBudgetError(
            f"simulating {cost.pairs:.2g} pairs of spot and patch needs {cost.bytes / 2**30:.1f} GiB"
            f" but {free / 2**30:.1f} GiB are free; use fewer spots, fewer bins or less detail"
        )


def _squared_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``[A, B]`` squared distances of points ``[A, 3]`` and ``[B, 3]``."""
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * _dots(a, b)
    return np.maximum(squared, 1e-12)


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``[A, B]`` dot products of vectors ``[A, 3]`` and ``[B, 3]``."""
    # Three terms are too few for BLAS: its threads cost more than they bring, most of all on a busy machine.
    return np.einsum("ik,kj->ij", a, np.ascontiguousarray(b.T))
