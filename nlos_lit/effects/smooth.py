"""What effects that are a smooth function of the spot share."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect, Parameter, Quantity
from nlos_lit.functional.smooth_basis import smooth_basis, smooth_map_basis


class SmoothEffect(Effect):
    """One parameter, the coefficients ``c`` of ``f(s) = Σ_k c_k b_k(s)``; the b_k average to zero with mean
    square 1 over the scan.

    The rougher a b_k, the smaller its coefficient is taken to be (prior): deviation ``likely`` of the
    smoothest, falling with the third power of the frequency (Sobolev smoothness 2 over a plane). Without it,
    coefficients that the fitted spots hardly settle run wild on those that were not fitted.

    Attributes:
        coefficients: name of the parameter.
        ends: whether the peak-to-peak value is reported, too.
    """

    coefficients: ClassVar[str]
    ends: ClassVar[bool] = False
    functions: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("functions", self.basis(scan)[0], persistent=False)

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        """``[S, K]`` functions, and ``[K]`` how large their coefficients are likely to be against the first."""
        raise NotImplementedError

    @classmethod
    def coefficient(
        cls, scan: Scan, unit: str, scale: float, bound: float, likely: float
    ) -> tuple[Parameter]:
        """The declaration: null 0, bounds ± ``bound``, ``likely`` deviation of the first coefficient."""
        share = cls.basis(scan)[1]
        prior = tuple((likely * share**1.5).tolist())
        return (Parameter(cls.coefficients, unit, 0.0, scale, -bound, bound, size=len(share), prior=prior),)

    def field(self, spots: Tensor | None = None) -> Tensor:
        """``[B]`` f at ``spots`` ``[B]``, or ``[S]`` at all of them."""
        functions = self.functions if spots is None else self.functions[spots]
        return functions @ self.value(self.coefficients).reshape(-1)

    def quantities(self) -> dict[str, Quantity]:
        unit, field = self.declared[self.coefficients].unit, self.field()
        reported = {
            "rms": Quantity(length(field / len(field) ** 0.5, self.declared[self.coefficients].scale), unit)
        }
        if self.ends:
            reported["peak_to_peak"] = Quantity(field.amax() - field.amin(), unit)
        return reported


def over_time(scan: Scan) -> tuple[Tensor, Tensor]:
    """``[S, ≤ 5]`` smooth functions of the order of acquisition, and their shares ``[≤ 5]``."""
    return smooth_basis(scan.rank, 6)


def over_wall(scan: Scan, n: int) -> tuple[Tensor, Tensor]:
    """``[S, ≤ n² - 1]`` smooth functions of the wall point, of both added where laser and sensor move; and
    their shares.
    """
    functions, share = smooth_map_basis(torch.cat(scan.places), n)
    return functions.view(len(scan.places), scan.n_spots, -1).sum(0), share


def length(values: Tensor, scale: float) -> Tensor:
    """Euclidean length of ``values``, with gradient zero instead of none at zero: exact to 1e-4 of ``scale``."""
    least = 1e-4 * scale
    return torch.sqrt(values.square().sum() + least**2) - least
