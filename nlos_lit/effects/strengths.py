"""Effects at given strengths, for simulations, and what effects report."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Mapping

import numpy as np
import torch

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS, build_effects
from nlos_lit.effects.effect import Effect


def typical(scan: Scan) -> dict[str, dict[str, float]]:
    """A strength that is clearly visible, for every effect of the registry."""
    return {effect.name: effect.typical(scan) for effect in EFFECTS}


def effects_at(
    names: Iterable[str], values: Mapping[str, float], scan: Scan, seed: int | None = 0, exposure: float = 1.0
) -> list[Effect]:
    """Effects with strengths, in the order in which they act.

    Args:
        names: of the registry.
        values: ``EFFECT.PARAMETER`` → value, in the unit of :meth:`Effect.settable`. An effect of which no
            amplitude is given has its typical strength; else amplitudes that are not given are at their null.
            Scanned parameters that are not given are at the middle of their grids.
        scan: of the capture.
        seed: of random coefficients; None is 0. Every effect draws its own, whatever others there are.
        exposure: factor on given values in counts per bin.

    Returns:
        One for each name.

    Raises:
        UserError: an unknown effect or parameter, a parameter of an effect that is not named, a value out of
            bounds.
    """
    effects = build_effects(names, scan)
    known = {effect.name: effect.settable() for effect in effects}
    for key in values:
        name, _, parameter = key.partition(".")
        if name not in known:
            raise UserError(
                f"found {key}=… but {name} is not among effects=[{','.join(known)}]; add it there"
            )
        if parameter not in known[name]:
            choices = ", ".join(f"{name}.{p}" for p in known[name])
            raise UserError(f"{name} has no parameter {parameter!r}; give one of {choices}")
    for effect in effects:
        units = known[effect.name]
        given = {p: values[f"{effect.name}.{p}"] for p in units if f"{effect.name}.{p}" in values}
        given = {p: v * exposure if units[p] == "counts/bin" else v for p, v in given.items()}
        no_amplitude = not set(given) - {p.name for p in effect.shapes}
        rng = np.random.default_rng([0 if seed is None else seed, zlib.crc32(effect.name.encode())])
        effect.draw({**(effect.typical(scan) if no_amplitude else {}), **given}, rng)
    return effects


@torch.no_grad()
def report(effects: Iterable[Effect]) -> dict[str, dict[str, dict[str, float | str]]]:
    """``{effect: {quantity: {"value": …, "unit": …}}}``, JSON-serialisable."""
    return {
        e.name: {name: {"value": float(q.value), "unit": q.unit} for name, q in e.quantities().items()}
        for e in effects
    }


@torch.no_grad()
def bound_notes(effects: Iterable[Effect]) -> list[str]:
    """Sentences on fitted parameters that lie at a bound, but for their null, or 0 of a shape, which is none.

    What the counts ask for lies beyond: the effect's law may be another one than its equation.

    Args:
        effects: as they were fitted.

    Returns:
        One for each such parameter.
    """
    notes = []
    for effect in effects:
        for p in (p for p in effect.declared.values() if p.size == 1):
            value = float(effect.value(p.name))
            for end, word in ((p.lower, "least"), (p.upper, "most")):
                # Stored in single precision, as multiples of the scale or as the logarithm of them.
                if end not in (p.null, 0.0) and math.isclose(value, end, rel_tol=1e-4):
                    notes.append(
                        f"{p.name} of {effect.name} is {end:g}, the {word} that it may be: what the counts "
                        "ask for lies beyond, so that its equation may be another one than what acts"
                    )
    return notes
