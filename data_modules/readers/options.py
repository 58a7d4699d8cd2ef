"""What a user may say about a file that the file does not say itself."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral, Real

import numpy as np

from nlos_lit.capture.errors import CaptureError


@dataclass(frozen=True)
class ReaderOptions:
    """Facts that override a format's own; None means "as the format says".

    Args:
        bin_width_ps: width of one time bin, ps.
        wall_size: side of the scanned rectangle, m; one number, or ``(x, y)``.
        t_start: optical path length at the start of bin 0, m.
        gate: ``(first, last)`` half-open range of bins to fit.
        flip_x, flip_y: mirror the wall coordinate, for a file whose axes run the other way.
        swap_xy: exchange x and y, before any flip.
        scan_order: order of acquisition over the file's own two scan axes: ``raster`` (last axis fastest),
            ``serpentine`` (the same, every second line backwards), ``columns`` (first axis fastest), or each
            spot's rank in the file's order.
        exposure_s: exposure per spot, s.
        raw_scale: whether a y-tal file carries the factor π·cosθ_l/d_l² of an unmodified ``tal render``.
        counts: whether the values are photon counts (Poisson distributed), or expected values.
        observed: ``all`` where every zero is a measurement, so that no bin is taken for one that was not
            recorded.

    Raises:
        CaptureError: a value cannot be what it stands for.
    """

    bin_width_ps: float | None = None
    wall_size: float | tuple[float, float] | None = None
    t_start: float | None = None
    gate: tuple[int, int] | None = None
    flip_x: bool | None = None
    flip_y: bool | None = None
    swap_xy: bool | None = None
    scan_order: str | np.ndarray | None = None
    exposure_s: float | None = None
    raw_scale: bool | None = None
    counts: bool | None = None
    observed: str | None = None

    def __post_init__(self) -> None:
        for name in ("bin_width_ps", "exposure_s"):
            _positive(name, getattr(self, name))
        sides = self.wall_size if isinstance(self.wall_size, Sequence) else (self.wall_size, self.wall_size)
        if len(sides) != 2:
            raise CaptureError(f"wall_size must be one length in metres or (x, y); found {self.wall_size!r}")
        for side in sides:
            _positive("wall_size", side)
        if self.t_start is not None and not (isinstance(self.t_start, Real) and math.isfinite(self.t_start)):
            raise CaptureError(f"t_start must be a path length in metres; found {self.t_start!r}")
        for name in ("flip_x", "flip_y", "swap_xy", "raw_scale", "counts"):
            if not isinstance(getattr(self, name), bool | None):
                raise CaptureError(f"{name} must be true or false; found {getattr(self, name)!r}")
        if self.observed not in (None, "all"):
            raise CaptureError(
                "observed must be all (every zero is a measurement), or be left out so that bins which were "
                f"not recorded are looked for; found {self.observed!r}"
            )
        if self.gate is not None:
            if (
                not isinstance(self.gate, Sequence)
                or len(self.gate) != 2
                or not all(isinstance(n, Integral) for n in self.gate)
            ):
                raise CaptureError(f"gate must be (first bin, last bin); found {self.gate!r}")
            object.__setattr__(self, "gate", (int(self.gate[0]), int(self.gate[1])))

    @property
    def given(self) -> dict[str, object]:
        """Only what was said, by name.

        Examples:
            >>> ReaderOptions(bin_width_ps=4.0, gate=(600, 2048)).given
            {'bin_width_ps': 4.0, 'gate': (600, 2048)}
        """
        pairs = ((field.name, getattr(self, field.name)) for field in dataclasses.fields(self))
        return {name: value for name, value in pairs if value is not None}

    @property
    def wall_sides(self) -> tuple[float, float] | None:
        """``wall_size`` as (x, y), m.

        Examples:
            >>> ReaderOptions(wall_size=0.7).wall_sides, ReaderOptions(wall_size=(2.0, 1.0)).wall_sides
            ((0.7, 0.7), (2.0, 1.0))
        """
        if self.wall_size is None:
            return None
        x, y = self.wall_size if isinstance(self.wall_size, Sequence) else (self.wall_size, self.wall_size)
        return x, y


def _positive(name: str, value: float | None) -> None:
    if value is not None and not (isinstance(value, Real) and math.isfinite(value) and value > 0):
        raise CaptureError(f"{name} must be a positive number; found {value!r}")
