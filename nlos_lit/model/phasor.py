"""Phasor imaging (paper Sec. 3.1, 4.1): transients → intensity I_pf, differentiable in {Ω_pf, σ_pf}."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import ScanGeometry, scan_geometry
from nlos_lit.capture.errors import MemoryBudgetError
from nlos_lit.capture.taper import tapered_counts
from nlos_lit.capture.volume_grid import VolumeGrid, path_range
from nlos_lit.functional import phasor as F
from nlos_lit.functional.even_convolution import convolution_length
from nlos_lit.functional.sharded import GatherPlanes, Slabs, most_planes
from nlos_lit.functional.streamed import SLAB_BYTES, FieldFile, StreamedMagnitude
from nlos_lit.model.parameters import BoundedParameter

ALIGNED = 1e-3  # how far a voxel may lie from its lattice point, in voxels
_SCRATCH = 100 * 2**20  # products of one run of frequencies, and what the libraries keep
REACH = 5.0  # virtual pulse half-length in units of σ_pf, where its envelope is 4e-6


@dataclass(frozen=True)
class PhasorPlan:
    """What the propagated field will need, known before anything is allocated."""

    method: str  # "lattice" (FFT) or "direct"
    n_frequencies: int
    rank: int
    precision: torch.dtype
    on_disk: bool  # whether the field is read from a file in every iteration
    field_bytes: int
    reading_bytes: int  # transients and their spectra, before there is a field
    working_bytes: int  # beside the field while it is propagated
    shards: int = 1  # processes that share the depth planes; bytes are those of one of them

    @property
    def resident_bytes(self) -> int:
        """What of the field stays in memory."""
        return 2 * SLAB_BYTES if self.on_disk else self.field_bytes

    @property
    def total_bytes(self) -> int:
        """Largest while the field is made."""
        return max(self.reading_bytes, self.resident_bytes + self.working_bytes)

    def __str__(self) -> str:
        kind = str(self.precision).removeprefix("torch.") + (" on disk" if self.on_disk else "")
        way = "FFT convolution" if self.method == "lattice" else "direct sum"
        return (
            f"phasor basis by {way}: {self.n_frequencies} frequencies in {self.rank} dimensions, "
            f"{self.field_bytes / 2**30:.2f} GiB {kind} + {self.working_bytes / 2**30:.2f} GiB working"
            + (f" in each of {self.shards} processes" if self.shards > 1 else "")
        )


@dataclass(frozen=True)
class LatticeLayout:
    """Voxels on the scan's lattice: ``upsample`` voxels a step, ``offset`` voxels from its first point."""

    geometry: ScanGeometry
    upsample: int
    offset: tuple[int, int]
    padded_points: int  # of the zero-padded transform

    def plane_bytes(self, n_freq: int, rank: int) -> int:
        """Working memory of one plane.

        Confocal scans keep the kernel's spectra of all frequencies, the others what is summed over them.

        Args:
            n_freq: F, frequencies.
            rank: R, dimensions of the basis.

        Returns:
            Bytes.
        """
        quarter = self.padded_points // 4 if self.geometry.fixed is None else 0
        return 8 * n_freq * quarter + 8 * rank * self.padded_points * 3


class PhasorImaging(nn.Module):
    """``I_pf = z^q |u|^p / max`` with ``u = RSD(P(Θ_pf) H)`` at t = 0 (Eq. 1-2).

    Args:
        grid: voxels to image.
        omega_pf: central frequency Ω_pf, rad/m of optical path.
        sigma_pf: standard deviation of the virtual pulse, m of optical path.
        power: p; the paper's Eq. 2 has 2, its code 1.
        depth_exponent: q; compensates the falloff with depth. The paper has 0, its code 2.
        tolerance: relative error of the virtual spectrum in the stored basis.

    Call :meth:`plan`, then :meth:`prepare`; then the module is a function of Θ_pf alone.

    Examples:
        A point at (0.3, 0.4, 0.5) m before a confocal scan of 8 × 8 spots, 0.1 m apart:

        >>> import numpy as np
        >>> from nlos_lit.capture.volume_grid import volume_grid
        >>> x, y = np.meshgrid(0.1 * np.arange(8), 0.1 * np.arange(8), indexing="ij")
        >>> wall = np.stack([x.ravel(), y.ravel(), np.zeros(64)], axis=1)
        >>> up = np.tile([0.0, 0.0, 1.0], (64, 1))
        >>> arrival = 2 * np.linalg.norm(wall - [0.3, 0.4, 0.5], axis=1)
        >>> counts = np.zeros((64, 100))
        >>> counts[np.arange(64), (arrival / 0.02).astype(int)] = 100
        >>> capture = Capture(counts, wall, wall, up, up, bin_length=0.02, scan_shape=(8, 8))
        >>> grid = volume_grid(capture, depth=(0.4, 0.6), depth_pitch=0.05)
        >>> omega = BoundedParameter(30.0, 25.0, 35.0, "rad/m")
        >>> imaging = PhasorImaging(grid, omega, BoundedParameter(0.15, 0.1, 0.2, "m"))
        >>> plan = imaging.plan(capture, memory_budget=2**30)
        >>> plan.method, plan.on_disk
        ('lattice', False)
        >>> imaging.prepare(capture, plan)
        >>> intensity = imaging()
        >>> depth, row, column = np.unravel_index(int(intensity.argmax()), grid.shape)
        >>> [round(float(place), 2) for place in (grid.x[row], grid.y[column], grid.z[depth])]
        [0.3, 0.4, 0.5]
    """

    field: Tensor
    basis: Tensor
    omega: Tensor
    gain: Tensor

    def __init__(
        self,
        grid: VolumeGrid,
        omega_pf: BoundedParameter,
        sigma_pf: BoundedParameter,
        *,
        power: float = 1.0,
        depth_exponent: float = 2.0,
        tolerance: float = 1e-4,
    ) -> None:
        super().__init__()
        self.grid, self.omega_pf, self.sigma_pf = grid, omega_pf, sigma_pf
        self.power, self.tolerance = float(power), tolerance
        self.register_buffer("field", torch.empty(0), persistent=False)
        self.file: FieldFile | None = None  # holds the field instead, where it is streamed
        self.slabs: Slabs | None = None  # where processes share the field
        self.image: Tensor | None = None  # what forward returns while it is held
        self.register_buffer("basis", torch.empty(0), persistent=False)
        self.register_buffer("omega", torch.empty(0), persistent=False)
        gain = torch.tensor(grid.z / grid.z.max(), dtype=torch.float32) ** depth_exponent
        self.register_buffer("gain", gain[:, None, None], persistent=False)

    def plan(self, capture: Capture, memory_budget: int, shards: int = 1) -> PhasorPlan:
        """Work out frequencies, rank, precision, place and bytes for a capture; allocates no field.

        The field is single precision in memory where that fits, else half precision, else single on disk.

        Args:
            capture: what will be imaged.
            memory_budget: bytes, of one process.
            shards: processes that share the depth planes.

        Returns:
            The plan, for :meth:`prepare`.

        Raises:
            CaptureError: the volume lies outside the gate.
            MemoryBudgetError: not even what propagates the field fits ``memory_budget`` bytes, or the disk is
                too small.
            UserError: more ``shards`` than depth planes.
        """
        omega = self._frequencies(capture)
        bounds = (self.omega_pf.lower, self.omega_pf.upper), (self.sigma_pf.lower, self.sigma_pf.upper)
        device = self.gain.device
        self.omega, self.basis = omega.to(device), F.weight_basis(omega, *bounds, self.tolerance).to(device)
        n_freq, rank = self.basis.shape
        layout = self._layout(capture)
        first, last = self._window(capture)
        # Counts twice, the spectrum and its two halves.
        reading = capture.n_spots * (8 * (last - first) + 16 * n_freq)
        if layout is None:
            propagating = capture.n_spots * (8 * n_freq + 256 * 96)
        else:
            spectra = 8 * n_freq * layout.padded_points * len(layout.geometry.rows)
            propagating = spectra + max(
                16 * n_freq * capture.n_spots * layout.upsample**2, layout.plane_bytes(n_freq, rank)
            )
        # Transients and spectra are gone when planes are propagated.
        reading, working = reading + _SCRATCH, propagating + _SCRATCH
        planes, nx, ny = self.grid.shape
        values, method = (
            most_planes(planes, shards) * nx * ny * 2 * rank,
            "direct" if layout is None else "lattice",
        )
        for precision, size, on_disk in (
            (torch.float32, 4, False),
            (torch.float16, 2, False),
            (torch.float32, 4, True),
        ):
            plan = PhasorPlan(
                method, n_freq, rank, precision, on_disk, values * size, reading, working, shards
            )
            if plan.total_bytes <= memory_budget and not (
                on_disk and plan.field_bytes * shards > _free_disk()
            ):
                return plan
        raise MemoryBudgetError(
            f"the phasor basis of {self.grid.shape} voxels × {rank} needs {plan.total_bytes / 2**30:.1f} GiB "
            f"of memory and {plan.field_bytes / 2**30:.1f} GiB of temporary disk even when it is streamed, "
            f"the budget is {memory_budget / 2**30:.1f} GiB (disk: {_free_disk() / 2**30:.1f} GiB); sum time "
            "bins or spots (scene.sum_bins, scene.sum_spots), shorten scene.volume.depth, widen "
            "scene.volume.depth_pitch, or raise memory_budget"
        )

    @torch.no_grad()
    def prepare(
        self,
        capture: Capture,
        plan: PhasorPlan,
        *,
        spots: np.ndarray | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Propagate the gated transients once; fills ``field`` ``[V, 2, R]`` or its file.

        Of a plan for several processes each calls this and propagates the voxels of its own planes.

        Args:
            capture: what was measured.
            plan: from :meth:`plan` of the same capture.
            spots: rows of the capture that are imaged, the others count as dark; None takes all.
            progress: called with (planes or blocks done, of how many).

        Raises:
            UserError: the plan is for another number of processes than are running.
        """
        nearest = path_range(capture, self.grid)[0] / 2
        spectrum = self._spectrum(capture, spots)
        # Only ratios matter (the intensity has a unit maximum); this scale keeps half precision in range.
        scale = float(spectrum.abs().mean()) * capture.n_spots / nearest**2
        layout = self._layout(capture)
        self.slabs = Slabs.join(self.grid.shape[0], plan.shards) if plan.shards > 1 else None
        planes = slice(0, self.grid.shape[0]) if self.slabs is None else self.slabs.own
        voxels = (planes.stop - planes.start) * self.grid.shape[1] * self.grid.shape[2]
        if layout is None:
            blocks, total = self._direct(capture, spectrum, planes), -(-voxels // 256)
        else:
            blocks, total = self._lattice(layout, spectrum, planes), planes.stop - planes.start
        del spectrum  # the propagation drops it, too, as soon as it can
        shape, device = (voxels, 2, self.basis.shape[1]), self.gain.device
        self.file = FieldFile(shape, device) if plan.on_disk else None
        field = torch.empty((0,) if plan.on_disk else shape, dtype=plan.precision, device=device)
        row = 0
        for done, block in enumerate(blocks, start=1):
            torch.div(block, scale, out=block)
            if self.file is not None:
                self.file.append(block)
            else:
                field[row : row + len(block)] = block
            row += len(block)
            if progress is not None:
                progress(done, total)
        self.field = field

    def forward(self) -> Tensor:
        """Intensity ``[nz, nx, ny]`` with a unit maximum; processes that share the field call it together."""
        if self.image is not None and not torch.is_grad_enabled():
            return self.image
        weights = F.virtual_illumination(self.omega, self.omega_pf(), self.sigma_pf())
        mixed = self.basis.T @ weights.to(self.basis.dtype)
        if self.file is not None:
            magnitude = StreamedMagnitude.apply(mixed, self.file)
        else:
            magnitude = F.PhasorMagnitude.apply(self.field, mixed)
        magnitude = magnitude.view(-1, *self.grid.shape[1:])
        if self.slabs is not None:
            magnitude = GatherPlanes.apply(magnitude, self.slabs)
        intensity = self.gain * (magnitude if self.power == 1 else magnitude**self.power)
        return intensity / intensity.max()

    @torch.no_grad()
    def hold(self) -> None:
        """Keep the volume as it is, for all that ask for it without gradients, until :meth:`release`.

        All processes that share the field call this together; after that each may look at the volume as often
        as it likes.
        """
        self.image = None
        self.image = self()

    def release(self) -> None:
        """The opposite of :meth:`hold`."""
        self.image = None

    def _window(self, capture: Capture) -> tuple[int, int]:
        """Bins inside the gate from which a virtual pulse can reach a voxel."""
        near, far = path_range(capture, self.grid)
        reach = REACH * self.sigma_pf.upper
        first = math.floor((near - reach - capture.t_start) / capture.bin_length)
        last = math.ceil((far + reach - capture.t_start) / capture.bin_length)
        return max(first, capture.gate[0]), min(last, capture.gate[1])

    def _frequencies(self, capture: Capture) -> Tensor:
        start, end = (capture.t_start + edge * capture.bin_length for edge in self._window(capture))
        near, far = path_range(capture, self.grid)
        period = max(end - near, far - start) + REACH * self.sigma_pf.upper
        return F.frequencies((self.omega_pf.lower, self.omega_pf.upper), self.sigma_pf.lower, period)

    def _spectrum(self, capture: Capture, spots: np.ndarray | None) -> Tensor:
        """``[F, S]`` of the transients of ``spots``, zero elsewhere and where nothing was recorded."""
        first, last = self._window(capture)
        wavelength = 2 * math.pi / float(self.omega_pf())
        counts = torch.from_numpy(tapered_counts(capture, (first, last), wavelength)).to(self.gain.device)
        if spots is not None:
            counts[torch.from_numpy(np.setdiff1d(np.arange(capture.n_spots), spots))] = 0
        time = capture.t_start + (torch.arange(first, last, dtype=torch.float64) + 0.5) * capture.bin_length
        return F.spectrum(counts, time, self.omega)

    def _layout(self, capture: Capture) -> LatticeLayout | None:
        """How the voxels lie on the scan's lattice; None where the direct sum is needed."""
        geometry = scan_geometry(capture)
        if geometry is None:
            return None
        lattice, grid = geometry.lattice, self.grid
        upsample = round(lattice.pitch[0] / grid.pitch[0])
        steps = [(grid.origin[a] - lattice.origin[a]) / grid.pitch[a] for a in (0, 1)]
        offset = (round(steps[0]), round(steps[1]))
        apart = max(abs(step - whole) for step, whole in zip(steps, offset, strict=True))
        stretch = max(abs(lattice.pitch[a] / grid.pitch[a] - upsample) * grid.shape[1 + a] for a in (0, 1))
        if upsample < 1 or apart + stretch > ALIGNED:
            return None
        sizes = [(n - 1) * upsample + 1 for n in lattice.shape]
        padded = [convolution_length(n, m, o) for n, m, o in zip(sizes, grid.shape[1:], offset, strict=True)]
        return LatticeLayout(geometry, upsample, offset, padded[0] * padded[1])

    def _lattice(self, layout: LatticeLayout, spectrum: Tensor, planes: slice) -> Iterator[Tensor]:
        geometry, upsample = layout.geometry, layout.upsample
        nx, ny = geometry.lattice.shape
        field = (
            spectrum[:, torch.from_numpy(geometry.rows)]
            .permute(1, 0, 2)
            .reshape(len(geometry.rows), -1, nx, ny)
        )
        if upsample > 1:
            sparse = field.new_zeros(*field.shape[:2], (nx - 1) * upsample + 1, (ny - 1) * upsample + 1)
            sparse[:, :, ::upsample, ::upsample] = field
            field = sparse
        plane = geometry.lattice.origin[2]
        fixed = None
        if geometry.fixed is not None:
            fixed = torch.from_numpy(geometry.fixed - np.array([0.0, 0.0, plane])).to(field.device)
        return F.lattice_phasors(
            field,
            self.omega,
            self.basis,
            pitch=self.grid.pitch[:2],
            offset=layout.offset,
            shape=self.grid.shape[1:],
            depth=torch.from_numpy(self.grid.z[planes] - plane),
            fixed=fixed,
            voxel_origin=self.grid.origin[:2],
        )

    def _direct(self, capture: Capture, spectrum: Tensor, planes: slice) -> Iterator[Tensor]:
        z, x, y = np.meshgrid(self.grid.z[planes], self.grid.x, self.grid.y, indexing="ij")
        voxels = torch.from_numpy(np.stack([x, y, z], axis=-1).reshape(-1, 3))
        return F.direct_phasors(
            spectrum,
            self.omega,
            self.basis,
            torch.from_numpy(capture.laser),
            torch.from_numpy(capture.sensor),
            voxels,
        )


def _free_disk() -> int:
    return shutil.disk_usage(tempfile.gettempdir()).free
