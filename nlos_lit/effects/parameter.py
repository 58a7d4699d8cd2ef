"""Numbers of an effect: parameters that are fitted, quantities that are reported, and how they are said."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

KIND_OF_UNIT = {"1": "plain", "m": "time", "rad": "angle", "bins": "bins", "counts/bin": "counts"}


class Number(NamedTuple):
    """How a number is said, whatever its value.

    Args:
        unit: ``1``, ``m``, ``rad``, ``bins``, ``bins²`` or ``counts/bin``.
        kind: ``percent`` or ``plain`` (1), ``time`` (m of path) or ``length`` (m), ``angle`` (rad), ``bins``,
            ``counts``; empty: the usual one of the unit.
        null: value at which the effect is absent; None for a shape, which has none.
        share: a part of a whole, which cannot exceed 1.
    """

    unit: str
    kind: str = ""
    null: float | None = 0.0
    share: bool = False

    @property
    def said_as(self) -> str:
        """``kind``, or the usual one of the unit."""
        return self.kind or KIND_OF_UNIT.get(self.unit, "plain")


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Args:
        unit: SI unit, ``1`` for pure numbers.
        null: value at which the effect is absent; None for a shape (a delay, a decay) that means nothing at
            the null …
        grid: … and is therefore scanned over these values.
        scale: a noticeable change: stored values count in it.
        lower, upper: bounds.
        size: number of coefficients; they share null, scale and bounds.
        log: shape that is stored as its logarithm (``scale`` is then a change of the logarithm).
        prior: standard deviation of each coefficient around the null, in its unit, for those that spots alone
            may not settle.
        kind: how its value is said, where that is not the usual way of its unit: see :class:`Number`.
    """

    name: str
    unit: str
    null: float | None
    scale: float
    lower: float
    upper: float
    size: int = 1
    grid: tuple[float, ...] = ()
    log: bool = False
    prior: tuple[float, ...] = ()
    kind: str = ""

    @property
    def number(self) -> Number:
        """How its value is said.

        Examples:
            >>> Parameter("fraction", "1", 0.0, 0.05, 0.0, 0.9, kind="percent").number
            Number(unit='1', kind='percent', null=0.0, share=True)
            >>> Parameter("decay", "m", None, 0.2, 0.01, 2.0, grid=(0.1, 0.3), log=True).number.said_as
            'time'
        """
        share = self.unit == "1" and self.null == self.lower == 0 and self.upper <= 1
        return Number(self.unit, self.kind, self.null, share)


class Quantity(NamedTuple):
    """A number worth reporting, differentiable by the effect's parameters.

    Args:
        value: a scalar.
        unit, kind: as of :class:`Number`.
        spots: it counts spots of the scan.
    """

    value: Tensor
    unit: str
    spots: bool = False
    kind: str = ""

    @property
    def number(self) -> Number:
        """How its value is said."""
        return Number(self.unit, self.kind)
