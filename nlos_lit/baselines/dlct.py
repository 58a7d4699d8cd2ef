"""Directional light-cone transform: albedo and normal of every voxel by one three-dimensional deconvolution.

Young, Lindell, Girod, Taubman, Wetzstein, *Non-line-of-sight surface reconstruction using the directional
light-cone transform*, CVPR 2020. A surface element of albedo ρ and normal n sends light along ω, from it to
the wall, as ``ρ n·ω``: linear in ``q = ρ n``. With ``v = (path/2)²``, ``u = z²`` and ``ω = (x' - x, y' - y,
-z)/r`` the light-cone transform takes three channels,

    v^(p/2)·τ(x', y', 2√v) = (x h) ⊛ R_x + (y h) ⊛ R_y + h ⊛ R_z,    h = δ(x² + y² + u - v),
    R_x = q_x/(2√u),    R_y = q_y/(2√u),    R_z = -q_z/2.

One measurement and three unknowns a frequency: the Tikhonov solution is a Wiener filter for each,

    S_i = ĥ_i* g / (Σ_j |ĥ_j|² + Σ_j ‖h_j‖²/snr),    ĥ_j = transforms of (x h/z₀, y h/z₀, h),    S = (z₀ R_x,
    z₀ R_y, R_z),

where z₀, the volume's middle depth, makes equal penalties on the three of equal penalties on the components
of q.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch

from nlos_lit.baselines.light_cone import (
    Cone,
    cone_bytes,
    cone_kernel,
    cone_to_depth,
    lateral_weights,
    light_cone,
    padded,
)
from nlos_lit.baselines.resample import apply_weights
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid


def dlct(capture: Capture, grid: VolumeGrid, *, snr: float = 0.8, falloff: float = 4.0) -> torch.Tensor:
    """Albedo density ``|q|`` of :func:`dlct_field`, zero where the surface faces away from the wall.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct; zero outside the scanned rectangle and outside the depths of the gate.
        snr: as of ``lct``.
        falloff: as of :func:`dlct_field`.

    Returns:
        ``[nz, nx, ny]`` float32, nonnegative, in the units of ``lct``.

    Raises:
        UserError: ``snr`` is not positive.
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    return directed_volume(dlct_field(capture, grid, snr=snr, falloff=falloff))


def directed_volume(field: torch.Tensor) -> torch.Tensor:
    """Length of the vectors that point to the wall (z < 0), zero elsewhere.

    Args:
        field: ``[3, nz, nx, ny]`` vectors.

    Returns:
        ``[nz, nx, ny]``.

    Examples:
        >>> import torch
        >>> field = torch.tensor([[3.0, 0.0], [0.0, 0.0], [-4.0, 1.0]]).view(3, 1, 1, 2)
        >>> directed_volume(field).tolist()
        [[[5.0, 0.0]]]
    """
    return field.norm(dim=0).mul_(field[2] < 0)


def dlct_field(capture: Capture, grid: VolumeGrid, *, snr: float = 0.8, falloff: float = 4.0) -> torch.Tensor:
    """The vector field ``q = ρ n`` of albedo density times unit normal.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct; zero outside the scanned rectangle and outside the depths of the gate.
        snr: as of ``lct``.
        falloff: how counts of a surface that faces the spot fall with distance: 4 for diffuse, 2 for
            retroreflective surfaces.

    Returns:
        ``[3, nz, nx, ny]`` float32, components along x, y and z; a surface that faces the wall has a negative
        third.

    Raises:
        UserError: ``snr`` is not positive.
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    if not snr > 0:
        raise UserError(f"dlct needs a positive snr; found {snr}")
    cone = light_cone(capture, grid, "dlct", falloff + 1)
    depth = float(abs(grid.z.mean() - cone.lattice.origin[2]))
    weights = lateral_weights(cone.lattice, grid)
    along_z = [cone_to_depth(cone, grid.z - cone.lattice.origin[2], grid.pitch[2], power) for power in (1, 0)]
    field = torch.empty(3, *grid.shape)
    for axis, channel in enumerate(_channels(cone, depth, snr)):
        # q_x = 2z R_x = 2z S_x/z₀ along the wall, q_z = -2 R_z = -2 S_z across it
        scale = -1.0 if axis == 2 else 1 / depth
        field[axis] = apply_weights(channel, along_z[axis == 2], *weights).mul_(scale)
    return field


def _channels(cone: Cone, depth: float, snr: float) -> Iterator[torch.Tensor]:
    """``S_x``, ``S_y`` and ``S_z`` in turn, ``[M, nx, ny]`` each over u."""
    shape, pitch = cone.values.shape, cone.lattice.pitch
    size = padded(shape)
    kernel = cone_kernel(shape, size, pitch, cone.step)
    # The kernel's negative offsets lie at the far end of its axes.
    along_x, along_y = (
        torch.fft.fftfreq(size[axis + 1], 1 / size[axis + 1]) * pitch[axis] / depth for axis in (0, 1)
    )
    lever = (along_x[:, None], along_y[None, :], torch.ones(1, 1))
    power, total = 0.0, torch.zeros(())
    for arm in lever:
        channel = kernel * arm
        power += float(channel.square().sum())
        total = total + torch.view_as_real(torch.fft.rfftn(channel)).square().sum(-1)
    filtered = torch.fft.rfftn(cone.values, s=size).div_(total.add_(power / snr))
    del total, channel
    bins, nx, ny = shape
    for arm in lever:
        spectrum = torch.conj_physical_(torch.fft.rfftn(kernel * arm)).mul_(filtered)
        yield torch.fft.irfftn(spectrum, s=size)[:bins, :nx, :ny]


def dlct_bytes(capture: Capture, grid: VolumeGrid) -> int:
    """Bytes that :func:`dlct` allocates at its peak.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct.

    Returns:
        Bytes, beyond the capture's counts.

    Raises:
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    return cone_bytes(capture, grid, "dlct", padded_arrays=7, volumes=5, matrices=2)
