"""Light paths over flat surface elements (surfels): throughput, length, and how they fill time bins.

A surfel is a flat patch over a lateral cell, given by its centre and normal. Its path from the laser's wall
point over the surfel to the sensor's carries (paper Eq. 6-7, unit wall reflectance and albedo)

    K = A cosθ1 cosθ2 cosθ3 cosθ4 / (d1² d2²)      at length d1 + d2,

A the surfel's true area. A cell is integrated with n × n points, so that arrival times vary smoothly over it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

STEEP = 0.4  # cosine of the tilt up to which a patch covers its whole lateral cell
SPLINE_VARIANCE = 1 / 3  # bins²; exact at every sub-bin phase


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


def trace(
    centre: Tensor,
    normal: Tensor,
    cell: Tensor,
    offsets: Tensor,
    laser: Tensor,
    laser_normal: Tensor,
    sensor: Tensor,
    sensor_normal: Tensor,
    confocal: bool,
) -> Paths:
    """All third-bounce paths of a batch of spots, laser → surfel → sensor (paper Eq. 6-7).

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit, towards the wall's side.
        cell: ``[2]`` lateral extents, m.
        offsets: ``[Q, 2]`` from :func:`quadrature`.
        laser: ``[B, 3]`` illuminated wall points, m.
        laser_normal: ``[B, 3]`` unit normals there.
        sensor: ``[B, 3]`` observed wall points, m; not used when ``confocal``.
        sensor_normal: ``[B, 3]`` unit normals there; not used when ``confocal``.
        confocal: whether the sensor looks at the laser's points.

    Returns:
        Paths of B spots over M surfels with Q points each.

    Examples:
        A surfel of 1 cm² straight ahead at 1 m, both facing each other: throughput A/d⁴.

        >>> import torch
        >>> spot, up = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
        >>> cell = torch.tensor([0.01, 0.01])
        >>> paths = trace(up, -up, cell, quadrature(1), spot, up, spot, up, confocal=True)
        >>> round(paths.contribution.item(), 8), paths.length.item()
        (0.0001, 2.0)
    """
    shift, area = spread(normal, cell, offsets)
    points = (centre[:, None] + shift).unbind(2)
    share = (area / len(offsets))[:, None]
    factor, leg, cosine = _leg(points, normal, laser, laser_normal)
    if confocal:
        return Paths(share * factor**2, 2 * leg, leg, leg, cosine, cosine, centre, normal, area)
    other, other_leg, other_cosine = _leg(points, normal, sensor, sensor_normal)
    legs = (leg, other_leg, cosine, other_cosine)
    return Paths(share * factor * other, leg + other_leg, *legs, centre, normal, area)


def _leg(
    points: tuple[Tensor, ...], facing: Tensor, wall: Tensor, normal: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """cosθ_wall cosθ_surfel / d², d and cosθ_surfel of legs from wall points ``[B, 3]`` to points.

    Each is ``[B, M, Q]``.
    """
    dx, dy, dz = (p - wall[:, k, None, None] for k, p in enumerate(points))
    square = dx * dx + dy * dy + dz * dz
    n = normal[:, :, None, None]
    at_wall = (n[:, 0] * dx + n[:, 1] * dy + n[:, 2] * dz).clamp_min(0)
    # The points of one surfel lie in one plane, whose distance from the wall point is the same for all of
    # them.
    plane = -(
        facing[:, 0, None] * dx[..., :1] + facing[:, 1, None] * dy[..., :1] + facing[:, 2, None] * dz[..., :1]
    ).clamp_max(0)
    distance = torch.sqrt(square)
    return at_wall * plane / square**2, distance, plane / distance


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
    first = torch.floor(time.detach() - 0.5)
    f = time - 0.5 - first
    g = 1 - f
    weights = torch.stack(
        [g**3 / 6, (3 * f**3 - 6 * f**2 + 4) / 6, (3 * g**3 - 6 * g**2 + 4) / 6, f**3 / 6], dim=-1
    )
    return first.long() - 1, weights


def spline_slopes(time: Tensor) -> Tensor:
    """Derivatives of the weights of :func:`spline_weights` by time.

    Args:
        time: ``[…]`` in bins.

    Returns:
        ``[…, 4]``, 1/bin; they sum to zero.
    """
    f = time - 0.5 - torch.floor(time.detach() - 0.5)
    g = 1 - f
    return torch.stack([-(g**2) / 2, (3 * f**2 - 4 * f) / 2, (4 * g - 3 * g**2) / 2, f**2 / 2], dim=-1)


class SplineSplat(torch.autograd.Function):
    """Transients ``[B, T]`` from contributions ``[B, K]`` at times ``[B, K]`` (bins) by cubic B-splines.

    What leaves [0, T) is lost. Written out because autograd through the composed operations takes three times
    as long and ten times the memory.
    """

    @staticmethod
    def forward(contribution: Tensor, time: Tensor, n_bins: int) -> Tensor:
        """``[B, n_bins]`` in the unit of ``contribution``."""
        row = torch.arange(len(time), device=time.device)[:, None] * (n_bins + 8)
        time = time.clamp(-2.0, n_bins + 2.0)
        first, weights = spline_weights(time)
        flat = torch.zeros(len(time) * (n_bins + 8), dtype=contribution.dtype, device=time.device)
        start = (first + 4 + row).reshape(-1)
        for k in range(4):
            flat.index_add_(0, start + k, (contribution * weights[..., k]).reshape(-1))
        return flat.view(len(time), n_bins + 8)[:, 4 : 4 + n_bins].contiguous()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, int], output: Tensor) -> None:
        """Keep contributions and times for both directions of differentiation."""
        contribution, time, ctx.n_bins = inputs
        ctx.save_for_backward(contribution, time)
        ctx.save_for_forward(contribution, time)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        """Gradients ``[B, K]`` of contributions and times from ``[B, T]`` of the transients."""
        contribution, time = ctx.saved_tensors
        gathered = gather_bins(grad, time)
        _, weights = spline_weights(time)
        return (gathered * weights).sum(-1), contribution * (gathered * spline_slopes(time)).sum(-1), None

    @staticmethod
    def jvp(ctx: Any, d_contribution: Tensor | None, d_time: Tensor | None, _: None) -> Tensor:
        """Change ``[B, T]`` of the transients with those of contributions and times."""
        contribution, time = ctx.saved_tensors
        first, weights = spline_weights(time)
        values = torch.zeros_like(weights)
        if d_contribution is not None:
            values = values + d_contribution[..., None] * weights
        if d_time is not None:
            values = values + (contribution * d_time)[..., None] * spline_slopes(time)
        return scatter_bins(values, first, ctx.n_bins)


def scatter_bins(values: Tensor, first: Tensor, n_bins: int) -> Tensor:
    """Values added to the four bins from ``first`` on; what lies outside the record is lost.

    Args:
        values: ``[B, …, 4]``.
        first: ``[B, …]`` long, first bins as of :func:`spline_weights`.
        n_bins: bins T of the record.

    Returns:
        ``[B, T]``.

    Examples:
        >>> import torch
        >>> scatter_bins(torch.tensor([[[1.0, 4.0, 1.0, 0.0]]]), torch.tensor([[-1]]), n_bins=3)
        tensor([[4., 1., 0.]])
    """
    first = first.reshape(len(first), -1).clamp(-4, n_bins)
    values = values.reshape(*first.shape, 4)
    width = n_bins + 8  # four bins on either side take what is lost
    row = torch.arange(len(first), device=first.device)[:, None] * width
    start = (first + 4 + row).reshape(-1)
    flat = torch.zeros(len(first) * width, dtype=values.dtype, device=values.device)
    for k in range(4):
        flat = flat.index_add(0, start + k, values[..., k].reshape(-1))
    return flat.view(len(first), width)[:, 4 : 4 + n_bins].contiguous()


def gather_bins(image: Tensor, time: Tensor) -> Tensor:
    """Values of transients in the four bins that arrivals fill: the transpose of splatting.

    Args:
        image: ``[B, T]``.
        time: ``[B, K]`` in bins.

    Returns:
        ``[B, K, 4]``, 0 outside the record.

    Examples:
        >>> import torch
        >>> gather_bins(torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[1.5]]))
        tensor([[[1., 2., 3., 0.]]])
    """
    n_bins = image.shape[1]
    padded = torch.nn.functional.pad(image, (4, 4)).reshape(-1)
    first, _ = spline_weights(time.clamp(-2.0, n_bins + 2.0))
    row = torch.arange(len(time), device=time.device)[:, None] * (n_bins + 8)
    start = first + 4 + row
    return torch.stack([padded[start + k] for k in range(4)], dim=-1)
