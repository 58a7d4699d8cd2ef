"""The exceptions a user is meant to read: one kind, told apart by what is wrong."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def printable(text: str) -> str:
    """Text with its control characters spelt out: what a file says of itself must not steer a terminal.

    Examples:
        >>> printable("Höhe" + chr(27) + "[2J" + chr(10) + "m")
        'Höhe\\\\x1b[2J\\nm'
    """
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


class UserError(Exception):
    """Something the user gave cannot work; the message says what was found, what was expected and what to do.

    The commands print the message alone, without a traceback, and exit with status 2.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class CaptureError(UserError, ValueError):
    """A capture (file, array or geometry) is unusable; one line, whatever names a file has in it."""

    def __str__(self) -> str:
        return super().__str__().replace("\n", "\\n")


class MemoryBudgetError(UserError, MemoryError):
    """A computation needs more memory than the budget allows."""


def suggest(name: str, known: Iterable[str], listed: Iterable[str] | None = None, above: str = "") -> str:
    """What to write instead of a name that does not exist, as the end of a sentence.

    Args:
        name: as it was given.
        known: the names there are.
        listed: what is told where none of them is near; None for all of them.
        above: what stands before the nearest in the answer, such as their section.

    Returns:
        The nearest, or those listed.

    Examples:
        >>> suggest("itrations", ["threshold", "iterations"])
        'did you mean iterations?'
        >>> suggest("x", ["threshold", "iterations"])
        'there are threshold, iterations'
    """
    names = list(known)
    close = difflib.get_close_matches(name, names, n=3)
    if close:
        return f"did you mean {' or '.join(above + near for near in close)}?"
    return f"there are {', '.join(names if listed is None else listed)}"
