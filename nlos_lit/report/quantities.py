"""Numbers as people read them: value ± error, percent, picoseconds and bins."""

from __future__ import annotations

import math
from collections.abc import Mapping

from nlos_lit.capture import SPEED_OF_LIGHT
from nlos_lit.inference.result import Estimate
from nlos_lit.report.words import describe

KINDS_OF_UNIT = {
    "m": ("time", "length"),
    "1": ("plain", "percent"),
    "rad": ("angle",),
    "bin": ("bins",),
    "bins": ("bins",),
}
UNIT_OF_KIND = {
    "time": "m",
    "length": "m",
    "percent": "1",
    "plain": "1",
    "angle": "rad",
    "bins": "bins",
    "counts": "counts/bin",
}
NONE = "–"


def number(value: float | None, digits: int = 3) -> str:
    """A number as text.

    Args:
        value: to be said.
        digits: significant ones.

    Returns:
        – for None, NaN and infinities.

    Examples:
        >>> number(1234.5), number(0.00012345, 2), number(1.5e-7, 2), number(None)
        ('1234', '0.00012', '1.5 × 10⁻⁷', '–')
    """
    if value is None or not math.isfinite(value):
        return NONE
    if value == 0:
        return "0"
    magnitude = math.floor(math.log10(abs(value)))
    if not -4 <= magnitude < 7:
        return _power(value, digits)
    return _fixed(value, max(0, digits - 1 - magnitude))


def percent(share: float | None, digits: int = 2) -> str:
    """A share in percent.

    Args:
        share: 1 is all.
        digits: significant ones.

    Returns:
        – for None, NaN and infinities.

    Examples:
        >>> percent(0.0723)
        '7.2 %'
    """
    return NONE if share is None or not math.isfinite(share) else f"{number(100 * share, digits)} %"


def probability(p: float | None) -> str:
    """A chance to two digits, never said smaller than it is; one too small for a float is said to be so.

    Examples:
        >>> probability(1 / 99), probability(0.25), probability(0.0)
        ('0.011', '0.25', '< 10⁻³⁰⁰')
    """
    if p is None or not math.isfinite(p):
        return NONE
    if p < 1e-300:
        return "< 10⁻³⁰⁰"
    step = 10.0 ** (math.floor(math.log10(p)) - 1)
    return number(math.ceil(p / step - 1e-9) * step, 2)


def plus_minus(value: float, stderr: float) -> str:
    """``value ± stderr``, rounded where the error is: one digit of it, two when it begins with 1.

    Args:
        value: estimate.
        stderr: its standard error, in the same unit.

    Returns:
        ``value ± ?`` where the error is not a positive number.

    Examples:
        >>> plus_minus(0.2113, 0.021), plus_minus(5.4321, 0.0123)
        ('0.21 ± 0.02', '5.432 ± 0.012')
    """
    if not (math.isfinite(value) and math.isfinite(stderr) and stderr > 0):
        return f"{number(value)} ± ?"
    decimals = _decimals(stderr)
    if decimals > 6:
        return f"{number(value)} ± {number(stderr, 1)}"
    return f"{_fixed(value, decimals)} ± {_fixed(stderr, decimals)}"


def scales(
    effect: str, parameter: str, unit: str | None, size: float, bin_length: float | None
) -> list[tuple[float, str]]:
    """How to say a number of an effect.

    Args:
        effect, parameter: their names.
        unit: the unit it is given in; None for the effect's own.
        size: its magnitude, which chooses between ps and ns, mm and m.
        bin_length: m, where known.

    Returns:
        (factor, unit) pairs, the most telling first.

    Examples:
        >>> scales("occlusion", "radius", "m", 0.25, None)
        [(1000.0, 'mm')]
    """
    return scales_of(describe(effect).kind_of(parameter), unit, size, bin_length)


def scales_of(kind: str, unit: str | None, size: float, bin_length: float | None) -> list[tuple[float, str]]:
    """How to say a number of a kind.

    Args:
        kind: ``percent``, ``plain``, ``time``, ``length``, ``angle``, ``bins`` or ``counts``.
        unit: the unit it is given in, which may speak against the kind; None for the kind's own.
        size: its magnitude, which chooses between ps and ns, mm and m.
        bin_length: m, where known.

    Returns:
        (factor, unit) pairs, the most telling first.

    Examples:
        >>> [f"{factor:.4g} {unit}" for factor, unit in scales_of("time", None, 0.01, 0.005)]
        ['3336 ps', '1000 mm of path', '200 bins']
    """
    unit = UNIT_OF_KIND[kind] if unit is None else unit
    allowed = KINDS_OF_UNIT.get(unit, ("counts",))  # any other unit is said as it is
    kind = kind if kind in allowed else allowed[0]
    size = abs(size) if math.isfinite(size) else 0.0
    length = (1.0, "m") if size >= 1 else (1e3, "mm")
    if kind == "time":
        pico = 1e12 / SPEED_OF_LIGHT
        time = (pico, "ps") if pico * size < 100 else (pico / 1000, "ns")
        return [
            time,
            (length[0], f"{length[1]} of path"),
            *([(1 / bin_length, "bins")] if bin_length else []),
        ]
    if kind == "bins":
        return [(1.0, "bins"), *([(bin_length * 1e12 / SPEED_OF_LIGHT, "ps")] if bin_length else [])]
    single = {"length": length, "percent": (100.0, "%"), "angle": (1e3, "mrad"), "plain": (1.0, "")}
    chosen = single.get(kind, (1.0, unit))
    return [chosen, (180 / math.pi, "°")] if kind == "angle" else [chosen]


def quantity(effect: str, parameter: str, estimate: Estimate, bin_length: float | None) -> list[str]:
    """An estimate with its error, in every unit that people think in.

    Args:
        effect, parameter: their names.
        estimate: value and standard error, in a unit of its own.
        bin_length: m, where known.

    Returns:
        The most telling first.

    Examples:
        >>> quantity("irf_tail", "fraction", Estimate(0.21, 0.02, "1"), None)
        ['21 ± 2 %']
        >>> quantity("irf_tail", "decay", Estimate(0.117, 0.006, "m"), 0.0048)
        ['0.39 ± 0.02 ns', '117 ± 6 mm of path', '24.4 ± 1.2 bins']
    """
    ways = scales(effect, parameter, estimate.unit, estimate.value, bin_length)
    return [f"{plus_minus(f * estimate.value, f * estimate.stderr)} {unit}".strip() for f, unit in ways]


def amount(effect: str, parameter: str, value: float | None, bin_length: float | None) -> str:
    """A bare value of a parameter in its most telling unit.

    Args:
        effect, parameter: their names.
        value: in the effect's own unit.
        bin_length: m, where known.

    Returns:
        – for None, NaN and infinities.

    Examples:
        >>> amount("wall_tilt", "tilt_x", 0.04, None)
        '40.0 mrad'
    """
    return amount_of(describe(effect).kind_of(parameter), value, bin_length)


def amount_of(kind: str, value: float | None, bin_length: float | None = None) -> str:
    """A bare value of a kind in its most telling unit.

    Args:
        kind: as of :func:`scales_of`.
        value: in the kind's own unit.
        bin_length: m, where known.

    Returns:
        – for None, NaN and infinities.
    """
    if value is None or not math.isfinite(value):
        return NONE
    factor, unit = scales_of(kind, None, value, bin_length)[0]
    return f"{number(factor * value)} {unit}".strip()


def headline(effect: str, parameters: Mapping[str, Estimate]) -> str:
    """Size of an effect in a few words, shapes without their errors.

    Args:
        effect: its name.
        parameters: by name.

    Returns:
        The effect's own sentence; parameter by parameter where that does not fit them.

    Examples:
        >>> headline("irf_tail", {"slow": Estimate(0.2, 0.02, "1"), "decay": Estimate(0.117, 0.006, "m")})
        '20 ± 2 % of the photons, τ = 0.39 ns'
    """
    known = describe(effect)

    def short(name: str, estimate: Estimate) -> str:
        factor, unit = scales(effect, name, estimate.unit, estimate.value, None)[0]
        both = plus_minus(factor * estimate.value, factor * estimate.stderr)
        return f"{both.split(' ± ')[0] if known.null_of(name) is None else both} {unit}".strip()

    values = {name: short(name, estimate) for name, estimate in parameters.items()}
    try:
        text = known.words.headline.format(**values)
    except KeyError:
        text = ""
    return text or ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in values.items())


def _decimals(stderr: float) -> int:
    magnitude = math.floor(math.log10(stderr))
    leading = round(stderr / 10**magnitude, 1)
    return (1 if leading < 2 else 0) - magnitude


def _fixed(value: float, decimals: int) -> str:
    text = f"{round(value, decimals) + 0.0:.{max(0, decimals)}f}"  # + 0.0: no minus before a zero
    return text.replace("-", "−")


def _power(value: float, digits: int) -> str:
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    raised = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa} × 10{raised}".replace("-", "−")
