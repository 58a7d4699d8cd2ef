"""Where physical effects act on the simulated measurement."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.functional.surfel_paths import Paths, Walls

# From the hooks that an effect overrides to its stage; the first that fits: an effect that moves arrivals may
# change their energy, too.
STAGE_OF_HOOKS = (
    ("time", frozenset({"walls", "time"})),
    ("path", frozenset({"path", "transients"})),
    ("response", frozenset({"response"})),
    ("spot", frozenset({"gain", "background"})),
    ("counting", frozenset({"counting"})),
)
OF_PATHS = frozenset({"walls", "path", "time", "transients"})


class Hooks:
    """Where physical effects act; this base class does nothing at every stage.

    B spots of a batch, M surfels, Q points on each, T time bins from bin 0 to the end of the gate.
    """

    def walls(self, walls: Walls, spots: Tensor) -> Walls:
        """Where light really leaves the wall and comes back.

        Args:
            walls: so far; the capture's own at first.
            spots: ``[B]`` indices into the scan.

        Returns:
            as many points and normals.
        """
        return walls

    def path(self, contribution: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        """Energy of each path.

        Args:
            contribution: ``[B, M, Q]`` energy so far, albedo included.
            paths: their geometry.
            spots: ``[B]`` indices into the scan.

        Returns:
            ``[B, M, Q]``.
        """
        return contribution

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        """Optical length of each path.

        Args:
            length: ``[B, M, Q]`` m, so far.
            paths: their geometry.
            spots: ``[B]`` indices into the scan.

        Returns:
            ``[B, M, Q]`` m.
        """
        return length

    def transients(
        self, transients: Tensor, energy: Tensor, albedo: Tensor, paths: Paths, spots: Tensor
    ) -> Tensor:
        """Light on arrival, before the response.

        Args:
            transients: ``[B, T]`` so far.
            energy: ``[B, M, Q]`` of the paths.
            albedo: ``[M]`` of the surfels, known but for a common factor.
            paths: their geometry.
            spots: ``[B]`` indices into the scan.

        Returns:
            ``[B, T]``.
        """
        return transients

    def response(self, kernel: Tensor, lead: int) -> Tensor:
        """Temporal response of laser and sensor.

        Args:
            kernel: ``[L]`` so far.
            lead: its bin that is centred on the arrival.

        Returns:
            ``[L' ≥ L]``, the same bin centred on the arrival.
        """
        return kernel

    def gain(self, signal: Tensor, spots: Tensor) -> Tensor:
        """Expected counts of the scene, before the background.

        Args:
            signal: ``[B, T]`` counts per bin, so far.
            spots: ``[B]`` indices into the scan.

        Returns:
            ``[B, T]`` counts per bin.
        """
        return signal

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        """What is added to the signal.

        Args:
            background: counts per bin so far, broadcastable to ``[B, T]``.
            spots: ``[B]`` indices into the scan.

        Returns:
            Counts per bin, broadcastable to ``[B, T]``.
        """
        return background

    def counting(self, expected: Tensor, spots: Tensor) -> Tensor:
        """Counts that are recorded.

        Args:
            expected: ``[B, T]`` photons per bin.
            spots: ``[B]`` indices into the scan.

        Returns:
            ``[B, T]`` counts per bin.
        """
        return expected


HOOKS = frozenset(name for name in vars(Hooks) if not name.startswith("_"))


def overridden(cls: type[Hooks]) -> frozenset[str]:
    """Names of the hooks at which a class does something.

    Examples:
        >>> class Late(Hooks):
        ...     def time(self, length, paths, spots):
        ...         return length + 1
        >>> sorted(overridden(Late))
        ['time']
    """
    return frozenset(name for name in HOOKS if getattr(cls, name) is not getattr(Hooks, name))


NOTHING = Hooks()
