"""Light that visits two hidden surfaces."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Number, Parameter, Quantity
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.irf import convolve_time
from nlos_lit.functional.surfel_paths import Paths, SplineSplat

CLUSTERS = 48
SAMPLES = 512  # surfels between which throughput is worked out
CLOSEST = 1e-3  # m between them: rounding leaves a fifth of that of two in the same place


class HigherOrderBounces(Effect):
    """The fourth bounce laser → wall → surfel a → surfel b → wall → sensor is added to the third.

    ``H_r → H_r + strength Σ_ab ρ_a ρ_b/(π ρ̄) · F_l(a) A_a · cosθ_ab cosθ_ba/(d_ab² + A/π) · A_b F_s(b)`` at
    ``d_la + d_ab + d_bs``, with ``F = cosθ_wall cosθ_surfel/d²`` of the leg from the wall.

    The common reflectances and 1/π of the wall are left out, as in the third bounce. A, the mean area of the
    two, keeps the throughput of touching surfels finite. No surfel hides another one.

    Estimator: surfels join in at most 48 clusters, cells of a cube lattice. Powers into and out of the
    clusters are exact sums over their surfels: what leaves surfel a towards b is the third bounce's energy
    over its other leg, ``ρ A F_l = energy/F_s``, and at most that of a surfel in full view: at its centre F_s
    may vanish where it does not at each of its points. The throughput between clusters is its mean over pairs
    of their surfels (of at most about 512 of them), the length likewise. Arrivals are blurred over a cell.

    Parameters: ``strength`` (1), null 0: mean albedo of the surfaces. Surfels know theirs but for a common
    factor, so that they are divided by their mean over the area, ρ̄. Quantity ``share`` (1): fourth bounce
    over third, known after a rendering without gradients (its last batch).

    Signature: a broad excess behind concave surfaces, from twice the shortest leg plus a gap on; none for one
    flat or convex surface.

    Degenerate with: ``irf_tail``, weak surfels behind the surface, ``background_slope``.

    Source: C. M. Goral et al., *Modeling the interaction of light between diffuse surfaces*, SIGGRAPH 1984;
    the bound for touching surfels: J. R. Wallace, K. A. Elmquist, E. A. Haines, *A ray tracing algorithm for
    progressive radiosity*, SIGGRAPH 1989.
    """

    name = "higher_order_bounces"
    imitated = ("echoes",)
    followed_by = ("free_response_wall",)
    words = EffectWords(
        phrase="light that bounced twice inside the hidden scene",
        cause="Surfaces that face each other exchange light, which arrives later than any direct path "
        "explains.",
        remedy="Nothing to repair: keep it in the model, or darken one of the facing surfaces.",
        headline="{share} of the light",
    )
    split_by: ClassVar = {
        "ghost_pulse": "a capture of a single flat target, where no light bounces twice",
        "irf_tail": "a capture of a single flat target, where no light bounces twice",
    }

    laser: Tensor
    sensor: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("laser", scan.laser.clone(), persistent=False)
        self.register_buffer("sensor", scan.sensor.clone(), persistent=False)
        self.ratio = math.nan

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        return (Parameter("strength", "1", 0.0, 0.1, 0.0, 5.0),)

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"strength": 1.0}

    def quantities(self) -> dict[str, Quantity]:
        strength = self.value("strength")
        reported = {"strength": Quantity(strength, "1")}
        if not math.isnan(self.ratio):
            reported["share"] = Quantity(strength * self.ratio, "1", kind="percent")
        return reported

    def numbers(self) -> dict[str, Number]:
        return {**super().numbers(), "share": Number("1", "percent")}

    def transients(
        self, transients: Tensor, energy: Tensor, albedo: Tensor, paths: Paths, spots: Tensor
    ) -> Tensor:
        mean = (albedo @ paths.area) / paths.area.sum()
        fourth = self.fourth_bounce(energy, albedo, paths, spots, transients.shape[1]) / mean
        if not torch.is_grad_enabled():
            self.ratio = float(fourth.sum()) / max(float(energy.sum()), 1e-30)
        return transients + self.value("strength") * fourth

    def fourth_bounce(
        self, energy: Tensor, albedo: Tensor, paths: Paths, spots: Tensor, n_bins: int
    ) -> Tensor:
        """Light on arrival, if albedos were no relative ones.

        Args:
            energy: ``[B, M, Q]`` of the third bounce.
            albedo: ``[M]`` of the surfels.
            paths: their geometry.
            spots: ``[B]`` indices into the scan.
            n_bins: of the record.

        Returns:
            ``[B, n_bins]``.
        """
        member, cell = clusters(paths.centre.detach())
        power = energy.sum(2)
        laser, laser_leg = throughput(self.laser[spots], paths)
        sensor, sensor_leg = (
            (laser, laser_leg) if self.scan.confocal else throughput(self.sensor[spots], paths)
        )
        most = albedo * paths.area
        into, out = torch.minimum(power / sensor, most * laser), torch.minimum(power / laser, most * sensor)
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
    away = centre - centre.amin(0)
    cell = max(float(away.max()) / CLUSTERS, 1e-6)
    sides = torch.tensor([1, 2 * CLUSTERS, 4 * CLUSTERS**2], device=centre.device)
    while True:
        cube = (torch.floor(away / cell).long() * sides).sum(1)
        cubes, index = torch.unique(cube, return_inverse=True)
        if len(cubes) <= CLUSTERS:
            return torch.nn.functional.one_hot(index, len(cubes)).to(centre.dtype), cell
        cell *= 1.15


def throughput(wall: Tensor, paths: Paths) -> tuple[Tensor, Tensor]:
    """``cosθ_wall cosθ_surfel/d²`` and d, from wall points to the surfels' centres.

    Args:
        wall: ``[B, 3]`` m; the wall's normal is +z.
        paths: for the surfels' centres and normals.

    Returns:
        ``[B, M]`` 1/m², and ``[B, M]`` m.
    """
    away = paths.centre - wall[:, None]
    square = away.square().sum(2)
    facing = -(away * paths.normal).sum(2)
    return (away[..., 2].clamp_min(0) * facing.clamp_min(0) / square**2).clamp_min(1e-6), torch.sqrt(square)


def between(paths: Paths, member: Tensor) -> tuple[Tensor, Tensor]:
    """``cosθ cosθ/(d² + A/π)`` and d between clusters, means over pairs of their surfels by area.

    Args:
        paths: for the surfels' centres, normals and areas.
        member: ``[M, C]`` ones and zeros, who belongs to which cluster.

    Returns:
        ``[C, C]`` 1/m², and ``[C, C]`` m.
    """
    rank = (member.cumsum(0) * member).sum(1) - 1
    chosen = torch.nonzero(rank % math.ceil(len(rank) / SAMPLES) == 0)[:, 0]
    centre, normal, area = paths.centre[chosen], paths.normal[chosen], paths.area[chosen]
    share = member[chosen] * area[:, None]
    share = share / share.sum(0)
    centre = centre - centre.mean(0)
    own = centre.square().sum(1)
    leaving = (normal @ centre.T - (normal * centre).sum(1)[:, None]).clamp_min(0)
    square = (own[:, None] + own - 2 * centre @ centre.T).clamp_min(CLOSEST**2)
    exchange = leaving * leaving.T / (square * (square + (area[:, None] + area) / (2 * math.pi)))
    total = share.T @ exchange @ share
    distance = share.T @ (exchange * torch.sqrt(square)) @ share
    return total, distance / (total + 1e-12)


def blurred(arrivals: Tensor, side: float) -> Tensor:
    """Arrivals spread in time as over two cells: a Gaussian of their joint standard deviation at 45°.

    Args:
        arrivals: ``[B, T]``.
        side: of a cell, in bins.

    Returns:
        ``[B, T]``.
    """
    sigma = max(side / math.sqrt(12), 1e-3)
    lead = math.ceil(3 * sigma)
    offset = torch.arange(-lead, lead + 1, dtype=arrivals.dtype, device=arrivals.device)
    kernel = torch.exp(-0.5 * (offset / sigma) ** 2)
    return convolve_time(arrivals, kernel / kernel.sum(), lead)
