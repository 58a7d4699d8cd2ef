"""Light that visits two hidden surfaces."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect, Parameter, Quantity
from nlos_lit.functional.irf import convolve_time
from nlos_lit.functional.surfel_paths import Paths, SplineSplat

CLUSTERS = 48
SAMPLES = 512  # surfels between which throughput is worked out


class HigherOrderBounces(Effect):
    """The fourth bounce laser → wall → surfel a → surfel b → wall → sensor is added to the third.

    ``H_r → H_r + strength Σ_ab ρ_a ρ_b/π · F_l(a) A_a · cosθ_ab cosθ_ba/(d_ab² + A/π) · A_b F_s(b)`` at
    ``d_la + d_ab + d_bs``, with ``F = cosθ_wall cosθ_surfel/d²`` of the leg from the wall; the common
    reflectances and 1/π of the wall are left out, as in the third bounce. A, the mean area of the two, keeps
    the throughput of touching surfels finite. No surfel hides another one.

    Estimator: surfels join in at most 48 clusters, cells of a cube lattice. Powers into and out of the
    clusters are exact sums over their surfels: what leaves surfel a towards b is the third bounce's energy
    over its other leg, ``ρ A F_l = energy/F_s``. The throughput between clusters is its mean over pairs of
    their surfels (of at most about 512 of them), the length likewise. Arrivals are blurred over a cell.

    Parameters: ``strength`` (1), null 0; 1 is physical if albedo 1 means albedo 1. Here albedo is relative,
    so that strength carries the unknown scale. Quantity ``share`` (1): fourth bounce over third, known after
    a rendering without gradients (its last batch).

    Signature: a broad excess behind concave surfaces, from twice the shortest leg plus a gap on; none for one
    flat or convex surface.

    Degenerate with: ``irf_tail``, weak surfels behind the surface, ``background_slope``.

    Source: C. M. Goral et al., *Modeling the interaction of light between diffuse surfaces*, SIGGRAPH 1984;
    the bound for touching
    surfels: J. R. Wallace, K. A. Elmquist, E. A. Haines, *A ray tracing algorithm for progressive radiosity*,
        SIGGRAPH 1989.
    """

    name = "higher_order_bounces"
    stage = "path"
    needs_paths = True

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("laser", scan.laser.clone(), persistent=False)
        self.register_buffer("sensor", scan.sensor.clone(), persistent=False)
        self.ratio = math.nan

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("strength", "1", 0.0, 0.5, 0.0, 50.0),)

    def quantities(self) -> dict[str, Quantity]:
        strength = self.value("strength")
        reported = {"strength": Quantity(strength, "1")}
        if not math.isnan(self.ratio):
            reported["share"] = Quantity(strength * self.ratio, "1")
        return reported

    def transients(self, transients: Tensor, energy: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        fourth = self.fourth_bounce(energy, paths, spots, transients.shape[1])
        if not torch.is_grad_enabled():
            self.ratio = float(fourth.sum()) / max(float(energy.sum()), 1e-30)
        return transients + self.value("strength") * fourth

    def fourth_bounce(self, energy: Tensor, paths: Paths, spots: Tensor, n_bins: int) -> Tensor:
        """``[B, n_bins]`` light on arrival at strength 1."""
        member, cell = clusters(paths.centre.detach())
        power = energy.sum(2)
        laser, laser_leg = throughput(self.laser[spots], paths)
        sensor, sensor_leg = (
            (laser, laser_leg) if self.scan.confocal else throughput(self.sensor[spots], paths)
        )
        into, out = power / sensor, power / laser
        inward, outward = into @ member, out @ member
        first = (into * laser_leg) @ member / (inward + 1e-12)
        last = (out * sensor_leg) @ member / (outward + 1e-12)
        exchange, gap = between(paths, member)
        light = inward[:, :, None] * exchange * outward[:, None, :] / math.pi
        length = first[:, :, None] + gap + last[:, None, :]
        scan = self.scan
        arrivals = SplineSplat.apply(
            light.flatten(1), (length.flatten(1) - scan.t_start) / scan.bin_length, n_bins
        )
        return blurred(arrivals, cell / scan.bin_length)


def clusters(centre: Tensor) -> tuple[Tensor, float]:
    """Who belongs together: ``[M, C]`` ones and zeros, C ≤ 48, and the side of the cubes, m."""
    low = centre.amin(0)
    cell = max(float((centre.amax(0) - low).max()) / CLUSTERS, 1e-6)
    while True:
        cubes, index = torch.unique(torch.floor((centre - low) / cell).long(), dim=0, return_inverse=True)
        if len(cubes) <= CLUSTERS:
            return torch.nn.functional.one_hot(index, len(cubes)).to(centre.dtype), cell
        cell *= 1.15


def throughput(wall: Tensor, paths: Paths) -> tuple[Tensor, Tensor]:
    """``cosθ_wall cosθ_surfel/d²`` and d, ``[B, M]``, from wall points ``[B, 3]`` (wall normal +z) to the
    surfels' centres.
    """
    away = paths.centre - wall[:, None]
    square = away.square().sum(2)
    facing = -(away * paths.normal).sum(2)
    return (away[..., 2].clamp_min(0) * facing.clamp_min(0) / square**2).clamp_min(1e-6), torch.sqrt(square)


def between(paths: Paths, member: Tensor) -> tuple[Tensor, Tensor]:
    """``cosθ cosθ/(d² + A/π)`` (1/m²) and d (m) between clusters, both ``[C, C]``, means over pairs of their
    surfels by area.
    """
    rank = (member.cumsum(0) * member).sum(1) - 1
    chosen = torch.nonzero(rank % math.ceil(len(rank) / SAMPLES) == 0)[:, 0]
    centre, normal, area = paths.centre[chosen], paths.normal[chosen], paths.area[chosen]
    share = member[chosen] * area[:, None]
    share = share / share.sum(0)
    away = centre[None] - centre[:, None]
    leaving = (away * normal[:, None]).sum(2).clamp_min(0)
    square = away.square().sum(2)
    # Ones keep the distance of a surfel from itself, and from one in the same place, differentiable; both
    # cosines are 0.
    square = square + (square == 0)
    exchange = leaving * leaving.T / (square * (square + (area[:, None] + area) / (2 * math.pi)))
    total = share.T @ exchange @ share
    distance = share.T @ (exchange * torch.sqrt(square)) @ share
    return total, distance / (total + 1e-12)


def blurred(arrivals: Tensor, side: float) -> Tensor:
    """``[B, T]`` spread in time as over two cells of ``side`` bins: a Gaussian of their joint standard
    deviation at 45°.
    """
    sigma = max(side / math.sqrt(12), 1e-3)
    lead = math.ceil(3 * sigma)
    offset = torch.arange(-lead, lead + 1, dtype=arrivals.dtype, device=arrivals.device)
    kernel = torch.exp(-0.5 * (offset / sigma) ** 2)
    return convolve_time(arrivals, kernel / kernel.sum(), lead)
