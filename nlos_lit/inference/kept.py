"""What the steps of a diagnosis leave in plain files (:mod:`nlos_lit.runtime.plain_file`)."""

from __future__ import annotations

from typing import Any

import torch

from nlos_lit.capture.scan import Scan
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.formulas import FORMULAS
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.candidates import Candidate, Pool, Taken
from nlos_lit.runtime.plain_file import Kind, record
from nlos_lit.surfels.fit import SurfelFit, SurfelSettings


def kinds(scan: Scan) -> list[Kind]:
    """How all that steps return is kept; effects are those of one ``scan``, and made anew by name."""

    def effect(parts: dict[str, Any]) -> Effect:
        return _effect(scan, **parts)

    return [
        *(record(of) for of in (Candidate, Taken, Pool, VolumeGrid, SurfelSettings)),
        Kind(SurfelFit, SurfelFit.parts, SurfelFit.of_parts),
        Kind(Extension, lambda e: {"effects": list(e.effects)}, lambda parts: Extension(**parts)),
        Kind(Effect, _parts, effect),
    ]


def _parts(effect: Effect) -> dict[str, Any]:
    """Stored values, the numbers that it has besides, and whether optimisers move it."""
    return {
        "name": effect.name,
        "stored": dict(effect.state_dict(keep_vars=True)),
        "numbers": _numbers(effect),
        "moves": any(p.requires_grad for p in effect.parameters()),
    }


@torch.no_grad()
def _effect(
    scan: Scan, name: str, stored: dict[str, torch.Tensor], numbers: dict[str, float], moves: bool
) -> Effect:
    effect = next(cls for cls in [*EFFECTS, *FREE, *FORMULAS] if cls.name == name)(scan)
    own = dict(effect.state_dict(keep_vars=True))
    if set(own) != set(stored) or set(_numbers(effect)) != set(numbers):
        raise ValueError(f"these are no values of {name}")
    for key, value in stored.items():
        own[key].copy_(value)
    for key, number in numbers.items():
        setattr(effect, key, number)
    return effect.requires_grad_(moves)


def _numbers(effect: Effect) -> dict[str, float]:
    return {name: value for name, value in vars(effect).items() if isinstance(value, float)}
