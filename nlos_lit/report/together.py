"""What several captures say together of names that one of them could not tell apart."""

from __future__ import annotations

from nlos_lit.inference.result import Further
from nlos_lit.report.quantities import number, percent
from nlos_lit.report.words import describe


def told_apart(further: Further) -> str:
    """What another capture leaves of the names that were open.

    Args:
        further: what it said.

    Returns:
        A few sentences.

    Examples:
        >>> one = Further("scan_2", ["irf_tail", "afterpulsing"], {"irf_tail": 2.0, "afterpulsing": 90.0},
        ...     {}, True, {"irf_tail": 0.01, "afterpulsing": 0.99}, ["afterpulsing"])
        >>> print(told_apart(one))
        With scan_2, afterpulsing (counts that trigger further counts) alone stays: 99 % of the weight of all
        captures together.
    """
    stays = [describe(name).phrase for name in further.stays]
    share = percent(sum(further.weights[name] for name in further.stays), 2)
    if len(stays) == 1:
        text = f"With {further.name}, {stays[0]} alone stays: {share} of the weight of all captures together."
    else:
        text = f"With {further.name}, it is still open: {' or '.join(stays)}."
    if not further.seen:
        text += (
            f" {further.name} by itself asks for none of them, though: either it has too few counts, or what"
            " is wrong was not the same there."
        )
    return text


def rows(further: Further) -> list[list[str]]:
    """A row for each name that was open.

    Args:
        further: what another capture said.

    Returns:
        Name, what it gains there, where its values come from, its weight in all captures, and what becomes of
        it.
    """
    return [
        [
            f"{describe(name).phrase} ({name})",
            f"{number(further.nats[name])}",
            _values(further, name),
            percent(further.weights[name], 2),
            "stays" if name in further.stays else "ruled out",
        ]
        for name in further.asked
    ]


def _values(further: Further, name: str) -> str:
    if name not in further.kept:
        return "fitted anew"
    share = further.kept[name]
    return (
        f"those found before keep {percent(share, 2)} of the gain" if share > 0 else "those found before fail"
    )
