"""Tail of the direct pulse that falls off with the distance between laser and sensor."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter, Quantity
from nlos_lit.effects.two_parts import quicker_part, share_left
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.delays import geometric


class DirectTail(Effect):
    """The tail of the first bounce reaches into the gate; the nearer the laser's point, the stronger.

    ``background → background + amplitude · (reach/(reach + d))² · ((1 - q) e^{-u/τ} + q e^{-u/τ₂})``,
    ``u = t - d - t0``, from the direct light's arrival d on, d the distance of the laser's point from the
    sensor's on the wall (its path between them), t the path at the bin's middle, t0 the least t - d of the
    gate's bins and the scan's spots (0 if that is below it); constant where t - d < t0.

    Parameters: ``amplitude`` (counts/bin), where t - d = t0, before the falloff, null 0. ``decay`` τ (m of
    path) and ``reach`` (m on the wall), scanned. ``quick`` q (1): share that decays more quickly, fitted
    along from 0 on. ``quick_decay`` τ₂ (m of path). Quantity ``strongest`` (counts/bin): the most that any
    spot has in the gate's first bin.

    Signature: residual above 0 at the start of the gate, the more so the nearer the sensor's point is to the
    laser's, in rings about the point of a laser that stands still.

    Degenerate with: ``direct_leak``, exactly so in confocal scans, where d is 0 at every spot and ``reach``
    does nothing; ``background_slope`` for long decays; ``ambient_map``, as to the rings.

    Source: falloff of stray light in optics with the inverse square of the distance in the picture: I. R.
    King, *The profile of a star image*, Publ. Astron. Soc. Pac. 83, 1971; tails in time as in
    ``direct_leak``.

    Examples:
        >>> from nlos_lit.effects.nominal import nominal_scan
        >>> tail = DirectTail(nominal_scan())
        >>> tail.set_all({"amplitude": 8.0, "decay": 0.1})
        >>> dark = torch.tensor(0.0)
        >>> tail.background(dark, torch.tensor([0]))[0, [40, 50, 60]].detach().round(decimals=3)
        tensor([8.0000, 2.9430, 1.0830])
    """

    name = "direct_tail"
    followed_by = ("free_time", "free_wall_background")
    with_power = ("amplitude",)
    words = EffectWords(
        phrase="direct light that strays from the laser's spot into the gate",
        cause="The very bright first return at the laser's spot is scattered within the detector's optics, "
        "and its tail has not died away when the gate opens.",
        remedy="Open the gate later, clean and baffle the lens, or keep the sensor's points away from the "
        "laser's.",
        headline="{strongest} where it is strongest, τ = {decay}, falling off over {reach}",
    )
    split_by: ClassVar = {
        "direct_leak": "a scan whose laser and sensor points lie at several distances from each other",
    }

    distance: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("distance", separation(scan), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        bins, width, half = scan.bin_length, scan.gate[1] - scan.gate[0], scan.half
        most = 1e3 * (scan.mean_counts / scan.n_bins + scan.background)
        reaches = (half,) if scan.confocal else (half / 8, half / 2, 2 * half)
        decays = geometric(3 * bins, bins * width, 8)
        longest = bins * scan.n_bins * 2
        return (
            Parameter("amplitude", "counts/bin", 0.0, scan.background, 0.0, most),
            Parameter("decay", "m", None, 0.2, bins, longest, grid=decays, log=True),
            Parameter("reach", "m", None, 0.3, half / 50, 50 * half, grid=reaches, log=True, kind="length"),
            *quicker_part(scan),
        )

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"amplitude": 5 * scan.background}

    def same_as(self) -> str:
        return "direct_leak" if bool(self.distance.amax() == self.distance.amin()) else ""

    def background(self, background: Tensor, spots: Tensor) -> Tensor:
        middles = torch.arange(self.scan.n_bins, dtype=background.dtype, device=background.device) + 0.5
        return background + self.tail(
            self.scan.t_start + middles * self.scan.bin_length, self.distance[spots]
        )

    def tail(self, path: Tensor, distance: Tensor) -> Tensor:
        """Counts that are added.

        Args:
            path: ``[T]`` m, at the bins' middles.
            distance: ``[B]`` m, of the laser's points from the sensor's.

        Returns:
            ``[B, T]`` counts per bin.
        """
        scan = self.scan
        opens = scan.t_start + (scan.gate[0] + 0.5) * scan.bin_length
        start = (opens - self.distance.max()).clamp_min(0)
        since = path - distance[:, None]
        left = share_left(self, (since - start).clamp_min(0)) * (since >= 0)
        reach = self.value("reach")
        return self.value("amplitude") * (reach / (reach + distance[:, None])) ** 2 * left

    def quantities(self) -> dict[str, Quantity]:
        opens = self.distance.new_tensor(
            [self.scan.t_start + (self.scan.gate[0] + 0.5) * self.scan.bin_length]
        )
        return {
            "strongest": Quantity(self.tail(opens, self.distance).amax(), "counts/bin"),
            **super().quantities(),
        }


def separation(scan: Scan) -> Tensor:
    """``[S]`` m from the laser's wall points to the sensor's."""
    if scan.confocal:
        return torch.zeros(scan.n_spots)
    return (scan.laser - scan.sensor).norm(dim=1)
