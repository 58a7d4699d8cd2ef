"""What every effect is: a module with declared parameters that acts at one or more stages of the forward
model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.hooks import Hooks

STAGES = ("path", "time", "response", "spot", "counting")


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


class Quantity(NamedTuple):
    """A number worth reporting, differentiable by the effect's parameters; ``spots``: it counts spots of the
    scan.
    """

    value: Tensor
    unit: str
    spots: bool = False


class Effect(nn.Module, Hooks):
    """One physical effect. Subclasses set ``name`` and ``stage``, declare parameters, and override the hooks
    they need.

    Args:
        scan: of the capture.

    Attributes:
        needs_paths: it acts on single paths (path, time and transients hooks); the others act on whole
            transients.
        per_spot: its parameter is one random number a spot, drawn from a normal distribution whose width is
            what is reported.
    """

    name: ClassVar[str]
    stage: ClassVar[str]
    needs_paths: ClassVar[bool] = False
    per_spot: ClassVar[bool] = False

    def __init__(self, scan: Scan) -> None:
        super().__init__()
        self.scan = scan
        self.declared = {p.name: p for p in self.declare(scan)}
        for p in self.declared.values():
            self.register_parameter(f"raw_{p.name}", nn.Parameter(torch.zeros(p.size)))
        self.width, self.share = (
            0.0,
            1.0,
        )  # per-spot effects: of their distribution, and how many spots have it
        self.prior_scale = 1.0  # of all prior deviations
        self.reset()

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        """Parameters, amplitudes before shapes."""
        raise NotImplementedError

    def value(self, name: str) -> Tensor:
        """``[size]`` (a scalar for size 1) in the parameter's unit."""
        p, raw = self.declared[name], getattr(self, f"raw_{name}")
        value = torch.exp(p.scale * raw) if p.log else p.scale * raw
        return value[0] if p.size == 1 else value

    @torch.no_grad()
    def set(self, name: str, value: float | Tensor) -> None:
        """Store a value (or one for each coefficient), kept within the bounds."""
        p = self.declared[name]
        value = torch.as_tensor(value, dtype=torch.float32).clamp(p.lower, p.upper)
        getattr(self, f"raw_{name}").copy_((torch.log(value) if p.log else value) / p.scale)

    def set_all(self, values: Mapping[str, float]) -> None:
        """Store several values by name."""
        for name, value in values.items():
            self.set(name, value)

    def reset(self) -> None:
        """The null; shapes at the middle of their grids."""
        for p in self.declared.values():
            self.set(p.name, p.grid[len(p.grid) // 2] if p.null is None else p.null)

    @torch.no_grad()
    def clamp(self) -> None:
        """Bring every parameter back within its bounds, after a step of an optimiser."""
        for p in self.declared.values():
            self.set(p.name, self.value(p.name))

    def precision(self) -> Tensor:
        """Prior precision of all stored values (amplitudes in order, then shapes): [k], 0 where there is no
        prior.
        """
        parts = [self._precision(p) if p.prior else torch.zeros(p.size) for p in self.declared.values()]
        return torch.cat(parts) if parts else torch.zeros(0)

    def penalty(self) -> Tensor:
        """Nats that the prior takes for the present values: ``½ Σ (value/deviation)²``; 0 at the null."""
        total = torch.zeros(())
        for p in self.declared.values():
            if p.prior:
                raw = getattr(self, f"raw_{p.name}")
                off = raw - (p.null or 0.0) / p.scale
                total = total.to(raw.device) + 0.5 * (self._precision(p).to(raw.device) * off.square()).sum()
        return total

    def _precision(self, p: Parameter) -> Tensor:
        """[size] of stored values of a parameter that has a prior."""
        return (torch.tensor(p.prior) * (self.prior_scale / p.scale)).square().reciprocal()

    @property
    def moves_light(self) -> bool:
        """It moves light in time or scales it, path by path or spot by spot, as errors of places, normals and
        albedos do.
        """
        return any(getattr(type(self), hook) is not getattr(Hooks, hook) for hook in ("path", "time", "gain"))

    @property
    def amplitudes(self) -> list[Parameter]:
        """Parameters with a null value."""
        return [p for p in self.declared.values() if p.null is not None]

    @property
    def shapes(self) -> list[Parameter]:
        """Parameters without one."""
        return [p for p in self.declared.values() if p.null is None]

    def shape_grid(self) -> list[dict[str, float]]:
        """Combinations of shape values to scan; one empty combination where there are none."""
        combinations: list[dict[str, float]] = [{}]
        for p in self.shapes:
            combinations = [{**c, p.name: v} for c in combinations for v in p.grid]
        return combinations

    def quantities(self) -> dict[str, Quantity]:
        """What is reported: every scalar parameter; effects with coefficients override this."""
        return {p.name: Quantity(self.value(p.name), p.unit) for p in self.declared.values() if p.size == 1}
