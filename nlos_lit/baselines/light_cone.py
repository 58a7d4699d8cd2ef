"""Light-cone transform: confocal imaging as one three-dimensional deconvolution.

O'Toole, Lindell, Wetzstein, *Confocal non-line-of-sight imaging based on the light-cone transform*, Nature
555, 338 (2018). With ``v = (path/2)²`` and ``u = z²`` a confocal transient of falloff ``r^-p`` becomes
shift-invariant,

    v^((p-1)/2)·τ(x', y', 2√v) = ∭ ρ(x, y, √u)/(2√u) · δ((x'-x)² + (y'-y)² + u - v) dx dy du,

and is inverted by a Wiener filter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.fft import next_fast_len

from nlos_lit.baselines.inputs import confocal_lattice, gated_bins, gated_transients
from nlos_lit.baselines.resample import apply_weights, linear_weights
from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import ScanLattice
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid, path_range


def lct(capture: Capture, grid: VolumeGrid, *, snr: float = 0.8, falloff: float = 4.0) -> torch.Tensor:
    """Light-cone transform with Wiener deconvolution.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct; zero outside the scanned rectangle and outside the depths of the gate.
        snr: power of the signal over that of the noise, relative to the mean power of the kernel's spectrum:
            large is sharp and noisy, small tends to backprojection.
        falloff: how counts fall with distance: 4 for diffuse, 2 for retroreflective surfaces.

    Returns:
        ``[nz, nx, ny]`` float32, nonnegative: albedo density per volume in the units of the counts.

    Raises:
        UserError: ``snr`` is not positive.
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    if not snr > 0:
        raise UserError(f"lct needs a positive snr; found {snr}")
    cone = light_cone(capture, grid, "lct", falloff)
    inverse = wiener_cone(cone.values, cone.lattice.pitch, cone.step, snr)
    along_x, along_y = lateral_weights(cone.lattice, grid)
    along_z = cone_to_depth(cone, grid.z - cone.lattice.origin[2], grid.pitch[2])
    return apply_weights(inverse, along_z, along_x, along_y).clamp_(min=0)


class Cone(NamedTuple):
    """Confocal transients over ``v``; cell ``k`` covers ``[first + k·step, first + (k+1)·step)``."""

    values: torch.Tensor  # [M, nx, ny] counts per m², times v^(p/2)
    lattice: ScanLattice
    first: float  # m²
    step: float  # m²


def light_cone(capture: Capture, grid: VolumeGrid, method: str, falloff: float) -> Cone:
    """Transients resampled from path to ``v = (path/2)²``, as counts per unit of ``v`` times ``v^(p/2)``.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct; bins that its light cannot reach are left out.
        method: named in messages.
        falloff: p, how counts fall with distance.

    Returns:
        As many cells of equal width in v as there are bins; counts are kept.

    Raises:
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    lattice = confocal_lattice(capture, method)
    transients, start = gated_transients(capture, path_range(capture, grid)[1], 0.0)
    bins = transients.shape[1]
    edges = ((start + np.arange(bins + 1) * capture.bin_length) / 2) ** 2
    step = (edges[-1] - edges[0]) / bins
    ordered = transients[torch.from_numpy(lattice.spots)].T
    values = torch.sparse.mm(_path_to_cone(edges, step, falloff), ordered).view(bins, *lattice.shape)
    return Cone(values, lattice, float(edges[0]), float(step))


def lateral_weights(lattice: ScanLattice, grid: VolumeGrid) -> tuple[torch.Tensor, torch.Tensor]:
    """Matrices that resample from the scan's lattice to the grid.

    Args:
        lattice: of the scan.
        grid: where to reconstruct.

    Returns:
        Along x and along y, ``[grid's points, lattice's points]`` each.
    """
    axes = zip(
        lattice.origin[:2], lattice.pitch, lattice.shape, (grid.x, grid.y), grid.pitch[:2], strict=True
    )
    along_x, along_y = (linear_weights(*axis) for axis in axes)
    return along_x, along_y


def wiener_cone(cone: torch.Tensor, pitch: tuple[float, float], step: float, snr: float) -> torch.Tensor:
    """Solve ``cone = k ⊛ x`` for ``x`` by a Wiener filter.

    Minimises ``‖k ⊛ x - cone‖² + ‖k‖²/snr·‖x‖²`` on a domain padded to twice the size.

    Args:
        cone: ``[M, nx, ny]`` samples in ``v``, zero where padded.
        pitch: lattice pitch, m.
        step: spacing in ``v`` and ``u``, m².
        snr: see :func:`lct`.

    Returns:
        ``[M, nx, ny]`` on the same samples in ``u``.
    """
    size = padded(cone.shape)
    kernel = cone_kernel(cone.shape, size, pitch, step)
    noise = float(kernel.square().sum()) / snr
    spectrum = torch.fft.rfftn(kernel)
    del kernel
    gain = torch.view_as_real(spectrum).square().sum(-1).add_(noise).reciprocal_()
    torch.conj_physical_(spectrum).mul_(gain)
    del gain
    spectrum *= torch.fft.rfftn(cone, s=size)
    m, nx, ny = cone.shape
    return torch.fft.irfftn(spectrum, s=size)[:m, :nx, :ny]


def lct_bytes(capture: Capture, grid: VolumeGrid) -> int:
    """Bytes that :func:`lct` allocates at its peak.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct.

    Returns:
        Bytes, beyond the capture's counts.

    Raises:
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    return cone_bytes(capture, grid, "lct", padded_arrays=4, volumes=1, matrices=1)


def cone_bytes(
    capture: Capture, grid: VolumeGrid, method: str, *, padded_arrays: int, volumes: int, matrices: int
) -> int:
    """Bytes of a light-cone method: three copies of the transients and what it holds beside them.

    Args:
        capture: confocal, on a regular planar lattice.
        grid: where to reconstruct.
        method: named in messages.
        padded_arrays: arrays of the transform's size that it holds at once.
        volumes: arrays of the grid's size that it holds at once.
        matrices: from the cone to depths that it holds at once.

    Returns:
        Bytes, beyond the capture's counts.

    Raises:
        CaptureError: not confocal, no lattice, or the volume lies outside the gate.
    """
    bins = gated_bins(capture, grid)
    m, nx, ny = padded((bins, *confocal_lattice(capture, method).shape))
    transform, resampling = m * nx * (ny + 2), bins * grid.shape[0]
    return 4 * (
        3 * bins * capture.n_spots
        + padded_arrays * transform
        + volumes * grid.n_voxels
        + matrices * resampling
    )


def padded(shape: tuple[int, ...]) -> tuple[int, ...]:
    """A size whose FFT is fast and at least twice as long along every axis: convolutions are then linear.

    Examples:
        >>> padded((5, 7, 11))
        (10, 15, 24)
    """
    return tuple(next_fast_len(2 * n, real=True) for n in shape)


def cone_kernel(
    shape: tuple[int, ...], size: tuple[int, ...], pitch: tuple[float, float], step: float
) -> torch.Tensor:
    """The kernel ``δ(x² + y² - w)`` on the lattice, with its negative offsets at the far ends of its axes.

    At each lateral offset lies one lattice cell's area, shared by the two nearest ``w``.

    Args:
        shape: ``(M, nx, ny)`` of what it is convolved with.
        size: of the transform, from :func:`padded`.
        pitch: of the lattice, m.
        step: spacing of w, m².

    Returns:
        ``[*size]`` float32, m².

    Examples:
        >>> kernel = cone_kernel((3, 2, 2), (6, 4, 4), pitch=(1.0, 1.0), step=1.0)
        >>> kernel[:3, 0, 0].tolist(), kernel[:3, 1, 1].tolist(), kernel[:3, -1, 0].tolist()
        ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    """
    bins, nx, ny = shape
    x, y = np.meshgrid(np.arange(1 - nx, nx), np.arange(1 - ny, ny), indexing="ij")
    w = ((x * pitch[0]) ** 2 + (y * pitch[1]) ** 2) / step
    low = np.floor(w).astype(int)
    kernel = np.zeros(size, dtype=np.float32)
    for index, share in ((low, 1 - (w - low)), (low + 1, w - low)):
        inside = index < bins
        kernel[index[inside], x[inside], y[inside]] += share[inside] * pitch[0] * pitch[1]
    return torch.from_numpy(kernel)


def cone_to_depth(cone: Cone, depth: np.ndarray, width: float, power: int = 1) -> torch.Tensor:
    """Matrix that takes R over ``u = z²`` to ``2 z^power·R(z²)`` at depths.

    It is linear in ``u`` between cell centres and averages over each voxel's depth. With ``power`` 1 this is
    the density in z, ``ρ(z) = 2z·R(z²)``.

    Args:
        cone: gives the cells of u.
        depth: ``[nz]`` distances of voxel centres from the wall, m.
        width: depth of a voxel, m.
        power: of z.

    Returns:
        ``[nz, M]``.
    """
    bins, first, step = len(cone.values), cone.first, cone.step
    finest = np.sqrt(first + step * bins) - np.sqrt(first + step * (bins - 1))
    parts = max(1, int(np.ceil(abs(width) / finest)))
    z = depth[:, None] + ((np.arange(parts) + 0.5) / parts - 0.5) * abs(width)
    weights = linear_weights(first + step / 2, step, bins, np.where(z > 0, z**2, -1.0).reshape(-1), 0.0)
    return (weights.view(len(depth), parts, bins) * torch.from_numpy(2 * z**power).float()[..., None]).mean(1)


def _path_to_cone(edges: np.ndarray, step: float, falloff: float) -> torch.Tensor:
    """Sparse ``[M, T]`` from counts in bins to counts per unit of ``v`` times ``v^(p/2)`` in equal cells.

    ``edges`` ``[T + 1]`` are the bins' in v.
    """
    bins = len(edges) - 1
    cells = edges[0] + step * np.arange(bins + 1)
    cuts = np.unique(np.concatenate([edges, np.clip(cells, edges[0], edges[-1])]))
    middle, length = (cuts[1:] + cuts[:-1]) / 2, np.diff(cuts)
    column = np.clip(np.searchsorted(edges, middle) - 1, 0, bins - 1)
    row = np.clip(((middle - edges[0]) / step).astype(int), 0, bins - 1)
    value = length / np.diff(edges)[column] * middle ** (falloff / 2) / step
    index = torch.from_numpy(np.stack([row, column]))
    return torch.sparse_coo_tensor(
        index, torch.from_numpy(value).float(), (bins, bins), check_invariants=True
    )
