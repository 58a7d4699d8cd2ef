"""Several effects as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from torch import Tensor, nn

from nlos_lit.effects.effect import Effect
from nlos_lit.effects.hooks import Hooks
from nlos_lit.functional.surfel_paths import Paths, Walls


class Extension(nn.Module, Hooks):
    """Several effects as one: each hook is that of all effects, one after the other.

    Args:
        effects: in the order in which they act.
    """

    effects: Sequence[Effect]

    def __init__(self, effects: Sequence[Effect]) -> None:
        super().__init__()
        self.effects = cast(Sequence[Effect], nn.ModuleList(effects))

    def walls(self, walls: Walls, spots: Tensor) -> Walls:
        for effect in self.effects:
            walls = effect.walls(walls, spots)
        return walls

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        for effect in self.effects:
            contribution = effect.path(contribution, paths, spots)
        return contribution

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        for effect in self.effects:
            length = effect.time(length, paths, spots)
        return length

    def transients(
        self, transients: Tensor, energy: Tensor, albedo: Tensor, paths: Paths, spots: Tensor
    ) -> Tensor:
        for effect in self.effects:
            transients = effect.transients(transients, energy, albedo, paths, spots)
        return transients

    def response(self, kernel: Tensor, lead: int) -> Tensor:
        for effect in self.effects:
            kernel = effect.response(kernel, lead)
        return kernel

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        for effect in self.effects:
            signal = effect.gain(signal, spots)
        return signal

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        for effect in self.effects:
            background = effect.background(background, spots)
        return background

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        for effect in self.effects:
            expected = effect.counting(expected, spots)
        return expected

    def clamp(self) -> None:
        """Bring every effect's parameters back within their bounds."""
        for effect in self.effects:
            effect.clamp()

    def penalty(self) -> Tensor | float:
        """Nats that the priors of all effects take."""
        return sum(effect.penalty() for effect in self.effects)

    def reach(self) -> dict[nn.Parameter, Tensor]:
        """Of all effects."""
        return {raw: reach for effect in self.effects for raw, reach in effect.reach().items()}
