"""What effects share that are a smooth function of the spot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.functional.smooth_basis import smooth_basis, smooth_map_basis

SLOW, FAST = 24, 128  # splines over the scan, of what changes slowly, and at most of what may change fast
FEW = 4  # spots for each spline of those


class SmoothEffect(Effect):
    """One parameter, the coefficients ``c`` of ``f(s) = Σ_k c_k b_k(s)``; the b_k average to zero with mean
    square 1 over the scan. Where f is a vector, each function has a coefficient for each component.

    The rougher a b_k, the smaller its coefficient is taken to be (prior): deviation ``likely`` of the
    smoothest, falling with a power of the frequency. Without it, coefficients that the fitted spots hardly
    settle run wild on those that were not fitted.

    Attributes:
        coefficients: name of the parameter.
        components: of f, J; 1 where it is a number.
        falling: the power; 3 is Sobolev smoothness 2 over a plane, 1 a random walk along a line.
        ends: whether the peak-to-peak value is reported, too.
        slow: it drifts: what swings, in the mean, more often over the scan than ``SLOW`` splines can is
            something else.
    """

    coefficients: ClassVar[str]
    components: ClassVar[int] = 1
    falling: ClassVar[float] = 3.0
    ends: ClassVar[bool] = False
    slow: ClassVar[bool] = False
    functions: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        functions, share = self.basis(scan)
        self.register_buffer("functions", functions, persistent=False)
        # of each coefficient, in half periods over the scan
        self.frequency = share.rsqrt().repeat_interleave(self.components)

    @classmethod
    def basis(cls, scan: Scan) -> tuple[Tensor, Tensor]:
        """``[S, K]`` functions, and ``[K]`` how large their coefficients likely are against the first."""
        raise NotImplementedError

    @classmethod
    def coefficient(
        cls, scan: Scan, unit: str, scale: float, bound: float, likely: float, kind: str = ""
    ) -> tuple[Parameter]:
        """The declaration of the coefficients, null 0.

        Args:
            scan: of the capture.
            unit, scale, kind: as of :class:`~nlos_lit.effects.parameter.Parameter`.
            bound: none is larger, either way.
            likely: deviation of the first coefficient.

        Returns:
            The one parameter.
        """
        share = cls.basis(scan)[1].repeat_interleave(cls.components)
        prior = falling_prior(share, likely, cls.falling)
        return (
            Parameter(
                cls.coefficients, unit, 0.0, scale, -bound, bound, size=len(share), prior=prior, kind=kind
            ),
        )

    def field(self, spots: Tensor | None = None) -> Tensor:
        """``[B]``, or ``[B, J]``, f at ``spots`` ``[B]``, or at all of them."""
        functions = self.functions if spots is None else self.functions[spots]
        field = functions @ self.value(self.coefficients).reshape(functions.shape[1], self.components)
        return field[:, 0] if self.components == 1 else field

    def is_meant(self, step: Tensor) -> bool:
        power = step.cpu().square()
        return not self.slow or bool((power * self.frequency).sum() <= SLOW * power.sum())

    def quantities(self) -> dict[str, Quantity]:
        p, field = self.declared[self.coefficients], self.field()
        reported = {"rms": Quantity(length(field / len(field) ** 0.5, p.scale), p.unit, kind=p.kind)}
        if self.ends:
            reported["peak_to_peak"] = Quantity(field.amax() - field.amin(), p.unit, kind=p.kind)
        return reported

    def settable(self) -> dict[str, str]:
        return {"rms": self.declared[self.coefficients].unit}

    def draw(self, values: Mapping[str, float], rng: np.random.Generator) -> None:
        """A random function, as smooth as its prior has it, of exactly the root mean square given.

        Args:
            values: ``rms`` in the coefficients' unit.
            rng: for the coefficients, normal deviates as large as their prior before they are scaled.

        Raises:
            UserError: it is negative or too large, or the scan has too few spots.
        """
        deviations = np.array(self.declared[self.coefficients].prior)
        field = deviations * rng.standard_normal(len(deviations))
        functions = self.functions.double()
        drawn = functions @ torch.from_numpy(field).view(functions.shape[1], self.components)
        size = float(drawn.square().sum(1).mean().sqrt())
        if size == 0:
            raise UserError(
                f"{self.name} needs more spots: the scan is too small for a smooth function over it"
            )
        given = torch.from_numpy(field * (self.given_size(values, "rms") / size))
        self.set_given(self.coefficients, given, "rms")


class SeveralWidths(Effect):
    """One parameter, coefficients whose prior may have several widths: the counts are asked for each.

    Attributes:
        width_of: ``[k]`` number of each coefficient's width.
        relative: ``[k]`` prior deviations that the counts ask for, over those that were likely beforehand.
    """

    width_of: Tensor
    relative: Tensor

    def give_widths(self, width_of: Tensor) -> None:
        """Say which coefficients have a width in common.

        Args:
            width_of: ``[k]`` numbers from 0 on.
        """
        self.width_of = width_of
        self.register_buffer("relative", torch.ones(len(width_of)))

    def _precision(self, p: Parameter) -> Tensor:
        return super()._precision(p) / self.relative.cpu().square()


def falling_prior(share: Tensor, first: float, falling: float) -> tuple[float, ...]:
    """Prior deviations of coefficients that fall with a power of the frequency.

    Args:
        share: ``[K]`` inverse squares of the functions' frequencies.
        first: deviation where that is 1.
        falling: the power.

    Returns:
        K deviations.

    Examples:
        >>> falling_prior(torch.tensor([1.0, 0.25]), 3.0, 1.0)
        (3.0, 1.5)
    """
    return tuple((first * share ** (falling / 2)).tolist())


def over_scan(scan: Scan, n: int) -> tuple[Tensor, Tensor]:
    """Smooth functions of the order of acquisition.

    Args:
        scan: of the capture.
        n: splines over it.

    Returns:
        ``[S, K ≤ n - 1]`` functions, and their shares ``[K]``.
    """
    return smooth_basis(scan.rank, n)


def fast(scan: Scan) -> int:
    """How many splines over a scan follow what may change within a few spots.

    Args:
        scan: of the capture.

    Returns:
        one for every ``FEW`` spots, from ``SLOW`` to ``FAST``.
    """
    return max(SLOW, min(FAST, scan.n_spots // FEW))


def over_wall(scan: Scan, n: int) -> tuple[Tensor, Tensor]:
    """Smooth functions of the wall point, of both added where laser and sensor move.

    Args:
        scan: of the capture.
        n: splines along either side of the wall.

    Returns:
        ``[S, K ≤ n² - 1]`` functions, and their shares ``[K]``.
    """
    functions, share = smooth_map_basis(torch.cat(scan.places), n)
    return functions.view(len(scan.places), scan.n_spots, -1).sum(0), share


def length(values: Tensor, scale: float) -> Tensor:
    """Euclidean length, with gradient zero instead of none at zero.

    Args:
        values: of any shape.
        scale: of noticeable values; the length is exact to 1e-4 of it.

    Returns:
        A scalar.

    Examples:
        >>> round(float(length(torch.tensor([3.0, 4.0]), 1.0)), 3)
        5.0
    """
    least = 1e-4 * scale
    return torch.sqrt(values.square().sum() + least**2) - least
