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
    """One axis of a convolution whose kernel is even.

    Voxel m lies ``m + offset - n`` steps from aperture point n. The kernel's centre is put at index 0 and the
    transform is long enough to hold it mirrored, so that halves of the kernel and of its spectrum are all
    there is; ``shift`` brings voxel 0 back to index 0.

    Args:
        n: aperture points.
        m: voxels.
        offset: steps from aperture point 0 to voxel 0.
        device: of all tensors.
    """

    def __init__(self, n: int, m: int, offset: int, device: torch.device) -> None:
        self.length = convolution_length(n, m, offset)
        self.half = self.length // 2 + 1
        self.rest = self.length - self.half  # indices that mirror 1 … rest
        self.lags = torch.arange(self.half, dtype=torch.float64, device=device)
        turn = 2 * math.pi / self.length
        self.shift = polar(
            torch.ones((), dtype=torch.float64, device=device),
            turn * offset * torch.arange(self.length, device=device).double(),
        )
        both = torch.where((self.lags == 0) | (2 * self.lags == self.length), 1.0, 2.0)
        self.cosines = (both[:, None] * torch.cos(turn * self.lags[:, None] * self.lags)).to(
            torch.float32
        )  # [lag, wave number]


def convolution_length(n: int, m: int, offset: int) -> int:
    """Points of the zero-padded transform along one axis.

    Args:
        n: aperture points.
        m: voxels, spaced as they are.
        offset: steps from aperture point 0 to voxel 0.

    Returns:
        The next fast length that holds the convolution and the mirrored kernel.

    Examples:
        >>> convolution_length(8, 8, 0)
        15
    """
    return next_fast_length(max(n + m - 1, 2 * max(abs(offset + 1 - n), abs(offset + m - 1))))


def fold(spectra: Tensor, x: EvenAxis, y: EvenAxis) -> Tensor:
    """The four mirror images of each wave vector side by side.

    Args:
        spectra: ``[F, lx, ly]``.
        x: axis of lx points, hx of them in a half.
        y: axis of ly points, hy of them in a half.

    Returns:
        ``[F, 4, hx, hy]``.
    """
    rows = spectra[:, : x.half], spectra.roll(-1, 1).flip(1)[:, : x.half]
    return torch.stack(
        [part for half in rows for part in (half[:, :, : y.half], half.roll(-1, 2).flip(2)[:, :, : y.half])],
        dim=1,
    )


def unfold(folded: Tensor, x: EvenAxis, y: EvenAxis) -> Tensor:
    """The inverse of :func:`fold`.

    Args:
        folded: ``[F, 4·hx·hy]``.
        x: axis of lx points, hx of them in a half.
        y: axis of ly points, hy of them in a half.

    Returns:
        ``[F, lx, ly]``.

    Examples:
        >>> device = torch.device("cpu")
        >>> x, y = EvenAxis(2, 3, 0, device), EvenAxis(4, 3, 1, device)
        >>> spectra = torch.rand(5, x.length, y.length)
        >>> bool((unfold(fold(spectra, x, y).flatten(1), x, y) == spectra).all())
        True
    """
    quarters = folded.view(-1, 2, 2, x.half, y.half)
    rows = torch.cat([quarters[:, :, 0], quarters[:, :, 1, :, 1 : y.rest + 1].flip(3)], dim=3)
    return torch.cat([rows[:, 0], rows[:, 1, 1 : x.rest + 1].flip(1)], dim=1)


def mirror(halves: Tensor, dim: int, axis: EvenAxis) -> Tensor:
    """Both halves of an even function, from the first.

    Args:
        halves: any shape, ``axis.half`` points along ``dim``.
        dim: that is completed.
        axis: which it is.

    Returns:
        the same with ``axis.length`` points along ``dim``.
    """
    return torch.cat([halves, halves.narrow(dim, 1, axis.rest).flip(dim)], dim=dim)


def even_transform(quarter: Tensor, x: EvenAxis, y: EvenAxis) -> Tensor:
    """A quarter of the 2-D Fourier transform of kernels that are even along both axes.

    As matrix products: a transform of a few hundred real cosines runs at several times the speed of an FFT of
    twice the length.

    Args:
        quarter: ``[F, hx, hy]`` of the kernels, complex, lags from 0 on.
        x: axis of hx points in a half.
        y: axis of hy points in a half.

    Returns:
        ``[F, hx, hy]`` of the spectra, wave numbers from 0 on.
    """
    real, imaginary = (x.cosines.T @ (part.contiguous() @ y.cosines) for part in (quarter.real, quarter.imag))
    return torch.complex(real, imaginary)


def inverse(spectra: Tensor, mx: int, my: int) -> Tensor:
    """First points of inverse 2-D Fourier transforms.

    Args:
        spectra: ``[…, lx, ly]``, complex.
        mx: points that are wanted along x.
        my: points that are wanted along y.

    Returns:
        ``[…, mx, my]``, complex.
    """
    return torch.fft.ifft(torch.fft.ifft(spectra, dim=-1)[..., :my], dim=-2)[..., :mx, :]


class Rotation:
    """``e^{-iΩ_k R}/R^power`` for equally spaced Ω.

    Double precision once for a run of them, then doubling by complex products.

    Args:
        distance: R, float64 of any shape, m.
        step: between frequencies, rad/m.
        most: frequencies that are asked for at once.
        power: of the falloff.
    """

    def __init__(self, distance: Tensor, step: float, most: int, power: int) -> None:
        self.distance, self.magnitude = distance, 1 / distance**power
        most = min(most, 64)
        self.powers = [
            polar(torch.ones_like(distance), -step * 2**j * distance) for j in range((most - 1).bit_length())
        ]

    def values(self, omega: Tensor, part: slice) -> Tensor:
        """The factors at some of the frequencies.

        Args:
            omega: ``[F]`` all frequencies, float64, rad/m.
            part: of them, with a start and a stop.

        Returns:
            ``[part, …]`` complex64, shaped as the distances.
        """
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
    """0 … n in runs that fill 16 MiB, small enough for caches and for memory to be used again.

    On a GPU 1 GiB, so that it has enough to do at once.

    Args:
        n: how many there are.
        size: complex numbers that each takes.
        device: that works on them.

    Returns:
        slices that cover 0 … n.

    Examples:
        >>> runs(5, 1 << 20, torch.device("cpu"))
        [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    most = max(1, (1 << 21 if device.type == "cpu" else 1 << 27) // size)
    return [slice(i, min(i + most, n)) for i in range(0, n, most)]


def next_fast_length(n: int) -> int:
    """Smallest number ≥ n whose only prime factors are 2, 3 and 5.

    ``scipy.fft.next_fast_len(n, real=True)`` says the same; imaging runs where there is torch alone.

    Examples:
        >>> [next_fast_length(n) for n in (7, 11, 128, 143)]
        [8, 12, 128, 144]
    """
    while True:
        rest = n
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return n
        n += 1


def polar(magnitude: Tensor, phase: Tensor) -> Tensor:
    """Complex64 from float64 magnitude and phase; the phase is reduced before it loses digits.

    Args:
        magnitude: of the phase's shape, or one that broadcasts to it.
        phase: rad.

    Returns:
        ``magnitude · e^{i phase}`` in the phase's shape.
    """
    turn = torch.remainder(phase, 2 * math.pi).to(torch.float32)
    return torch.polar(magnitude.to(torch.float32).expand_as(turn), turn)
