"""Where surfels begin, grow and die: candidates judged by the counts themselves.

A candidate with throughput ``a[s, t]`` (its transient through the response, per unit albedo) is tested
against the present expectation μ by the Poisson score: ``g = Σ (H/μ - 1) a``, information ``F = Σ a²/μ``,
significance ``z = g/√F``, normal under noise alone. So a threshold in z means the same at every count rate,
whatever the ambient light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.background import quietest_level
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.capture.wall_blocks import wall_blocks
from nlos_lit.effects.hooks import NOTHING, Hooks
from nlos_lit.functional.irf import convolve_time, response
from nlos_lit.functional.surfel_graph import BEND, misfits
from nlos_lit.functional.surfel_paths import (
    SPLINE_VARIANCE,
    Walls,
    quadrature,
    spline_at,
    spread,
    trace,
)
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.surfels.model import Lateral, SurfelModel, spline_sensor

CHUNK = 1 << 21  # paths at a time
BLOCKS = 6  # along each side of the wall, between which scores are held against each other
EXACT = "donot_use_mm_for_euclid_dist"  # distances as differences: products cancel for near points


class Seeds(NamedTuple):
    """Places where a surfel might be."""

    centre: Tensor  # [V, 3] m
    normal: Tensor  # [V, 3]

    def take(self, which: Tensor) -> Seeds:
        return Seeds(self.centre[which], self.normal[which])


class Score(NamedTuple):
    """Per candidate: score by albedo, its information, summed over the tested spots; and how both agree.

    ``scatter`` is how much more the scores of wall blocks scatter about one albedo than counts do, at least
    1: a body is as bright for one part of the wall as for another.
    """

    score: Tensor  # [V]
    information: Tensor  # [V]
    scatter: Tensor  # [V]

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
    asked: tuple[Tensor, Tensor],
    spots: Tensor,
    hooks: Hooks = NOTHING,
    visible: Tensor | None = None,
) -> Score:
    """Test places of surfels against the present expectation.

    Args:
        candidates: V places.
        capture: for its wall points and bins.
        cell: extents of a cell, m.
        points: quadrature points along each side.
        laser_sensor: present response.
        asked: ``[B, T_gate]`` each, of the spots' bins: derivative of the likelihood by what arrives there,
            and its information; ``H/μ - 1`` and ``1/μ`` where all that arrives is counted.
        spots: ``[B]`` rows of the capture that are looked at.
        hooks: effects: where the walls are, what they do to paths and times, and the response.
        visible: ``[B, V]`` share of each place's light that the spots see; None: all.

    Returns:
        score and information of each place's albedo, and how wall blocks agree.
    """
    sensor, bins = laser_sensor, capture.gate[1]
    device = asked[0].device

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
    pull, weight = adjoint(asked[0], kernel), adjoint(asked[1], whole**2).clamp_min(0)
    rows = spots.cpu().numpy()
    laser, laser_normal, sensor_point, sensor_normal = (
        torch.tensor(points[rows], dtype=torch.float32, device=device)
        for points in (capture.laser, capture.laser_normal, capture.sensor, capture.sensor_normal)
    )
    walls = hooks.walls(Walls(laser, laser_normal, sensor_point, sensor_normal, capture.confocal), spots)
    offsets = quadrature(points, device)
    extent = torch.tensor(cell, device=device).abs()
    n = len(candidates.centre)
    block = torch.from_numpy(wall_blocks(capture, BLOCKS)[rows]).to(device)
    total = torch.zeros(2, BLOCKS**2, n, dtype=torch.float64, device=device)
    size = max(1, CHUNK // (len(spots) * len(offsets)))
    for start in range(0, n, size):
        part = candidates.take(torch.arange(start, min(n, start + size), device=device))
        seen = None if visible is None else visible[:, start : start + len(part.centre)]
        paths = trace(part.centre, part.normal, extent, offsets, walls, seen=seen)
        shape = paths.length.shape
        length = hooks.time(paths.length, paths, spots)
        time = ((length - capture.t_start) / capture.bin_length).flatten(1)
        energy = hooks.path(paths.contribution, paths, spots)
        g = (energy * spline_at(pull, time)[0].view(shape)).sum(2)
        # Cauchy-Schwarz: exact where the points of a cell arrive together, above the true information
        # otherwise.
        f = energy.sum(2) * (energy * spline_at(weight, time)[0].view(shape)).sum(2)
        here = slice(start, start + g.shape[1])
        total[0, :, here].index_add_(0, block, g.double())
        total[1, :, here].index_add_(0, block, f.double())
    gain = sensor.intensity().item()
    return _over_blocks(total[0] * gain, total[1] * gain**2, len(block.unique()))


def _over_blocks(score: Tensor, information: Tensor, number: int) -> Score:
    """Sums over wall blocks of scores and information ``[blocks, V]``, ``number`` of which hold spots."""
    total, known = score.sum(0), information.sum(0)
    albedo = (total / known.clamp_min(1e-30)).clamp_min(0)
    away = (score - albedo * information).square() / information.clamp_min(1e-30)
    return Score(total, known, (away.sum(0) / max(1, number - 1)).clamp_min(1.0))


def continuations(centre: Tensor, normal: Tensor, cell: Tensor) -> tuple[Seeds, Tensor]:
    """The eight places around each surfel to which its sheet may extend: straight on, or bent either way.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit.
        cell: ``[2]`` extents of a cell, m.

    Returns:
        24 M places with their normals, and ``[24 M]`` long the surfel that each continues.
    """
    steps = [(i, j) for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0) if i or j]
    shift, _ = spread(normal, cell, torch.tensor(steps, device=centre.device))
    length = shift.norm(dim=2, keepdim=True)
    onward = shift / length
    source = torch.arange(len(centre), device=centre.device)[:, None].expand(-1, len(steps))
    centres, normals = [], []
    for turn in (0.0, BENT, -BENT):
        way = math.cos(turn / 2) * onward - math.sin(turn / 2) * normal[:, None]
        centres.append((centre[:, None] + length * way).reshape(-1, 3))
        normals.append((math.cos(turn) * normal[:, None] + math.sin(turn) * onward).reshape(-1, 3))
    return Seeds(torch.cat(centres), torch.cat(normals)), source.reshape(-1).repeat(3)


def facings(places: Seeds) -> Seeds:
    """Each place with its own normal, facing the wall, and tilted by 60° to either side along x and y."""
    tilt = 3**0.5 * torch.tensor(TILTS, device=places.centre.device)
    menu = torch.nn.functional.normalize(torch.cat([tilt, -torch.ones_like(tilt[:, :1])], 1), dim=1)
    normals = [places.normal, *(n.expand_as(places.normal) for n in menu)]
    return Seeds(places.centre.repeat(len(normals), 1), torch.cat(normals))


def within_depths(places: Tensor, grid: VolumeGrid) -> Tensor:
    """Which places lie no more than two voxels before or behind the grid.

    Args:
        places: ``[V, 3]`` m.
        grid: of the image.

    Returns:
        ``[V]`` bool.
    """
    low, high = grid.z[0] - 2 * grid.pitch[2], grid.z[-1] + 2 * grid.pitch[2]
    return (places[:, 2] > low) & (places[:, 2] < high)


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
BENT = 0.25  # rad by which a sheet may turn from one cell to the next
APART = 0.7  # surfels keep this many cells from each other
FIRST_SHARE = 0.5  # of the best albedo: neighbours that grow together share the same residual
ALIKE = 0.7  # deviation of ln(albedo) that a continued sheet is given
ALBEDOS = (0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0, 1.25, 1.6, 2.0)  # of its neighbour's, that are tried
LONE = 12.0  # nats, 5 standard deviations, that a body which is missing must gain


@torch.no_grad()
def support(model: SurfelModel, worth: Tensor) -> Tensor:
    """What neighbours are worth, as far as each surfel lies in one plane with them.

    Surfels of a sheet share the counts' evidence: where they lie closer than the counts resolve, each by
    itself is worth next to nothing, and all of them everything.

    Args:
        model: the surfels, linked.
        worth: ``[M]`` nats that the counts lose without each.

    Returns:
        ``[M]`` nats; a neighbour counts whole in the surfel's plane, not at all at a right angle.
    """
    i, j = model.pairs
    misfit = misfits(*model.placed(), model.pairs)
    agree = 1 - torch.log1p(misfit / BEND**2) / math.log1p(1 / BEND**2)
    return torch.zeros_like(worth).index_add(0, i, worth[j] * agree)


def dispersion(significance: Tensor) -> float:
    """Variance of the scores of places that ask for *less* light, at least the 1 of noise alone.

    A place without a surfel cannot have too much light: scores below 0 are noise, or a misfit that is not the
    surface's, such as an effect that the model lacks. That makes light seem to be missing as often, and a
    place must stand out from it.

    Args:
        significance: ``[V]`` of places, standard deviations.

    Returns:
        1 where there are none; from the median of their sizes.

    Examples:
        >>> dispersion(torch.tensor([-6.745, 0.0, 50.0, 60.0]))
        100.0
    """
    below = -significance[significance < 0]
    if not len(below):
        return 1.0
    return max(1.0, round(float(below.median()) / 0.6745, 6) ** 2)


@torch.no_grad()
def continuing_gain(result: Score, albedo: Tensor, dispersion: float) -> tuple[Tensor, Tensor]:
    """What a surfel that continues a sheet gains, its albedo a priori log-normal about its neighbour's.

    Args:
        result: of V places.
        albedo: ``[V]`` of the surfels that they continue.
        dispersion: of the scores over what noise alone makes; the counts speak by so much less.

    Returns:
        ``[V]`` largest log-posterior over ``ALBEDOS``, nats, and the albedo there.
    """
    tried = albedo.double()[:, None] * torch.tensor(ALBEDOS, dtype=torch.float64, device=albedo.device)
    away = torch.tensor([math.log(x) / ALIKE for x in ALBEDOS], device=albedo.device)
    counts = result.score[:, None] * tried - result.information[:, None] * tried**2 / 2
    gain = counts / dispersion - away**2 / 2
    best, which = gain.max(1)
    return best, tried.gather(1, which[:, None])[:, 0]


@dataclass(frozen=True)
class PlaceTest:
    """What the counts ask of places beside the present surface.

    Args:
        model: the surfels, whose expectation the counts are held against.
        capture: that is fitted.
        spots: ``[B]`` rows of the capture that are looked at.
        counts: ``[B, T_gate]`` of the spots.
        expected: ``[B, T_gate]`` of the spots by the model.
        hooks: effects of the present expectation; what they do to light is done to that of places, too.
    """

    model: SurfelModel
    capture: Capture
    spots: Tensor
    counts: Tensor
    expected: Tensor
    hooks: Hooks = NOTHING

    @cached_property
    def asked(self) -> tuple[Tensor, Tensor]:
        """As for :func:`score`. Where a count depends on what arrived before, as with a dead time, the second
        takes it that it does not.
        """
        back = self.model.pull_back(self.spots, self.hooks, self.counts / self.expected - 1)
        return back[0], back[1].square() / self.expected

    def surfels(self) -> Score:
        """Of the surfels themselves, with the light that they are seen by."""
        model = self.model
        visible = self._seen(model.hiders[:, self.spots]) if len(model.hiders) else None
        return self._score(Seeds(*model.placed()), model.quadrature, visible)

    def places(self, places: Seeds) -> Score:
        """Of places without a surfel, each seen past the surfels; their centres stand for them."""
        model = self.model
        hidden = model.hidden_by(self.spots, places.centre[:, None]) if len(model.hiders) else None
        return self._score(places, 1, None if hidden is None else self._seen(hidden))

    @torch.no_grad()
    def _seen(self, hiders: Tensor) -> Tensor:
        return self.model.arriving(hiders)

    def _score(self, places: Seeds, points: int, visible: Tensor | None) -> Score:
        cell, sensor = (float(self.model.cell[0]), float(self.model.cell[1])), self.model.laser_sensor
        given = (places, self.capture, cell, points, sensor, self.asked)
        return score(*given, self.spots, self.hooks, visible)


@torch.no_grad()
def prune_and_grow(model: SurfelModel, grid: VolumeGrid, test: PlaceTest, share: float, cost: float) -> None:
    """Drop surfels that neither counts nor neighbours speak for, and extend sheets.

    A surfel stays while what the counts lose without it (``a² F/2``) and without its neighbours in one
    plane (:func:`support`) exceeds ``cost``. A place that continues a sheet gets one where it gains more than
    that.

    Args:
        model: whose surfels are replaced; linked, its normals its own.
        grid: whose depths bound the volume.
        test: of places beside it.
        share: of the training spots that the test looks at; the others are taken to say the same.
        cost: nats that a surfel must be worth.

    Raises:
        UserError: no surfel is left.
    """

    def all_spots(found: Score) -> Score:
        return found._replace(score=found.score / share, information=found.information / share)

    present, albedo = Seeds(*model.placed()), model.albedo()
    worth = albedo.double() ** 2 * all_spots(test.surfels()).information / 2
    kept = (worth + support(model, worth) > cost) & within_depths(present.centre, grid)
    if not kept.any():
        raise UserError(
            "every surfel faded away during the fit: the counts hold no third-bounce light at the image's "
            "maxima"
        )
    apart = APART * float(model.cell.max())
    places, source = continuations(*present, model.cell)
    free = ~occupied(places.centre, present.centre, apart) & within_depths(places.centre, grid)
    free &= places.normal[:, 2] < 0.2
    places, source = places.take(free), source[free]
    result = all_spots(test.places(places))
    gain, light = continuing_gain(result, albedo[source], dispersion(result.significance))
    wanted = gain > cost
    places, gain, light = places.take(wanted), gain[wanted], light[wanted]
    _add(model, kept, places, gain, light, apart)


@torch.no_grad()
def begin_bodies(model: SurfelModel, grid: VolumeGrid, test: PlaceTest, reserve: Seeds) -> int:
    """Begin bodies that are missing, at places of the reserve away from all surfels.

    A place must gain ``LONE`` nats on the spots that are looked at. They are divided by how much more the
    scores of wall blocks scatter than counts do, since a body is as bright for one part of the wall as for
    another, and what the model lacks otherwise mostly is not; or by how far the scores of all places go that
    ask for less light (:func:`dispersion`), where that is more.

    Args:
        model: which gets more surfels; its normals its own.
        grid: whose depths bound the volume.
        test: of places beside it.
        reserve: places where one may be, each of which is tried with several normals.

    Returns:
        how many surfels were begun.
    """
    apart = APART * float(model.cell.max())
    near = occupied(reserve.centre, model.placed()[0], apart)
    places = facings(reserve.take(~near & within_depths(reserve.centre, grid)))
    if not len(places.centre):
        return 0
    result = test.places(places)
    unlike = result.scatter.clamp_min(dispersion(result.significance))
    gain = result.significance.clamp_min(0) ** 2 / 2 / unlike
    begun = gain > LONE
    if not begun.any():
        return 0
    light = (result.score / result.information.clamp_min(1e-30)).clamp_max(float(model.albedo().mean()))
    everything = torch.ones(len(model), dtype=torch.bool, device=gain.device)
    return _add(model, everything, places.take(begun), gain[begun], light[begun], apart)


def _add(model: SurfelModel, kept: Tensor, places: Seeds, gain: Tensor, light: Tensor, apart: float) -> int:
    """Keep some surfels and begin others at the best of some places that are so far apart; how many."""
    present, albedo = Seeds(*model.placed()).take(kept), model.albedo()[kept]
    # A misfit that is not the surface's asks for light everywhere; growing by shares gives the fit time to
    # explain it otherwise.
    chosen = best_apart(places.centre, gain, apart)[: max(64, len(model) // 4)]
    new, begin = places.take(chosen), FIRST_SHARE * light[chosen].float()
    hiders, opacity, curvature = model.hiders, model.opacity()[kept], model.curvature[kept]
    model.place(
        torch.cat([present.centre, new.centre]),
        torch.cat([present.normal, new.normal]),
        torch.cat([albedo, begin]),
        opacity,
        curvature,
    )
    if len(hiders):  # until it is worked out anew
        number = torch.cat([kept.new_zeros(1), kept]).cumsum(0) * torch.cat([kept.new_ones(1), kept])
        stay = number.to(torch.int32)[hiders[:, :, kept]]
        model.hiders = torch.cat([stay, stay.new_zeros(*stay.shape[:2], len(chosen), stay.shape[3])], 2)
    return len(chosen)
