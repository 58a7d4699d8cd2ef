"""What was measured, and where: raw photon histograms with the geometry of the scan.

World frame: relay wall near z = 0, hidden scene at z > 0, right-handed, metres. Time is optical path length
in metres from the laser's wall point to the sensor's wall point; bin ``k`` covers ``[t_start + k·bin_length,
t_start + (k+1)·bin_length)``.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np

from nlos_lit.capture.errors import CaptureError

SPEED_OF_LIGHT = 299_792_458.0  # m/s
SHORTEST_BIN, LONGEST_BIN = 1e-9, 1e6  # m
FARTHEST = 1e6  # m; squares of it stand in any precision
LONGEST_EXPOSURE = 1e9  # s

Value = TypeVar("Value")


class Filled(Generic[Value]):
    """A field that may be left out or given as None, and holds a value as soon as the object is made.

    ``__post_init__`` puts the value there; type checkers then know that nobody reads None.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: object, owner: type | None = None) -> Value:
        # The dataclass looks for the default at the class itself, without an instance: it is None.
        held: Any = None if instance is None else vars(instance)[self.name]
        return held

    def __set__(self, instance: object, value: Value | None) -> None:
        vars(instance)[self.name] = value


@dataclass(frozen=True)
class Capture:
    """Raw transients and the geometry of the scan they were taken with.

    Args:
        counts: ``[S, T]`` photon counts as in the file (any unsigned or float dtype), never scaled, never
            zeroed.
        laser: ``[S, 3]`` illuminated wall points, m.
        sensor: ``[S, 3]`` observed wall points, m; equal to ``laser`` when confocal.
        laser_normal: ``[S, 3]`` unit wall normals at ``laser``, towards the hidden scene.
        sensor_normal: ``[S, 3]`` unit wall normals at ``sensor``.
        bin_length: optical path length of one time bin, m (speed of light times bin width).
        t_start: path length at the start of bin 0, m.
        gate: ``(first, last)`` half-open range of bins that may be fitted (third bounce); None means all
            bins.
        scan_shape: ``(nx, ny)`` for one scanned grid, spot ``s = i·ny + j`` at ``x_i, y_j``;
            ``(lx, ly, sx, sy)`` for an exhaustive scan; None for irregular spots.
        scan_order: ``[S]`` rank of each spot in the order of acquisition; None means row-major raster, i.e.
            ``arange(S)``.
        exposure_s: exposure per spot in seconds, where known.
        is_counts: False for expected values without photon statistics (renders); Poisson statements need
            True.
        provenance: where the data came from and what was done to it, JSON-serialisable; ``steps`` lists the
            changes.
        observed: ``[S, T]`` bool, True where a bin of a spot was recorded; its counts are measurements there,
            zeros included. None means everywhere. Elsewhere ``counts`` are zero and say nothing.

    Raises:
        CaptureError: shapes disagree, values are NaN, infinite or negative, coordinates or the start of the
            times are beyond 1000 km, everything is zero, the exposure is no time, the gate is empty or none
            of its bins was recorded, or counts lie in bins that were not recorded.

    Examples:
        A confocal scan of 2 × 2 spots, 0.1 m apart, with 4 bins of 0.02 m:

        >>> import numpy as np
        >>> x, y = np.meshgrid([0.0, 0.1], [0.0, 0.1], indexing="ij")
        >>> wall = np.stack([x.ravel(), y.ravel(), np.zeros(4)], axis=1)
        >>> up = np.tile([0.0, 0.0, 1.0], (4, 1))
        >>> counts = np.arange(16, dtype=np.uint16).reshape(4, 4)
        >>> capture = Capture(counts, wall, wall, up, up, bin_length=0.02, gate=(1, 4), scan_shape=(2, 2))
        >>> capture.n_spots, capture.n_bins, capture.kind
        (4, 4, 'confocal')
        >>> capture.path_gate
        (0.02, 0.08)
        >>> capture.gated_counts()[0].tolist()
        [1.0, 2.0, 3.0]
        >>> Capture(-counts.astype(float), wall, wall, up, up, bin_length=0.02)
        Traceback (most recent call last):
        nlos_lit.capture.errors.CaptureError: counts must not be negative; ...
    """

    counts: np.ndarray
    laser: np.ndarray
    sensor: np.ndarray
    laser_normal: np.ndarray
    sensor_normal: np.ndarray
    bin_length: float
    t_start: float = 0.0
    gate: Filled[tuple[int, int]] = Filled()
    scan_shape: tuple[int, ...] | None = None
    scan_order: Filled[np.ndarray] = Filled()
    exposure_s: float | None = None
    is_counts: bool = True
    provenance: dict[str, Any] = field(default_factory=dict)
    observed: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.counts.ndim != 2 or 0 in self.counts.shape:
            raise CaptureError(f"counts must be [spots, bins] and not empty; found shape {self.counts.shape}")
        spots, bins = self.counts.shape
        for name in ("laser", "sensor", "laser_normal", "sensor_normal"):
            points = np.asarray(getattr(self, name), dtype=np.float64)
            if points.shape != (spots, 3):
                raise CaptureError(f"{name} must be [{spots}, 3], one row a spot; found shape {points.shape}")
            if not np.isfinite(points).all():
                raise CaptureError(f"{name} holds NaN or infinite coordinates")
            if (largest := float(np.abs(points).max())) > FARTHEST:
                raise CaptureError(
                    f"{name} holds coordinates of up to {largest:.3g}; they are metres, {FARTHEST:g} at most"
                )
            object.__setattr__(self, name, points)
        for name in ("laser_normal", "sensor_normal"):
            normals = getattr(self, name)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            if (lengths < 1e-6).any():
                raise CaptureError(
                    f"{name} holds a zero vector; wall normals must be unit vectors towards the hidden scene"
                )
            object.__setattr__(self, name, normals / lengths)
        if not SHORTEST_BIN < self.bin_length < LONGEST_BIN:
            raise CaptureError(
                f"bin_length must be a length in metres, {SHORTEST_BIN:g} to {LONGEST_BIN:g}; found "
                f"{self.bin_length}"
            )
        if not abs(self.t_start) <= FARTHEST:
            raise CaptureError(
                f"t_start must be a path in metres, {FARTHEST:g} at most; found {self.t_start}"
            )
        if self.exposure_s is not None and not 0 < self.exposure_s <= LONGEST_EXPOSURE:
            raise CaptureError(
                f"exposure_s must be a positive number of seconds, at most {LONGEST_EXPOSURE:g}; found "
                f"{self.exposure_s}"
            )
        _check_counts(self.counts)
        first, last = (0, bins) if self.gate is None else (int(self.gate[0]), int(self.gate[1]))
        if not 0 <= first < last <= bins:
            raise CaptureError(
                f"the gate [{first}, {last}) leaves no bins of the capture's {bins}; "
                f"give 0 <= first < last <= {bins}"
            )
        object.__setattr__(self, "gate", (first, last))
        if self.observed is not None:
            _check_observed(self.observed, self.counts, (first, last))
        if self.scan_shape is not None:
            shape = tuple(int(n) for n in self.scan_shape)
            if len(shape) not in (2, 4) or math.prod(shape) != spots:
                raise CaptureError(f"scan_shape {shape} does not hold the capture's {spots} spots")
            object.__setattr__(self, "scan_shape", shape)
        order = np.arange(spots) if self.scan_order is None else np.asarray(self.scan_order, dtype=np.int64)
        if order.shape != (spots,) or not np.array_equal(np.sort(order), np.arange(spots)):
            raise CaptureError(
                f"scan_order must be a permutation of 0 … {spots - 1}; found shape {order.shape}"
            )
        object.__setattr__(self, "scan_order", order)

    @property
    def n_spots(self) -> int:
        """Number S of pairs of a laser and a sensor point."""
        return self.counts.shape[0]

    @property
    def n_bins(self) -> int:
        """Number T of time bins, inside and outside the gate."""
        return self.counts.shape[1]

    @property
    def wall_extent(self) -> float:
        """Diagonal of the box around all laser and sensor points, m."""
        return float(np.linalg.norm(np.ptp(np.concatenate([self.laser, self.sensor]), axis=0)))

    @property
    def confocal(self) -> bool:
        """Laser and sensor look at the same wall point at every spot (within a hundredth of a bin)."""
        return bool(np.abs(self.laser - self.sensor).max() < 0.01 * self.bin_length)

    @property
    def kind(self) -> str:
        """``confocal``, ``exhaustive``, ``single_laser``, ``single_sensor`` or ``irregular``."""
        if self.confocal:
            return "confocal"
        if self.scan_shape is not None and len(self.scan_shape) == 4:
            return "exhaustive"
        tolerance = 0.01 * self.bin_length
        if np.ptp(self.laser, axis=0).max() < tolerance:
            return "single_laser"
        if np.ptp(self.sensor, axis=0).max() < tolerance:
            return "single_sensor"
        return "irregular"

    @property
    def bin_width_ps(self) -> float:
        """Width of a time bin, ps."""
        return self.bin_length / SPEED_OF_LIGHT * 1e12

    @property
    def path_gate(self) -> tuple[float, float]:
        """The gate as optical path length, m."""
        first, last = self.gate
        return self.t_start + first * self.bin_length, self.t_start + last * self.bin_length

    def gated_counts(self) -> np.ndarray:
        """``[S, last - first]`` float32 copy of the bins inside the gate."""
        first, last = self.gate
        return self.counts[:, first:last].astype(np.float32)

    def gated_observed(self) -> np.ndarray | None:
        """``[S, last - first]`` bool, which bins inside the gate were recorded; None where all were."""
        if self.observed is None:
            return None
        inside = self.observed[:, self.gate[0] : self.gate[1]]
        return None if inside.all() else inside

    def mean_transient(self) -> np.ndarray:
        """``[T]`` float64 counts a bin, on average over the spots that recorded it; NaN where none did.

        Examples:
            >>> import numpy as np
            >>> two, up = np.zeros((2, 3)), np.tile([0.0, 0.0, 1.0], (2, 1))
            >>> seen = np.array([[True, True, False], [True, False, False]])
            >>> counts = np.array([[2, 3, 0], [6, 0, 0]])
            >>> Capture(counts, two, two, up, up, 0.1, observed=seen).mean_transient().tolist()
            [4.0, 3.0, nan]
        """
        if self.observed is None:
            return self.counts.mean(axis=0, dtype=np.float64)
        spots = self.observed.sum(axis=0)
        total = self.counts.sum(axis=0, dtype=np.float64)
        return np.divide(total, spots, out=np.full(self.n_bins, np.nan), where=spots > 0)

    def digest(self) -> str:
        """SHA-256 of all that a fit reads: counts, scan, times, gate; places to the digits of float32.

        Examples:
            >>> import numpy as np
            >>> one, up = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
            >>> capture = Capture(np.array([[1, 2, 3]]), one, one, up, up, bin_length=0.01)
            >>> capture.digest() == capture.with_gate(0, 3).digest()
            True
            >>> capture.digest() == capture.with_gate(0, 2).digest()
            False
        """
        times = tuple(float(np.float32(value)) for value in (self.bin_length, self.t_start))
        facts = (self.counts.dtype.str, self.counts.shape, times, self.gate, self.scan_shape, self.is_counts)
        found = hashlib.sha256(repr(facts).encode())
        places = (self.laser, self.sensor, self.laser_normal, self.sensor_normal)
        for array in (self.counts, *(p.astype(np.float32) for p in places), self.scan_order):
            found.update(np.ascontiguousarray(array).data)
        if self.observed is not None:
            found.update(np.packbits(self.observed).data)
        return found.hexdigest()

    def with_counts(self, counts: np.ndarray, **changes: Any) -> Capture:
        """The same scan with other counts, such as drawn ones; what was not recorded stays zero.

        Args:
            counts: ``[S, T]``; those in bins that were not recorded are left out.
            changes: further fields that change, by name.

        Returns:
            A capture that shares this one's geometry and the bins that were recorded.

        Raises:
            CaptureError: as for any capture.
        """
        if self.observed is not None:
            counts = np.where(self.observed, counts, np.zeros((), dtype=counts.dtype))
        return dataclasses.replace(self, counts=counts, **changes)

    def with_gate(self, first: int | None = None, last: int | None = None) -> Capture:
        """The same counts with another gate.

        Args:
            first: first bin that may be fitted; None keeps the present one.
            last: bin after the last that may be fitted; None keeps the present one.

        Returns:
            A capture that shares this one's arrays.

        Raises:
            CaptureError: the gate holds no bin.
        """
        gate = (self.gate[0] if first is None else first, self.gate[1] if last is None else last)
        return self._changed(f"gate [{gate[0]}, {gate[1]})", gate=gate)

    def sum_bins(self, factor: int) -> Capture:
        """Every ``factor`` neighbouring bins summed into one; a rest at the end is dropped.

        The gate shrinks to whole new bins, so that nothing from outside it comes in. A sum was recorded where
        all its parts were; the counts of others are left out.

        Raises:
            CaptureError: ``factor`` is not between 1 and the number of bins, or no whole new bin lies inside
                the gate.

        Examples:
            >>> import numpy as np
            >>> one, up = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
            >>> counts = np.array([[1, 2, 3, 4, 5]], dtype=np.uint8)
            >>> short = Capture(counts, one, one, up, up, bin_length=0.01, gate=(1, 5))
            >>> wide = short.sum_bins(2)
            >>> wide.counts.tolist(), wide.bin_length, wide.gate
            ([[3, 7]], 0.02, (1, 2))
        """
        if factor == 1:
            return self
        if not 1 <= factor <= self.n_bins:
            raise CaptureError(f"cannot sum {factor} bins of {self.n_bins} into one")
        bins = self.n_bins // factor

        def parts(values: np.ndarray) -> np.ndarray:
            return values[:, : bins * factor].reshape(self.n_spots, bins, factor)

        wide = np.uint64 if self.counts.dtype.kind in "uib" else np.float64
        summed, observed = parts(self.counts).sum(axis=2, dtype=wide), self.observed
        if observed is not None:
            observed = np.asarray(parts(observed).all(axis=2))
            summed[~observed] = 0
        gate = (-(-self.gate[0] // factor), min(self.gate[1] // factor, bins))
        step = f"summed {factor} bins into one"
        return self._changed(
            step,
            counts=_narrow(summed),
            bin_length=self.bin_length * factor,
            gate=gate,
            observed=observed,
        )

    def sum_spots(self, factor: int) -> Capture:
        """Every ``factor × factor`` neighbouring spots of a scanned grid summed into one.

        A sum lies at the mean of its spots' wall points and normals; rows and columns left over at the end
        are dropped. A bin of a sum was recorded where it was at all its spots; the counts of others are left
        out.

        Raises:
            CaptureError: there is no single scanned grid, or ``factor`` is not between 1 and the grid's
                shorter side.
        """
        if factor == 1:
            return self
        if self.scan_shape is None or len(self.scan_shape) != 2:
            raise CaptureError("only a capture with one scanned grid [nx, ny] can be down-sampled in space")
        if not 1 <= factor <= min(self.scan_shape):
            raise CaptureError(
                f"cannot sum {factor}×{factor} spots of a {self.scan_shape[0]}×{self.scan_shape[1]} scan "
                "into one"
            )
        shape = self.scan_shape
        nx, ny = (n // factor for n in shape)

        def blocks(values: np.ndarray) -> np.ndarray:
            grid = values.reshape(*shape, -1)[: nx * factor, : ny * factor]
            return grid.reshape(nx, factor, ny, factor, -1)

        wide = np.uint64 if self.counts.dtype.kind in "uib" else np.float64
        counts = blocks(self.counts).sum(axis=(1, 3), dtype=wide).reshape(nx * ny, -1)
        observed = self.observed
        if observed is not None:
            observed = blocks(observed).all(axis=(1, 3)).reshape(nx * ny, -1)
            counts[~observed] = 0
        means = {
            name: blocks(getattr(self, name)).mean(axis=(1, 3)).reshape(nx * ny, 3)
            for name in ("laser", "sensor", "laser_normal", "sensor_normal")
        }
        rank = blocks(self.scan_order).mean(axis=(1, 3)).reshape(-1)
        order = np.argsort(np.argsort(rank, kind="stable"), kind="stable")
        return self._changed(
            f"summed {factor}×{factor} spots into one",
            counts=_narrow(counts),
            scan_shape=(nx, ny),
            scan_order=order,
            observed=observed,
            **means,
        )

    def _changed(self, step: str, **changes: Any) -> Capture:
        provenance = {**self.provenance, "steps": [*self.provenance.get("steps", []), step]}
        return dataclasses.replace(self, provenance=provenance, **changes)


def _check_counts(counts: np.ndarray) -> None:
    if counts.dtype.kind not in "uif":
        raise CaptureError(f"counts must be numbers; found dtype {counts.dtype}")
    if counts.dtype.kind == "f":
        bad = counts.size - int(np.isfinite(counts).sum())
        if bad:
            raise CaptureError(
                f"counts hold {bad} NaN or infinite values of {counts.size}; "
                "clean the file or mask those spots"
            )
    lowest = counts.min()
    if lowest < 0:
        raise CaptureError(
            f"counts must not be negative; found {lowest} "
            "(background-subtracted data cannot be used as counts)"
        )
    if counts.max() == 0:
        raise CaptureError("every count is zero; there is nothing to reconstruct")


def _check_observed(observed: np.ndarray, counts: np.ndarray, gate: tuple[int, int]) -> None:
    if observed.shape != counts.shape or observed.dtype != np.bool_:
        raise CaptureError(
            f"observed must be {list(counts.shape)} of True and False, as the counts; "
            f"found shape {observed.shape} of {observed.dtype}"
        )
    lost = np.count_nonzero(counts[~observed])
    if lost:
        raise CaptureError(
            f"{lost} bins hold counts but are said not to have been recorded; "
            "mark them as observed or set them to zero"
        )
    if not observed[:, gate[0] : gate[1]].any():
        raise CaptureError(
            f"no bin of the gate [{gate[0]}, {gate[1]}) was recorded; choose another gate, or "
            "scene.reader.observed=all where the zeros are measurements"
        )


def _narrow(counts: np.ndarray) -> np.ndarray:
    """Integers as the smallest of uint16/uint32/uint64 that holds them, floats as float32."""
    if counts.dtype.kind == "f":
        return counts.astype(np.float32)
    for dtype in (np.uint16, np.uint32):
        if counts.max() <= np.iinfo(dtype).max:
            return counts.astype(dtype)
    return counts
