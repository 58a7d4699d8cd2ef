"""f-k migration: confocal transients as a wave field, carried back to the moment of its emission.

Lindell, Wetzstein, O'Toole, *Wave-based non-line-of-sight imaging using fast f-k migration*, ACM Trans. Graph. 38, 116 (2019), after
Stolt, Geophysics 43, 23 (1978). With ``ζ = path/2`` the field of sources exploding at ζ = 0 has unit speed, so that measured at the
wall, ``Ψ(x, y, 0, ζ)``, its spectrum ``Φ(kx, ky, f)`` gives the field at ζ = 0:

    Ψ(x, y, z, 0) = ∭ kz/f · Φ(kx, ky, f) e^{i(kx x + ky y + kz z)} dkx dky dkz,      f = √(kx² + ky² + kz²).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.fft import next_fast_len

from nlos_lit.baselines.lct import gated_bins
from nlos_lit.baselines.resample import apply_weights, linear_weights
from nlos_lit.baselines.scan import confocal_lattice, gated_transients, path_range
from nlos_lit.capture import Capture
from nlos_lit.grid import VolumeGrid


def fk(capture: Capture, grid: VolumeGrid, *, falloff: float = 4.0) -> torch.Tensor:
    """f-k migration of the square root of the counts; returns the squared magnitude of the migrated field.

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
        linear_weights(lattice.origin[a], lattice.pitch[a], lattice.shape[a], (grid.x, grid.y)[a], grid.pitch[a]) for a in (0, 1)
    )
    along_z = linear_weights(start / 2 + step / 2, step, bins, grid.z - lattice.origin[2], grid.pitch[2])
    return apply_weights(power, along_z, along_x, along_y)


def stolt(field: torch.Tensor, pitch: tuple[float, float], step: float, first: float) -> torch.Tensor:
    """The field at ζ = 0 from the field at the wall, by Stolt's change of variable.

    Linear interpolation in ``f`` multiplies the record by sinc² of ζ over the padded length; with ζ counted from the middle of the
    record and the record divided by that sinc² beforehand, it is accurate at every depth.

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
    taper = torch.sinc((torch.arange(bins, dtype=torch.float64) - middle) / size).square().float()
    padded = torch.zeros(size, nx, ny)
    padded[: bins - middle] = field[middle:] / taper[middle:, None, None]
    padded[size - middle :] = field[:middle] / taper[:middle, None, None]
    spectrum = torch.fft.fft2(torch.fft.rfft(padded, dim=0), s=(px, py))
    del padded
    wave = torch.fft.rfftfreq(size, step, dtype=torch.float64)
    kx, ky = (torch.fft.fftfreq(n, d, dtype=torch.float64) for n, d in zip((px, py), pitch, strict=True))
    origin = 2 * np.pi * (first + middle * step)
    for i in range(px):
        frequency = torch.sqrt(wave[:, None] ** 2 + ky**2 + kx[i] ** 2)
        position = frequency / wave[1]
        low = position.long().clamp_(max=len(wave) - 2)
        share = (position - low).float()
        row = spectrum[:, i]
        moved = torch.lerp(row.gather(0, low), row.gather(0, low + 1), share.to(row.dtype))
        jacobian = wave[:, None] / frequency.clamp(min=1e-30)
        jacobian[position > len(wave) - 1] = 0
        spectrum[:, i] = moved * torch.polar(jacobian, (wave[:, None] - frequency) * origin).to(moved.dtype)
    columns = torch.fft.ifft2(spectrum)[:, :nx, :ny]
    del spectrum
    image = torch.fft.ifft(columns, n=size, dim=0).mul_(2)
    return torch.cat([image[size - middle :], image[: bins - middle]])


def fk_bytes(capture: Capture, grid: VolumeGrid) -> int:
    """Bytes that :func:`fk` allocates at its peak."""
    lattice = confocal_lattice(capture, "f-k")
    bins = gated_bins(capture, grid)
    size, px, py = (next_fast_len(2 * n, real=True) for n in (bins, *lattice.shape))
    half = size // 2 + 1
    wide = half * px * py
    return 8 * (2 * wide + 8 * half * py + size * capture.n_spots) + 4 * (bins * capture.n_spots + grid.n_voxels + bins * grid.shape[0])
