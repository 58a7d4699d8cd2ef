"""Formulas along an axis: what a free term may turn out to follow.

A formula is a *form* (a step, an exponential …) of x, from 0 to 1 along an axis, and a *place* where it acts,
that of a free term. Each pair is an effect like those of the registry, with a few numbers instead of dozens
of coefficients. Where one predicts as well as the free term does, its name is found: the pair is written out
as an effect file (:func:`written`).

    f(x) = Σ_j a_j b_j(x),    counts → counts · e^f   or   background → background · e^f   or   L → L + f   …
"""

from __future__ import annotations

import math
import re
import textwrap
from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.free_terms import (
    RATES,
    Free,
    FreeRate,
    FreeScan,
    FreeScanBackground,
    FreeScanDelay,
    FreeTime,
    FreeWidthScan,
)
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import filtered, geometric
from nlos_lit.functional.surfel_paths import Paths

EDGE = 0.01  # of the axis: width of a step
FREQUENCIES = tuple(k / 2 for k in range(1, 49))  # periods along the axis, half a period apart


class Form:
    """Functions ``b_j`` of x, with their shape.

    Attributes:
        form: what it is called. says: it in words.
        equation: with ``x`` from 0 to 1.
        names: of the amplitudes. told: of the shape, with its meaning, for the docstring of an effect.
    """

    form: ClassVar[str]
    says: ClassVar[str]
    equation: ClassVar[str]
    names: ClassVar[tuple[str, ...]]
    told: ClassVar[str] = ""

    @classmethod
    def shape(cls) -> tuple[Parameter, ...]:
        """Scanned parameters, at most one."""
        return ()

    @staticmethod
    def functions(x: Tensor, shape: Tensor) -> Tensor:
        """Values of b_j.

        Args:
            x: ``[…]``.
            shape: a scalar, of the scanned parameter.

        Returns:
            ``[…, J]``.
        """
        raise NotImplementedError


class Step(Form):
    """From one value to another, at one place."""

    form, says, equation, names = "step", "a step", "height σ((x - place)/0.01)", ("height",)
    told = "``place`` (1) of the step, from 0 to 1, scanned."

    @classmethod
    def shape(cls) -> tuple[Parameter, ...]:
        return (Parameter("place", "1", None, EDGE, 0.02, 0.98, grid=tuple(k / 50 for k in range(2, 49))),)

    @staticmethod
    def functions(x: Tensor, shape: Tensor) -> Tensor:
        return torch.sigmoid((x - shape) / EDGE)[..., None]


class Decay(Form):
    """What dies off, as a warm-up does."""

    form, says, equation, names = "decay", "an exponential", "start e^{-x/decay}", ("start",)
    told = "``decay`` (1) as a share of the axis, scanned."

    @classmethod
    def shape(cls) -> tuple[Parameter, ...]:
        return (Parameter("decay", "1", None, 0.1, 0.01, 4.0, grid=geometric(0.02, 2.0, 14), log=True),)

    @staticmethod
    def functions(x: Tensor, shape: Tensor) -> Tensor:
        return torch.exp(-x / shape)[..., None]


class Power(Form):
    """What grows ever faster, or ever slower."""

    form, says, equation, names = "power", "a power law", "end x^exponent", ("end",)
    told = "``exponent`` (1), scanned."

    @classmethod
    def shape(cls) -> tuple[Parameter, ...]:
        return (Parameter("exponent", "1", None, 0.1, 0.1, 8.0, grid=geometric(0.25, 6.0, 12), log=True),)

    @staticmethod
    def functions(x: Tensor, shape: Tensor) -> Tensor:
        return x.clamp_min(1e-6)[..., None] ** shape


class Wave(Form):
    """What swings."""

    form, says, names = "wave", "a sinusoid", ("sine", "cosine")
    equation = "sine sin(2πx·frequency) + cosine cos(2πx·frequency)"
    told = "``frequency`` (1): periods along the axis, scanned."

    @classmethod
    def shape(cls) -> tuple[Parameter, ...]:
        return (Parameter("frequency", "1", None, 0.1, 0.3, 40.0, grid=FREQUENCIES),)

    @staticmethod
    def functions(x: Tensor, shape: Tensor) -> Tensor:
        phase = 2 * math.pi * shape * x
        return torch.stack([torch.sin(phase), torch.cos(phase)], -1)


class Log(Form):
    """What grows as a share of what is there already, as a detector that saturates does."""

    form, says, equation, names = "log", "a logarithm", "slope ln(1 + x/knee)", ("slope",)
    told = "``knee`` (1): x from which on it bends, scanned."

    @classmethod
    def shape(cls) -> tuple[Parameter, ...]:
        return (Parameter("knee", "1", None, 0.2, 0.002, 4.0, grid=geometric(0.005, 2.0, 14), log=True),)

    @staticmethod
    def functions(x: Tensor, shape: Tensor) -> Tensor:
        return torch.log1p(x / shape)[..., None]


class Cubic(Form):
    """What bends a little."""

    form, says, names = "cubic", "a polynomial", ("first", "second", "third")
    equation = "first x + second x² + third x³"

    @staticmethod
    def functions(x: Tensor, shape: Tensor) -> Tensor:
        return torch.stack([x, x**2, x**3], -1)


class Formula(Form, Effect):
    """A form at a place. Places set where x is and which hook acts.

    Attributes:
        free: the free term whose place it is.
        where: the axis in words. acts: the equation of the place, in terms of f. is_x: what x is.
        size: unit, noticeable change and bound of the amplitudes, bins for a delay. one_way: they cannot be
            negative.
    """

    free: ClassVar[type[Free]]
    where: ClassVar[str]
    acts: ClassVar[str]
    is_x: ClassVar[str]
    size: ClassVar[tuple[str, float, float]] = ("1", 0.05, 3.0)
    kind: ClassVar[str] = "plain"
    one_way: ClassVar[bool] = False

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        unit, scale, bound = cls.size
        unit_size = scan.bin_length if unit == "m" else 1.0
        low = 0.0 if cls.one_way else -bound * unit_size
        amplitudes = [
            Parameter(name, unit, 0.0, scale * unit_size, low, bound * unit_size, kind=cls.kind)
            for name in cls.names
        ]
        return (*amplitudes, *cls.shape())

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        unit, scale, _ = cls.size
        return {cls.names[0]: 4 * scale * (scan.bin_length if unit == "m" else 1.0)}

    def basis(self, x: Tensor) -> Tensor:
        """``[…, J]`` b_j at ``x`` ``[…]``, at the present shape."""
        return self.functions(x, self.value(self.shapes[0].name) if self.shapes else torch.ones_like(x))

    def f(self, x: Tensor) -> Tensor:
        """``[…]`` at ``x`` ``[…]``."""
        return self.basis(x) @ torch.stack([self.value(name) for name in self.names])

    def seen_in(self, free: Free, spots: Tensor, expected: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What the free term of this place says of f.

        Args:
            free: the term, fitted.
            spots: ``[B]`` that were fitted.
            expected: ``[B, T_gate]`` of them, with the term.

        Returns:
            x, values of f and their weights, ``[n]`` each.
        """
        raise NotImplementedError

    def along(self, edges: Tensor) -> Tensor:
        """Where places of the axis are.

        Args:
            edges: ``[…]`` as :class:`~nlos_lit.inference.result.Shape` has them.

        Returns:
            ``[…]`` x.
        """
        raise NotImplementedError

    def quantities(self) -> dict[str, Quantity]:
        return {p.name: Quantity(self.value(p.name), p.unit, kind=p.kind) for p in self.declared.values()}


class _OverScan(Formula):
    is_x: ClassVar[str] = "the order of acquisition from 0 to 1"
    order: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("order", (scan.rank + 1) / 2, persistent=False)

    def at(self, spots: Tensor) -> Tensor:
        """``[B, 1]`` f at spots."""
        return self.f(self.order[spots])[:, None]

    def seen_in(self, free: Free, spots: Tensor, expected: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.order[spots], free.values()[spots], torch.ones(len(spots))

    def along(self, edges: Tensor) -> Tensor:
        return edges / len(self.order)


class CountsOverScan(_OverScan):
    """Counts change over the scan."""

    free, where, acts = FreeScan, "over the course of the scan", "m → m e^f"

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        return expected * torch.exp(self.at(spots))


class BackgroundOverScan(_OverScan):
    """The background changes over the scan."""

    free, where = FreeScanBackground, "in the background over the course of the scan"
    acts = "background → background · e^f"

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        return background * torch.exp(self.at(spots))


class DelayOverScan(_OverScan):
    """Light comes late or early over the scan."""

    free, where, acts = FreeScanDelay, "in the delay over the course of the scan", "L → L + f"
    size: ClassVar[tuple[str, float, float]] = ("m", 1.0, 20.0)
    kind: ClassVar[str] = "time"

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        return length + self.at(spots)[:, None]


class WidthOverScan(_OverScan):
    """The response grows wider over the scan: a Gaussian whose variance is f, in squared bins."""

    free, where = FreeWidthScan, "in the response's width over the course of the scan"
    acts = "signal → signal * N(0, f bins²)"
    size: ClassVar[tuple[str, float, float]] = ("bins²", 1.0, 100.0)
    one_way: ClassVar[bool] = True

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        return filtered(signal, lambda wave: torch.exp(-0.5 * self.at(spots) * wave**2))


class CountsOverTime(Formula):
    """All spots count too much or too little in the same bins."""

    free, where, acts = FreeTime, "along the time axis", "m_t → m_t e^f"
    is_x = "the time from 0 in the gate's first bin to 1 in its last"

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        bins = torch.arange(expected.shape[1], dtype=expected.dtype, device=expected.device)
        return expected * torch.exp(self.f(self.along(bins)))

    def along(self, edges: Tensor) -> Tensor:
        first, last = self.scan.gate
        return ((edges - first) / (last - 1 - first)).clamp_min(0.0)

    def seen_in(self, free: Free, spots: Tensor, expected: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        first, last = self.scan.gate
        return torch.linspace(0, 1, last - first), free.values()[first:last], expected.sum(0)


class CountsOverRate(Formula):
    """Spots with many counts have too few, or too many."""

    free, where, acts = FreeRate, "with the count rate", "m → m e^f"
    is_x = "a spot's counts over e² times the scan's mean"

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        return expected * torch.exp(self.f(self.along(expected.sum(1, keepdim=True))))

    def along(self, edges: Tensor) -> Tensor:
        return edges / (self.scan.mean_counts * math.exp(RATES[1]))

    def seen_in(self, free: Free, spots: Tensor, expected: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # Knots are evenly spaced along ln n; each has the spots about it.
        assert isinstance(free, FreeRate)
        knots = torch.linspace(*RATES, FreeRate.KNOTS)
        return (knots - RATES[1]).exp(), free.values(), free.tents(expected).sum(0)


FORMS: tuple[type[Form], ...] = (Step, Decay, Power, Log, Wave, Cubic)
PLACES: tuple[type[Formula], ...] = (
    CountsOverScan,
    BackgroundOverScan,
    DelayOverScan,
    WidthOverScan,
    CountsOverTime,
    CountsOverRate,
)
ONE_SIGN = frozenset({"step", "decay", "power", "log"})  # forms that a place of one sign can have


def _pair(form: type[Form], place: type[Formula]) -> type[Formula]:
    name = f"{_snake(place.__name__)}_{form.form}"
    return type(name, (form, place), {"name": name, "words": _words(form, place), "__module__": __name__})


def _snake(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")


def _words(form: type[Form], place: type[Formula]) -> EffectWords:
    numbers = [*form.names, *(p.name for p in form.shape())]
    return EffectWords(
        phrase=f"{form.says} {place.where}",
        cause=f"{(place.__doc__ or '').splitlines()[0]}",
        remedy="Look for what in the rig follows this form.",
        headline=", ".join(f"{name} {{{name}}}" for name in numbers),
    )


FORMULAS: tuple[type[Formula], ...] = tuple(
    _pair(form, place) for place in PLACES for form in FORMS if form.form in ONE_SIGN or not place.one_way
)


def formulas_of(name: str) -> list[type[Formula]]:
    """Formulas that act where a free term acts.

    Args:
        name: of the free term.

    Returns:
        none where it acts along no single axis.

    Examples:
        >>> [each.name for each in formulas_of("free_rate")][:2]
        ['counts_over_rate_step', 'counts_over_rate_decay']
        >>> formulas_of("free_wall")
        []
    """
    return [each for each in FORMULAS if each.free.name == name]


def written(formula: type[Formula], found: str) -> str:
    """The file of a formula as an effect of its own, for ``nlos_lit/effects``.

    Args:
        formula: that was found.
        found: where, and how well it predicts: a sentence. What could end a docstring is left out of it.

    Returns:
        Python source; its module's name is the formula's.
    """
    form, place = formula.__mro__[1:3]
    assert issubclass(form, Form)
    assert issubclass(place, Formula)
    words, title = formula.words, "".join(part.capitalize() for part in formula.name.split("_"))
    assert words is not None
    amplitudes = ", ".join(f"``{name}``" for name in form.names)
    phrase = words.phrase[0].upper() + words.phrase[1:]
    clean = re.sub(r"[^-\u2212±·%().,:;\w ]", "", found)
    paragraphs = [
        f"{phrase}.",
        f"``{place.acts}``, ``f = {form.equation}``, x {place.is_x}.",
        f"Parameters: {amplitudes} ({place.size[0]}), null 0. {form.told}",
        f"Signature: the residual follows this form {place.where}.",
        "Degenerate with: any effect that changes the same along the same axis.",
        f"Source: {clean}",
    ]
    lines = [
        textwrap.fill(p.strip(), 106, initial_indent=4 * " ", subsequent_indent=4 * " ") for p in paragraphs
    ]
    docstring = "\n\n".join(lines).lstrip()
    return f'''"""{phrase}."""

from __future__ import annotations

from nlos_lit.effects.formulas import {place.__name__}, {form.__name__}
from nlos_lit.effects.words import EffectWords


class {title}({form.__name__}, {place.__name__}):
    """{docstring}
    """

    name = "{formula.name}"
    followed_by = ("{formula.free.name}",)
    words = EffectWords(
        phrase="{words.phrase}",
        cause="{words.cause}",
        remedy="{words.remedy}",
        headline="{words.headline}",
    )
'''
