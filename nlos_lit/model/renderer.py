"""Transient rendering of the implicit surface: paths laser → x_g → sensor (paper Sec. 3.2, 4.3, Eq. 5-9)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from nlos_lit.functional.splat import gaussian_splat
from nlos_lit.model.geometry import Surface


class TransientRenderer(nn.Module):
    """Surface points and albedo → transients H_r ``[S, T]`` before the laser-sensor response.

    A ray of solid angle ``dω = 2π/n²`` from the sensor's wall point meets the area ``dω d_gs²/cosθ_3``, so
    Eq. 8 integrated over that area is ``K = ρ cosθ_1 cosθ_2 cosθ_4 / d_lg² · dω``: the inverse square and the
    cosine on the sensor's leg cancel exactly. The constant ρ_w²/π³ of radiometry is part of the laser
    intensity I_l.

    Args:
        n_bins: T, bins of the transients.
        bin_length: path length of a bin, m.
        t_start: path length at the start of bin 0, m.
        rays: number of rays over the hemisphere (n²).
        splat_sigma: σ_t in bins.
        conserve_energy: normalise each path's splat (see :func:`~nlos_lit.functional.splat.gaussian_splat`).
    """

    def __init__(
        self,
        *,
        n_bins: int,
        bin_length: float,
        t_start: float,
        rays: int,
        splat_sigma: float = 0.62,
        conserve_energy: bool = True,
    ) -> None:
        super().__init__()
        self.n_bins, self.bin_length, self.t_start = n_bins, bin_length, t_start
        self.solid_angle = 2 * math.pi / rays
        self.splat_sigma, self.conserve_energy = splat_sigma, conserve_energy

    def forward(
        self,
        surface: Surface,
        albedo: Tensor,
        laser: Tensor,
        laser_normal: Tensor,
        sensor: Tensor,
        sensor_normal: Tensor,
    ) -> Tensor:
        """Transients of a batch of S spots.

        Args:
            surface: K points seen from the sensor's wall points.
            albedo: ``[K]`` ρ at the surface points.
            laser: ``[S, 3]`` illuminated wall points, m.
            laser_normal: ``[S, 3]`` unit normals there.
            sensor: ``[S, 3]`` observed wall points, m.
            sensor_normal: ``[S, 3]`` unit normals there.

        Returns:
            H_r ``[S, T]``, 1/m² times the solid angle.
        """
        spot = surface.spot
        contribution = (
            albedo
            * throughput(surface, laser[spot], laser_normal[spot], sensor_normal[spot])
            * self.solid_angle
        )
        leg = torch.linalg.vector_norm(surface.point - laser[spot], dim=1)
        time = (leg + surface.distance - self.t_start) / self.bin_length
        return gaussian_splat(
            contribution, time, spot, sensor.shape[0], self.n_bins, self.splat_sigma, self.conserve_energy
        )


def throughput(surface: Surface, laser: Tensor, laser_normal: Tensor, sensor_normal: Tensor) -> Tensor:
    """Throughput ``cosθ_1 cosθ_2 cosθ_4 / d_lg²`` of paths, with absolute cosines as in the paper's Eq. 6.

    Args:
        surface: K points seen from the sensor's wall points.
        laser: ``[K, 3]`` illuminated wall point of each path, m.
        laser_normal: ``[K, 3]`` unit normals there.
        sensor_normal: ``[K, 3]`` unit normals at the observed wall points.

    Returns:
        ``[K]`` 1/m².

    Examples:
        A point 2 m straight ahead of a confocal spot, facing it: 1/d².

        >>> import torch
        >>> up, origin = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3)
        >>> ahead = Surface(torch.tensor([0]), torch.tensor([2.0]), up, 2 * up, -up)
        >>> throughput(ahead, origin, up, up)
        tensor([0.2500])
    """
    ray = surface.point - laser
    leg = torch.linalg.vector_norm(ray, dim=1)
    unit = ray / leg[:, None]
    leave_wall = (unit * laser_normal).sum(1).abs()
    reach_surface = (unit * surface.normal).sum(1).abs()
    reach_wall = (surface.direction * sensor_normal).sum(1).abs()
    return leave_wall * reach_surface * reach_wall / leg**2
