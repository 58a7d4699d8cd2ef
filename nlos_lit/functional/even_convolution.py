"""Linear convolution with kernels that are even in x and y, and their phases, for propagation from plane to
plane.

A kernel that is even along both axes and its spectrum are known by a quarter of their values; only these are
evaluated.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


class EvenAxis:
    """One axis of a convolution whose kernel is even: voxel m lies ``m + offset - n`` steps from aperture
    point n.

    The kernel's centre is put at index 0 and the transform is long enough to hold it mirrored, so that halves
    of the kernel and of its spectrum are all there is; ``shift`` brings voxel 0 back to index 0.
    """

    def __init__(self, n: int, m: int, offset: int, device: torch.device) -> None:
        self.length = convolution_length(n, m, offset)
        self.half = self.length // 2 + 1
        self.rest = self.length - self.half  # indices that mirror 1 … rest
        self.lags = torch.arange(self.half, dtype=torch.float64, device=device)
        turn = 2 * math.pi / self.length
        self.shift = polar(
            torch.ones((), dtype=torch.float64),
            turn * offset * torch.arange(self.length, device=device).double(),
        )
        both = torch.where((self.lags == 0) | (2 * self.lags == self.length), 1.0, 2.0)
        self.cosines = (both[:, None] * torch.cos(turn * self.lags[:, None] * self.lags)).to(
            torch.float32
        )  # [lag, wave number]


def convolution_length(n: int, m: int, offset: int) -> int:
    """Points of the zero-padded transform along an axis of n aperture points and m voxels that start
    ``offset`` steps further.
    """
    return next_fast_length(max(n + m - 1, 2 * max(abs(offset + 1 - n), abs(offset + m - 1))))


def fold(spectra: Tensor, x: EvenAxis, y: EvenAxis) -> Tensor:
    """``[F, lx, ly]`` → ``[F, 4, hx, hy]``: the four mirror images of each wave vector side by side."""
    rows = spectra[:, : x.half], spectra.roll(-1, 1).flip(1)[:, : x.half]
    return torch.stack(
        [part for half in rows for part in (half[:, :, : y.half], half.roll(-1, 2).flip(2)[:, :, : y.half])],
        dim=1,
    )


def unfold(folded: Tensor, x: EvenAxis, y: EvenAxis) -> Tensor:
    """The inverse of :func:`fold`, for ``[F, 4·hx·hy]``."""
    quarters = folded.view(-1, 2, 2, x.half, y.half)
    rows = torch.cat([quarters[:, :, 0], quarters[:, :, 1, :, 1 : y.rest + 1].flip(3)], dim=3)
    return torch.cat([rows[:, 0], rows[:, 1, 1 : x.rest + 1].flip(1)], dim=1)


def mirror(halves: Tensor, dim: int, axis: EvenAxis) -> Tensor:
    """Both halves along ``dim``, from the first."""
    return torch.cat([halves, halves.narrow(dim, 1, axis.rest).flip(dim)], dim=dim)


def even_transform(quarter: Tensor, x: EvenAxis, y: EvenAxis) -> Tensor:
    """A quarter of the 2-D Fourier transform of kernels even along both axes, from a quarter of them ``[F,
    hx, hy]``.

    As matrix products: a transform of a few hundred real cosines runs at several times the speed of an FFT of
    twice the length.
    """
    real, imaginary = (x.cosines.T @ (part.contiguous() @ y.cosines) for part in (quarter.real, quarter.imag))
    return torch.complex(real, imaginary)


def inverse(spectra: Tensor, mx: int, my: int) -> Tensor:
    """``[…, mx, my]`` first points of the inverse transforms of ``[…, lx, ly]``."""
    return torch.fft.ifft(torch.fft.ifft(spectra, dim=-1)[..., :my], dim=-2)[..., :mx, :]


class Rotation:
    """``e^{-iΩ_k R}/R^power`` for equally spaced Ω: double precision once for a run of them, then doubling by
    complex products.
    """

    def __init__(self, distance: Tensor, step: float, most: int, power: int) -> None:
        self.distance, self.magnitude = distance, 1 / distance**power
        most = min(most, 64)
        self.powers = [
            polar(torch.ones_like(distance), -step * 2**j * distance) for j in range((most - 1).bit_length())
        ]

    def values(self, omega: Tensor, part: slice) -> Tensor:
        """``[part, …]`` at frequencies ``omega[part]``."""
        count = part.stop - part.start
        result = torch.empty(count, *self.distance.shape, dtype=torch.complex64, device=self.distance.device)
        for begin in range(0, count, 64):
            run = result[begin : begin + 64]
            run[0] = polar(self.magnitude, -omega[part.start + begin] * self.distance)
            done = 1
            for power in self.powers:
                more = min(done, len(run) - done)
                torch.mul(run[:more], power, out=run[done : done + more])
                done += more
        return result


def runs(n: int, size: int, device: torch.device) -> list[slice]:
    """0 … n in runs whose n × size complex numbers fill 16 MiB, small enough for caches and for memory to be
    used again.

    On a GPU 1 GiB, so that it has enough to do at once.
    """
    most = max(1, (1 << 21 if device.type == "cpu" else 1 << 27) // size)
    return [slice(i, min(i + most, n)) for i in range(0, n, most)]


def next_fast_length(n: int) -> int:
    """Smallest number ≥ n whose only prime factors are 2, 3 and 5."""
    while True:
        rest = n
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return n
        n += 1


def polar(magnitude: Tensor, phase: Tensor) -> Tensor:
    """Complex64 from float64 magnitude and phase; the phase is reduced before it loses digits."""
    turn = torch.remainder(phase, 2 * math.pi).to(torch.float32)
    return torch.polar(magnitude.to(torch.float32).expand_as(turn), turn)


def _step(omega: Tensor) -> float:
    return float(omega[1] - omega[0]) if len(omega) > 1 else 0.0


def _real_rows(values: Tensor) -> Tensor:
    """Complex ``[F, …]`` as real ``[F, 2·…]``."""
    return torch.view_as_real(values.contiguous()).reshape(len(values), -1)
