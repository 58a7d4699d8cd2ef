"""The generated parts of docs/effects.md.

``python -m nlos_lit.effects.page``, in the repository, writes them anew.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.nominal import nominal_scan, numbers_of

PAGE = Path("docs/effects.md")
SECTION = re.compile(r"(?m)^(Parameters|Signature|Degenerate with|Source): ")


def sections(effect: type[Effect]) -> dict[str, str]:
    """An effect's docstring, taken apart.

    Returns:
        ``what`` (its first line), ``equation`` (the paragraph after it), and the named sections, each on one
        line.

    Examples:
        >>> sections(EFFECTS.named("time_offset"))["equation"]
        '`L → L + offset`'
    """
    text = (inspect.getdoc(effect) or "").partition("\nExamples:\n")[0]
    head, *named = SECTION.split(text)
    what, *rest = head.strip().split("\n\n")
    parts = {"what": what, "equation": rest[0] if rest else ""}
    parts |= dict(zip(named[::2], named[1::2], strict=True))
    return {name: re.sub(r"\s+", " ", part.replace("``", "`")).strip() for name, part in parts.items()}


def numbers(effect: type[Effect]) -> str:
    """An effect's parameters with their symbols, units and nulls, and what it reports beside them.

    Examples:
        >>> numbers(EFFECTS.named("irf_tail"))
        '`fraction` f (1); `decay` τ (m) scanned; `quick` q (1); `quick_decay` τ₂ (m); slow'
        >>> numbers(EFFECTS.named("wall_reflectance"))
        '`gain_map` (1) 143 coefficients; rms'
    """
    said, told = [], sections(effect)["Parameters"]
    for p in effect.declare(nominal_scan()):
        symbol = re.search(rf"`{p.name}` (\S{{1,2}}) \(", told)
        name = f"`{p.name}` {symbol[1]}" if symbol else f"`{p.name}`"
        size = (
            "one a spot"
            if effect.per_spot and p.null is not None
            else f"{p.size} coefficients"
            if p.size > 1
            else ""
        )
        null = "scanned" if len(p.grid) > 1 else f"null {p.null:g}" if p.null else ""
        said.append(" ".join(filter(None, (f"{name} ({p.unit})", null, size))))
    declared = {p.name for p in effect.declare(nominal_scan())}
    more = ", ".join(name for name in numbers_of(effect) if name not in declared)
    return "; ".join(filter(None, (*said, more)))


def strength(effect: type[Effect]) -> str:
    """The typical strength of an effect, as given to simulate.py, in units of the scan.

    Examples:
        >>> strength(EFFECTS.named("time_drift")), strength(EFFECTS.named("direct_leak"))
        ('rms=1.5 bins', 'amplitude=5 backgrounds')
    """
    scan, known, built = nominal_scan(), numbers_of(effect), effect(nominal_scan())
    spots = {name for name, quantity in built.quantities().items() if quantity.spots}
    said = []
    for name, value in effect.typical(scan).items():
        number = known[name]
        if name in built.declared and value == number.null:
            continue
        bins, backgrounds = value / scan.bin_length, value / scan.background
        text = {
            "time": f"{bins:g} bin{'s' if bins != 1 else ''}",
            "length": f"{100 * value / scan.half:g} % of half the wall",
            "angle": f"{value:g} rad",
            "counts": f"{backgrounds:g} background{'s' if backgrounds != 1 else ''}",
        }.get(number.said_as, f"{value:g}")
        said.append(f"{name}={f'{100 * value / scan.n_spots:g} % of the spots' if name in spots else text}")
    return ", ".join(said)


def table() -> str:
    """All effects: where they act, what they do, what is fitted, what they are easily taken for."""
    head = "effect | stage | equation | parameters (unit); reported beside them | degenerate with"
    rows = []
    for effect in EFFECTS:
        parts = sections(effect)
        cells = (parts["equation"], numbers(effect), parts["Degenerate with"])
        rows.append([f"`{effect.name}`", effect.stage, *(cell.removesuffix(".") for cell in cells)])
    return _table(head.split(" | "), rows)


def strengths() -> str:
    """Typical strengths of all effects."""
    return _table(["effect", "typical strength"], [[f"`{e.name}`", strength(e)] for e in EFFECTS])


def splits() -> str:
    """Pairs of effects that are easily taken for each other, and the measurement that would tell."""
    rows = [
        [f"`{effect.name}`, `{other}`", measurement]
        for effect in EFFECTS
        for other, measurement in effect.split_by.items()
    ]
    return _table(["effects", "what would tell them apart"], rows)


def count() -> str:
    """How many there are.

    Examples:
        >>> count() == f"There are {len(EFFECTS)} effects."
        True
    """
    return f"There are {len(EFFECTS)} effects."


PARTS = {"count": count, "table": table, "strengths": strengths, "splits": splits}


def generated(page: str) -> str:
    """A page with its generated parts made anew.

    Each stands between ``<!-- generated: NAME -->`` and ``<!-- end -->``.
    """

    def part(found: re.Match[str]) -> str:
        return f"{found[1]}\n\n{PARTS[found[2]]()}\n\n{found[3]}"

    return re.sub(r"(?s)(<!-- generated: (\w+) -->).*?(<!-- end -->)", part, page)


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *([cell.replace("|", r"\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Write the page anew, in the working directory."""
    PAGE.write_text(generated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
