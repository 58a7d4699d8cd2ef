"""Rules for single values of a config: type, range, unit, and the sentence that says what was expected."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class Rule:
    """What a value may be.

    Args:
        expected: in words, as the end of "… must be".
        allows: whether a value that is not null is that.
        null: it may be left open.
    """

    expected: str
    allows: Callable[[Any], bool]
    null: bool = False

    def __str__(self) -> str:
        return f"{self.expected}, or null" if self.null else self.expected

    def problem(self, value: Any) -> str | None:
        """What is wrong with a value, as the end of "KEY must be"; None where nothing is.

        Examples:
            >>> number(0, 1, "m", above=True).problem(2)
            'a number above 0 to 1 m; found 2'
            >>> whole(1).problem(None), optional(whole(1)).problem(None)
            ('a whole number from 1; found null', None)
        """
        right = self.null if value is None else self.allows(value)
        return None if right else f"{self}; found {'null' if value is None else value}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number(low: float, high: float, unit: str = "", above: bool = False, below: bool = False) -> Rule:
    """A finite number in a range.

    Args:
        low, high: of the range.
        unit: for the message.
        above: ``low`` itself is left out.
        below: ``high`` itself is.

    Returns:
        The rule.
    """
    ends = f"{'above' if above else 'from'} {low:g} to {'below ' if below else ''}{high:g} {unit}".rstrip()

    def allows(value: Any) -> bool:
        if not _is_number(value) or value in ([low] if above else []) + ([high] if below else []):
            return False
        return bool(low <= value <= high)

    return Rule(f"a number {ends}", allows)


def whole(low: int, high: int | None = None, unit: str = "") -> Rule:
    """A whole number in a range.

    Args:
        low, high: of the range; None for no upper end.
        unit: for the message.

    Returns:
        The rule.
    """
    ends = f"from {low}" + (f" to {high}" if high is not None else "")

    def allows(value: Any) -> bool:
        inside = isinstance(value, int) and not isinstance(value, bool) and value >= low
        return inside and (high is None or value <= high)

    return Rule(f"a whole number {ends} {unit}".rstrip(), allows)


def word(*choices: str) -> Rule:
    """One of some words."""
    return Rule(f"one of {', '.join(choices)}", lambda value: value in choices)


def many(rule: Rule, length: int | None = None, ascending: bool = False) -> Rule:
    """A list of values.

    Args:
        rule: of each.
        length: of the list; None for any.
        ascending: each is larger than the one before.

    Returns:
        The rule.
    """
    size = "a list" if length is None else f"[{', '.join('ab'[:length])}]"
    order = ", a < b" if ascending else ""

    def allows(value: Any) -> bool:
        right = isinstance(value, list | tuple) and all(rule.allows(entry) for entry in value)
        if not right or (length is not None and len(value) != length):
            return False
        return not ascending or all(a < b for a, b in itertools.pairwise(value))

    return Rule(f"{size}, each {rule.expected}{order}", allows)


def either(*rules: Rule) -> Rule:
    """A value that one of some rules allows."""
    return Rule(
        ", or ".join(rule.expected for rule in rules), lambda v: any(rule.allows(v) for rule in rules)
    )


def optional(rule: Rule) -> Rule:
    """The same, or null."""
    return replace(rule, null=True)


def zero_or(rule: Rule) -> Rule:
    """0, which switches something off, or what a rule allows."""
    return Rule(
        f"0 or {rule.expected}", lambda value: (_is_number(value) and value == 0) or rule.allows(value)
    )


def _is_size(value: Any) -> bool:
    text = r"\s*[0-9]+(\.[0-9]*)?(e[0-9]+)?\s*([KMGT]i?)?B?\s*"
    return _is_number(value) or (
        isinstance(value, str) and re.fullmatch(text, value, re.IGNORECASE) is not None
    )


FLAG = Rule("true or false", lambda value: isinstance(value, bool))
TEXT = Rule("a text", lambda value: isinstance(value, str))
NAME = Rule(  # numbers are names, too: scene 34
    "a name without slashes",
    lambda v: isinstance(v, str | int) and re.fullmatch(r"[^/\\\0]+", str(v)) is not None,
)
FILE = Rule("a file or folder that is there", lambda value: isinstance(value, str) and os.path.exists(value))
SIZE = Rule("a size such as 8GiB or 500MB", _is_size)
SETTINGS = Rule("KEY: VALUE pairs", lambda value: isinstance(value, dict))
