"""Scalar imaging parameters: stored unconstrained, read through a constraint, named with a unit."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class BoundedParameter(nn.Module):
    """One positive physical quantity ``lower · (upper/lower)^sigmoid(raw)``: log-uniform between its bounds.

    Args:
        initial: start value, strictly between the bounds.
        lower: smallest value, > 0, in ``unit``.
        upper: largest value.
        unit: SI unit, for reports.

    Raises:
        ValueError: the start value does not lie between the bounds.

    Examples:
        >>> width = BoundedParameter(2.0, lower=1.0, upper=4.0, unit="m")
        >>> round(width().item(), 4), width.raw.item()
        (2.0, 0.0)
    """

    def __init__(self, initial: float, lower: float, upper: float, unit: str) -> None:
        super().__init__()
        if not 0 < lower < initial < upper:
            raise ValueError(
                f"start value {initial:g} {unit} must lie strictly between {lower:g} and {upper:g}"
            )
        self.lower, self.upper, self.unit = float(lower), float(upper), unit
        share = math.log(initial / lower) / math.log(upper / lower)
        self.raw = nn.Parameter(torch.tensor(math.log(share / (1 - share))))

    def forward(self) -> Tensor:
        """The quantity, in ``unit``, scalar."""
        return self.lower * torch.exp(math.log(self.upper / self.lower) * torch.sigmoid(self.raw))

    def extra_repr(self) -> str:
        """Value and bounds, for ``print(module)``."""
        return f"{float(self()):.6g} {self.unit} in [{self.lower:.4g}, {self.upper:.4g}]"
