"""The paper's equations written out: dense, slow, float64. Nothing here shares code with the package; tests
compare the two.

Everything is evaluated where the paper evaluates it: every frequency of the virtual illumination, every spot
and voxel, every sample of every ray, every time bin of every path. Equation and section numbers are the
paper's. Lengths in metres, time as optical path length.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

DOUBLE = torch.float64


class Field(NamedTuple):
    """Propagated phasors of one capture: what Eq. 2 integrates, but for the virtual illumination."""

    omega: Tensor  # [F] rad/m
    phasors: Tensor  # [F, V] complex128


def bounded(raw: Tensor, lower: float, upper: float) -> Tensor:
    """A positive quantity that is log-uniform between its bounds."""
    return lower * (upper / lower) ** (1 / (1 + torch.exp(-raw)))


def voxel_centres(origin, pitch, shape) -> Tensor:
    """``[nz, nx, ny, 3]`` centres of a grid given by ``(x, y, z)`` origin and pitch and ``(nz, nx, ny)``
    shape.
    """
    nz, nx, ny = shape
    centres = torch.empty(nz, nx, ny, 3, dtype=DOUBLE)
    centres[..., 0] = (origin[0] + pitch[0] * torch.arange(nx, dtype=DOUBLE))[None, :, None]
    centres[..., 1] = (origin[1] + pitch[1] * torch.arange(ny, dtype=DOUBLE))[None, None, :]
    centres[..., 2] = (origin[2] + pitch[2] * torch.arange(nz, dtype=DOUBLE))[:, None, None]
    return centres


def propagate(
    counts: Tensor, time: Tensor, laser: Tensor, sensor: Tensor, voxels: Tensor, omega: Tensor
) -> Field:
    """The inner integrals of Eq. 2 for every frequency: ``Σ_s e^{-iΩ(d_lv + d_vs)}/(d_lv d_vs) Σ_t H[s, t]
    e^{iΩt}``.
    """
    flat = voxels.reshape(-1, 3)
    to_laser = torch.linalg.vector_norm(flat[:, None] - laser, dim=2)
    to_sensor = torch.linalg.vector_norm(flat[:, None] - sensor, dim=2)
    rows = []
    for frequency in omega.tolist():
        measured = (counts * torch.exp(1j * frequency * time)).sum(1)
        kernel = torch.exp(-1j * frequency * (to_laser + to_sensor)) / (to_laser * to_sensor)
        rows.append(kernel @ measured)
    return Field(omega, torch.stack(rows))


def frequencies(omega_pf: float, sigma_pf: float, longest: float, widths: float = 6.5) -> Tensor:
    """Equally spaced over all that the virtual pulse contains, negative ones too, fine enough for paths up to
    ``longest``.
    """
    step = 2 * math.pi / (longest + 2 * widths * sigma_pf)
    half = math.ceil(widths / sigma_pf / step)
    return omega_pf + step * torch.arange(-half, half + 1, dtype=DOUBLE)


def intensity(
    field: Field,
    omega_pf: Tensor,
    sigma_pf: Tensor,
    depth: Tensor,
    shape,
    power: float,
    depth_exponent: float,
) -> Tensor:
    """Eq. 1-2 at t = 0: ``|∫ P(Ω) … dΩ|^power · z^depth_exponent``, divided by its maximum."""
    illumination = torch.exp(-0.5 * (field.omega - omega_pf) ** 2 * sigma_pf**2)
    wave = (illumination[:, None] * field.phasors).sum(0).reshape(shape)
    magnitude = torch.sqrt(wave.real**2 + wave.imag**2)
    volume = magnitude**power * depth[:, None, None] ** depth_exponent
    return volume / volume.max()


def pulse_intensity(counts, time, laser, sensor, voxels, omega_pf: float, sigma_pf: float) -> Tensor:
    """``|u|`` of Eq. 2 in the time domain: each photon contributes the virtual pulse at (its time - the
    path's length).
    """
    flat = voxels.reshape(-1, 3)
    to_laser = torch.linalg.vector_norm(flat[:, None] - laser, dim=2)
    to_sensor = torch.linalg.vector_norm(flat[:, None] - sensor, dim=2)
    total = torch.zeros(len(flat), dtype=torch.complex128)
    for k, t in enumerate(time.tolist()):
        delay = t - to_laser - to_sensor
        pulse = torch.exp(1j * omega_pf * delay) * torch.exp(-(delay**2) / (2 * sigma_pf**2))
        total += (pulse / (to_laser * to_sensor)) @ counts[:, k].to(torch.complex128)
    return total.abs().reshape(voxels.shape[:3])


def concentric_directions(n: int) -> Tensor:
    """``[n·n, 3]``: centres of an n × n grid through Shirley and Chiu's square → disk → hemisphere map, one
    at a time.
    """
    rows = []
    for i in range(n):
        for j in range(n):
            a, b = (2 * i + 1) / n - 1, (2 * j + 1) / n - 1
            if a == 0 and b == 0:
                r, phi = 0.0, 0.0
            elif a > -b:
                r, phi = (a, math.pi / 4 * (b / a)) if a > b else (b, math.pi / 4 * (2 - a / b))
            else:
                r, phi = (-a, math.pi / 4 * (4 + b / a)) if a < b else (-b, math.pi / 4 * (6 - a / b))
            out = r * math.sqrt(2 - r * r)
            rows.append((out * math.cos(phi), out * math.sin(phi), 1 - r * r))
    return torch.tensor(rows, dtype=DOUBLE)


def local_frame(normal: Tensor) -> Tensor:
    """Columns x, y, z of a wall point's frame: z the normal, x horizontal."""
    up = (
        torch.tensor([0.0, 1.0, 0.0], dtype=DOUBLE)
        if abs(normal[1]) < 0.9
        else torch.tensor([1.0, 0.0, 0.0], dtype=DOUBLE)
    )
    x = torch.linalg.cross(up, normal)
    x = x / x.norm()
    return torch.stack([x, torch.linalg.cross(normal, x), normal], dim=1)


def interpolate(volume: Tensor, points: Tensor, origin, pitch) -> tuple[Tensor, Tensor]:
    """Trilinear values at ``points`` ``[M, 3]``, and which of them lie inside the box of voxel centres; 0
    outside it.
    """
    nz, nx, ny = volume.shape
    steps = (points - torch.tensor(origin, dtype=DOUBLE)) / torch.tensor(pitch, dtype=DOUBLE)
    u, v, w = steps.unbind(1)
    inside = (u >= 0) & (u <= nx - 1) & (v >= 0) & (v <= ny - 1) & (w >= 0) & (w <= nz - 1)
    total = torch.zeros(len(points), dtype=DOUBLE)
    i0, j0, k0 = (
        torch.clamp(torch.floor(c.detach()), 0, max(n - 2, 0)).long() for c, n in ((u, nx), (v, ny), (w, nz))
    )
    for di in (0, 1):
        for dj in (0, 1):
            for dk in (0, 1):
                i, j, k = (
                    (i0 + di).clamp_max(nx - 1),
                    (j0 + dj).clamp_max(ny - 1),
                    (k0 + dk).clamp_max(nz - 1),
                )
                share = (
                    (1 - (u - (i0 + di)).abs()) * (1 - (v - (j0 + dj)).abs()) * (1 - (w - (k0 + dk)).abs())
                )
                total = total + volume[k, i, j] * share
    return torch.where(inside, total, torch.zeros_like(total)), inside


class Points(NamedTuple):
    """Per spot and ray ``[S, n, n]``: whether it meets a surface, its distance, point and normal."""

    hit: Tensor
    distance: Tensor
    point: Tensor
    direction: Tensor
    normal: Tensor  # zero where there is none
    valid: Tensor


def surface(
    volume, origin, pitch, wall, wall_normal, n, threshold, step, beta, farthest, fine: int | None = None
) -> Points:
    """Sec. 4.2: every ray, every sample, softargmax over all of them with intensities below the threshold set
    to zero.

    With ``fine`` (not in the paper) the softargmax runs over ``2·fine + 1`` samples from one step before to
    one step behind the largest one instead, and β applies to intensities relative to the largest of these.
    """
    spots = len(wall)
    frames = torch.stack([local_frame(m) for m in wall_normal])
    direction = torch.einsum("sij,rj->sri", frames, concentric_directions(n))
    distances = ((torch.arange(math.ceil(farthest / step), dtype=DOUBLE) + 0.5) * step).expand(
        spots, n * n, -1
    )

    def along(distances: Tensor) -> Tensor:
        samples = wall[:, None, None] + distances[..., None] * direction[:, :, None]
        return interpolate(volume, samples.reshape(-1, 3), origin, pitch)[0].reshape(distances.shape)

    value = along(distances)
    value = torch.where(value >= threshold, value, torch.zeros_like(value))
    hit = value.detach().amax(2) >= threshold
    if fine is not None:
        best = distances.gather(2, value.detach().argmax(2, keepdim=True))
        distances = best + torch.arange(-fine, fine + 1, dtype=DOUBLE) * (step / fine)
        value = along(distances)
        value = value / torch.where(hit, value.amax(2), torch.ones_like(value[..., 0]))[..., None]
    weight = torch.exp(beta * (value - value.detach().amax(2, keepdim=True)))
    distance = (weight * distances).sum(2) / weight.sum(2)
    point = wall[:, None] + distance[..., None] * direction
    grid = [spots, n, n]
    hit, distance = hit.reshape(grid), distance.reshape(grid)
    point, direction = point.reshape([*grid, 3]), direction.reshape([*grid, 3])
    normal, valid = normals(hit, point, direction)
    return Points(hit, distance, point, direction, normal, valid)


def normals(hit: Tensor, point: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Sum of the normals of the triangles N-E-S and S-W-N of the neighbouring rays' points, towards the wall.

    A neighbour without a surface is replaced by the ray's own point; a ray with neither of two opposite
    neighbours has none.
    """

    def shifted(di: int, dj: int) -> tuple[Tensor, Tensor]:
        there = torch.zeros_like(hit)
        moved = point.clone()
        n = hit.shape[1]
        here_i, from_i = slice(max(0, -di), n - max(0, di)), slice(max(0, di), n - max(0, -di))
        here_j, from_j = slice(max(0, -dj), n - max(0, dj)), slice(max(0, dj), n - max(0, -dj))
        there[:, here_i, here_j] = hit[:, from_i, from_j]
        moved[:, here_i, here_j] = point[:, from_i, from_j]
        return torch.where(there[..., None], moved, point), there

    (east, has_e), (west, has_w) = shifted(1, 0), shifted(-1, 0)
    (south, has_s), (north, has_n) = shifted(0, 1), shifted(0, -1)
    first = torch.linalg.cross(east - north, south - north)
    second = torch.linalg.cross(west - south, north - south)
    total = first + second
    valid = hit & (has_e | has_w) & (has_s | has_n)
    length = torch.sqrt(torch.where(valid, (total**2).sum(-1), torch.ones_like(total[..., 0])))
    unit = torch.where(valid[..., None], total / length[..., None], torch.zeros_like(total))
    away = ((unit * direction).sum(-1) > 0)[..., None]
    return torch.where(away, -unit, unit), valid


def contributions(
    found: Points, albedo: Tensor, laser, laser_normal, sensor, sensor_normal, n: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Eq. 5-6 of every ray with a surface: (K, path length, spot), each path integrated over the area its ray
    sees.
    """
    spot, row, column = torch.nonzero(found.valid, as_tuple=True)
    point, normal = found.point[spot, row, column], found.normal[spot, row, column]
    to_light, to_eye = laser[spot] - point, sensor[spot] - point
    d_lg, d_gs = to_light.norm(dim=1), to_eye.norm(dim=1)
    to_light, to_eye = to_light / d_lg[:, None], to_eye / d_gs[:, None]
    cos1 = (-to_light * laser_normal[spot]).sum(1).abs()
    cos2 = (to_light * normal).sum(1).abs()
    cos3 = (to_eye * normal).sum(1).abs()
    cos4 = (-to_eye * sensor_normal[spot]).sum(1).abs()
    throughput = cos1 * cos2 / d_lg**2 * cos3 * cos4 / d_gs**2
    area = 2 * math.pi / n**2 * d_gs**2 / cos3
    return albedo * throughput * area, d_lg + d_gs, spot


def rendered_transients(k, path, spot, n_spots, n_bins, bin_length, t_start, sigma_t, normalise) -> Tensor:
    """Eq. 7-9: every path spread over all bins by the Gaussian in bins; ``normalise`` divides by its sum over
    the whole axis.
    """
    margin = 40
    index = torch.arange(-margin, n_bins + margin, dtype=DOUBLE) + 0.5
    arrival = (path - t_start) / bin_length
    gauss = torch.exp(-((index - arrival[:, None]) ** 2) / (2 * sigma_t**2))
    if normalise:
        gauss = gauss / gauss.sum(1, keepdim=True)
    one_hot = (spot == torch.arange(n_spots)[:, None]).to(DOUBLE)
    return (one_hot @ (k[:, None] * gauss))[:, margin : margin + n_bins]


def psi(sigma: Tensor, kappa: Tensor, first: int, last: int, fine: int = 64) -> Tensor:
    """Eq. 10 per bin, without I_l: a sampled exponential convolved with a sampled Gaussian, then summed over
    each bin.

    Args:
        sigma, kappa: in bins and per bin; first, last: bins before and after the arrival, ``[last - first +
            1]`` results.
    """
    dt = 1 / fine
    length = math.ceil(32 / float(kappa.detach()) / dt)
    decay = kappa * torch.exp(-kappa * (torch.arange(length, dtype=DOUBLE) + 0.5) * dt) * dt
    bins = last - first + 1
    # Sub-bin m lies at first - 1/2 + (m + 1/2) dt, the exponential's sample j at (j + 1/2) dt: their
    # differences are a grid again.
    lag = first - 0.5 + torch.arange(1 - length, bins * fine, dtype=DOUBLE) * dt
    gauss = torch.exp(-(lag**2) / (2 * sigma**2)) / (sigma * math.sqrt(2 * math.pi))
    sampled = torch.nn.functional.conv1d(gauss[None, None], decay.flip(0)[None, None])[0, 0]
    return sampled.reshape(bins, fine).sum(1) * dt


def sensed(rendered: Tensor, sigma: Tensor, kappa: Tensor, gain: Tensor, background: Tensor) -> Tensor:
    """Eq. 11: ``H_R[τ] = I_l Σ_τ' Ψ(τ - τ') H_r[τ'] + η_s``, the sum written as a matrix over all pairs of
    bins.
    """
    bins = rendered.shape[1]
    share = psi(sigma, kappa, 1 - bins, bins - 1)
    pair = torch.arange(bins)[:, None] - torch.arange(bins) + bins - 1
    return gain * rendered @ share[pair].T + background


def splat_variance(sigma_t: float) -> float:
    """Mean squared distance in bins from arrival to bin centre under the normalised Gaussian, over all
    sub-bin phases.
    """
    total = 0.0
    for phase in range(1000):
        arrival = (phase + 0.5) / 1000
        weights = [
            (math.exp(-((k + 0.5 - arrival) ** 2) / (2 * sigma_t**2)), (k + 0.5 - arrival) ** 2)
            for k in range(-40, 41)
        ]
        total += sum(w * d for w, d in weights) / sum(w for w, _ in weights)
    return total / 1000


def data_term(measured: Tensor, rendered: Tensor) -> Tensor:
    """E_H, Eq. 13 of the paper's source: squared differences over all elements, divided by their number."""
    return sum(((m - r) ** 2).sum() for m, r in zip(measured, rendered, strict=True)) / measured.numel()


def sparsity_term(volume: Tensor) -> Tensor:
    """E_Ipf/λ1: mean over pixels of the largest intensity along z."""
    return (
        torch.stack([volume[:, i, j].max() for i in range(volume.shape[1]) for j in range(volume.shape[2])])
        .abs()
        .mean()
    )


def variation_term(albedo: Tensor) -> Tensor:
    """E_ρ/λ2: mean over voxels of the summed absolute forward differences along x and y."""
    nz, nx, ny = albedo.shape
    total = sum((albedo[:, i + 1] - albedo[:, i]).abs().sum() for i in range(nx - 1))
    total = total + sum((albedo[:, :, j + 1] - albedo[:, :, j]).abs().sum() for j in range(ny - 1))
    return total / (nz * nx * ny)


def relative(found: Tensor, expected: Tensor) -> float:
    """‖found - expected‖/‖expected‖."""
    expected = expected.detach().to(DOUBLE)
    return float((found.detach().to(DOUBLE) - expected).norm() / expected.norm())
