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

from nlos_lit.baselines.resample import apply_weights, linear_weights
from nlos_lit.baselines.scan import confocal_lattice, gated_transients
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
    """Confocal transients over ``v``: ``values [M, nx, ny]``, cell ``k`` covering ``[first + k·step, first +
    (k+1)·step)`` m².
    """

    values: torch.Tensor
    lattice: ScanLattice
    first: float
    step: float


def light_cone(capture: Capture, grid: VolumeGrid, method: str, falloff: float) -> Cone:
    """``v^(p/2)`` times counts per unit of ``v``, with ``p`` = ``falloff``; ``method`` is named in messages.

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
    """Matrices that resample from the scan's lattice to the grid, along x and along y."""
    axes = zip(
        lattice.origin[:2], lattice.pitch, lattice.shape, (grid.x, grid.y), grid.pitch[:2], strict=True
    )
    along_x, along_y = (linear_weights(*axis) for axis in axes)
    return along_x, along_y


def wiener_cone(cone: torch.Tensor, pitch: tuple[float, float], step: float, snr: float) -> torch.Tensor:
    """Solves ``cone = k ⊛ x`` for ``x``: minimises ``‖k ⊛ x - cone‖² + ‖k‖²/snr·‖x‖²`` on a domain padded to
    twice the size.

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
    """Bytes that :func:`lct` allocates at its peak."""
    return cone_bytes(capture, grid, "lct", padded_arrays=4, volumes=1, matrices=1)


def cone_bytes(
    capture: Capture, grid: VolumeGrid, method: str, *, padded_arrays: int, volumes: int, matrices: int
) -> int:
    """Bytes of a light-cone method: three copies of the transients, and at once so many arrays of the
    transform's size, volumes, and matrices from the cone to depths; ``method`` is named in messages.
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


def gated_bins(capture: Capture, grid: VolumeGrid) -> int:
    """How many bins of the gate :func:`lct` and f-k migration work on: those that light from the volume can
    reach.
    """
    longest = path_range(capture, grid)[1]
    return (
        min(capture.gate[1], int(np.ceil((longest - capture.t_start) / capture.bin_length)) + 1)
        - capture.gate[0]
    )


def padded(shape: tuple[int, ...]) -> tuple[int, ...]:
    """A size whose FFT is fast and at least twice as long along every axis, so that a convolution is linear."""
    return tuple(next_fast_len(2 * n, real=True) for n in shape)


def cone_kernel(
    shape: tuple[int, ...], size: tuple[int, ...], pitch: tuple[float, float], step: float
) -> torch.Tensor:
    """``δ(x² + y² - w)`` on the lattice: at each lateral offset one lattice cell's area, shared by the two
    nearest ``w``.
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


def _path_to_cone(edges: np.ndarray, step: float, falloff: float) -> torch.Tensor:
    """Sparse ``[M, T]``: counts in bins with ``edges`` in ``v`` to ``v^(p/2)`` times counts per unit ``v`` in
    equal cells.
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


def cone_to_depth(cone: Cone, depth: np.ndarray, width: float, power: int = 1) -> torch.Tensor:
    """Matrix ``[nz, M]``: ``2 z^power·R(z²)``, linear in ``u`` between cell centres, averaged over each
    voxel's depth.

    With ``power`` 1 this is the density in z, ``ρ(z) = 2z·R(z²)``.
    """
    bins, first, step = len(cone.values), cone.first, cone.step
    finest = np.sqrt(first + step * bins) - np.sqrt(first + step * (bins - 1))
    parts = max(1, int(np.ceil(abs(width) / finest)))
    z = depth[:, None] + ((np.arange(parts) + 0.5) / parts - 0.5) * abs(width)
    weights = linear_weights(first + step / 2, step, bins, np.where(z > 0, z**2, -1.0).reshape(-1), 0.0)
    return (weights.view(len(depth), parts, bins) * torch.from_numpy(2 * z**power).float()[..., None]).mean(1)
