"""Effects and free terms in plain words, by their names; what a residual lies along, likewise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from nlos_lit.effects import EFFECTS
from nlos_lit.effects.formulas import FORMULAS
from nlos_lit.effects.free_terms import FREE
from nlos_lit.effects.nominal import numbers_of
from nlos_lit.effects.parameter import Number
from nlos_lit.effects.words import EffectWords

AXES = {
    "time": "along the time axis",
    "depth": "along depth",
    "wall": "across the wall",
    "scan": "over the course of the scan",
    "rate": "with the count rate",
    "time×scan": "along the time axis, differently over the course of the scan",
    "time×wall": "along the time axis, differently across the wall",
    "spot": "from spot to spot",
}
PLAIN = Number("1")
FREE_TERMS = {term.name: term for term in FREE}
UNLISTED = FREE_TERMS | {formula.name: formula for formula in FORMULAS}


@dataclass(frozen=True)
class Description:
    """What the report knows of an effect or a free term.

    Args:
        words: in which it is told.
        numbers: its parameters and reported quantities.
        free: it is a free term.
    """

    words: EffectWords
    numbers: Mapping[str, Number] = field(default_factory=dict)
    free: bool = False

    @property
    def phrase(self) -> str:
        """Completes "Your simulation misses …"."""
        return self.words.phrase

    def number(self, name: str) -> Number:
        """A parameter or reported quantity; one that the effect does not declare is like its first."""
        first = next(iter(self.numbers.values()), PLAIN)
        return self.numbers.get(name) or Number(first.unit, first.kind)

    def kind_of(self, name: str) -> str:
        """How a parameter or reported quantity is said: ``percent``, ``time``, …"""
        return self.number(name).said_as

    def null_of(self, name: str) -> float | None:
        """Value at which the effect is absent; None for a shape, which has none."""
        return self.number(name).null


def capital(text: str) -> str:
    """A text as the beginning of a sentence.

    Args:
        text: of any length.

    Returns:
        the same, its first letter large.

    Examples:
        >>> capital("a ghost pulse")
        'A ghost pulse'
    """
    return text[:1].upper() + text[1:]


def describe(name: str) -> Description:
    """Words and numbers of an effect, a free term or a formula; one that has no words is called by its name.

    Examples:
        >>> describe("irf_tail").phrase
        'a slow detector tail'
        >>> describe("irf_tail").kind_of("decay"), describe("irf_tail").null_of("fraction")
        ('time', 0.0)
        >>> describe("dust_cloud").phrase
        'dust cloud'
        >>> describe("free_wall").phrase, describe("free_wall").free
        ('something unknown across the wall', True)
    """
    effect = EFFECTS.named(name) or UNLISTED.get(name)
    words = (effect.words if effect else None) or EffectWords(name.replace("_", " "))
    return Description(words, numbers_of(effect) if effect else {}, name in FREE_TERMS)
