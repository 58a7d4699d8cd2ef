"""What every effect is: a module with declared parameters that acts on the simulated measurement."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.hooks import OF_PATHS, STAGE_OF_HOOKS, Hooks, overridden
from nlos_lit.effects.parameter import Number, Parameter, Quantity
from nlos_lit.effects.words import EffectWords

STAGES = ("path", "time", "response", "spot", "counting")


class Asked(NamedTuple):
    """What the counts ask of the light of B spots over M surfels, in units of counting noise."""

    spots: Tensor  # [B] rows of the scan
    centre: Tensor  # [M, 3] m, of the surfels
    excess: Tensor  # [B, M] gain in likelihood, nats, of leaving out a small share of a path's light, by it
    light: Tensor  # [B, M] light of each path, by the noise where it arrives


class Effect(nn.Module, Hooks):
    """One physical effect. Subclasses set ``name`` and ``words``, declare parameters, and override hooks.

    Args:
        scan: of the capture.

    Attributes:
        name: of the effect and of its module.
        words: for the report.
        split_by: other effects that leave nearly the same trace, and the measurement that would tell. Of a
            pair, one says it.
        witness: what of the direct pulse, which no fit has seen, tells of the effect: its ``energy`` spot by
            spot (a gain), its ``tail`` (a parameter ``decay``), its ``delay`` spot by spot (a parameter
            ``offset``), or nothing.
        per_spot: its parameter is one random number a spot, drawn from a normal distribution whose width is
            what is reported.
        width_of: ``[k]`` numbers, from 0 on, of the prior widths that its coefficients have, which the counts
            are asked for; None where all have the same.
        in_runs: of such an effect, neighbouring spots may share their numbers. Otherwise only what a spot has
            over its neighbours counts.
        lasting: it belongs to the wall or to how the rig stands, so that another capture of the same wall has
            it with the same values.
        imitated: kinds of those that a scene fitted without it imitates: its "light" by more surfels, as of
            what real captures have strongly, its "geometry" by places and normals, its "echoes" or all its
            "late" light by surfels behind the surface. A diagnosis also builds a scene with all effects of
            each kind from the first surfel on.
        followed_by: free terms that can do what it does: they take any values where it follows an equation.
        with_power: amplitudes that are proportional to the laser's power.
        hooks: those that the class overrides. What follows from them:
        stage: where it acts, one of ``STAGES``.
        needs_paths: it acts on single paths (walls, path, time and transients hooks); the others act on whole
            transients.
    """

    name: ClassVar[str]
    words: ClassVar[EffectWords | None] = None
    split_by: ClassVar[Mapping[str, str]] = {}
    witness: ClassVar[Literal["energy", "tail", "delay"] | None] = None
    per_spot: ClassVar[bool] = False
    in_runs: ClassVar[bool] = False
    lasting: ClassVar[bool] = False
    followed_by: ClassVar[tuple[str, ...]] = ()
    with_power: ClassVar[tuple[str, ...]] = ()
    imitated: ClassVar[tuple[Literal["light", "geometry", "echoes", "late"], ...]] = ()
    hooks: ClassVar[frozenset[str]] = frozenset()
    stage: ClassVar[str] = ""
    needs_paths: ClassVar[bool] = False
    width_of: Tensor | None = None

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.hooks = overridden(cls)
        cls.stage = next((stage for stage, hooks in STAGE_OF_HOOKS if hooks & cls.hooks), "")
        cls.needs_paths = bool(cls.hooks & OF_PATHS)

    def __init__(self, scan: Scan) -> None:
        super().__init__()
        self.scan = scan
        self.declared = {p.name: p for p in self.declare(scan)}
        for p in self.declared.values():
            self.register_parameter(f"raw_{p.name}", nn.Parameter(torch.zeros(p.size)))
        # Per-spot effects: of their distribution, and how many spots have it.
        self.width, self.share = 0.0, 1.0
        self.prior_scale = 1.0  # of all prior deviations
        self.reset()

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        """Parameters, amplitudes before shapes."""
        raise NotImplementedError

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        """A strength that is clearly visible, by the names of :meth:`settable`; shapes are left out."""
        raise NotImplementedError

    def same_as(self) -> str:
        """Name of another effect that is exactly this one in its scan; empty where there is none."""
        return ""

    def twin_of(self, other: Effect) -> bool:
        """Whether one of the two is the other in its scan: they may be meant alike, and never both."""
        return self.name == other.same_as() or other.name == self.same_as()

    def value(self, name: str) -> Tensor:
        """``[size]`` (a scalar for size 1) in the parameter's unit."""
        p, raw = self.declared[name], getattr(self, f"raw_{name}")
        value = torch.exp(p.scale * raw) if p.log else p.scale * raw
        return value[0] if p.size == 1 else value

    @torch.no_grad()
    def set(self, name: str, value: float | Tensor) -> None:
        """Store a value (or one for each coefficient), kept within the bounds.

        Args:
            name: of the parameter.
            value: a scalar or ``[size]``, in the parameter's unit.
        """
        p = self.declared[name]
        value = torch.as_tensor(value, dtype=torch.float32).clamp(p.lower, p.upper)
        getattr(self, f"raw_{name}").copy_((torch.log(value) if p.log else value) / p.scale)

    def set_all(self, values: Mapping[str, float | Tensor]) -> None:
        """Store several values by name."""
        for name, value in values.items():
            self.set(name, value)

    def reset(self) -> None:
        """The null; shapes at the middle of their grids."""
        for p in self.declared.values():
            self.set(p.name, p.grid[len(p.grid) // 2] if p.null is None else p.null)

    def begin(self, counts: Tensor) -> None:
        """Take on what a scene is built with from the first surfel on: the null, or what the counts show.

        Args:
            counts: ``[S, T]`` of the spots that are fitted.
        """
        self.reset()

    def part_of(self) -> dict[str, float]:
        """Values by which it does what it does now, and what a scene may have taken up; empty: none."""
        return {}

    @torch.no_grad()
    def clamp(self) -> None:
        """Bring every parameter back within its bounds, after a step of an optimiser."""
        for p in self.declared.values():
            self.set(p.name, self.value(p.name))

    @torch.no_grad()
    def shift(self, step: Tensor, shapes: bool = False) -> None:
        """Add to the stored amplitudes, without regard to bounds.

        Args:
            step: ``[k]``, in order.
            shapes: its last numbers are added to the stored shapes.
        """
        for p in self.amplitudes + (self.shapes if shapes else []):
            getattr(self, f"raw_{p.name}").add_(step[: p.size])
            step = step[p.size :]

    def step_bounds(self) -> tuple[Tensor, Tensor]:
        """``[k]`` least and largest steps of the stored amplitudes from their nulls."""
        lower, upper = [], []
        for p in self.amplitudes:
            assert p.null is not None  # what makes an amplitude
            lower.append(torch.full((p.size,), (p.lower - p.null) / p.scale))
            upper.append(torch.full((p.size,), (p.upper - p.null) / p.scale))
        return torch.cat(lower).double(), torch.cat(upper).double()

    def is_meant(self, step: Tensor) -> bool:
        """Whether the effect is still what its name says.

        Args:
            step: ``[k]`` of its stored amplitudes from their nulls.
        """
        return True

    def factors(self, spots: Tensor) -> Tensor | None:
        """``[B, J]`` where amplitudes act as those of :meth:`alone` do, times a number at each spot.

        Then there are J times as many as those; None where that is not so.
        """
        return None

    def alone(self) -> Effect:
        """An effect that acts alike at all spots; see :meth:`factors`."""
        raise NotImplementedError

    def precision(self) -> Tensor:
        """``[k]`` prior precision of all stored values, amplitudes first; 0 where there is no prior."""
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

    def reach(self) -> dict[nn.Parameter, Tensor]:
        """By stored parameter with a prior, how far that expects each value from its null: 1 at most."""
        known = {getattr(self, f"raw_{p.name}"): p for p in self.declared.values() if p.prior}
        return {raw: self._precision(p).clamp_min(1.0).rsqrt().to(raw.device) for raw, p in known.items()}

    def _precision(self, p: Parameter) -> Tensor:
        """[size] of stored values of a parameter that has a prior."""
        return (torch.tensor(p.prior) * (self.prior_scale / p.scale)).square().reciprocal()

    @property
    def moves_light(self) -> bool:
        """It moves or scales light by path or spot, as errors of places, normals and albedos do."""
        return bool(self.hooks & {"walls", "path", "time", "gain"})

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

    def likely_shapes(self, asked: Asked) -> list[dict[str, float]]:
        """Shapes that are worth a test; the whole grid, where an effect does not know better.

        Args:
            asked: what the counts ask of each path's light.

        Returns:
            as of :meth:`shape_grid`.
        """
        return self.shape_grid()

    def likely_in_time(self, excess: Tensor, light: Tensor) -> list[dict[str, float]]:
        """The same of an effect that does not act on single paths.

        Args:
            excess: ``[T_gate]`` counts over the expected ones, of all spots together.
            light: ``[T_gate]`` expected counts of all spots together.

        Returns:
            as of :meth:`shape_grid`.
        """
        return self.shape_grid()

    def quantities(self) -> dict[str, Quantity]:
        """What is reported: every scalar parameter; effects with coefficients override this."""
        return {
            p.name: Quantity(self.value(p.name), p.unit, kind=p.kind)
            for p in self.declared.values()
            if p.size == 1
        }

    def numbers(self) -> dict[str, Number]:
        """Every number that may be said of the effect, parameters first; those reported at times, too."""
        said = {p.name: p.number for p in self.declared.values()}
        return said | {name: q.number for name, q in self.quantities().items() if name not in said}

    def settable(self) -> dict[str, str]:
        """Scalars that can be given, with their units: parameters, or the size of random coefficients."""
        return {p.name: p.unit for p in self.declared.values()}

    def draw(self, values: Mapping[str, float], rng: np.random.Generator) -> None:
        """Take on a strength that a user gave; effects with coefficients draw these.

        Args:
            values: by the names of :meth:`settable`, each in its unit.
            rng: for what is random.

        Raises:
            UserError: a value that is out of bounds, or makes no sense.
        """
        for name, value in values.items():
            self.set_given(name, torch.tensor(value, dtype=torch.float64), name)

    def set_given(self, parameter: str, value: Tensor, given: str) -> None:
        """Store a value that follows from what a user gave.

        Args:
            parameter: that is set.
            value: a scalar, or ``[size]`` coefficients that were drawn, in the parameter's unit.
            given: name of the scalar that the user gave.

        Raises:
            UserError: a value is out of the parameter's bounds.
        """
        p = self.declared[parameter]
        low, high = float(value.min()), float(value.max())
        if not (p.lower <= low and high <= p.upper):
            found = (
                f"found {high:g}"
                if value.ndim == 0
                else f"found values from {low:g} to {high:g} in the field drawn; take it smaller"
            )
            unit = "" if p.unit == "1" else f" {p.unit}"
            raise UserError(f"{self.name}.{given} must keep within {p.lower:g} … {p.upper:g}{unit}; {found}")
        self.set(parameter, value.float())

    def given_size(self, values: Mapping[str, float], name: str) -> float:
        """One of the values given, a size.

        Args:
            values: by the names of :meth:`settable`.
            name: of the one.

        Returns:
            The value, 0 or more.

        Raises:
            UserError: it is below 0.
        """
        if not values[name] >= 0:
            raise UserError(f"{self.name}.{name} must be 0 or more; found {values[name]:g}")
        return values[name]

    def settle(self, expected: Tensor) -> None:
        """In a simulation, before its counting hook: take on what follows from how much light there is.

        Args:
            expected: ``[S, T]`` photons of all spots.
        """
