"""What effects know about the scan: where and when each spot was taken, how time is binned."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.background import quietest_level


@dataclass(frozen=True)
class Scan:
    """Coordinates of all spots, scaled so that effects need no units of their own.

    Args:
        places: one ``[S, 2]`` for each wall point that varies (the spot of a confocal or single scan; laser
            and sensor else), lateral coordinates from -1 to 1 over the scanned wall.
        half: half the scanned wall's larger side, m: ``places`` × half is metres.
        rank: ``[S]`` place in the order of acquisition, from -1 (first) to 1 (last).
        laser, sensor: ``[S, 3]`` wall points, m.
        mean_counts: counts a spot, all bins up to the gate's end.
        background: a rough level of the counts per bin without the scene, the unit of additive effects.
        light: ``[S, ≥ n_bins]`` what is known of all spots' light beforehand: the capture's own counts, not a
            copy, unless a model's expected counts are put in their place; None where there are neither.
    """

    places: tuple[Tensor, ...]
    half: float
    rank: Tensor
    laser: Tensor
    sensor: Tensor
    confocal: bool
    bin_length: float
    t_start: float
    n_bins: int
    gate: tuple[int, int]
    mean_counts: float
    background: float
    light: np.ndarray | None = field(default=None, repr=False)

    def __deepcopy__(self, memo: dict[int, Any]) -> Scan:
        # Nothing writes into a scan: copies of effects share it, and with it the capture's counts.
        return self

    @property
    def n_spots(self) -> int:
        return len(self.rank)

    @property
    def centre(self) -> Tensor:
        """``[2]`` centre of the scanned wall, m."""
        fixed_laser = bool((self.laser == self.laser[0]).all())
        moving = self.sensor if fixed_laser else self.laser
        return moving[0, :2] - self.half * self.places[0][0]

    @property
    def middle(self) -> float:
        """Path length at the middle of the gate, m."""
        return self.t_start + (self.gate[0] + self.gate[1]) / 2 * self.bin_length

    @staticmethod
    def of(capture: Capture) -> Scan:
        """The scan of a capture."""
        laser, sensor = (torch.tensor(getattr(capture, n), dtype=torch.float32) for n in ("laser", "sensor"))
        moving = (
            [laser]
            if capture.confocal
            else [p for p in (laser, sensor) if float(np.ptp(p.numpy(), axis=0).max()) > 0] or [laser]
        )
        low = torch.stack([p[:, :2].amin(0) for p in moving]).amin(0)
        high = torch.stack([p[:, :2].amax(0) for p in moving]).amax(0)
        half = float((high - low).max()) / 2 or 1.0
        first, last = capture.gate
        kept = capture.mean_transient()[:last]
        mean = kept[first:]
        return Scan(
            places=tuple((p[:, :2] - (low + high) / 2) / half for p in moving),
            half=half,
            rank=torch.tensor(2 * capture.scan_order / max(1, capture.n_spots - 1) - 1, dtype=torch.float32),
            laser=laser,
            sensor=sensor,
            confocal=capture.confocal,
            bin_length=capture.bin_length,
            t_start=capture.t_start,
            n_bins=last,
            gate=capture.gate,
            mean_counts=float(np.nansum(kept)),
            background=max(quietest_level(torch.from_numpy(mean)), 1e-3 * float(np.nanmean(mean))),
            light=capture.counts,
        )
