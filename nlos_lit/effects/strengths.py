"""Effects at given strengths: scalars from a command line, random fields scaled to them, and what is reported
of effects.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import build_effects
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.hot_spots import HotSpots
from nlos_lit.effects.smooth import SmoothEffect
from nlos_lit.effects.timing_jitter import TimingJitter


def typical(scan: Scan) -> dict[str, dict[str, float]]:
    """A strength that is clearly visible, for every effect, by the names of :func:`settable`; scanned
    parameters are left out.
    """
    bins = scan.bin_length
    return {
        "retroreflection": {"falloff": 2.0, "cosine": 0.0},
        "specular_lobe": {"strength": 0.5},
        "occlusion": {"opacity": 1.0},
        "higher_order_bounces": {"strength": 1.0},
        "wall_tilt": {"tilt_x": 0.03, "tilt_y": 0.0},
        "laser_sensor_baseline": {"baseline_x": 0.05 * scan.half, "baseline_y": 0.0},
        "time_drift": {"rms": 1.5 * bins},
        "timing_jitter": {"sigma": bins},
        "time_offset": {"offset": 4 * bins},
        "clock_scale": {"scale": 0.02},
        "irf_tail": {"fraction": 0.2},
        "ghost_pulse": {"fraction": 0.1},
        "power_drift": {"rms": 0.2},
        "wall_reflectance": {"rms": 0.2},
        "vignetting": {"strength": 0.4},
        "ambient_map": {"rms": 0.3},
        "background_slope": {"slope": 0.5},
        "hot_spots": {"level": 5 * scan.background, "number": max(1, round(0.01 * scan.n_spots))},
        "direct_leak": {"amplitude": 5 * scan.background},
        "afterpulsing": {"probability": 0.1},
        "pile_up": {"detections": 0.3},
        "tcspc_nonlinearity": {"sine": 0.05, "cosine": 0.0},
        "gate_edges": {"start": 0.5, "end": 0.5},
    }


def settable(effect: Effect) -> dict[str, str]:
    """Scalars that can be given, with their units: parameters, or the size of random coefficients."""
    if isinstance(effect, SmoothEffect):
        return {"rms": effect.declared[effect.coefficients].unit}
    if isinstance(effect, TimingJitter):
        return {"sigma": "m"}
    if isinstance(effect, HotSpots):
        return {"level": "counts/bin", "number": "1"}
    return {p.name: p.unit for p in effect.declared.values()}


def effects_at(
    names: Iterable[str], values: Mapping[str, float], scan: Scan, seed: int | None = 0, exposure: float = 1.0
) -> list[Effect]:
    """Effects with strengths, in the order in which they act.

    Args:
        names: of the registry.
        values: ``EFFECT.PARAMETER`` → value, see :func:`settable`. An effect of which no amplitude is given
            has that of :func:`typical`; else amplitudes that are not given are at their null. Scanned
            parameters that are not given are at the middle of their grids. ``hot_spots`` completes ``level``
            or ``number`` alone by the typical other one.
        seed: of random coefficients; None is 0. Every effect draws its own, whatever others there are.
        exposure: factor on given values in counts per bin.

    Raises:
        UserError: an unknown effect or parameter, a parameter of an effect that is not named, a value out of
            bounds.
    """
    effects = build_effects(names, scan)
    known = {effect.name: settable(effect) for effect in effects}
    for key in values:
        name, _, parameter = key.partition(".")
        if name not in known:
            raise UserError(
                f"found {key}=… but {name} is not among effects=[{','.join(known)}]; add it there"
            )
        if parameter not in known[name]:
            raise UserError(
                f"{name} has no parameter {parameter!r}; give one of {', '.join(f'{name}.{p}' for p in known[name])}"
            )
    usual = typical(scan)
    for effect in effects:
        units = known[effect.name]
        given = {p: values[f"{effect.name}.{p}"] for p in units if f"{effect.name}.{p}" in values}
        given = {p: v * exposure if units[p] == "counts/bin" else v for p, v in given.items()}
        shapes = {p.name for p in effect.shapes}
        whole = isinstance(effect, HotSpots) or not set(given) - shapes
        rng = np.random.default_rng([0 if seed is None else seed, zlib.crc32(effect.name.encode())])
        _apply(effect, {**(usual[effect.name] if whole else {}), **given}, rng)
    return effects


def _apply(effect: Effect, values: dict[str, float], rng: np.random.Generator) -> None:
    if isinstance(effect, SmoothEffect):
        field = rng.standard_normal(effect.functions.shape[1])
        size = float((effect.functions.double() @ torch.from_numpy(field)).square().mean().sqrt())
        if size == 0:
            raise UserError(
                f"{effect.name} needs more spots: the scan is too small for a smooth function over it"
            )
        _set(
            effect,
            effect.coefficients,
            torch.from_numpy(field * (_positive(effect, values, "rms") / size)),
            "rms",
        )
    elif isinstance(effect, TimingJitter):
        sigma = _positive(effect, values, "sigma")
        _set(effect, "offset", torch.from_numpy(sigma * rng.standard_normal(effect.scan.n_spots)), "sigma")
    elif isinstance(effect, HotSpots):
        level, number, spots = _positive(effect, values, "level"), values["number"], effect.scan.n_spots
        if number != int(number) or not 1 <= number <= spots:
            raise UserError(
                f"hot_spots.number must be a whole number from 1 to the scan's {spots} spots; found {number:g}"
            )
        extra = torch.zeros(spots)
        share = rng.uniform(0.5, 1.5, int(number))
        extra[torch.from_numpy(rng.permutation(spots)[: int(number)])] = torch.from_numpy(
            level * share / share.mean()
        ).float()
        _set(effect, "extra", extra, "level")
    else:
        for name, value in values.items():
            _set(effect, name, torch.tensor(value, dtype=torch.float64), name)


def _positive(effect: Effect, values: dict[str, float], name: str) -> float:
    if not values[name] >= 0:
        raise UserError(f"{effect.name}.{name} must be 0 or more; found {values[name]:g}")
    return values[name]


def _set(effect: Effect, parameter: str, value: Tensor, given: str) -> None:
    p = effect.declared[parameter]
    low, high = float(value.min()), float(value.max())
    if not (p.lower <= low and high <= p.upper):
        found = (
            f"found {high:g}"
            if value.ndim == 0
            else f"found values from {low:g} to {high:g} in the field drawn; take it smaller"
        )
        unit = "" if p.unit == "1" else f" {p.unit}"
        raise UserError(f"{effect.name}.{given} must keep within {p.lower:g} … {p.upper:g}{unit}; {found}")
    effect.set(parameter, value.float())


@torch.no_grad()
def report(effects: Iterable[Effect]) -> dict[str, dict[str, dict[str, float | str]]]:
    """``{effect: {quantity: {"value": …, "unit": …}}}``, JSON-serialisable."""
    return {
        e.name: {name: {"value": float(q.value), "unit": q.unit} for name, q in e.quantities().items()}
        for e in effects
    }
