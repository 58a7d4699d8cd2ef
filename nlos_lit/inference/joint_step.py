"""One Gauss–Newton step of effects and base together, as the screening's columns ask for it.

An effect that the base has imitated can only come in while the imitation goes: with little retained
information, an effect's step by itself makes the fit worse.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.problem import acting_order, albedo_unit, tilt_fields, tilt_frame
from nlos_lit.surfels.fit import SurfelFit

LENGTHS = (1.0, 0.5, 0.25)
MOST_DEPTH, MOST_DARKER, MOST_BRIGHTER, MOST_RESPONSE = (
    1.5,
    -0.8,
    2.0,
    1.0,
)  # bins, relative, relative, stored units


def set_step(effect: Effect, step: Tensor) -> None:
    """Move an effect's stored amplitudes, within bounds.

    Args:
        effect: that is moved, in place.
        step: ``[k]`` all amplitudes in order.
    """
    _add(effect, step, shapes=False)


@torch.no_grad()
def move_base(fit: SurfelFit, present: Extension, step: Tensor) -> None:
    """Move surfels, response and present effects by coefficients of the nuisance columns.

    Args:
        fit: whose model is moved, in place.
        present: effects that have columns.
        step: ``[P]`` in the order of the columns.
    """
    model = fit.model
    m, fields = len(model), tilt_fields(model)
    sizes = (m, m, fields.shape[1], fields.shape[1])
    brighter, deeper, across, along, rest = step.split([*sizes, len(step) - sum(sizes)])
    albedo, normal = model.albedo(), model.normal()
    sides = tilt_frame(normal)
    model.set_albedo(albedo + albedo_unit(albedo) * brighter.clamp(MOST_DARKER, MOST_BRIGHTER))
    model.raw_depth.add_(deeper.clamp(-MOST_DEPTH, MOST_DEPTH))
    model.raw_normal.copy_(
        normal + (fields @ across)[:, None] * sides[0] + (fields @ along)[:, None] * sides[1]
    )
    hiding = [model.raw_passing] if len(model.visible) else []
    for parameter in [*model.laser_sensor.parameters(), *hiding]:
        parameter.add_(rest[0].clamp(-MOST_RESPONSE, MOST_RESPONSE))
        rest = rest[1:]
    for effect in present.effects:
        if not effect.per_spot:
            rest = _add(effect, rest, shapes=True)


def _add(effect: Effect, step: Tensor, shapes: bool) -> Tensor:
    """:func:`shift`, within bounds."""
    rest = shift(effect, step, shapes)
    effect.clamp()
    return rest


@torch.no_grad()
def shift(effect: Effect, step: Tensor, shapes: bool) -> Tensor:
    """Add the first numbers of a step to an effect's stored values, without regard to bounds.

    Args:
        effect: that is moved, in place.
        step: ``[k]`` or longer.
        shapes: after the amplitudes, its shapes are moved, too.

    Returns:
        the numbers that are left.
    """
    for p in effect.amplitudes + (effect.shapes if shapes else []):
        getattr(effect, f"raw_{p.name}").add_(step[: p.size])
        step = step[p.size :]
    return step


def best_start(
    fit: SurfelFit, extra: list[Effect], steps: list[Tensor], beside: Tensor | None, seed: int
) -> SurfelFit:
    """A copy of the fit with more effects, begun where the tested spots are likeliest.

    Tried are steps of the effects with the base left alone, and joint steps of several lengths.

    Args:
        fit: that is copied.
        extra: effects at their nulls.
        steps: ``[k]`` of each extra effect's stored amplitudes.
        beside: ``[P]`` what the base does at the same time, None for nothing.
        seed: of the copy's batches.

    Returns:
        the copy; nothing is run.
    """

    def begun(length: float, moved: Tensor | None) -> SurfelFit:
        own = [copy.deepcopy(e) for e in extra]
        for effect, step in zip(own, steps, strict=True):
            set_step(effect, length * step)
        again = fit.copy(copy_effects(fit.extension, own), seed)
        if moved is not None:
            present = {e.name for e in fit.extension.effects}
            move_base(
                again, Extension([e for e in again.extension.effects if e.name in present]), length * moved
            )
        return again

    trials = [begun(1.0, None)]
    if beside is not None:
        trials += [begun(length, beside) for length in LENGTHS]
    return max(trials, key=lambda again: _likelihood(again, fit.tested))


def copy_effects(extension: Extension, extra: list[Effect]) -> Extension:
    """A copy of the extension with more effects at their present values, in order of application.

    Args:
        extension: that is copied.
        extra: effects, copied too.

    Returns:
        a new extension.
    """
    return Extension(sorted((copy.deepcopy(e) for e in [*extension.effects, *extra]), key=acting_order))


def null_of(effect: Effect) -> Effect:
    """A copy at its null, at the shape that it has."""
    copied = type(effect)(effect.scan)
    for p in copied.shapes:
        copied.set(p.name, effect.value(p.name).detach())
    return copied


def _likelihood(fit: SurfelFit, rows: Tensor) -> float:
    counts = fit.counts[rows]
    expected = fit.model.expected(fit.train[rows], fit.extension).clamp_min(1e-9)
    return float((torch.xlogy(counts, expected) - expected).double().sum())
