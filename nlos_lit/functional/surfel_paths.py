"""Light paths over surface elements (surfels): throughput, length, and how they fill time bins.

A surfel is a patch over a lateral cell, given by its centre, normal and curvature. Its path from the laser's
wall point over the surfel to the sensor's carries (paper Eq. 6-7, unit wall reflectance and albedo)

    K = A cosθ1 cosθ2 cosθ3 cosθ4 / (d1² d2²)      at length d1 + d2,

A the surfel's true area. A cell is integrated with n × n points, so that arrival times and the angles of a
curved patch vary smoothly over it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nlos_lit.functional import path_loops, sheet_loops
from nlos_lit.functional.compiled import compiled, for_loops, numpy_of
from nlos_lit.functional.path_loops import EDGE

STEEP = 0.4  # cosine of the tilt up to which a patch covers its whole lateral cell
SPLINE_VARIANCE = 1 / 3  # bins²; exact at every sub-bin phase
# Shares of the four bins (rows) in powers of the phase, from the zeroth on: the cubic B-spline's pieces.
PIECES = torch.tensor([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]], dtype=torch.float64).div_(
    6
)


class Walls(NamedTuple):
    """Where the light of B spots leaves the wall, and where it comes back."""

    laser: Tensor  # [B, 3] m, illuminated
    laser_normal: Tensor  # [B, 3] unit, towards the hidden scene
    sensor: Tensor  # [B, 3] m, observed; the laser's when confocal
    sensor_normal: Tensor  # [B, 3] unit
    confocal: bool


class Paths(NamedTuple):
    """Third-bounce paths of B spots over M surfels with Q quadrature points each."""

    contribution: Tensor  # [B, M, Q] throughput per unit albedo, 1/m²
    length: Tensor  # [B, M, Q] m, laser's wall point to sensor's wall point
    laser_leg: Tensor  # [B, M, Q] distance laser's wall point to surfel, m
    sensor_leg: Tensor  # [B, M, Q] m; the same tensor when confocal
    laser_cosine: Tensor  # [B, M, Q] at the surfel, towards the laser's wall point, ≥ 0
    sensor_cosine: Tensor  # [B, M, Q]
    centre: Tensor  # [M, 3] m, of the surfels
    normal: Tensor  # [M, 3]
    area: Tensor  # [M] m²


def quadrature(n: int, device: torch.device | str = "cpu") -> Tensor:
    """Midpoints of n × n parts of a unit cell centred on 0.

    Args:
        n: parts along a side.
        device: where the result lies.

    Returns:
        ``[n², 2]`` in cells.

    Examples:
        >>> quadrature(2).tolist()
        [[-0.25, -0.25], [-0.25, 0.25], [0.25, -0.25], [0.25, 0.25]]
    """
    line = (torch.arange(n, dtype=torch.float32, device=device) + 0.5) / n - 0.5
    return torch.cartesian_prod(line, line).reshape(-1, 2)


def spread(normal: Tensor, cell: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Points of the patches relative to their centres, and areas.

    A patch covers its lateral cell exactly while its normal is within ``acos(STEEP)`` of the z axis; a
    steeper one keeps the length it has there and stands up in its own tangent plane, also beyond the
    vertical.

    Args:
        normal: ``[M, 3]`` unit, towards the wall's side.
        cell: ``[2]`` lateral extents, m.
        offsets: ``[Q, 2]`` from :func:`quadrature`.

    Returns:
        ``[M, Q, 3]`` points, m, and ``[M]`` areas, m².

    Examples:
        A patch tilted by 60° covers its cell with twice the area:

        >>> import torch
        >>> tilted = torch.tensor([[0.75**0.5, 0.0, -0.5]])
        >>> points, area = spread(tilted, torch.tensor([0.1, 0.1]), quadrature(2))
        >>> points.shape, round(area.item(), 6)
        (torch.Size([1, 4, 3]), 0.02)
    """
    across, upright = normal[:, :2], -normal[:, 2]
    stretch = 1 / upright.clamp_min(STEEP)
    shift = offsets * cell
    along = across @ shift.T
    # 0 for patches that cover their cell; elsewhere sinα > 0.9 keeps the quotient tame.
    shrink = (stretch * upright - 1) / (across**2).sum(1).clamp_min(1e-3)
    lateral = shift + (shrink[:, None] * along)[..., None] * across[:, None]
    return torch.cat([lateral, (stretch[:, None] * along)[..., None]], dim=2), cell.prod() * stretch


def on_patch(normal: Tensor, shift: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor]:
    """Points and normals of curved patches, of second and first order in the distance from their centres.

    Args:
        normal: ``[M, 3]`` unit, at the centres.
        shift: ``[M, Q, 3]`` m, from :func:`spread`, in the tangent planes.
        curvature: ``[M, 3, 3]`` 1/m, change of the normal along each way in the tangent plane.

    Returns:
        ``[M, Q, 3]`` places relative to the centres, and unit normals there.

    Examples:
        On a sphere of radius 1 that bulges towards the wall, 0.1 aside:

        >>> facing, bulge = torch.tensor([[0.0, 0.0, -1.0]]), torch.diag(torch.tensor([1.0, 1.0, 0.0]))
        >>> place, normal = on_patch(facing, torch.tensor([[[0.1, 0.0, 0.0]]]), bulge[None])
        >>> [round(x, 3) for x in place.flatten().tolist()]
        [0.1, 0.0, 0.005]
        >>> [round(x, 3) for x in normal.flatten().tolist()]
        [0.1, 0.0, -0.995]
    """
    turn = torch.einsum("mij,mqj->mqi", curvature, shift)
    fallen = (shift * turn).sum(2, keepdim=True) / 2
    facing = normal[:, None] + turn
    return shift - fallen * normal[:, None], torch.nn.functional.normalize(facing, dim=2)


def trace(
    centre: Tensor,
    normal: Tensor,
    cell: Tensor,
    offsets: Tensor,
    walls: Walls,
    curvature: Tensor | None = None,
    seen: Tensor | None = None,
) -> Paths:
    """All third-bounce paths of a batch of spots, laser → surfel → sensor (paper Eq. 6-7).

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit, towards the wall's side.
        cell: ``[2]`` lateral extents, m.
        offsets: ``[Q, 2]`` from :func:`quadrature`.
        walls: points and normals of the spots.
        curvature: ``[M, 3, 3]`` 1/m, see :func:`on_patch`; None for flat patches.
        seen: ``[B, M]`` share of each surfel's light that is not hidden; None where all is seen.

    Returns:
        Paths of B spots over M surfels with Q points each.

    Examples:
        A surfel of 1 cm² straight ahead at 1 m, both facing each other: throughput A/d⁴.

        >>> import torch
        >>> spot, up = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
        >>> cell = torch.tensor([0.01, 0.01])
        >>> paths = trace(up, -up, cell, quadrature(1), Walls(spot, up, spot, up, confocal=True))
        >>> round(paths.contribution.item(), 8), paths.length.item()
        (0.0001, 2.0)
    """
    place, facing, share = patches(normal, cell, offsets, curvature)
    # From the middle of the scene, so that differences of squares keep their digits, in any batch the same.
    middle = centre.detach().mean(0)
    points = centre[:, None] + place - middle
    seen = points.new_ones(len(walls.laser), len(centre)) if seen is None else seen
    factor, leg, cosine = _legs(points, facing, walls.laser - middle, walls.laser_normal)
    if walls.confocal:
        energy = _energies(share, seen, factor, factor)
        return Paths(energy, 2 * leg, leg, leg, cosine, cosine, centre, normal, share.sum(1))
    other, other_leg, other_cosine = _legs(points, facing, walls.sensor - middle, walls.sensor_normal)
    energy, legs = _energies(share, seen, factor, other), (leg, other_leg, cosine, other_cosine)
    return Paths(energy, leg + other_leg, *legs, centre, normal, share.sum(1))


def patches(
    normal: Tensor, cell: Tensor, offsets: Tensor, curvature: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Points of patches.

    Args:
        normal: ``[M, 3]`` unit, at the centres.
        cell: ``[2]`` lateral extents, m.
        offsets: ``[Q, 2]`` from :func:`quadrature`.
        curvature: ``[M, 3, 3]`` 1/m, see :func:`on_patch`, without gradients; None for flat patches.

    Returns:
        ``[M, Q, 3]`` places relative to the centres, normals there, and ``[M, Q]`` areas, m².
    """
    curvature = normal.new_zeros(0, 3, 3) if curvature is None or len(offsets) == 1 else curvature
    plain = _Patches.apply if compiled(normal) else _patches
    return plain(normal, cell, offsets, curvature)


def _patches(
    normal: Tensor, cell: Tensor, offsets: Tensor, curvature: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Tensor by tensor."""
    shift, area = spread(normal, cell, offsets)
    share, facing = (area / len(offsets))[:, None].expand(shift.shape[:2]), normal[:, None].expand_as(shift)
    if len(curvature):
        shift, facing = on_patch(normal, shift, curvature)
        # Where a patch covers its lateral cell, what leans more has more area.
        leans = (-facing[..., 2]).clamp_min(STEEP)
        share = share * (-normal[:, 2:]).clamp_min(STEEP) / leans
    return shift, facing, share


class _Patches(torch.autograd.Function):
    """Compiled."""

    @staticmethod
    def forward(
        ctx: Any, normal: Tensor, cell: Tensor, offsets: Tensor, curvature: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        place, facing, share = (normal.new_empty(len(normal), len(offsets), *n) for n in ((3,), (3,), ()))
        ctx.given = [*map(numpy_of, (normal, curvature, cell, offsets)), np.float32(STEEP)]
        sheet_loops.patches(*ctx.given, place.numpy(), facing.numpy(), share.numpy())
        return place, facing, share

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        return torch.from_numpy(sheet_loops.pull_patches(*ctx.given, *map(numpy_of, grads))), None, None, None


def _legs(points: Tensor, facing: Tensor, wall: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """cosθ_wall cosθ_surfel / d², d and cosθ_surfel ``[B, M, Q]`` of legs from wall points ``[B, 3]`` to
    points ``[M, Q, 3]``. The compiled ones have no gradients of the wall's.
    """
    fixed = not (wall.requires_grad or normal.requires_grad)
    return (_Legs.apply if fixed and compiled(points) else _plain_legs)(points, facing, wall, normal)


def _plain_legs(
    points: Tensor, facing: Tensor, wall: Tensor, normal: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Tensor by tensor. Squares of distances and distances from planes are sums of products of what belongs
    to the wall point and what belongs to the surfel, so that they are products of matrices.
    """
    flat, one = points.reshape(-1, 3), wall.new_ones(len(wall), 1)
    size, facing = (flat**2).sum(1, keepdim=True), facing.reshape(-1, 3)
    whole = torch.cat([flat, size, torch.ones_like(size)], 1)
    square = torch.cat([-2 * wall, one, (wall**2).sum(1, keepdim=True)], 1) @ whole.T
    at_wall = torch.cat([normal, -(normal * wall).sum(1, keepdim=True)], 1) @ whole[:, [0, 1, 2, 4]].T
    level = (facing * flat).sum(1, keepdim=True)
    plane = torch.cat([wall, one], 1) @ torch.cat([facing, -level], 1).T
    shape = (len(wall), *points.shape[:2])
    square, at_wall = square.clamp_min(1e-12).view(shape), at_wall.clamp_min(0).view(shape)
    plane, distance = plane.clamp_min(0).view(shape), torch.sqrt(square)
    return at_wall * plane / square**2, distance, plane / distance


class _Legs(torch.autograd.Function):
    """Compiled."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, facing: Tensor, wall: Tensor, normal: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        factor, leg, cosine = found = points.new_empty(3, len(wall), *points.shape[:2])
        ctx.walls, ctx.points = [numpy_of(wall), numpy_of(normal)], [_rows(points), _rows(facing)]
        path_loops.legs(*ctx.walls, *found.flatten(2).numpy(), *ctx.points)
        return factor, leg, cosine

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None, None]:
        found = np.zeros((2, *ctx.points[0].shape), np.float32)
        path_loops.pull_legs(*ctx.walls, *(numpy_of(g.flatten(1)) for g in grads), *ctx.points, *found)
        of_points, of_facing = (torch.from_numpy(x).T.reshape(*grads[0].shape[1:], 3) for x in found)
        return of_points, of_facing, None, None


def _energies(share: Tensor, seen: Tensor, factor: Tensor, other: Tensor) -> Tensor:
    """What paths carry ``[B, M, Q]``: areas of points ``[M, Q]`` times what is seen of their surfels ``[B,
    M]`` times the factors ``[B, M, Q]`` of both legs.
    """
    return (_Energies.apply if compiled(factor) else _plain_energies)(share, seen, factor, other)


def _plain_energies(share: Tensor, seen: Tensor, factor: Tensor, other: Tensor) -> Tensor:
    return share * seen[:, :, None] * factor * other


class _Energies(torch.autograd.Function):
    """Compiled."""

    @staticmethod
    def forward(ctx: Any, share: Tensor, seen: Tensor, factor: Tensor, other: Tensor) -> Tensor:
        energy = torch.empty_like(factor)
        ctx.rows = [numpy_of(x) for x in (seen, factor.flatten(1), other.flatten(1))]
        ctx.share = numpy_of(share.flatten())
        path_loops.energies(*ctx.rows, energy.flatten(1).numpy(), ctx.share)
        return energy

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:
        of_share, found = np.zeros_like(ctx.share), [np.empty_like(x) for x in ctx.rows]
        path_loops.pull_energies(*ctx.rows, numpy_of(grad.flatten(1)), *found, ctx.share, of_share)
        of_seen, of_factor, of_other = map(torch.from_numpy, found)
        shape = grad.shape
        return (
            torch.from_numpy(of_share).view(shape[1:]),
            of_seen,
            of_factor.view(shape),
            of_other.view(shape),
        )


def _rows(points: Tensor) -> np.ndarray:
    """``[3, N]`` from ``[…, 3]``."""
    return numpy_of(points.reshape(-1, 3).T)


def spline_weights(time: Tensor) -> tuple[Tensor, Tensor]:
    """Cubic B-spline shares of arrivals in the four nearest time bins.

    They sum to one and have the right mean and variance ``SPLINE_VARIANCE`` at every sub-bin phase, so that
    shifting a path by part of a bin neither makes nor loses light (de Boor, *A Practical Guide to Splines*,
    ch. IX).

    Args:
        time: ``[…]`` in bins; bin k is centred on k + ½.

    Returns:
        First bin, ``[…]`` long, and weights ``[…, 4]`` of it and the three bins after.

    Examples:
        >>> import torch
        >>> first, weights = spline_weights(torch.tensor(5.5))
        >>> first, 6 * weights
        (tensor(4), tensor([1., 4., 1., 0.]))
    """
    first, phase = _phase(time)
    return first.long() - 1, _powers(phase) @ PIECES.to(time).T


def spline_slopes(time: Tensor) -> Tensor:
    """Derivatives of the weights of :func:`spline_weights` by time.

    Args:
        time: ``[…]`` in bins.

    Returns:
        ``[…, 4]``, 1/bin; they sum to zero.
    """
    one, f, square, _ = _powers(_phase(time)[1]).unbind(-1)
    return torch.stack([torch.zeros_like(f), one, 2 * f, 3 * square], -1) @ PIECES.to(time).T


def _phase(time: Tensor) -> tuple[Tensor, Tensor]:
    """The bin whose centre is the last before an arrival, as a float, and how far after it, from 0 to 1."""
    since = time - 0.5
    whole = torch.floor(since.detach())
    return whole, since - whole


def _powers(phase: Tensor) -> Tensor:
    """``[…, 4]`` from the zeroth to the third."""
    return torch.stack([torch.ones_like(phase), phase, phase**2, phase**3], -1)


class SplineSplat(torch.autograd.Function):
    """Transients ``[B, T]`` from contributions ``[B, K]`` at times ``[B, K]`` (bins) by cubic B-splines.

    What leaves [0, T) is lost. A path's shares are polynomials of its phase, and the same polynomials for all
    paths of a bin (``PIECES``). So powers of the phase are summed in each bin, or the transients turned into
    the coefficients of each bin, and no path ever has four weights of its own.
    """

    @staticmethod
    def forward(contribution: Tensor, time: Tensor, n_bins: int) -> Tensor:
        """``[B, n_bins]`` in the unit of ``contribution``."""
        if for_loops(time):
            return _by_loop(path_loops.splat, contribution, time, n_bins)
        place, f = _located(time, n_bins)
        first = contribution * f
        second = first * f
        return _from_moments([contribution, first, second, second * f], place, n_bins)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, int], output: Tensor) -> None:
        """Keep contributions and times for both directions of differentiation."""
        contribution, time, ctx.n_bins = inputs
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(contribution, time)
        ctx.save_for_forward(contribution, time)

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None) -> tuple[Tensor | None, Tensor | None, None]:
        """Gradients ``[B, K]`` of contributions and times from ``[B, T]`` of the transients."""
        if grad is None:
            return None, None, None
        contribution, time = ctx.saved_tensors
        value, slope = spline_at(grad, time)
        return value, contribution * slope, None

    @staticmethod
    def jvp(ctx: Any, d_contribution: Tensor | None, d_time: Tensor | None, _: None) -> Tensor:
        """Change ``[B, T]`` of the transients with those of contributions and times."""
        contribution, time = ctx.saved_tensors
        changes = [] if d_contribution is None else [SplineSplat.apply(d_contribution, time, ctx.n_bins)]
        changes += [] if d_time is None else [_SplatMoved.apply(contribution * d_time, time, ctx.n_bins)]
        return sum(changes[1:], changes[0])


class _SplatMoved(torch.autograd.Function):
    """Change ``[B, T]`` of transients where light arrives later, from ``[B, K]`` light times how much later
    (bins), and when it came (bins).
    """

    @staticmethod
    def forward(moved: Tensor, time: Tensor, n_bins: int) -> Tensor:
        if for_loops(time):
            return _by_loop(path_loops.splat_moved, moved, time, n_bins)
        place, f = _located(time, n_bins)
        return _from_moments([torch.zeros_like(f), moved, 2 * moved * f, 3 * moved * f**2], place, n_bins)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, int], output: Tensor) -> None:
        """It is a derivative already, and is not derived."""


def _by_loop(loop: Callable[..., None], light: Tensor, time: Tensor, n_bins: int) -> Tensor:
    """``[B, n_bins]`` that a loop adds to from ``[B, K]`` light and times."""
    padded = light.new_zeros(len(time), n_bins + path_loops.ROW)
    loop(*map(numpy_of, (light, time, padded)))
    return padded[:, EDGE : EDGE + n_bins].contiguous()


def spline_at(image: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """What arrivals see of transients through their shares of the bins: the transpose of splatting.

    Args:
        image: ``[B, T]``; 0 outside the record.
        time: ``[B, K]`` in bins.

    Returns:
        ``[B, K]`` sums of the four bins of each arrival with its shares, and their derivatives by time.

    Examples:
        >>> import torch
        >>> value, slope = spline_at(torch.tensor([[1.0, 2.0, 3.0, 4.0]]), torch.tensor([[2.0]]))
        >>> round(value.item(), 6), round(slope.item(), 6)  # a line is told as it is
        (2.5, 1.0)
    """
    n_bins, padded = image.shape[1], torch.nn.functional.pad(image, (EDGE, EDGE + 3))
    if for_loops(time):
        value, slope = torch.empty_like(time), torch.empty_like(time)
        path_loops.spline_values(*map(numpy_of, (padded, time, value, slope)))
        return value, slope
    place, f = _located(time, n_bins)
    bins = torch.stack([padded[:, k : k + n_bins + 2 * EDGE].reshape(-1) for k in range(4)])
    tables = PIECES.to(image).T @ bins
    c0, c1, c2, c3 = (table.index_select(0, place).view(f.shape) for table in tables)
    return c0 + f * (c1 + f * (c2 + f * c3)), c1 + f * (2 * c2 + 3 * f * c3)


class Runs(NamedTuple):
    """What the light of M sources does to the T bins of B spots, for light that arrives at the same times
    again and again: each source's runs of bins, and their shares.
    """

    begin: np.ndarray  # [B, M] in padded rows
    block: np.ndarray  # [B, M + 1] of shares
    share: np.ndarray  # [n, BLOCK]
    bins: int

    @classmethod
    def of(cls, contribution: Tensor, time: Tensor, n_bins: int) -> Runs:
        """:class:`SplineSplat` of sources that have many points each.

        Args:
            contribution: ``[B, M, Q]`` of M sources with Q points each, per unit of a source's light.
            time: ``[B, M, Q]`` in bins.
            n_bins: T.

        Returns:
            on the CPU.

        Examples:
            >>> runs = Runs.of(torch.ones(1, 1, 1), torch.full((1, 1, 1), 2.5), 5)
            >>> runs.send(torch.tensor([6.0]))
            tensor([[0., 1., 4., 1., 0.]])
        """
        given = [numpy_of(x.cpu()) for x in (contribution, time)]
        begin, block, share = path_loops.runs(*given, np.float32(n_bins))
        return cls(begin, block, share, n_bins)

    def send(self, light: Tensor) -> Tensor:
        """``[B, T]`` transients of sources of light ``[M]``; what leaves [0, T) is lost."""
        padded = torch.zeros(len(self.begin), self.bins + path_loops.ROW + path_loops.BLOCK)
        path_loops.send(self.begin, self.block, self.share, numpy_of(light.cpu()), padded.numpy())
        return padded[:, EDGE : EDGE + self.bins].to(light.device)

    def pull(self, grad: Tensor) -> np.ndarray:
        """Gradient ``[M]`` of the light from that of the transients ``[B, T]``."""
        padded = torch.nn.functional.pad(grad.cpu(), (EDGE, EDGE + 3 + path_loops.BLOCK))
        found = np.zeros(self.begin.shape[1], np.float32)
        path_loops.pull_send(self.begin, self.block, self.share, numpy_of(padded), found)
        return found


def _located(time: Tensor, n_bins: int) -> tuple[Tensor, Tensor]:
    """Where the first of each arrival's four bins is, ``[B·K]`` among rows of ``n_bins + 2·EDGE``, and its
    phase ``[B, K]``.
    """
    whole, phase = _phase(time.clamp(-2.0, n_bins + 2.0))
    row = torch.arange(len(time), device=time.device, dtype=torch.int32)[:, None] * (n_bins + 2 * EDGE)
    return (whole.to(torch.int32) + (row + EDGE - 1)).reshape(-1), phase


def _from_moments(moments: list[Tensor], place: Tensor, n_bins: int) -> Tensor:
    """Transients ``[B, T]`` from what arrives ``[B, K]``, times each power of its phase."""
    size = len(moments[0]) * (n_bins + 2 * EDGE)
    nothing = moments[0].new_zeros(size)
    tables = torch.stack([nothing.index_add(0, place, m.reshape(-1)) for m in moments])
    bins = (PIECES.to(tables) @ tables).view(4, -1, n_bins + 2 * EDGE)
    shifted = [bins[k, :, EDGE - k : EDGE - k + n_bins] for k in range(4)]
    return shifted[0] + shifted[1] + shifted[2] + shifted[3]
