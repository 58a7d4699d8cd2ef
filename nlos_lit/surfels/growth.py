"""Where surfels begin, grow and die: candidates judged by the counts themselves.

A candidate with throughput ``a[s, t]`` (its transient through the response, per unit albedo) is tested
against the present expectation μ by the Poisson score: ``g = Σ (H/μ - 1) a``, information ``F = Σ a²/μ``,
significance ``z = g/√F``, normal under noise alone. So a threshold in z means the same at every count rate,
whatever the ambient light.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.background import quietest_level
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects.hooks import NOTHING, Hooks
from nlos_lit.functional.irf import convolve_time, response
from nlos_lit.functional.surfel_paths import (
    SPLINE_VARIANCE,
    gather_bins,
    quadrature,
    spline_weights,
    spread,
    trace,
)
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.surfels.model import Lateral, SurfelModel, spline_sensor

CHUNK = 1 << 21  # paths at a time
EXACT = "donot_use_mm_for_euclid_dist"  # distances as differences: products cancel for near points


class Seeds(NamedTuple):
    """Places where a surfel might be."""

    centre: Tensor  # [V, 3] m
    normal: Tensor  # [V, 3]

    def take(self, which: Tensor) -> Seeds:
        return Seeds(self.centre[which], self.normal[which])


class Score(NamedTuple):
    """Per candidate: score by albedo, its information; both summed over the tested spots."""

    score: Tensor  # [V]
    information: Tensor  # [V]

    @property
    def significance(self) -> Tensor:
        return self.score / self.information.clamp_min(1e-30).sqrt()


def volume_maxima(
    intensity: Tensor, grid: VolumeGrid, floor: float, per_cell: int, lateral: Lateral
) -> tuple[Seeds, Tensor]:
    """The largest local maxima along z of each lateral cell.

    Their depths are interpolated between voxels by a parabola.

    Args:
        intensity: ``[nz, nx, ny]`` on ``grid``.
        grid: of the image.
        floor: share of the volume's maximum that they reach at least.
        per_cell: of them in each lateral cell of the grid.
        lateral: cells of the surfels; a maximum seeds every cell of its voxel.

    Returns:
        places, and ``[V]`` their intensities relative to the maximum.
    """
    volume = intensity.detach() / intensity.max()
    padded = torch.nn.functional.pad(volume, (0, 0, 0, 0, 1, 1), value=-1.0)
    peak = (volume >= padded[:-2]) & (volume > padded[2:]) & (volume >= floor)
    ranked = torch.where(peak, volume, torch.zeros_like(volume))
    values, z = ranked.topk(min(per_cell, len(volume)), dim=0)
    k, i, j = torch.nonzero(values > 0, as_tuple=True)
    z, value = z[k, i, j], values[k, i, j]
    before, after = padded[z, i, j], padded[z + 2, i, j]
    bend = (before + after - 2 * value).clamp_max(-1e-12)
    inner = (z > 0) & (z < len(volume) - 1)
    shift = torch.where(inner, (0.5 * (before - after) / bend).clamp(-0.5, 0.5), torch.zeros_like(value))
    depth = grid.origin[2] + grid.pitch[2] * (z + shift)
    subdivide = lateral.shape[0] // grid.shape[1]
    fine = torch.arange(subdivide, device=value.device)
    a, b = (t.reshape(-1) for t in torch.meshgrid(fine, fine, indexing="ij"))
    index = torch.stack(
        [(i[:, None] * subdivide + a).reshape(-1), (j[:, None] * subdivide + b).reshape(-1)], 1
    )
    depth, value = (t[:, None].expand(-1, subdivide**2).reshape(-1) for t in (depth, value))
    centre = torch.cat([cell_centres(index, lateral), depth.float()[:, None]], 1)
    return Seeds(centre, torch.tensor([0.0, 0.0, -1.0], device=value.device).expand(len(centre), 3)), value


def cell_centres(index: Tensor, lateral: Lateral) -> Tensor:
    """Centres of lateral cells.

    Args:
        index: ``[N, 2]`` of the cells.
        lateral: their lattice.

    Returns:
        ``[N, 2]`` m.
    """
    origin, pitch = (
        torch.tensor(v, dtype=torch.float32, device=index.device) for v in (lateral.origin, lateral.pitch)
    )
    return origin + index * pitch


def rank_one(counts: Tensor) -> Tensor:
    """Expectation without structure: each spot's total times the mean transient, ``[S, T]`` of ``[S, T]``.

    The mean is smoothed by a hair of background.
    """
    total = counts.sum(1, keepdim=True).double()
    mean = counts.double().sum(0) + 0.5
    return (total * (mean / mean.sum())).float().clamp_min(1e-4)


def start_response(capture: Capture, counts: Tensor, start: LaserSensor | None) -> LaserSensor:
    """Start values and bounds of the response, from training counts alone.

    Args:
        capture: for its bins.
        counts: ``[N, T_gate]`` of the training spots.
        start: whose width and decay are taken; None takes 1.2 bins and 0.7 per bin.

    Returns:
        the response, of unit intensity.
    """
    length = capture.bin_length
    smallest = math.sqrt(SPLINE_VARIANCE + 0.05**2) * length
    sigma = max(1.2 * length if start is None else float(start.sigma_ls().detach()), 1.05 * smallest)
    kappa = 0.7 / length if start is None else float(start.kappa_s().detach())
    lowest = quietest_level(counts.mean(0))
    brightest = float(counts.max())
    background = min(max(lowest, 2e-6 * brightest), 0.5 * brightest)
    return spline_sensor(
        capture,
        {
            "sigma_ls": BoundedParameter(sigma, smallest, max(10 * length, 4 * sigma), "m"),
            "kappa_s": BoundedParameter(
                kappa, min(0.02 / length, kappa / 2), max(50 / length, 2 * kappa), "1/m"
            ),
            "intensity": BoundedParameter(1.0, 1e-3, 1e3, "counts m2"),
            "background": BoundedParameter(background, 1e-6 * brightest, brightest, "counts/bin"),
        },
    )


@torch.no_grad()
def score(
    candidates: Seeds,
    capture: Capture,
    cell: tuple[float, float],
    points: int,
    laser_sensor: LaserSensor,
    counts: Tensor,
    expected: Tensor,
    spots: Tensor,
    hooks: Hooks = NOTHING,
) -> Score:
    """Test places of surfels against the present expectation.

    Args:
        candidates: V places.
        capture: for its wall points and bins.
        cell: extents of a cell, m.
        points: quadrature points along each side.
        laser_sensor: present response.
        counts: ``[B, T_gate]`` of the spots.
        expected: ``[B, T_gate]`` of the spots.
        spots: ``[B]`` rows of the capture that are looked at.
        hooks: effects, whose response is applied.

    Returns:
        score and information of each place's albedo.
    """
    sensor, bins = laser_sensor, capture.gate[1]
    device = counts.device

    def adjoint(image: Tensor, kernel: Tensor) -> Tensor:
        full = torch.nn.functional.pad(image, (bins - image.shape[1], 0))
        return convolve_time(full, kernel.flip(0), len(kernel) - 1 - sensor.lead)

    kernel = hooks.response(sensor.kernel(), sensor.lead)
    whole = response(
        sensor.sigma_ls() / sensor.bin_length,
        sensor.kappa_s() * sensor.bin_length,
        sensor.length,
        sensor.lead,
    )
    whole = hooks.response(whole, sensor.lead)
    pull = adjoint(counts / expected - 1, kernel)
    weight = adjoint(1 / expected, whole**2).clamp_min(0)
    rows = spots.cpu().numpy()
    laser, laser_normal, sensor_point, sensor_normal = (
        torch.tensor(points[rows], dtype=torch.float32, device=device)
        for points in (capture.laser, capture.laser_normal, capture.sensor, capture.sensor_normal)
    )
    walls = (laser, laser_normal, sensor_point, sensor_normal)
    offsets = quadrature(points, device)
    extent = torch.tensor(cell, device=device).abs()
    n = len(candidates.centre)
    total = torch.zeros(2, n, dtype=torch.float64, device=device)
    size = max(1, CHUNK // (len(spots) * len(offsets)))
    for start in range(0, n, size):
        part = candidates.take(torch.arange(start, min(n, start + size), device=device))
        paths = trace(part.centre, part.normal, extent, offsets, *walls, capture.confocal)
        shape = paths.length.shape
        time = ((paths.length - capture.t_start) / capture.bin_length).flatten(1)
        energy = paths.contribution
        _, weights = spline_weights(time)
        g = (energy * (gather_bins(pull, time) * weights).sum(-1).view(shape)).sum((0, 2))
        # Cauchy-Schwarz: exact where the points of a cell arrive together, above the true information
        # otherwise.
        f = (energy.sum(2) * (energy * (gather_bins(weight, time) * weights).sum(-1).view(shape)).sum(2)).sum(
            0
        )
        total[0, start : start + len(g)], total[1, start : start + len(g)] = g.double(), f.double()
    gain = sensor.intensity().item()
    return Score(total[0] * gain, total[1] * gain**2)


def neighbour_candidates(centre: Tensor, normal: Tensor, cell: Tensor) -> Seeds:
    """The eight places around each surfel to which its plane extends.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit.
        cell: ``[2]`` extents of a cell, m.

    Returns:
        8 M places with the normals of their surfels.
    """
    moves = torch.tensor(
        [(i, j) for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0) if i or j], device=centre.device
    )
    shift, _ = spread(normal, cell, moves)
    return Seeds((centre[:, None] + shift).reshape(-1, 3), normal[:, None].expand(-1, 8, 3).reshape(-1, 3))


def facings(places: Seeds) -> Seeds:
    """Each place with its own normal, facing the wall, and tilted by 60° to either side along x and y."""
    tilt = 3**0.5 * torch.tensor(TILTS, device=places.centre.device)
    menu = torch.nn.functional.normalize(torch.cat([tilt, -torch.ones_like(tilt[:, :1])], 1), dim=1)
    normals = [places.normal, *(n.expand_as(places.normal) for n in menu)]
    return Seeds(places.centre.repeat(len(normals), 1), torch.cat(normals))


def occupied(candidates: Tensor, centre: Tensor, reach: float, chunk: int = 4096) -> Tensor:
    """Which places have a surfel nearby.

    Args:
        candidates: ``[V, 3]`` m.
        centre: ``[M, 3]`` m, of the surfels.
        reach: m.
        chunk: places at a time.

    Returns:
        ``[V]`` True where a surfel lies within reach.

    Examples:
        >>> occupied(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.5, 1.0]]), torch.tensor([[0.0, 0.1, 1.0]]), 0.2)
        tensor([ True, False])
    """
    if len(centre) == 0 or len(candidates) == 0:
        return torch.zeros(len(candidates), dtype=torch.bool, device=candidates.device)
    near = [torch.cdist(p, centre, compute_mode=EXACT).min(1).values < reach for p in candidates.split(chunk)]
    return torch.cat(near)


def best_apart(centre: Tensor, value: Tensor, reach: float) -> Tensor:
    """The places that have no better one nearby.

    Args:
        centre: ``[V, 3]`` m.
        value: ``[V]`` how good they are.
        reach: m within which only the best stays.

    Returns:
        indices, best first.

    Examples:
        >>> centre = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.1, 1.0], [0.5, 0.0, 1.0]])
        >>> best_apart(centre, torch.tensor([1.0, 3.0, 2.0]), reach=0.2)
        tensor([1, 2])
    """
    order = torch.argsort(value, descending=True, stable=True)
    points = centre[order].cpu().double().numpy()
    near = cKDTree(points).query_ball_point(points, reach) if len(points) else []
    free = np.ones(len(points), dtype=bool)
    kept = []
    for k in range(len(points)):
        if free[k]:
            kept.append(k)
            free[near[k]] = False
    return order[torch.tensor(kept, dtype=torch.long, device=order.device)]


TILTS = (
    (0.0, 0.0),
    (1.0, 0.0),
    (-1.0, 0.0),
    (0.0, 1.0),
    (0.0, -1.0),
)  # tangents of the facings tried, in units of √3
APART = 0.7  # surfels keep this many cells from each other
FIRST_SHARE = 0.3  # of the one-step albedo: neighbours that grow together share the same residual


@torch.no_grad()
def prune_and_grow(
    model: SurfelModel,
    capture: Capture,
    grid: VolumeGrid,
    reserve: Seeds,
    counts: Tensor,
    train: Tensor,
    tested: Tensor,
    prune: float,
    grow: float,
    hooks: Hooks = NOTHING,
) -> None:
    """Drop surfels that the counts do not need or that left the volume; add some where light is missing.

    Args:
        model: whose surfels are replaced.
        capture: that is fitted.
        grid: whose depths bound the volume.
        reserve: unused seeds; candidates besides the places next to surfels.
        counts: ``[N, T_gate]`` of the training spots.
        train: ``[N]`` their rows of the capture.
        tested: rows of ``counts`` that are looked at.
        prune: significance below which a surfel dies, over all training spots.
        grow: significance from which on a place gets one, over all training spots.
        hooks: effects of the present expectation; candidates are tested with their response.

    Raises:
        UserError: no surfel is left.
    """
    spots, seen = train[tested], counts[tested]
    expected = model.expected(spots, hooks)
    scale = len(train) / len(tested)
    low, high = grid.z[0] - 2 * grid.pitch[2], grid.z[-1] + 2 * grid.pitch[2]
    sensor, (across, along) = model.laser_sensor, model.cell.tolist()

    def test(places: Seeds, points: int) -> Score:
        return score(places, capture, (across, along), points, sensor, seen, expected, spots, hooks)

    present = Seeds(model.centre(), model.normal())
    albedo = model.albedo()
    needed = albedo * (test(present, model.quadrature).information * scale).sqrt() > prune
    needed &= (present.centre[:, 2] > low) & (present.centre[:, 2] < high)
    if not needed.any():
        raise UserError(
            "every surfel faded away during refinement: the counts hold no third-bounce light at the image's "
            "maxima"
        )
    kept, albedo = present.take(needed), albedo[needed]
    places = Seeds(
        *(torch.cat(p) for p in zip(neighbour_candidates(*kept, model.cell), reserve, strict=True))
    )
    apart = APART * float(model.cell.max())
    free = (
        ~occupied(places.centre, kept.centre, apart)
        & (places.centre[:, 2] > low)
        & (places.centre[:, 2] < high)
    )
    places = facings(places.take(free))
    result = test(places, 1)
    wanted = result.significance * math.sqrt(scale) > grow
    places, result = places.take(wanted), Score(*(v[wanted] for v in result))
    # A misfit that is not the surface's asks for light everywhere; growing by shares gives the fit time to
    # explain it otherwise.
    chosen = best_apart(places.centre, result.significance, apart)[: max(20, len(albedo) // 5)]
    start = (
        (FIRST_SHARE * result.score / result.information)[chosen]
        .float()
        .clamp(1e-3 * albedo.mean(), albedo.mean())
    )
    new = places.take(chosen)
    model.place(
        torch.cat([kept.centre, new.centre]), torch.cat([kept.normal, new.normal]), torch.cat([albedo, start])
    )
