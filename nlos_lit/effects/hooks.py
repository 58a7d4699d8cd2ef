"""Where physical effects act on the simulated measurement."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.functional.surfel_paths import Paths


class Hooks:
    """Where physical effects act; this base class does nothing at every stage. Shapes as in
    :meth:`SurfelModel.render`.
    """

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        """``[B, M, Q]`` energy of each path."""
        return contribution

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        """``[B, M, Q]`` optical length of each path, m."""
        return length

    def transients(self, transients: Tensor, energy: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        """``[B, T]`` light on arrival, before the response; ``energy`` ``[B, M, Q]`` is that of the paths."""
        return transients

    def response(self, kernel: Tensor, lead: int) -> Tensor:
        """``[L]`` temporal response, bin ``lead`` centred on the arrival; may be returned longer."""
        return kernel

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        """``[B, T]`` expected counts of the scene, before the background."""
        return signal

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        """What is added to the signal, broadcastable to ``[B, T]``, counts per bin."""
        return background

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        """``[B, T]`` counts that are recorded of ``expected`` photons."""
        return expected


NOTHING = Hooks()
