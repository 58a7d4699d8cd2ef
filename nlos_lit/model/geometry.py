"""Implicit surface geometry G = D(I_pf) (paper Sec. 4.2): points and normals seen from each wall point."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.functional.concentric import ray_grid, wall_frame
from nlos_lit.functional.fixed_size_march import Capacity, StaticSamples, static_march
from nlos_lit.functional.march import Samples, VoxelLattice, march, trilinear


class Surface(NamedTuple):
    """Surface points x_g found along rays from a batch of S wall points; K of the S·n² rays met something.

    On a GPU K is a capacity: rows that no ray needed have a zero normal, and so contribute nothing.
    """

    spot: Tensor  # [K] index into the batch
    distance: Tensor  # [K] d_gs, m
    direction: Tensor  # [K, 3] unit, from the wall point
    point: Tensor  # [K, 3] x_g, m
    normal: Tensor  # [K, 3] unit, towards the wall point


class ImplicitGeometry(nn.Module):
    """Ray marching with softargmax, and normals from neighbouring rays (paper Sec. 4.2).

    On a ray with samples at distances d_i and intensities I_i the surface lies at
    ``d_gs = Σ ω_i d_i / Σ ω_i``, ``ω_i = e^{β I_i}``; its normal is that of the triangles between the points
    of the neighbouring rays.

    Args:
        grid: voxels of the intensity volume.
        rays: n of the n × n concentric ray grid.
        threshold: rays whose largest intensity is below meet no surface (paper: 0.05 synthetic, 0.2 real).
        step: spacing of samples along a ray, m (one per time bin: half a bin length).
        beta: sharpness of the softargmax.
        fine: samples a step around the largest sample; 1 keeps the paper's one sample a bin, whose depth is
            quantised to half a bin.
        relative: β applies to intensities relative to the ray's largest, so that weak surfaces are located as
            sharply as strong ones; False applies it to the intensities themselves, as the paper does.
        static: march with tensors of fixed size, so that a GPU never waits for the host; None does so on
            accelerators. Needs ``fine > 1``: the samples that the paper's softargmax looks at can be any
            number.

    Examples:
        A bright plane of voxels 0.8 m in front of one wall point:

        >>> import torch
        >>> grid = VolumeGrid((-0.5, -0.5, 0.5), (0.1, 0.1, 0.1), (8, 11, 11))
        >>> plane = torch.zeros(grid.shape)
        >>> plane[3] = 1.0
        >>> geometry = ImplicitGeometry(grid, rays=15, threshold=0.5, step=0.02, fine=4, relative=True)
        >>> surface = geometry(plane, torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]))
        >>> [round(part[:, 2].median().item(), 2) for part in (surface.point, surface.normal)]
        [0.8, -1.0]
    """

    origin: Tensor
    pitch: Tensor
    rays: Tensor
    needed: Tensor

    def __init__(
        self,
        grid: VolumeGrid,
        *,
        rays: int,
        threshold: float,
        step: float,
        beta: float = 1e3,
        fine: int = 1,
        relative: bool = False,
        static: bool | None = None,
    ) -> None:
        super().__init__()
        self.wants_static, self.pitch_m = static, grid.pitch
        self.capacity: tuple[float, float] | None = None  # blocks and rays a spot that there is room for
        self.register_buffer("needed", torch.zeros(2), persistent=False)  # blocks and rays a spot
        self.side, self.threshold, self.step, self.beta = rays, threshold, step, beta
        self.fine, self.relative = fine, relative
        self.shape = grid.shape
        self.register_buffer("rays", ray_grid(rays), persistent=False)
        self.register_buffer("origin", torch.tensor(grid.origin, dtype=torch.float32), persistent=False)
        self.register_buffer("pitch", torch.tensor(grid.pitch, dtype=torch.float32), persistent=False)

    @property
    def lattice(self) -> VoxelLattice:
        """Where the voxels lie, on the module's device."""
        return VoxelLattice(self.origin, self.pitch, self.shape)

    def forward(self, intensity: Tensor, origins: Tensor, normals: Tensor) -> Surface:
        """The surface seen from a batch of wall points.

        Args:
            intensity: ``[nz, nx, ny]`` I_pf, unit maximum.
            origins: ``[S, 3]`` wall points, m.
            normals: ``[S, 3]`` unit wall normals.

        Returns:
            Points of the K rays that meet a surface and have a normal; distance and point are differentiable
            in the intensity, directly and through the normals.
        """
        frames = wall_frame(normals)
        if self.static:
            return self._static(intensity, origins, frames)
        # Weights below e^{-17} ≈ 4e-8 of the largest vanish in float32.
        samples = march(
            intensity.detach(),
            self.lattice,
            origins,
            frames,
            self.rays,
            threshold=self.threshold,
            step=self.step,
            reach=17.0 / self.beta,
            fine=self.fine,
        )
        direction = torch.einsum("kij,kj->ki", frames[samples.spot], self.rays[samples.ray])
        distance = self._softargmax(intensity, samples, origins, direction)
        point = origins[samples.spot] + distance[:, None] * direction
        normal, valid = self._normals(point, direction, samples, origins.shape[0])
        return Surface(samples.spot[valid], distance[valid], direction[valid], point[valid], normal[valid])

    @property
    def static(self) -> bool:
        """Whether the march is the one with tensors of fixed size."""
        wanted = self.origin.device.type != "cpu" if self.wants_static is None else self.wants_static
        return wanted and self.fine > 1

    def renew_capacity(self) -> bool:
        """Make room for half as much again as was needed since the last call.

        Waits for the device; does nothing on a CPU.

        Returns:
            True if there was too little room, so that rays were lost.
        """
        if not self.static or self.capacity is None:
            return False
        needed = self.needed.tolist()
        lost = any(n > had for n, had in zip(needed, self.capacity, strict=True))
        blocks, rays = (1.5 * n + 64 for n in needed)
        self.capacity = (blocks, rays)
        self.needed.zero_()
        return lost

    def _static(self, intensity: Tensor, origins: Tensor, frames: Tensor) -> Surface:
        n_rays = self.side**2
        world = torch.einsum("sij,rj->sri", frames, self.rays)
        spots = len(origins)
        capacity = None if self.capacity is None else Capacity(*(math.ceil(n * spots) for n in self.capacity))
        found = static_march(
            intensity.detach(),
            self.lattice,
            self.pitch_m,
            origins,
            world,
            threshold=self.threshold,
            step=self.step,
            fine=self.fine,
            capacity=capacity,
        )
        torch.maximum(self.needed, found.needed / spots, out=self.needed)
        if capacity is None:
            self.capacity = (0.0, 0.0)
            self.renew_capacity()
        spot, ray = found.line // n_rays, found.line % n_rays
        direction = world.reshape(-1, 3)[found.line]
        width = found.distance.shape[1]
        hit = torch.arange(len(spot), device=spot.device)[:, None].expand(-1, width).reshape(-1)
        samples = Samples(spot, ray, hit, found.distance.reshape(-1))
        distance = self._softargmax(intensity, samples, origins, direction, found)
        point = origins[spot] + distance[:, None] * direction
        normal, valid = self._normals(point, direction, samples, origins.shape[0], found.used)
        return Surface(
            spot, distance, direction, point, torch.where((valid & found.used)[:, None], normal, 0.0)
        )

    def _places(self, samples: Samples, origins: Tensor, direction: Tensor) -> Tensor:
        """``[M, 3]`` float64 samples at whole half steps along hit rays.

        β multiplies every rounding of a place by a thousand.
        """
        unit = self.step / (2 * self.fine)
        at = torch.empty(len(samples.hit), 3, dtype=torch.float64, device=origins.device)
        for hit, distance, rows in zip(
            *(t.split(1 << 17) for t in (samples.hit, samples.distance, at)), strict=True
        ):
            whole = torch.round(distance.double() / unit) * unit
            torch.addcmul(
                origins[samples.spot[hit]].double(), whole[:, None], direction[hit].double(), out=rows
            )
        return at

    def _softargmax(
        self,
        intensity: Tensor,
        samples: Samples,
        origins: Tensor,
        direction: Tensor,
        static: StaticSamples | None = None,
    ) -> Tensor:
        """``Σ ω_i d_i / Σ ω_i`` with ``ω_i = e^{β I_i}`` per hit ray ``[K]``, m.

        Of ``static`` samples those count that mean something.
        """
        hits = samples.spot.shape[0]
        value = trilinear(intensity, self._places(samples, origins, direction), self.lattice)
        if static is not None:
            value = torch.where(
                static.used[:, None], torch.where(static.inside, value.view_as(static.inside), 0.0), 1.0
            ).view(-1)
        # With a relative β the largest intensity scales the exponent, so the gradient passes through it;
        # otherwise it cancels.
        largest = value if self.relative else value.detach()
        top = torch.full((hits,), -torch.inf, device=value.device, dtype=value.dtype).scatter_reduce(
            0, samples.hit, largest, "amax"
        )
        sharpness = self.beta / top if self.relative else self.beta * torch.ones_like(top)
        weight = torch.exp(sharpness[samples.hit] * (value - top[samples.hit]))
        if static is not None:
            weight = torch.where(static.inside, weight.view_as(static.inside), 0.0).view(-1)
        zeros = torch.zeros(hits, device=value.device, dtype=value.dtype)
        total = zeros.index_add(0, samples.hit, weight)
        # Relative to the first sample, so that float32 keeps the sub-step digits.
        base = zeros.scatter_reduce(0, samples.hit, samples.distance, "amin", include_self=False)
        return base + zeros.index_add(0, samples.hit, weight * (samples.distance - base[samples.hit])) / total

    def _normals(
        self, point: Tensor, direction: Tensor, samples: Samples, n_spots: int, used: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Unit normals ``[K, 3]`` and which hits have one.

        The paper sums the normals of the triangles N-E-S and S-W-N of the neighbouring rays' points, which is
        ``(E - W) × (S - N)``. A neighbour that met no surface is replaced by the point itself (a one-sided
        difference); a hit without any neighbour along one of the two directions has no normal and is treated
        as no surface. Rows that are not ``used`` are nobody's neighbours.
        """
        n = self.side
        rays = n_spots * n * n
        # The last row is for what is not used.
        table = torch.full((rays + 1,), -1, dtype=torch.long, device=point.device)
        row, column = samples.ray // n, samples.ray % n
        line = samples.spot * n * n
        own = torch.arange(len(row), device=point.device)
        table.scatter_(
            0, line + samples.ray if used is None else torch.where(used, line + samples.ray, rays), own
        )

        def neighbour(di: int, dj: int) -> Tensor:
            i, j = row + di, column + dj
            inside = (i >= 0) & (i < n) & (j >= 0) & (j < n)
            found = torch.where(inside, table[line + i.clamp(0, n - 1) * n + j.clamp(0, n - 1)], -1)
            return torch.where(found < 0, own, found)

        east, west, south, north = neighbour(1, 0), neighbour(-1, 0), neighbour(0, 1), neighbour(0, -1)
        valid = (east != west) & (south != north)
        cross = torch.linalg.cross(point[east] - point[west], point[south] - point[north])
        length = torch.linalg.vector_norm(cross.detach(), dim=1)
        valid &= length > 0
        safe = torch.where(valid[:, None], cross, direction)
        normal = torch.nn.functional.normalize(safe, dim=1)
        facing = torch.where((normal * direction).sum(1, keepdim=True) > 0, -1.0, 1.0)
        return normal * facing, valid
