"""One training iteration as the paper formulates it, in batched torch, as fast as that formulation allows.

Every depth and frequency is propagated by FFT in every iteration, every ray is sampled from the wall to the
volume's far corner, and every path is spread over all time bins. What the formulation leaves open is taken in
its favour: one FFT of the wall's field per frequency and one inverse per depth; distances once per depth;
frequencies only within 5.5/σ of Ω_pf (at 4/σ gradients are off by 1 %); the propagation's gradient written
out; only rays that meet something become paths. Planes and rays are worked on in blocks that fit memory, and
what the backward pass needs of a block is computed again, as it would otherwise take tens of GiB.
"""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize
from torch.utils.checkpoint import checkpoint
from workload import Training

from nlos_lit.functional.concentric import wall_frame
from nlos_lit.functional.losses import transient_loss
from nlos_lit.functional.phasor import virtual_illumination


class _Propagation(torch.autograd.Function):
    """``u(x_v) = Σ_f w_f (U_f ⊛ h_{f,z})(x_v)``: ``[nz, nx, ny]`` complex, from weights ``[F]``."""

    @staticmethod
    def forward(ctx, weights: Tensor, literal: LiteralIteration) -> Tensor:
        ctx.literal = literal
        ctx.save_for_backward(weights)
        nx, ny = literal.grid.shape[1:]
        mixed = torch.stack(
            [torch.einsum("f,fxy->xy", weights.to(p.dtype), p) for p in map(literal.products, literal.depth)]
        )
        return torch.fft.ifft2(mixed)[:, :nx, :ny].contiguous()

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        literal, (weights,) = ctx.literal, ctx.saved_tensors
        padded = literal.aperture.shape[1:]
        total = torch.zeros_like(weights)
        for plane, z in zip(grad, literal.depth, strict=True):
            # Parseval: Σ_x conj(g) ifft(p) = Σ_k conj(fft(g)) p / N, and fft(g) of the zero-padded gradient
            adjoint = torch.fft.fft2(plane, s=padded)
            total += torch.einsum("fxy,xy->f", literal.products(z), adjoint.conj()).real / adjoint.numel()
        return total, None


class LiteralIteration:
    """The same parameters, batch and objective as ``training`` (profile "paper", confocal, volume below the
    scan).

    Args:
        precision: float32 shares the parameters of ``training``; float64 has copies of them, and is what
            rounding is judged by.
        reach: frequencies up to this many 1/σ_pf from Ω_pf; infinite takes all that the package has.
    """

    def __init__(
        self,
        training: Training,
        precision: torch.dtype = torch.float32,
        reach: float = 5.5,
        samples_at_once: int = 1 << 22,
    ) -> None:
        self.training, self.precision, self.samples_at_once = training, precision, samples_at_once
        pipeline, capture = training.pipeline, training.capture
        if precision == torch.float64:
            stored = pipeline.phasor.field  # not worth a copy
            pipeline = copy.deepcopy(pipeline, {id(stored): stored.new_empty(0)}).double()
        self.pipeline, self.grid = pipeline, pipeline.phasor.grid
        phasor, geometry = pipeline.phasor, pipeline.geometry
        if not capture.confocal or phasor.power != 2 or geometry.fine != 1 or geometry.relative:
            raise ValueError("the literal iteration is written for confocal captures and the profile 'paper'")
        centre, sigma = float(phasor.omega_pf().detach()), float(phasor.sigma_pf().detach())
        self.omega = phasor.omega[(phasor.omega - centre).abs() <= reach / sigma]
        first, last = capture.gate
        time = capture.t_start + (torch.arange(first, last, dtype=torch.float64) + 0.5) * capture.bin_length
        nx, ny = capture.scan_shape
        kernel = torch.polar(torch.ones((), dtype=torch.float64), self.omega[:, None] * time)
        field = kernel @ torch.from_numpy(capture.gated_counts()).T.to(kernel.dtype)
        self.field = field.to(torch.promote_types(precision, torch.complex32)).view(-1, nx, ny)
        self.field /= self.field.abs().mean()
        mx, my = self.grid.shape[1:]
        if (mx, my) != (nx, ny):
            raise ValueError(
                f"the literal iteration has a voxel column a spot; found {mx} x {my} for {nx} x {ny} spots"
            )
        self.padded = (2 * nx, 2 * ny)
        self.depth = self.grid.z.tolist()
        steps = [torch.minimum(torch.arange(2 * n), 2 * n - torch.arange(2 * n)).double() for n in (nx, ny)]
        self.lateral = (steps[0][:, None] * self.grid.pitch[0]) ** 2 + (steps[1] * self.grid.pitch[1]) ** 2
        sides = [(n - 1) * p for n, p in zip((nx, ny), self.grid.pitch[:2], strict=True)]
        corner = math.hypot(*sides, self.depth[-1])  # the farthest voxel from the farthest spot
        self.n_samples = min(capture.n_bins, math.ceil(corner / geometry.step))
        self.ffts = len(self.omega) * (1 + 2 * len(self.depth)) + 2 * len(self.depth)

    def products(self, z: float) -> Tensor:
        """``[F, lx, ly]``: transform of the wall's field times that of every frequency's kernel for depth
        ``z``.
        """
        distance = torch.sqrt(self.lateral + z * z)
        turns = torch.remainder(self.omega[:, None, None] * (-2 * distance), 2 * math.pi).to(self.precision)
        kernel = torch.polar((1 / distance**2).to(self.precision).expand_as(turns), turns)
        return torch.fft.fft2(kernel).mul_(self.aperture)

    def step_on(self, spots: Tensor, counts: Tensor) -> Tensor:
        """Forward, backward, Adam."""
        self.training.optimiser.zero_grad()
        loss = self.terms(spots, counts)["loss"]
        loss.backward()
        self.training.optimiser.step()
        self.training.steps += 1
        return loss.detach()

    def terms(self, spots: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """The data term and the whole objective."""
        pipeline, criterion = self.pipeline, self.training.criterion
        phasor = pipeline.phasor
        self.aperture = torch.fft.fft2(self.field, s=self.padded)
        weights = virtual_illumination(self.omega, phasor.omega_pf(), phasor.sigma_pf()).to(self.precision)
        field = _Propagation.apply(weights, self)
        intensity = field.real**2 + field.imag**2
        intensity = intensity / intensity.max()
        albedo = pipeline.albedo(intensity)
        rendered = self.render(intensity, albedo, spots)
        expected = pipeline.laser_sensor(rendered)[:, pipeline.gate[0] :]
        data = transient_loss(counts / criterion.scale, expected / criterion.scale)
        planes = criterion.voxel_batch(albedo, self.training.steps)
        return {"transient": data, "loss": data + sum(criterion.regularisation(intensity, planes).values())}

    def at(self, volume: Tensor, points: Tensor) -> Tensor:
        """Trilinear ``[…]`` at ``[…, 3]``, zero outside the box of voxel centres."""
        geometry, (nz, nx, ny) = self.pipeline.geometry, self.grid.shape
        last = torch.tensor([nx - 1, ny - 1, nz - 1])
        steps = (points - geometry.origin) / geometry.pitch
        unit = (2 * steps / last - 1)[..., [1, 0, 2]]
        value = grid_sample(volume[None, None], unit.view(1, 1, 1, -1, 3), align_corners=True).view(
            points.shape[:-1]
        )
        return torch.where(((steps >= 0) & (steps <= last)).all(-1), value, 0.0)

    def depths(self, intensity: Tensor, origins: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Softargmax ``[M]`` over all samples of rays ``[M, 3]``, and their largest intensity."""
        geometry = self.pipeline.geometry
        distance = (torch.arange(self.n_samples, dtype=self.precision) + 0.5) * geometry.step
        value = self.at(intensity, origins[:, None] + distance[:, None] * direction[:, None])
        value = torch.where(value >= geometry.threshold, value, 0.0)
        top = value.detach().amax(1)
        weight = torch.exp(geometry.beta * (value - top[:, None]))
        return (weight * distance).sum(1) / weight.sum(1), top

    def render(self, intensity: Tensor, albedo: Tensor, spots: Tensor) -> Tensor:
        geometry, renderer, capture = self.pipeline.geometry, self.pipeline.renderer, self.training.capture
        wall, up = self.pipeline.sensor[spots], self.pipeline.sensor_normal[spots]
        n, count = geometry.side, len(spots)
        direction = torch.einsum("sij,rj->sri", wall_frame(up), geometry.rays).reshape(-1, 3)
        origins = wall[:, None].expand(-1, n * n, -1).reshape(-1, 3)
        at_once = max(1, self.samples_at_once // self.n_samples)
        parts = [
            checkpoint(self.depths, intensity, o, d, use_reentrant=False)
            for o, d in zip(origins.split(at_once), direction.split(at_once), strict=True)
        ]
        distance, top = (torch.cat(p) for p in zip(*parts, strict=True))
        hit = (top >= geometry.threshold).view(count, n, n)
        point = (origins + distance[:, None] * direction).view(count, n, n, 3)
        east, has_e = _neighbour(point, hit, 1, 0)
        west, has_w = _neighbour(point, hit, -1, 0)
        south, has_s = _neighbour(point, hit, 0, 1)
        north, has_n = _neighbour(point, hit, 0, -1)
        valid = (hit & (has_e | has_w) & (has_s | has_n)).view(-1)
        cross = torch.linalg.cross(east - west, south - north).view(-1, 3)
        valid &= cross.detach().norm(dim=1) > 0
        spot = torch.arange(count).repeat_interleave(n * n)[valid]
        point, direction, normal = point.view(-1, 3)[valid], direction[valid], normalize(cross[valid], dim=1)
        to_wall, there = point - wall[spot], up[spot]
        leg = to_wall.norm(dim=1)
        unit = to_wall / leg[:, None]
        cosines = (
            (unit * there).sum(1).abs() * (unit * normal).sum(1).abs() * (direction * there).sum(1).abs()
        )
        contribution = self.at(albedo, point) * cosines / leg**2 * renderer.solid_angle
        arrival = (leg + distance[valid] - capture.t_start) / capture.bin_length
        rows = max(1, self.samples_at_once // renderer.n_bins)
        rendered = torch.zeros(count, renderer.n_bins, dtype=self.precision)
        for k, t, s in zip(contribution.split(rows), arrival.split(rows), spot.split(rows), strict=True):
            rendered = rendered + checkpoint(self.spread, k, t, s, count, use_reentrant=False)
        return rendered

    def spread(self, contribution: Tensor, arrival: Tensor, spot: Tensor, count: int) -> Tensor:
        """Eq. 7-9: every path over all bins by a Gaussian of unit peak."""
        renderer = self.pipeline.renderer
        bins = torch.arange(renderer.n_bins, dtype=self.precision) + 0.5
        gauss = torch.exp(-0.5 * ((bins - arrival[:, None]) / renderer.splat_sigma) ** 2)
        return torch.zeros(count, renderer.n_bins, dtype=self.precision).index_add(
            0, spot, contribution[:, None] * gauss
        )


def _neighbour(point: Tensor, hit: Tensor, di: int, dj: int) -> tuple[Tensor, Tensor]:
    """Points of the rays one cell further on; the ray's own where that one met nothing or lies outside."""
    there = torch.roll(hit, (-di, -dj), (1, 2))
    if di:
        there[:, -1 if di > 0 else 0] = False
    if dj:
        there[:, :, -1 if dj > 0 else 0] = False
    return torch.where(there[..., None], torch.roll(point, (-di, -dj), (1, 2)), point), there
