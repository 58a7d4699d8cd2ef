"""What is known of an effect before there is a capture: its numbers, on a plain scan."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import torch

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Number

SIDE = 20  # spots along either side of the wall


@lru_cache
def nominal_scan() -> Scan:
    """Confocal, 20 × 20 spots over 1 m, bins of 1 cm, 0.2 background counts a bin."""
    line = torch.linspace(-1, 1, SIDE)
    places = torch.cartesian_prod(line, line)
    wall = torch.nn.functional.pad(0.5 * places, (0, 1))
    return Scan(
        places=(places,),
        half=0.5,
        rank=torch.linspace(-1, 1, len(places)),
        laser=wall,
        sensor=wall,
        confocal=True,
        bin_length=0.01,
        t_start=0.0,
        n_bins=200,
        gate=(40, 200),
        mean_counts=1000.0,
        background=0.2,
    )


_KNOWN: dict[type[Effect], Mapping[str, Number]] = {}


@torch.no_grad()
def numbers_of(effect: type[Effect]) -> Mapping[str, Number]:
    """Every number that may be said of an effect, by name, parameters first.

    Examples:
        >>> from nlos_lit.effects import EFFECTS
        >>> numbers_of(EFFECTS.named("pile_up"))
        {'detections': Number(unit='1', kind='', null=0.0, share=True)}
    """
    if effect not in _KNOWN:
        _KNOWN[effect] = effect(nominal_scan()).numbers()
    return _KNOWN[effect]
