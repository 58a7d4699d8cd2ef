"""Laser-sensor response Ψ in closed form: an exponential decay convolved with a Gaussian (paper Eq. 10)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlos_lit.functional.even_convolution import next_fast_length


def emg_cdf(time: Tensor, sigma: Tensor, kappa: Tensor) -> Tensor:
    """Distribution function of an exponentially modified Gaussian ``κ e^{-κt} * N(0, σ)``.

    ``F(t) = Φ(t/σ) - e^{-κt + κ²σ²/2} Φ(t/σ - κσ)``, accurate for σ and 1/κ far below or far above the
    spacing of ``time``: Φ(x) of a negative x is ½ e^{-x²/2} erfcx(-x/√2), so that the huge exponential of
    the second term meets the tiny Φ analytically, and in the left tail both terms share the factor
    e^{-t²/(2σ²)}.

    Args:
        time: ``[…]`` times since the arrival, in any unit.
        sigma: σ, a scalar in the same unit.
        kappa: κ, a scalar in one over that unit.

    Returns:
        ``[…]`` in 0 … 1; differentiable in all three.

    Examples:
        >>> import torch
        >>> one = torch.ones((), dtype=torch.float64)
        >>> late, early = emg_cdf(torch.tensor([3.0, -30.0], dtype=torch.float64), 1e-6 * one, one).tolist()
        >>> round(late, 5), early  # a tiny jitter leaves the bare decay: 1 - e^-3
        (0.95021, 0.0)
    """
    scaled = time / sigma
    late = scaled - kappa * sigma
    left = 0.5 * torch.exp(-0.5 * scaled**2)
    root = math.sqrt(0.5)
    # Clamps keep the branch that is not taken finite, for the gradient's sake.
    jitter = torch.where(
        scaled < 0, left * torch.special.erfcx(-scaled.clamp_max(0) * root), torch.special.ndtr(scaled)
    )
    decay = torch.exp((0.5 * (kappa * sigma) ** 2 - kappa * time).clamp_max(0)) * torch.special.ndtr(late)
    delayed = torch.where(late < 0, left * torch.special.erfcx(-late.clamp_max(0) * root), decay)
    return (jitter - delayed).clamp(0.0, 1.0)


def response(sigma: Tensor, kappa: Tensor, n_bins: int, lead: int) -> Tensor:
    """Share of Ψ/I_l that falls into each time bin (paper Eq. 10, integrated over bins).

    Args:
        sigma: σ_ls in bins, a scalar.
        kappa: κ_s per bin, a scalar.
        n_bins: length K of the kernel.
        lead: bins before the one that is centred on the arrival.

    Returns:
        ``[K]`` float32, worked out in double precision; the sum is 1 less what lies outside the kernel.

    Examples:
        >>> import torch
        >>> kernel = response(torch.tensor(0.6), torch.tensor(2.0), n_bins=16, lead=4)
        >>> round(kernel.sum().item(), 6), kernel.argmax().item()
        (1.0, 4)
        >>> bins = torch.arange(16) - 4.0
        >>> round((kernel @ bins).item(), 3)  # the decay delays light by 1/κ on average
        0.5
    """
    if sigma.device.type == "cpu":
        return _Response.apply(sigma, kappa, n_bins, lead)[0]
    edges = torch.arange(n_bins + 1, dtype=torch.float64, device=sigma.device) - lead - 0.5
    return torch.diff(emg_cdf(edges, sigma.double(), kappa.double())).to(torch.float32)


class _Response(torch.autograd.Function):
    """:func:`response` ``[K]``, and its slopes by σ and by κ ``[2, K]``, which are known in closed form.

    With φ the normal density and E = Φ(t/σ) - F, ∂F/∂σ = κ (φ(t/σ) - κσE) and ∂F/∂κ = (t - κσ²) E + σ φ(t/σ).
    """

    @staticmethod
    def forward(sigma: Tensor, kappa: Tensor, n_bins: int, lead: int) -> tuple[Tensor, Tensor]:
        # A machine that simulates on a GPU alone needs no numba.
        from nlos_lit.functional.path_loops import emg

        found = np.diff(emg(n_bins + 1, -lead - 0.5, sigma.item(), kappa.item())).astype(np.float32)
        return torch.from_numpy(found[0]), torch.from_numpy(found[1:])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(*inputs[:2], output[1])
        ctx.save_for_forward(*inputs[:2], output[1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, Tensor, None, None]:
        sigma, kappa, slopes = ctx.saved_tensors
        of_sigma, of_kappa = slopes.double() @ grad.double()
        return of_sigma.to(sigma), of_kappa.to(kappa), None, None

    @staticmethod
    def jvp(ctx: Any, of_sigma: Tensor | None, of_kappa: Tensor | None, *_: None) -> tuple[Tensor, None]:
        sigma, kappa, slopes = ctx.saved_tensors
        both = (
            x if change is None else change for x, change in ((sigma * 0, of_sigma), (kappa * 0, of_kappa))
        )
        return sum(change * slope for change, slope in zip(both, slopes, strict=True)), None


def convolve_time(transients: Tensor, kernel: Tensor, lead: int) -> Tensor:
    """Linear convolution along time with a kernel that begins ``lead`` bins early, by zero-padded FFT.

    ``out[s, t] = Σ_k kernel[k] transients[s, t - k + lead]``; what leaves the window is lost.

    Args:
        transients: ``[S, T]``.
        kernel: ``[K]``.
        lead: index of the kernel's bin that leaves light where it is.

    Returns:
        ``[S, T]``.

    Examples:
        >>> import torch
        >>> spike = torch.tensor([[0.0, 0.0, 8.0, 0.0, 0.0]])
        >>> convolve_time(spike, torch.tensor([0.25, 0.5, 0.25]), lead=1).round()
        tensor([[0., 2., 4., 2., 0.]])
    """
    return _Convolution.apply(transients, kernel, lead)


class _Convolution(torch.autograd.Function):
    """:func:`convolve_time`; its derivatives take as many real transforms as itself."""

    @staticmethod
    def forward(transients: Tensor, kernel: Tensor, lead: int) -> Tensor:
        bins, size = transients.shape[1], _whole(transients, kernel)
        product = torch.fft.rfft(transients, size) * torch.fft.rfft(kernel, size)
        return torch.fft.irfft(product, size)[:, lead : lead + bins].contiguous()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, int], output: Tensor) -> None:
        transients, kernel, ctx.lead = inputs
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(transients, kernel)
        ctx.save_for_forward(transients, kernel)

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None) -> tuple[Tensor | None, Tensor | None, None]:
        if grad is None:
            return None, None, None
        transients, kernel = ctx.saved_tensors
        bins, size = transients.shape[1], _whole(transients, kernel)
        pull = torch.fft.rfft(torch.nn.functional.pad(grad, (ctx.lead, 0)), size)
        of_light = of_kernel = None
        if ctx.needs_input_grad[0]:
            of_light = torch.fft.irfft(pull * torch.fft.rfft(kernel, size).conj(), size)[:, :bins]
        if ctx.needs_input_grad[1]:
            both = (pull * torch.fft.rfft(transients, size).conj()).sum(0)
            of_kernel = torch.fft.irfft(both, size)[: len(kernel)]
        return of_light, of_kernel, None

    @staticmethod
    def jvp(ctx: Any, d_transients: Tensor | None, d_kernel: Tensor | None, _: None) -> Tensor:
        transients, kernel = ctx.saved_tensors
        changes = [] if d_transients is None else [convolve_time(d_transients, kernel, ctx.lead)]
        changes += [] if d_kernel is None else [convolve_time(transients, d_kernel, ctx.lead)]
        return sum(changes[1:], changes[0])


def _whole(transients: Tensor, kernel: Tensor) -> int:
    """Bins of the transforms: the whole convolution fits, and even lengths are several times faster."""
    size = transients.shape[1] + len(kernel) - 1
    return 2 * next_fast_length(-(-size // 2))
