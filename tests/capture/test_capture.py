"""Captures: what is refused, with which sentence, and what summing gives."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import numpy as np
import pytest
from small_capture import NORMAL, fields, grid_points

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.taper import tapered_counts


def altered(array: np.ndarray, index, value) -> np.ndarray:
    array = array.astype(np.float64)
    array[index] = value
    return array


COUNTS = np.arange(120, dtype=np.float64).reshape(12, 10)
EARLY = np.tile(np.arange(10) < 7, (12, 1))
REFUSED = {
    "flat counts": ({"counts": np.ones(12)}, r"\[spots, bins\].*\(12,\)"),
    "no spots": ({"counts": np.ones((0, 10))}, "not empty"),
    "no bins": ({"counts": np.ones((12, 0))}, "not empty"),
    "text": ({"counts": np.full((12, 10), "3")}, "must be numbers"),
    "complex": ({"counts": COUNTS.astype(complex)}, "must be numbers"),
    "NaN": ({"counts": altered(COUNTS, (2, 3), np.nan)}, "1 NaN or infinite values of 120"),
    "infinite": ({"counts": altered(COUNTS, (2, slice(0, 3)), np.inf)}, "3 NaN or infinite"),
    "negative": ({"counts": altered(COUNTS, (0, 0), -2)}, r"not be negative; found -2"),
    "negative integer": ({"counts": altered(COUNTS, (0, 0), -7).astype(np.int32)}, "found -7"),
    "all zero": ({"counts": np.zeros((12, 10), dtype=np.uint8)}, "every count is zero"),
    "few laser points": ({"laser": grid_points()[:5]}, r"laser must be \[12, 3\].*\(5, 3\)"),
    "flat sensor points": ({"sensor": grid_points()[:, :2]}, r"sensor must be \[12, 3\]"),
    "NaN position": ({"sensor": altered(grid_points(), (1, 1), np.nan)}, "sensor holds NaN"),
    "zero normal": (
        {"laser_normal": altered(np.tile(NORMAL, (12, 1)), 4, 0)},
        "laser_normal holds a zero vector",
    ),
    "infinite normal": (
        {"sensor_normal": altered(np.tile(NORMAL, (12, 1)), 4, np.inf)},
        "sensor_normal holds NaN",
    ),
    "no bin length": ({"bin_length": 0.0}, "length in metres"),
    "NaN bin length": ({"bin_length": float("nan")}, "length in metres"),
    "no start": ({"t_start": float("inf")}, r"t_start must be a path in metres, 1e\+06 at most; found inf"),
    "a start of no number": ({"t_start": float("nan")}, "t_start must be a path in metres"),
    "a start too far": ({"t_start": -1.001e6}, r"1e\+06 at most; found -1001000.0"),
    "empty gate": ({"gate": (4, 4)}, r"gate \[4, 4\) leaves no bins"),
    "long gate": ({"gate": (0, 11)}, "capture's 10"),
    "early gate": ({"gate": (-1, 5)}, "leaves no bins"),
    "wrong scan": ({"scan_shape": (4, 4)}, "does not hold the capture's 12 spots"),
    "odd scan": ({"scan_shape": (2, 2, 3)}, "does not hold"),
    "repeated order": ({"scan_order": np.zeros(12, dtype=int)}, "permutation of 0 … 11"),
    "short order": ({"scan_order": np.arange(11)}, "permutation"),
    "few observed": ({"observed": np.ones((12, 9), dtype=bool)}, r"observed must be \[12, 10\].*\(12, 9\)"),
    "a wall beyond any": ({"laser": np.full((12, 3), 1e7)}, r"laser .* up to 1e\+07; they are metres"),
    "weights for observed": ({"observed": np.ones((12, 10))}, "True and False.*float64"),
    "counts nobody recorded": ({"observed": EARLY}, "36 bins hold counts but are said not to"),
    "no gated bin recorded": (
        {"observed": EARLY, "counts": COUNTS * EARLY, "gate": (7, 10)},
        r"no bin of the gate \[7, 10\) was recorded",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_capture_refuses(name):
    changes, sentence = REFUSED[name]
    with pytest.raises(CaptureError, match=sentence):
        Capture(**fields(**changes))


def test_capture_keeps_what_it_was_given():
    given = fields(gate=(2, 9))
    capture = Capture(**given)
    assert capture.counts is given["counts"]
    assert np.allclose(np.linalg.norm(capture.sensor_normal, axis=1), 1)
    assert (capture.n_spots, capture.n_bins, capture.kind) == (12, 10, "confocal")
    assert capture.path_gate == pytest.approx((0.7, 1.4))
    assert capture.gated_counts().shape == (12, 7)
    assert capture.scan_order.tolist() == list(range(12))
    assert capture.bin_width_ps == pytest.approx(333.5641)


def test_kinds():
    laser = np.tile([0.3, 0.0, 0.0], (12, 1))
    assert Capture(**fields(laser=laser)).kind == "single_laser"
    assert Capture(**fields(sensor=laser)).kind == "single_sensor"
    assert Capture(**fields(laser=grid_points() + 0.05)).kind == "irregular"
    assert (
        Capture(**fields(laser=np.repeat(laser[:2] * [[1], [2]], 6, axis=0), scan_shape=(2, 1, 2, 3))).kind
        == "exhaustive"
    )


def test_gate_and_order_are_filled_in():
    """None means all bins and raster order, also when a copy is made; what was filled in stays."""
    capture = Capture(**fields(gate=(2, 9), scan_order=np.arange(12)[::-1]))
    whole = dataclasses.replace(capture, gate=None, scan_order=None)
    assert whole.gate == (0, 10)
    assert whole.scan_order.tolist() == list(range(12))
    for same in (copy.deepcopy(capture), pickle.loads(pickle.dumps(capture))):
        assert same.gate == (2, 9)
        assert same.scan_order[0] == 11
    with pytest.raises(dataclasses.FrozenInstanceError):
        capture.gate = (0, 1)


def test_sum_bins_by_hand():
    capture = Capture(**fields(gate=(2, 9))).sum_bins(3)
    assert capture.counts[1].tolist() == [10 + 11 + 12, 13 + 14 + 15, 16 + 17 + 18]
    assert capture.gate == (1, 3)
    assert (capture.bin_length, capture.t_start) == (pytest.approx(0.3), 0.5)
    assert capture.provenance["steps"] == ["summed 3 bins into one"]
    assert Capture(**fields(counts=np.full((12, 10), 250, dtype=np.uint8))).sum_bins(10).counts[0, 0] == 2500


def test_sum_spots_by_hand():
    capture = Capture(**fields()).sum_spots(2)
    rows = [[0, 1, 3, 4], [6, 7, 9, 10]]
    assert capture.scan_shape == (2, 1)
    assert capture.counts[:, 3].tolist() == [sum(10 * r + 3 for r in group) for group in rows]
    assert np.allclose(capture.sensor, [[-0.15, 0.2, 0], [0.05, 0.2, 0]])
    backwards = dataclasses.replace(Capture(**fields()), scan_order=np.arange(12)[::-1]).sum_spots(2)
    assert backwards.scan_order.tolist() == [1, 0]


def partly_recorded() -> Capture:
    """The small capture of 4 × 3 spots: the second spot lost bins 4 and 5, spot 9 lost all."""
    observed = np.ones((12, 10), dtype=bool)
    observed[1, 4:6] = observed[9] = False
    counts = np.where(observed, np.arange(120, dtype=np.uint16).reshape(12, 10), 0)
    return Capture(**fields(counts=counts.astype(np.uint16), observed=observed, gate=(2, 9)))


def test_a_sum_was_recorded_where_all_its_parts_were():
    bins = partly_recorded().sum_bins(3)
    assert bins.observed[1].tolist() == [True, False, True]
    assert bins.counts[1].tolist() == [10 + 11 + 12, 0, 16 + 17 + 18]
    spots = partly_recorded().sum_spots(2)
    assert spots.observed[0].tolist() == [True] * 4 + [False] * 2 + [True] * 4
    assert not spots.observed[1].any()
    assert spots.counts[0, 3:6].tolist() == [3 + 13 + 33 + 43, 0, 0]


def test_gated_parts_and_means_over_what_was_recorded():
    capture = partly_recorded()
    assert capture.gated_observed()[[0, 1]].sum(axis=1).tolist() == [7, 5]
    assert capture.with_gate(0, 4).gated_observed().sum() == 11 * 4
    assert Capture(**fields()).gated_observed() is None
    mean = capture.mean_transient()
    rows = [r for r in range(12) if r != 9]
    assert mean[0] == pytest.approx(np.mean([10 * r for r in rows]))
    assert mean[4] == pytest.approx(np.mean([10 * r + 4 for r in rows if r != 1]))


def test_other_counts_stay_zero_where_nothing_was_recorded():
    drawn = partly_recorded().with_counts(np.full((12, 10), 5), is_counts=False)
    assert drawn.counts.sum() == 5 * (120 - 12)
    assert not drawn.is_counts
    assert (drawn.observed == partly_recorded().observed).all()


def test_the_scans_levels_are_those_of_recorded_bins():
    """A flat capture has the same level of counts, whatever part of it was recorded."""
    observed = np.ones((12, 10), dtype=bool)
    observed[:, :2] = observed[3] = observed[4, 5:] = False
    scan = Scan.of(Capture(**fields(counts=4.0 * observed, observed=observed)))
    assert scan.background == pytest.approx(4)
    assert scan.mean_counts == pytest.approx(8 * 4)


def test_counts_are_faded_towards_bins_that_were_not_recorded():
    observed = np.ones((12, 10), dtype=bool)
    observed[2, :4] = observed[5, 8:] = False
    capture = Capture(**fields(counts=4.0 * observed, observed=observed))
    faded = tapered_counts(capture, (3, 10), width=0.2)  # two bins
    edge = [4 * np.sin(np.pi / 8) ** 2, 4 * np.sin(3 * np.pi / 8) ** 2]
    assert faded[2].tolist() == pytest.approx([0, *edge, 4, 4, 4, 4])
    assert faded[5].tolist() == pytest.approx([4, 4, 4, *edge[::-1], 0, 0])
    assert (np.delete(faded, [2, 5], axis=0) == 4).all()


@pytest.mark.parametrize("factor", [0, -1, 11])
def test_summing_refuses(factor):
    with pytest.raises(CaptureError, match=f"cannot sum {factor}"):
        Capture(**fields()).sum_bins(factor)
    with pytest.raises(CaptureError, match=f"cannot sum {factor}"):
        Capture(**fields()).sum_spots(factor)


def test_summing_spots_needs_a_grid_and_an_open_gate():
    with pytest.raises(CaptureError, match="only a capture with one scanned grid"):
        Capture(**fields(scan_shape=None)).sum_spots(2)
    with pytest.raises(CaptureError, match="leaves no bins"):
        Capture(**fields(gate=(1, 4))).sum_bins(3)
