"""Phasor-field imaging, paper Eq. 1-2 at t = 0: virtual illumination and Rayleigh-Sommerfeld propagation.

The field at a voxel is ``u(x_v) = Σ_f w_f(Ω_pf, σ_pf) A_f(x_v)``. Only the weights ``w`` depend on what is
optimised, so the propagated field ``A`` is computed once. The weights of all admissible (Ω_pf, σ_pf) span far
fewer dimensions than there are frequencies (a virtual pulse of a few σ_pf is short against the transient), so
``A`` is stored in an orthonormal basis of that span: ``u = Σ_r (Bᵀw)_r (A B)_r``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from nlos_lit.functional.even_convolution import (
    EvenAxis,
    Rotation,
    even_transform,
    fold,
    inverse,
    mirror,
    polar,
    runs,
    unfold,
)

ROWS = 1 << 15  # of the field that are converted at once on a CPU
RUN = 64  # rows that are summed in single precision


def virtual_illumination(omega: Tensor, omega_pf: Tensor, sigma_pf: Tensor) -> Tensor:
    """Spectrum of the virtual illumination ``P(t) = e^{iΩ_pf t} e^{-t²/(2σ_pf²)}`` (paper Eq. 1).

    ``w(Ω) = e^{-(Ω - Ω_pf)² σ_pf²/2}``: the Gaussian's Fourier transform, scaled to a unit peak.

    Args:
        omega: ``[F]`` frequencies of optical path, rad/m.
        omega_pf: central frequency Ω_pf, rad/m; broadcasts against ``omega``.
        sigma_pf: standard deviation σ_pf of the pulse, m of path.

    Returns:
        ``[F]`` (or as broadcast) in 0 … 1, differentiable in both parameters.

    Examples:
        >>> import torch
        >>> weights = virtual_illumination(torch.tensor([50.0, 60.0]), torch.tensor(50.0), torch.tensor(0.1))
        >>> weights, round(torch.exp(torch.tensor(-0.5)).item(), 4)
        (tensor([1.0000, 0.6065]), 0.6065)
    """
    return torch.exp(-0.5 * ((omega - omega_pf) * sigma_pf) ** 2)


def spectrum(counts: Tensor, time: Tensor, omega: Tensor) -> Tensor:
    """Spectrum of transients over optical path, ``U[f, s] = Σ_t H[s, t] e^{iΩ_f t}``.

    Args:
        counts: ``[S, T]`` transients H.
        time: ``[T]`` path length at the centres of bins, m.
        omega: ``[F]`` rad/m.

    Returns:
        ``[F, S]`` complex64; phases are worked out in double precision.

    Examples:
        >>> import math, torch
        >>> quarter = spectrum(torch.tensor([[3.0]]), torch.tensor([0.5]), torch.tensor([math.pi]))
        >>> torch.allclose(quarter, torch.tensor([[3.0j]]), atol=1e-6)
        True
    """
    phase = omega.double().to(counts.device)[:, None] * time.double().to(counts.device)
    kernel = torch.polar(torch.ones_like(phase), phase).to(torch.complex64)
    real = counts.to(torch.float32).T.contiguous()
    return torch.complex(kernel.real @ real, kernel.imag @ real)


def frequencies(
    omega_bounds: tuple[float, float], sigma_min: float, period: float, cutoff: float = 3.0
) -> Tensor:
    """Multiples of 2π/period that carry the spectrum of every admissible virtual pulse.

    Frequencies at and below zero are left out, although a pulse of few cycles has weight there. Against Eq.
    2, which has them, the volume changes by 1e-5 at σΩ = 5, 2e-4 at 4.6, 2 % at 3.4 and 13 % at 2.6.

    Args:
        omega_bounds: smallest and largest Ω_pf, rad/m.
        sigma_min: smallest σ_pf, m.
        period: path length after which the sampled pulse repeats, m.
        cutoff: half-width of the band around Ω_pf in units of 1/σ_pf.

    Returns:
        ``[F]`` rad/m, float64, ascending.

    Examples:
        >>> import math
        >>> band = frequencies((40.0, 60.0), sigma_min=0.3, period=2 * math.pi)  # 1 rad/m apart
        >>> len(band), band[0].item(), band[-1].item()
        (41, 30.0, 70.0)
    """
    step = 2 * math.pi / period
    first = max(1, math.floor((omega_bounds[0] - cutoff / sigma_min) / step))
    last = math.ceil((omega_bounds[1] + cutoff / sigma_min) / step)
    return step * torch.arange(first, last + 1, dtype=torch.float64)


def weight_basis(
    omega: Tensor, omega_bounds: tuple[float, float], sigma_bounds: tuple[float, float], tolerance: float
) -> Tensor:
    """Orthonormal basis whose span holds the spectrum of every admissible virtual illumination.

    The family is sampled densely against its own width (a fifth of 1/σ in Ω), so what lies between the
    samples is in the span too.

    Args:
        omega: ``[F]`` rad/m, float64.
        omega_bounds: smallest and largest Ω_pf, rad/m.
        sigma_bounds: smallest and largest σ_pf, m.
        tolerance: largest relative error of a spectrum, in the 2-norm.

    Returns:
        ``[F, R]`` float64 with orthonormal columns, R as small as the tolerance allows.

    Examples:
        >>> import math
        >>> omega = frequencies((40.0, 60.0), sigma_min=0.2, period=2 * math.pi)
        >>> basis = weight_basis(omega, (40.0, 60.0), (0.2, 0.4), tolerance=1e-3)
        >>> len(omega), basis.shape[1] < len(omega) / 2
        (51, True)
    """
    sigmas = torch.exp(
        torch.linspace(math.log(sigma_bounds[0]), math.log(sigma_bounds[1]), 24, dtype=torch.float64)
    )
    family = []
    for sigma in sigmas:
        count = 3 + int((omega_bounds[1] - omega_bounds[0]) * float(sigma) * 5)
        centres = torch.linspace(*omega_bounds, count, dtype=torch.float64)
        weights = virtual_illumination(omega[:, None], centres, sigma)
        family.append(weights / weights.norm(dim=0))
    samples = torch.cat(family, dim=1)
    left, _, _ = torch.linalg.svd(samples, full_matrices=False)
    for rank in range(1, left.shape[1] + 1):
        basis = left[:, :rank]
        if float((samples - basis @ (basis.T @ samples)).norm(dim=0).max()) <= tolerance:
            return basis
    return left


def lattice_phasors(
    field: Tensor,
    omega: Tensor,
    basis: Tensor,
    *,
    pitch: tuple[float, float],
    offset: tuple[int, int],
    shape: tuple[int, int],
    depth: Tensor,
    fixed: Tensor | None = None,
    voxel_origin: tuple[float, float] = (0.0, 0.0),
) -> Iterator[Tensor]:
    """Propagate a planar aperture to planes parallel to it, one at a time (paper Eq. 2 at t = 0).

    ``A_f(x_v) = Σ_s U[f, s] e^{-iΩ_f(|x_v - l_s| + |x_v - d_s|)}/(|x_v - l_s| |x_v - d_s|)`` as a linear
    (zero-padded) convolution over the lattice, projected on the basis.

    Args:
        field: ``[L, F, nx, ny]`` complex spectrum on the aperture lattice; L = 1 but for exhaustive scans.
        omega: ``[F]`` equally spaced, rad/m.
        basis: ``[F, R]`` as from :func:`weight_basis`.
        pitch: spacing of the lattice, m; voxels lie on the same lattice.
        offset: index of the first voxel column and row relative to the aperture's first point.
        shape: ``(mx, my)`` voxels of a plane.
        depth: ``[nz]`` distances of the planes from the aperture, m.
        fixed: ``[L, 3]`` the other wall point of each of the L scans (relative to the aperture's plane), m;
            None when confocal.
        voxel_origin: x, y of voxel [0, 0] in the frame of ``fixed``, m.

    Yields:
        ``[mx·my, 2, R]`` float32, real and imaginary part, plane after plane.
    """
    n_scans, n_freq, nx, ny = field.shape
    device, rank = field.device, basis.shape[1]
    x, y = (EvenAxis(n, m, o, device) for n, m, o in zip((nx, ny), shape, offset, strict=True))
    folded = (4, x.half, y.half) if fixed is None else (x.length, y.length)
    spectra = torch.empty(n_scans, n_freq, *folded, dtype=torch.complex64, device=device)
    for scan, part in itertools.product(range(n_scans), runs(n_freq, x.length * y.length, device)):
        shifted = torch.fft.fft2(field[scan, part], s=(x.length, y.length)) * (x.shift[:, None] * y.shift)
        spectra[scan, part] = fold(shifted, x, y) if fixed is None else shifted
    del field, shifted
    lateral = ((pitch[0] * x.lags) ** 2)[:, None] + (pitch[1] * y.lags) ** 2
    weights = basis.to(device=device, dtype=torch.float32)
    if fixed is None:
        step, wave = 2 * _step(omega), 2 * omega.to(device)
        parts, spread = (
            runs(n_freq, x.half * y.half, device),
            torch.empty(n_freq, x.half, y.half, dtype=torch.complex64, device=device),
        )
        for z in depth.tolist():
            kernel = Rotation(torch.sqrt(lateral + z * z), step, n_freq, 2)
            for part in parts:
                spread[part] = even_transform(kernel.values(wave, part), x, y)
            mixed = torch.empty(rank, *folded, 2, device=device)
            for quarter, rows in itertools.product(range(4), runs(x.half, n_freq * y.half, device)):
                product = spectra[0, :, quarter, rows] * spread[:, rows]
                mixed[:, quarter, rows] = (weights.T @ _real_rows(product)).view(rank, -1, y.half, 2)
            yield _voxels_first(inverse(unfold(torch.view_as_complex(mixed), x, y), *shape))
        return
    step, wave = _step(omega), omega.to(device)
    xs = voxel_origin[0] + pitch[0] * torch.arange(shape[0], dtype=torch.float64, device=device)
    ys = voxel_origin[1] + pitch[1] * torch.arange(shape[1], dtype=torch.float64, device=device)
    for z in depth.tolist():
        kernel = Rotation(torch.sqrt(lateral + z * z), step, n_freq, 1)
        to_fixed = [
            torch.sqrt((xs[:, None] - p[0]) ** 2 + (ys - p[1]) ** 2 + (z - p[2]) ** 2)
            for p in fixed.to(device)
        ]
        legs = [Rotation(distance, step, n_freq, 1) for distance in to_fixed]
        mixed = torch.zeros(rank, shape[0] * shape[1] * 2, device=device)
        for part in runs(n_freq, x.length * y.length, device):
            spread = mirror(mirror(even_transform(kernel.values(wave, part), x, y), 1, x), 2, y)
            for scan, leg in enumerate(legs):
                arrived = inverse(spectra[scan, part] * spread, *shape)
                mixed.addmm_(weights[part].T, _real_rows(arrived * leg.values(wave, part)))
        yield _voxels_first(torch.view_as_complex(mixed.view(rank, -1, 2)))


def _voxels_first(plane: Tensor) -> Tensor:
    """Complex ``[R, …]`` as real ``[V, 2, R]``."""
    return torch.view_as_real(plane.reshape(len(plane), -1)).permute(1, 2, 0)


def direct_phasors(
    field: Tensor,
    omega: Tensor,
    basis: Tensor,
    laser: Tensor,
    sensor: Tensor,
    voxels: Tensor,
    block: int = 256,
) -> Iterator[Tensor]:
    """The sum of :func:`lattice_phasors` for any wall and any spots, voxel block after voxel block.

    Args:
        field: ``[F, S]`` complex spectrum per spot.
        omega: ``[F]`` equally spaced, rad/m.
        basis: ``[F, R]`` as from :func:`weight_basis`.
        laser: ``[S, 3]`` illuminated wall points, m.
        sensor: ``[S, 3]`` observed wall points, m.
        voxels: ``[V, 3]`` m.
        block: voxels worked on at once.

    Yields:
        ``[≤ block, 2, R]`` float32, real and imaginary part, block after block.

    Examples:
        One spot, one voxel 1 m away there and back, one frequency: magnitude 1/d² = 1, phase -2Ω.

        >>> import torch
        >>> one, spot = torch.ones(1, 1), torch.zeros(1, 3)
        >>> voxel, omega = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([torch.pi], dtype=torch.float64)
        >>> (block,) = direct_phasors(one.to(torch.complex64), omega, one, spot, spot, voxel)
        >>> torch.allclose(block[0, :, 0], torch.tensor([1.0, 0.0]), atol=1e-6)
        True
    """
    device = field.device
    weights = basis.to(device=device, dtype=torch.float32)
    omega = omega.to(device)
    step = _step(omega)
    same = torch.equal(laser, sensor)
    for chunk in voxels.to(device).split(block):
        to_sensor = torch.cdist(chunk.double(), sensor.to(device).double())
        to_laser = to_sensor if same else torch.cdist(chunk.double(), laser.to(device).double())
        path = to_sensor + to_laser
        factor = polar(1 / (to_sensor * to_laser), -omega[0] * path)
        advance = polar(torch.ones_like(path), -step * path)
        values = torch.empty(len(omega), len(chunk), dtype=torch.complex64, device=device)
        for f in range(len(omega)):
            values[f] = factor @ field[f]
            factor = factor * advance
        yield torch.view_as_real(_mix(weights, values)).permute(1, 2, 0).contiguous()


def sum_of_rows(pull: Tensor, rows: Tensor) -> Tensor:
    """``Σ_n pull[n] rows[n]`` in nearly double precision at the speed of single.

    Runs of 64 rows are summed in single precision, these sums in double. What Ω_pf gets of this sum is
    thousands of times smaller than the sum, so that its last digits count.

    Args:
        pull: ``[N]``.
        rows: ``[N, R]``.

    Returns:
        ``[R]`` float64.

    Examples:
        >>> import torch
        >>> sum_of_rows(torch.ones(100), torch.ones(100, 2))
        tensor([100., 100.], dtype=torch.float64)
    """
    whole = len(rows) // RUN * RUN
    sums = torch.bmm(pull[:whole].view(-1, 1, RUN), rows[:whole].view(-1, RUN, rows.shape[1]))
    return sums.sum((0, 1), dtype=torch.float64) + (pull[whole:] @ rows[whole:]).double()


class PhasorMagnitude(torch.autograd.Function):
    """``|Σ_r w_r A[v, r]|`` for all voxels; the backward pass touches only those that received a gradient.

    Inputs: basis field ``[V, 2, R]`` (any float type) and weights ``[R]``, whose gradient is summed in double
    precision; to be kept they must be float64. Output ``[V]`` float32 (float64 from a float64 field),
    m⁻²-weighted counts.
    """

    @staticmethod
    def forward(ctx: Any, field: Tensor, weights: Tensor) -> Tensor:
        """``[V]`` magnitudes."""
        voxels = field.shape[0]
        rows = field.reshape(2 * voxels, -1)
        weights = weights.to(torch.promote_types(field.dtype, torch.float32))
        if field.dtype == weights.dtype:
            parts = (rows @ weights).view(voxels, 2)
        else:
            parts = torch.cat([chunk.to(weights.dtype) @ weights for chunk in rows.split(ROWS)]).view(
                voxels, 2
            )
        magnitude = torch.linalg.vector_norm(parts, dim=1)
        ctx.save_for_backward(field, parts, magnitude)
        return magnitude

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        """``[R]`` float64 gradient of the weights from ``[V]`` of the magnitudes; the field has none."""
        field, parts, magnitude = ctx.saved_tensors
        if field.device.type != "cpu":  # what the host would have to wait for costs more than all voxels
            pull = parts * torch.where(magnitude > 0, grad / magnitude, 0.0)[:, None]
            rows = field.reshape(2 * len(field), -1)
            if rows.dtype == parts.dtype:
                return None, sum_of_rows(pull.view(-1), rows)
            pairs = zip(pull.view(-1).split(ROWS), rows.split(ROWS), strict=True)
            sums = [sum_of_rows(part, chunk.to(part.dtype)) for part, chunk in pairs]
            return None, sum(sums[1:], start=sums[0])
        touched = torch.nonzero((grad != 0) & (magnitude > 0)).squeeze(1)
        result = torch.zeros(field.shape[2], dtype=torch.float64)
        # Collecting these rows takes most of the time, so they may as well be doubled.
        for chunk in touched.split(ROWS):
            pull = parts[chunk] * (grad[chunk] / magnitude[chunk])[:, None]
            result += pull.reshape(-1).double() @ field[chunk].double().reshape(-1, len(result))
        return None, result


def _mix(weights: Tensor, values: Tensor) -> Tensor:
    """``Σ_f weights[f, r] values[f, …]`` with real weights and complex values."""
    flat = torch.view_as_real(values.contiguous()).reshape(values.shape[0], -1)
    return torch.view_as_complex((weights.T @ flat).reshape(-1, *values.shape[1:], 2))


def _step(omega: Tensor) -> float:
    return float(omega[1] - omega[0]) if len(omega) > 1 else 0.0


def _real_rows(values: Tensor) -> Tensor:
    """Complex ``[F, …]`` as real ``[F, 2·…]``."""
    return torch.view_as_real(values.contiguous()).reshape(len(values), -1)
