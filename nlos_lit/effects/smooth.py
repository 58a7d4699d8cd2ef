"""What effects that are a smooth function of the spot share."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.effects.base import Effect, Quantity
from nlos_lit.effects.basis import smooth_basis, smooth_map_basis
from nlos_lit.effects.scan import Scan


class SmoothEffect(Effect):
    """One parameter, the coefficients ``c`` of ``f(s) = Σ_k c_k b_k(s)``; the b_k average to zero with mean square 1 over the scan.

    Attributes:
        coefficients: name of the parameter.
        ends: whether the peak-to-peak value is reported, too.
    """

    coefficients: ClassVar[str]
    ends: ClassVar[bool] = False
    functions: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("functions", self.basis(scan), persistent=False)

    @classmethod
    def basis(cls, scan: Scan) -> Tensor:
        """``[S, K]``."""
        raise NotImplementedError

    def field(self, spots: Tensor | None = None) -> Tensor:
        """``[B]`` f at ``spots`` ``[B]``, or ``[S]`` at all of them."""
        functions = self.functions if spots is None else self.functions[spots]
        return functions @ self.value(self.coefficients).reshape(-1)

    def quantities(self) -> dict[str, Quantity]:
        unit, field = self.declared[self.coefficients].unit, self.field()
        reported = {"rms": Quantity(length(field / len(field) ** 0.5, self.declared[self.coefficients].scale), unit)}
        if self.ends:
            reported["peak_to_peak"] = Quantity(field.amax() - field.amin(), unit)
        return reported


def over_time(scan: Scan) -> Tensor:
    """``[S, ≤ 5]`` smooth functions of the order of acquisition."""
    return smooth_basis(scan.rank, 6)


def over_wall(scan: Scan, n: int) -> Tensor:
    """``[S, ≤ n² - 1]`` smooth functions of the wall point; of both, added, where laser and sensor move."""
    return smooth_map_basis(torch.cat(scan.places), n).view(len(scan.places), scan.n_spots, -1).sum(0)


def length(values: Tensor, scale: float) -> Tensor:
    """Euclidean length of ``values``, with gradient zero instead of none at zero: exact to 1e-4 of ``scale``."""
    least = 1e-4 * scale
    return torch.sqrt(values.square().sum() + least**2) - least
