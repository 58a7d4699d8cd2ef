"""Slow tail of the instrument response."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.two_parts import quicker_part, share_left
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import convolve, geometric, whole_record


class IrfTail(Effect):
    """A share of the photons is counted late, by delays of one or two exponential distributions.

    ``Ψ' = (1 - f) Ψ + f · Ψ * ((1 - q) e^{-t/τ}/τ + q e^{-t/τ₂}/τ₂)``

    Parameters: ``fraction`` f (1), null 0. ``decay`` τ (m of path), scanned. ``quick`` q (1): share of them
    that decays more quickly, fitted along from 0 on. ``quick_decay`` τ₂ (m of path). What is left, ``slow``,
    is reported, too: its error is smaller, since a scene can imitate what is quick.

    Signature: residuals above 0 for tens of bins after every strong return, at every spot alike; energy is
    conserved.

    Degenerate with: ``afterpulsing`` (the same delay, after background counts too), weak surfels behind the
    surface.

    Source: diffusion tail of silicon SPADs: carriers from the neutral region reach the junction late (S. Cova
    et al., *Avalanche photodiodes and quenching circuits for single-photon detection*, Appl. Opt. 35, 1996).
    """

    name = "irf_tail"
    followed_by = ("free_time",)
    words = EffectWords(
        phrase="a slow detector tail",
        cause="In a silicon SPAD some carriers are born outside the junction and diffuse into it late.",
        remedy="Measure the instrument response on the direct pulse and use it; a thinner detector or a "
        "shorter wavelength has less tail.",
        headline="{slow} of the photons, τ = {decay}",
    )
    witness = "tail"
    imitated = ("light", "late")

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        bins = scan.bin_length
        decays = geometric(4 * bins, 0.75 * bins * scan.n_bins, 7)
        return (
            Parameter("fraction", "1", 0.0, 0.05, 0.0, 0.9, kind="percent"),
            Parameter("decay", "m", None, 0.2, bins, bins * scan.n_bins, grid=decays, log=True),
            *quicker_part(scan),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"fraction": 0.2}

    def response(self, kernel: Tensor, lead: int) -> Tensor:
        kernel = whole_record(kernel, lead, self.scan.n_bins)
        edges = self.scan.bin_length * torch.arange(len(kernel) + 1, dtype=kernel.dtype, device=kernel.device)
        late = -share_left(self, edges).diff()
        fraction = self.value("fraction")
        return (1 - fraction) * kernel + fraction * convolve(kernel, late)

    def quantities(self) -> dict[str, Quantity]:
        slow = self.value("fraction") * (1 - self.value("quick"))
        return super().quantities() | {"slow": Quantity(slow, "1", kind="percent")}
