"""Several effects as one."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from nlos_lit.effects.effect import Effect
from nlos_lit.effects.hooks import Hooks


class Extension(nn.Module, Hooks):
    """Several effects as one, each stage in the order given."""

    def __init__(self, effects: list[Effect]) -> None:
        super().__init__()
        self.effects = nn.ModuleList(effects)

    def path(self, contribution: Tensor, paths: Any, spots: Tensor) -> Tensor:
        for effect in self.effects:
            contribution = effect.path(contribution, paths, spots)
        return contribution

    def time(self, length: Tensor, paths: Any, spots: Tensor) -> Tensor:
        for effect in self.effects:
            length = effect.time(length, paths, spots)
        return length

    def transients(self, transients: Tensor, energy: Tensor, paths: Any, spots: Tensor) -> Tensor:
        for effect in self.effects:
            transients = effect.transients(transients, energy, paths, spots)
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
        for effect in self.effects:
            effect.clamp()

    def penalty(self) -> Tensor | float:
        """Nats that the priors of all effects take."""
        return sum(effect.penalty() for effect in self.effects)
