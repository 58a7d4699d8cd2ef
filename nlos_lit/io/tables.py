"""Tables on disk and in pages: rows as CSV at full precision, and as Markdown for people."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nlos_lit.io.files import whole_file

Row = dict[str, Any]  # column → value


def columns(rows: Sequence[Row]) -> list[str]:
    """All keys of all rows, in the order of their first appearance.

    Examples:
        >>> columns([{"a": 1, "b": 2}, {"a": 3, "c": 4}])
        ['a', 'b', 'c']
    """
    return list(dict.fromkeys(key for row in rows for key in row))


def cell(value: Any) -> str:
    """A value as people read it: three digits, ✓ for yes, – for no and where nothing is known.

    Examples:
        >>> [cell(value) for value in (12.3456, 4.58e-4, True, None, float("nan"), 7, "a|b")]
        ['12.3', '4.58e-04', '✓', '–', '–', '7', 'a\\\\|b']
    """
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "✓" if value else "–"
    if isinstance(value, float):
        return f"{value:.3g}" if value == 0 or 1e-3 <= abs(value) < 1e5 else f"{value:.2e}"
    return str(value).replace("|", "\\|")


def markdown_table(rows: Sequence[Row], show: Callable[[Any], str] = cell) -> str:
    """The rows as a Markdown table.

    Args:
        rows: column → value; a column that a row lacks is shown as `show` shows None.
        show: a value's text.

    Returns:
        header, rule and a line a row, without a line break at the end.

    Examples:
        >>> print(markdown_table([{"system": "lct", "error": 1 / 3}, {"system": "ours"}]))
        | system | error |
        |---|---|
        | lct | 0.333 |
        | ours | – |
    """
    names = columns(rows)
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(show(row.get(name)) for name in names) + " |" for row in rows]
    return "\n".join(lines)


def write_csv(path: Path | str, rows: Sequence[Row]) -> None:
    """A header and a line a row, at full precision; a whole file or none.

    Args:
        path: where to.
        rows: column → value; columns come in the order of their first appearance, what a row lacks is empty.
    """
    with whole_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=columns(rows))
        writer.writeheader()
        writer.writerows(rows)
