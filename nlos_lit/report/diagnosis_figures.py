"""Figures of a diagnosis: functions take results and return figures; they count and scale, no more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from nlos_lit.inference.result import Accepted, Diagnosis, Followed, Profile, Screened, Shape
from nlos_lit.report.quantities import amount_of, number, percent, plus_minus, scales, scales_of
from nlos_lit.report.style import (
    BLACK,
    BLUE,
    GREEN,
    NOTHING,
    ORANGE,
    PINK,
    RED,
    SIGNED,
    SKY,
    colour_bar,
    styled,
    upper_time_axis,
)
from nlos_lit.report.verdict import barely, invisible
from nlos_lit.report.words import describe

LABELS = {
    "time": "time bin",
    "depth": "depth",
    "scan": "scan order",
    "rate": "count rate",
    "wall": "place on the wall",
    "spot": "spot, in scan order",
}
BY_CHANCE = 0.0027  # share of a normal distribution beyond ±3σ
MANY = 300  # values from which on a free term is drawn as dots
GREY = "#8c8c8c"
PALE_PINK = "#e9c6db"


def diagnosis_figures(diagnosis: Diagnosis) -> dict[str, Figure]:
    """Every figure the diagnosis has results for, by file name, in the order of the report."""
    bin_length = diagnosis.capture.get("bin_length")
    shown: dict[str, Figure] = {}
    calm = not (diagnosis.effects or diagnosis.unknown)
    for profile in diagnosis.profiles:
        name = f"residual_{profile.axis}"
        name += f"_{sum(other.startswith(name) for other in shown) + 1}" if name in shown else ""
        flat = profile.edges_y is None
        shown[name] = residual_profile(profile, bin_length, calm) if flat else residual_wall(profile, calm)
    for term in diagnosis.unknown:
        if term.shape is not None:
            shown[f"unknown_{term.name}"] = free_shape(term.name, term.shape, bin_length, term.formula)
    shown["deviance"] = deviances(diagnosis)
    terms = [*diagnosis.effects, *diagnosis.unknown]
    if any(term.parameters for term in terms):
        shown["effects"] = accepted_effects(terms, bin_length)
    if diagnosis.screened:
        shown["screening"] = screening_ranking(
            diagnosis.screened, diagnosis.needed, [term.name for term in terms]
        )
    if any(s.detectable for s in diagnosis.screened):
        shown["detection_limits"] = detection_limits(diagnosis.screened, bin_length)
    witness = diagnosis.witness or {}
    if witness.get("maps"):
        walls = [
            (p.edges[[0, -1]], p.edges_y[[0, -1]])
            for p in diagnosis.profiles
            if p.axis == "wall" and p.edges_y is not None
        ]
        ends = walls[0] if walls else None
        shown["witness_maps"] = witness_maps(witness["maps"], ends, witness.get("wall_gain_correlation"))
    if witness.get("tail_decay_fitted_m") is not None and witness.get("tail_decay_direct_m"):
        shown["witness_tail"] = witness_tail(witness["tail_decay_fitted_m"], witness["tail_decay_direct_m"])
    if witness.get("delays"):
        shown["witness_delays"] = witness_delays(**witness["delays"], r=witness["delay_correlation"])
    return shown


@styled
def residual_profile(profile: Profile, bin_length: float | None = None, calm: bool = False) -> Figure:
    """Signed significance along an axis, before above after, on one scale; red beyond ±3σ.

    Args:
        profile: before and after; one panel where nothing changed.
        bin_length: m; where it is known, the time axis is told in ns, too.
        calm: nothing was needed to explain it, and nothing is red: among many bands single ones stand out.

    Returns:
        One or two panels.
    """
    panels = _panels(profile)
    figure = Figure(figsize=(7.5, 0.9 + 1.9 * len(panels)))
    every = np.abs(np.concatenate([profile.before, profile.after]))
    limit = 1.15 * max(4.0, float(np.max(every[np.isfinite(every)], initial=0.0)))
    rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, values) in zip(rows, panels.items(), strict=True):
        for sigma, alpha in ((3, 0.45), (2, 0.8)):
            axes.axhspan(-sigma, sigma, color=NOTHING, alpha=alpha, linewidth=0)
        axes.axhline(0, color=BLACK, linewidth=0.6)
        if not calm:
            axes.stairs(
                np.where(np.abs(values) > 3, values, np.nan),
                profile.edges,
                fill=True,
                color=RED,
                alpha=0.55,
                linewidth=0,
            )
        axes.stairs(values, profile.edges, baseline=None, color=BLUE, linewidth=1.1)
        if limit > 20:
            axes.set_yscale("symlog", linthresh=4, linscale=1.2)
            ticks = [t for t in (10, 30, 100, 300, 1000, 3000) if t < limit]
            axes.set_yticks(
                [-t for t in ticks] + [-3, 0, 3] + ticks,
                labels=[f"{t:g}" for t in [-t for t in ticks] + [-3, 0, 3] + ticks],
            )
            axes.minorticks_off()
        axes.set(ylim=(-limit, limit), xlim=(profile.edges[0], profile.edges[-1]), ylabel="residual (σ)")
        axes.set_title(f"{name}{_beyond(values)}", loc="left")
    unit = f" ({profile.unit})" if profile.unit and profile.axis != "time" else ""
    rows[-1].set_xlabel(LABELS.get(profile.axis, profile.axis) + unit)
    if profile.axis == "time" and bin_length:
        upper_time_axis(rows[0], bin_length, 1e9, "time since the start of bin 0 (ns)")
    return figure


@styled
def residual_wall(profile: Profile, calm: bool = False) -> Figure:
    """Signed significance over the wall, seen from it, before and after; one map where nothing changed.

    Args:
        profile: of the wall.
        calm: nothing was needed to explain it, and nothing is in full colour.

    Returns:
        One or two maps.
    """
    panels, edges_y = _panels(profile), profile.edges_y
    assert edges_y is not None
    known = np.abs(np.concatenate([values[np.isfinite(values)] for values in panels.values()]))
    limit = max(3.0, float(np.quantile(known, 0.99))) if known.size else 3.0
    limit = 2 * max(limit, float(known.max(initial=0.0))) if calm else limit
    high = np.ptp(edges_y) / np.ptp(profile.edges)
    figure = Figure(figsize=(0.9 + 4.3 * len(panels), min(7.0, 1.1 + 3.6 * high)))
    for axes, (name, values) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        mesh = _map(axes, values, profile.edges, edges_y, cmap=SIGNED, norm=Normalize(-limit, limit))
        axes.set_title(f"{name}{_beyond(values)}", loc="left", fontsize="small")
        axes.set(xlabel=f"x ({profile.unit})", ylabel=f"y ({profile.unit})")
    colour_bar(mesh, "residual (σ)" if calm else "residual (σ), 99 % inside")
    return figure


@styled
def free_shape(
    name: str, shape: Shape, bin_length: float | None = None, formula: Followed | None = None
) -> Figure:
    """What a free term does along its axis, or over two: a change in percent, a delay or a width, 0 for none.

    Args:
        name: of the term.
        shape: of it.
        bin_length: m; where it is known, delays are told in bins.
        formula: that comes nearest, a line.

    Returns:
        One panel.
    """
    values, label = _change(name, shape, bin_length)
    if shape.edges_y is None:
        figure = Figure(figsize=(7.5, 3.0))
        axes = figure.subplots()
        axes.axhline(0, color=BLACK, linewidth=0.6)
        if len(values) > MANY:
            centres = (shape.edges[:-1] + shape.edges[1:]) / 2
            axes.plot(centres, values, ".", color=PINK, markersize=2)
        else:
            axes.stairs(values, shape.edges, fill=True, color=PINK, alpha=0.35, linewidth=0)
            axes.stairs(values, shape.edges, baseline=None, color=PINK, linewidth=1.1)
        if formula is not None and formula.curve is not None:
            line, _ = _change(name, replace(shape, values=formula.curve), bin_length)
            axes.plot(shape.edges, line, color=BLACK, linewidth=1.2, label=describe(formula.name).phrase)
            axes.legend(frameon=False)
        axes.set(xlim=shape.edges[[0, -1]], xlabel=_along(shape.axis), ylabel=label)
        axes.margins(y=0.1)
        if shape.axis == "rate" and shape.edges[0] > 0:
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        if shape.axis == "time" and bin_length:
            upper_time_axis(axes, bin_length, 1e9, "time since the start of bin 0 (ns)")
    else:
        known = np.abs(values[np.isfinite(values)])
        limit = (float(np.quantile(known, 0.99)) if known.size else 0.0) or 1.0
        scale: dict[str, Any] = {"cmap": SIGNED, "norm": Normalize(-limit, limit)}
        first, _, second = shape.axis.partition("×")
        high = np.ptp(shape.edges_y) / np.ptp(shape.edges)
        figure = Figure(figsize=(7.5, 3.6) if second else (5.2, min(7.0, max(3.4, 1.1 + 3.6 * high))))
        axes = figure.subplots()
        if second:
            mesh = axes.pcolormesh(shape.edges, shape.edges_y, np.ma.masked_invalid(values).T, **scale)
            axes.set(xlabel=_along(first), ylabel=_along(second), facecolor=NOTHING)
        else:
            mesh = _map(axes, values, shape.edges, shape.edges_y, **scale)
            axes.set(xlabel="x (m)", ylabel="y (m)")
        colour_bar(mesh, f"{label}, 99 % inside")
    axes.set_title(describe(name).phrase, loc="left")
    return figure


@styled
def screening_ranking(screened: Sequence[Screened], needed: float, accepted: Sequence[str] = ()) -> Figure:
    """Evidence of every effect and free term, the most first.

    Args:
        screened: grey and hatched where an effect can hardly be told from the scene.
        needed: nats, a line.
        accepted: names that are ticked.

    Returns:
        One panel, a bar for each.
    """
    ranked = by_evidence(screened)
    figure = Figure(figsize=(8, 1.4 + 0.27 * len(ranked)))
    axes = figure.subplots()
    largest = max([s.evidence for s in ranked if np.isfinite(s.evidence)] + [needed, 10.0])
    for row, one in enumerate(ranked):
        hard, length = barely(one), one.evidence if one.evidence > 1 else 1.0  # NaN: no bar
        deep, pale = (PINK, PALE_PINK) if describe(one.name).free else (BLUE, SKY)
        colour = NOTHING if hard else deep if one.name in accepted else pale
        axes.barh(
            row,
            length - 1,
            left=1,
            height=0.72,
            color=colour,
            hatch="////" if hard else None,
            edgecolor=GREY,
            linewidth=0.6,
        )
        text = f"{number(one.evidence)}   keeps {percent(one.retained_information)}"
        box = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
        axes.text(
            length * largest**0.015,
            row,
            text,
            va="center",
            fontsize="small",
            color=GREY if hard else BLACK,
            bbox=box,
        )
    axes.axvline(needed, color=ORANGE, linestyle="--", linewidth=1)
    names = [one.name + (" ✔" if one.name in accepted else "") for one in ranked]
    axes.set_yticks(range(len(ranked)), labels=names)
    axes.set(xscale="log", xlim=(1, largest**1.4), ylim=(len(ranked) - 0.4, -0.6), xlabel="evidence (nats)")
    ticks = [10**k for k in range(int(np.log10(largest)) + 1)]
    axes.set_xticks(ticks, labels=[f"{tick:,}" for tick in ticks])
    axes.minorticks_off()
    axes.set_title(
        f"blue: known effects; pink: free terms; dark: accepted;\n"
        f"dashed: needed ({number(needed)} nats); hatched: barely identifiable here",
        loc="left",
    )
    return figure


@styled
def accepted_effects(effects: Sequence[Accepted], bin_length: float | None = None) -> Figure:
    """Each parameter with its 95 % interval, against the value that means "absent" (dashed).

    Args:
        effects: that were accepted, or free terms.
        bin_length: m, where known.

    Returns:
        A panel for each parameter.
    """
    rows = [(e.name, n, p) for e in effects for n, p in e.parameters.items()]
    figure = Figure(figsize=(8, 0.5 + 0.62 * len(rows)))
    for axes, (effect, name, p) in zip(figure.subplots(len(rows), 1, squeeze=False)[:, 0], rows, strict=True):
        factor, unit = scales(effect, name, p.unit, p.value, bin_length)[0]
        value, half = factor * p.value, 1.96 * factor * p.stderr
        colour, xerr = PINK if describe(effect).free else BLUE, half if np.isfinite(half) else None
        axes.errorbar(value, 0, xerr=xerr, fmt="o", color=colour, capsize=3)
        null = describe(effect).null_of(name)
        ends = [value] + ([value - half, value + half] if np.isfinite(half) else [])
        if null is not None:
            axes.axvline(factor * null, color=RED, linestyle="--", linewidth=1)
            ends.append(factor * null)
        ends = [e for e in ends if np.isfinite(e)] or [0.0]
        room = 0.08 * (max(ends) - min(ends)) or 0.1 * abs(ends[0]) or 1.0
        axes.set(xlim=(min(ends) - room, max(ends) + room), yticks=[])
        axes.spines["left"].set_visible(False)
        axes.set_ylabel(f"{effect}\n{name}", rotation=0, ha="right", va="center", fontsize="small")
        axes.text(
            1.02, 0.5, f"{plus_minus(value, factor * p.stderr)} {unit}", transform=axes.transAxes, va="center"
        )
        axes.locator_params(axis="x", nbins=6)
    figure.suptitle("bars: 95 % intervals; dashed: absent", fontsize="small")
    return figure


@styled
def deviances(diagnosis: Diagnosis) -> Figure:
    """Deviance per bin without any term, without each and with all, and of untouched spots; grey: noise."""
    base, extended, test = diagnosis.base, diagnosis.extended, diagnosis.untouched_test
    steps = [("base", base.deviance_per_bin)]
    terms = [*diagnosis.effects, *diagnosis.unknown]
    fewer = [(f"without {t.name}", t.heldout_gain.deviance_per_bin_before) for t in terms]
    if len(terms) > 1:
        steps += sorted(fewer, key=lambda step: np.nan_to_num(step[1]), reverse=True)
    steps += [("with all", extended.deviance_per_bin)] if terms else []
    figure = Figure(figsize=(max(5.0, 1.1 * (len(steps) + 3)), 3.6))
    axes = figure.subplots()
    last = extended.deviance_noise if np.isfinite(extended.deviance_noise) else base.deviance_noise
    groups: list[tuple[float, list[tuple[str, float]], np.ndarray, str, str]]
    groups = [(0, steps, np.linspace(base.deviance_noise, last, len(steps)), BLUE, "held-out spots")]
    names = [n for n in ("base", "extended") if n in test and (n == "base" or terms)]
    scored = [(f"untouched:\n{n}", test[n].deviance_per_bin) for n in names]
    groups += (
        [
            (
                len(steps) + 0.5,
                scored,
                np.array([test[n].deviance_noise for n in names]),
                GREEN,
                "untouched spots",
            )
        ]
        if names
        else []
    )
    ticks: list[float] = []
    for start, points, noise, colour, label in groups:
        x = start + np.arange(len(points))
        y = np.array([value for _, value in points], dtype=float)
        axes.vlines(x, noise, y, color=colour, alpha=0.35, linewidth=9)
        axes.plot(x, y, "o", color=colour, label=label)
        axes.hlines(
            noise,
            x - 0.35,
            x + 0.35,
            color=GREY,
            linewidth=2.5,
            label="counting noise" if start == 0 else "",
        )
        for place, value in zip(x, y, strict=True):
            axes.annotate(
                number(value, 4), (place, value), xytext=(6, 4), textcoords="offset points", fontsize="small"
            )
        ticks += list(x)
    labels = [
        name.replace("without ", "without\n").replace("_", "_\n") if len(name) > 14 else name
        for _, points, *_ in groups
        for name, _ in points
    ]
    axes.set_xticks(ticks, labels=labels, fontsize="small")
    levels = [
        v
        for _, points, noise, *_ in groups
        for v in [*noise, *(value for _, value in points)]
        if np.isfinite(v)
    ] or [1.0]
    high = max(
        1.02 * max(levels), 1.12 * min(levels)
    )  # a misfit of a few percent must not look like a large one
    axes.set(
        xlim=(ticks[0] - 0.6, ticks[-1] + 0.8), ylim=(0.97 * min(levels), high), ylabel="deviance per bin"
    )
    figure.legend(loc="outside upper center", ncols=3)
    return figure


@styled
def detection_limits(screened: Sequence[Screened], bin_length: float | None = None) -> Figure:
    """Smallest amplitude that this capture would have revealed, a panel for each unit.

    Args:
        screened: grey where the scene can imitate an effect.
        bin_length: m, where known.

    Returns:
        A panel for each unit, a row for each amplitude.
    """
    panels: dict[str, list[tuple[str, float, bool, bool]]] = {}
    for one in screened:
        for name, value in one.detectable.items():
            factor, unit = scales(one.name, name, None, 0.0, bin_length)[0]
            entry = (
                f"{one.name} · {name}",
                factor * value if value is not None else np.nan,
                barely(one),
                invisible(one),
            )
            panels.setdefault(unit or "pure number", []).append(entry)
    heights = [len(rows) + 1.5 for rows in panels.values()]
    figure = Figure(figsize=(7.5, 0.5 + 0.3 * sum(heights)))
    for axes, (unit, rows) in zip(
        figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0],
        panels.items(),
        strict=True,
    ):
        rows.sort(key=lambda entry: np.nan_to_num(entry[1], nan=np.inf, posinf=np.inf))
        finite = [value for _, value, *_ in rows if np.isfinite(value) and value > 0]
        low, high = (min(finite) / 3, max(finite) * 8) if finite else (0.1, 10.0)
        for row, (_, value, blind, hidden) in enumerate(rows):
            known = np.isfinite(value) and value > 0 and not hidden
            text = (
                f"{number(value, 2)} {'' if unit == 'pure number' else unit}" if known else "at no strength"
            )
            if known:
                axes.plot([low, value], [row, row], color=NOTHING, linewidth=1.2, zorder=0)
                axes.plot(
                    value,
                    row,
                    "D",
                    color=NOTHING if blind else BLUE,
                    markeredgecolor=GREY if blind else BLUE,
                    markersize=5,
                )
            note = text + (" (scene can imitate it)" if blind else "")
            axes.text(
                1.15 * value if known else 1.15 * low,
                row,
                "  " + note,
                va="center",
                fontsize="small",
                color=GREY if blind else BLACK,
            )
        axes.set_yticks(range(len(rows)), labels=[name for name, *_ in rows])
        axes.set(xscale="log", xlim=(low, high), ylim=(len(rows) - 0.5, -0.5), xlabel=unit)
        axes.xaxis.set_minor_formatter(NullFormatter())
    figure.suptitle("smallest strength that would be named in nine of ten cases", fontsize="medium")
    return figure


@styled
def witness_maps(
    maps: Mapping[str, Any], ends: tuple[np.ndarray, np.ndarray] | None = None, r: float | None = None
) -> Figure:
    """Direct pulse's energy and the fitted wall gain, both over their mean, and one against the other.

    Args:
        maps: ``direct`` and ``fitted``, both ``[nx, ny]``.
        ends: first and last edge of the wall in x and y, m; None counts spots.
        r: their correlation.

    Returns:
        Three panels.
    """
    relative = [
        values / np.nanmean(values)
        for values in (np.asarray(maps[n], dtype=float) for n in ("direct", "fitted"))
    ]
    figure = Figure(figsize=(12.5, 3.9))
    panels = figure.subplots(1, 3)
    both = np.concatenate([values[np.isfinite(values)] for values in relative])
    norm = Normalize(*np.quantile(both, (0.01, 0.99))) if both.size else None
    for axes, values, name in zip(
        panels, relative, ("direct pulse (no fit saw it)", "fitted wall gain"), strict=False
    ):
        x, y = (
            np.linspace(0, n, n + 1) if ends is None else np.linspace(ends[k][0], ends[k][1], n + 1)
            for k, n in enumerate(values.shape)
        )
        mesh = _map(axes, values, x, y, cmap="cividis", norm=norm)
        axes.set_title(name)
        axes.set(
            xlabel="x (spots)" if ends is None else "x (m)", ylabel="y (spots)" if ends is None else "y (m)"
        )
    colour_bar(mesh, "gain / mean")
    if relative[0].shape == relative[1].shape:
        panels[2].plot(
            relative[0].ravel(),
            relative[1].ravel(),
            ".",
            color=BLUE,
            markersize=3,
            alpha=0.5,
            rasterized=True,
        )
    panels[2].set(
        xlabel="direct pulse / mean", ylabel="fitted gain / mean", title=f"correlation {number(r, 2)}"
    )
    return figure


@styled
def witness_tail(fitted: float, direct: Sequence[float]) -> Figure:
    """Decay of the fitted tail against the direct pulse's.

    Args:
        fitted: m of path.
        direct: m of path, early to late.

    Returns:
        One panel.
    """
    factor, unit = scales_of("time", "m", fitted, None)[0]
    figure = Figure(figsize=(6, 1.7))
    axes = figure.subplots()
    low, high = sorted(factor * value for value in direct)
    axes.plot(
        [low, high],
        [0, 0],
        color=ORANGE,
        linewidth=9,
        solid_capstyle="butt",
        label="direct pulse, early to late",
    )
    axes.plot(factor * fitted, 0, "D", color=BLUE, label="fitted")
    axes.set(
        xlabel=f"decay time ({unit})", yticks=[], ylim=(-1, 1), xlim=(0, 1.25 * max(high, factor * fitted))
    )
    axes.spines["left"].set_visible(False)
    axes.legend(loc="upper left", ncols=2)
    return figure


@styled
def witness_delays(direct: Sequence[float], fitted: Sequence[float], r: float) -> Figure:
    """Single spots' delays, of the direct pulse and fitted, one against the other.

    Args:
        direct: m of path. fitted: too.
        r: their correlation.

    Returns:
        One panel.
    """
    both = np.stack([direct, fitted])
    factor, unit = scales_of("time", "m", float(np.abs(both).max()), None)[0]
    figure = Figure(figsize=(4.2, 3.9))
    axes = figure.subplots()
    ends = factor * np.quantile(np.abs(both), 0.999) * np.array([-1, 1])
    axes.plot(ends, ends, color=ORANGE, linewidth=1)
    axes.plot(*(factor * both), ".", color=BLUE, markersize=3, alpha=0.5, rasterized=True)
    axes.set(
        xlim=ends,
        ylim=ends,
        xlabel=f"direct pulse ({unit})",
        ylabel=f"fitted ({unit})",
        title=f"correlation {number(r, 2)}",
    )
    return figure


def by_evidence(screened: Sequence[Screened]) -> list[Screened]:
    """Most evidence first, unknown ones last."""
    return sorted(screened, key=lambda s: s.evidence if np.isfinite(s.evidence) else -np.inf, reverse=True)


def _along(axis: str) -> str:
    """What stands at an axis of a free term's shape."""
    return {"rate": "counts of a spot", "wall": "place on the wall (m)"}.get(axis) or LABELS.get(axis, axis)


def _change(name: str, shape: Shape, bin_length: float | None) -> tuple[np.ndarray, str]:
    """A free term's values as they are shown, and what they are."""
    if shape.unit == "1":
        what = "background" if "background" in name else "counts"
        return 100 * np.expm1(shape.values), f"change of the {what} (%)"
    if shape.unit == "bins²":
        return shape.values, "change of the response's variance (bins²)"
    if bin_length:
        return shape.values / bin_length, f"delay (bins of {amount_of('length', bin_length)})"
    return 1e3 * shape.values, "delay (mm of path)"


def _panels(profile: Profile) -> dict[str, np.ndarray]:
    """Title's beginning → values."""
    same = np.array_equal(profile.before, profile.after, equal_nan=True)
    return {"": profile.before} if same else {"before: ": profile.before, "after: ": profile.after}


def _map(axes: Axes, values: np.ndarray, x: np.ndarray, y: np.ndarray, **options: Any) -> QuadMesh:
    """``values`` [nx, ny] between edges ``x`` and ``y`` as seen from the wall: +x to the left, +y up."""
    mesh = axes.pcolormesh(x, y, np.ma.masked_invalid(values).T, **options)
    axes.set(aspect="equal", facecolor=NOTHING)
    axes.invert_xaxis()
    return mesh


def _beyond(values: np.ndarray) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "no values"
    count, chance = int((np.abs(known) > 3).sum()), number(BY_CHANCE * known.size, 2)
    largest = number(known[np.abs(known).argmax()], 2)
    return f"{count} of {known.size} beyond 3σ (chance: {chance}), largest {largest} σ"
