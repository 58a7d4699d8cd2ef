"""f-k migration: confocal transients as a wave field, carried back to the moment of its emission.

Lindell, Wetzstein, O'Toole, *Wave-based non-line-of-sight imaging using fast f-k migration*, ACM Trans.
Graph. 38, 116 (2019), after Stolt, Geophysics 43, 23 (1978). With ``ζ = path/2`` the field of sources that
explode at ζ = 0 has unit speed; the spectrum ``Φ(kx, ky, f)`` of what the wall receives, ``Ψ(x, y, 0, ζ)``,
gives the field at ζ = 0:

    Ψ(x, y, z, 0) = ∭ kz/f · Φ(kx, ky, f) e^{i(kx x + ky y + kz z)} dkx dky dkz,      f = √(kx² + ky² + kz²).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.fft import next_fast_len

from nlos_lit.baselines.inputs import confocal_lattice, gated_bins, gated_transients
from nlos_lit.baselines.resample import apply_weights, linear_weights
from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid, path_range

_SCRATCH = 24 << 20  # bytes that the allocator and the libraries were seen to keep besides


def fk(capture: Capture, grid: VolumeGrid, *, falloff: float = 4.0) -> torch.Tensor:
    """f-k migration of the square root of the counts: squared magnitude of the migrated field.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct; zero outside the scanned rectangle and outside the depths of the gate.
        falloff: how counts fall with distance: 4 for diffuse, 2 for retroreflective surfaces.

    Returns:
        ``[nz, nx, ny]`` float32, nonnegative, in counts times m^falloff.

    Raises:
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    lattice = confocal_lattice(capture, "f-k")
    transients, start = gated_transients(capture, path_range(capture, grid)[1], falloff)
    bins, step = transients.shape[1], capture.bin_length / 2
    field = transients[torch.from_numpy(lattice.spots)].sqrt_().T.reshape(bins, *lattice.shape)
    del transients
    image = stolt(field, lattice.pitch, step, start / 2 + step / 2)
    power = torch.view_as_real(image).square().sum(-1)
    del image
    along_x, along_y = (
        linear_weights(
            lattice.origin[a], lattice.pitch[a], lattice.shape[a], (grid.x, grid.y)[a], grid.pitch[a]
        )
        for a in (0, 1)
    )
    along_z = linear_weights(start / 2 + step / 2, step, bins, grid.z - lattice.origin[2], grid.pitch[2])
    return apply_weights(power, along_z, along_x, along_y)


def stolt(field: torch.Tensor, pitch: tuple[float, float], step: float, first: float) -> torch.Tensor:
    """The field at ζ = 0 from the field at the wall, by Stolt's change of variable.

    Interpolation in ``f`` by cubic B-splines multiplies the record by sinc⁴ of ζ over the padded length; with
    ζ counted from the middle of the record and the record divided by that sinc⁴ beforehand, it is accurate at
    every depth.

    Args:
        field: ``[N, nx, ny]`` real samples at ``ζ = first + k·step``.
        pitch: lattice pitch, m.
        step: spacing of ζ and z, m.
        first: ζ of sample 0, m, which is also the z of plane 0 of the result.

    Returns:
        ``[N, nx, ny]`` complex64 at ``z = first + k·step``, twice the part with ``kz > 0``: its real
        part is the field, its magnitude the envelope.
    """
    bins, nx, ny = field.shape
    size, px, py = (next_fast_len(2 * n, real=True) for n in (bins, nx, ny))
    middle = bins // 2
    taper = torch.sinc((torch.arange(bins, dtype=torch.float64) - middle) / size).pow(4).float()
    padded = torch.zeros(size, nx, ny)
    padded[: bins - middle] = field[middle:] / taper[middle:, None, None]
    padded[size - middle :] = field[:middle] / taper[:middle, None, None]
    spectrum = torch.fft.fft2(torch.fft.rfft(padded, dim=0), s=(px, py))
    del padded
    kz = torch.fft.rfftfreq(size, step)[:, None, None]
    kx, ky = (torch.fft.fftfreq(n, d) for n, d in zip((px, py), pitch, strict=True))
    origin = 2 * np.pi * (first + middle * step)
    last = len(kz) - 1
    rows = _rows(len(kz), px, py)
    for i in range(0, px, rows):
        block = spectrum[:, i : i + rows]
        lateral = kx[i : i + rows, None] ** 2 + ky**2
        frequency = torch.sqrt(kz**2 + lateral).clamp_(min=1e-30)
        position = frequency / kz[1]
        outside = position > last + 1e-3
        low = position.long().clamp_(max=last)
        bounded = torch.cat([block[:1], block, block[-1:], block[-1:]])
        moved = torch.zeros_like(block)
        for tap, weight in enumerate(_cubic_weights(position.sub_(low))):
            moved.addcmul_(bounded[tap : tap + len(kz)].gather(0, low), weight.to(block.dtype))
        jacobian = (kz / frequency).masked_fill_(outside, 0)
        phase = lateral.mul(-origin) / frequency.add_(kz)  # (kz - f)·origin, without the cancellation
        torch.mul(moved, torch.polar(jacobian, phase), out=block)
    columns = torch.fft.ifft2(spectrum)[:, :nx, :ny]
    del spectrum
    image = torch.fft.ifft(columns, n=size, dim=0).mul_(2)
    return torch.cat([image[size - middle :], image[: bins - middle]])


def fk_bytes(capture: Capture, grid: VolumeGrid) -> int:
    """Bytes that :func:`fk` allocates at its peak.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct.

    Returns:
        Bytes, beyond the capture's counts.

    Raises:
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    lattice = confocal_lattice(capture, "f-k")
    bins = gated_bins(capture, grid)
    size, px, py = (next_fast_len(2 * n, real=True) for n in (bins, *lattice.shape))
    half = size // 2 + 1
    block = half * py * _rows(half, px, py)
    wide = 8 * half * px * py
    native = bins * capture.n_spots
    moving = max(2 * wide, 112 * block)
    return (
        _SCRATCH
        + wide
        + moving
        + 16 * size * capture.n_spots
        + 4 * (2 * native + grid.n_voxels + bins * grid.shape[0])
    )


def _cubic_weights(t: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Cubic B-spline at the four samples around a position a fraction ``t`` past the second."""
    near = t * t * (3 * t - 6) + 4
    s = 1 - t
    return s * s * s / 6, near / 6, (s * s * (3 * s - 6) + 4) / 6, t * t * t / 6


def _rows(half: int, px: int, py: int) -> int:
    """Rows of kx to interpolate at a time, so that one block holds at most half a million wave vectors."""
    return max(1, min(px, (1 << 19) // (half * py)))
