"""Zeros that nobody measured: what is taken for them, what is not, and what a reader then says."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import scipy.io

from data_modules.readers import ReaderOptions, read_capture
from data_modules.readers.unrecorded import CHANCE, find_unrecorded
from data_modules.simulate import SCENES, ScanPlan, SensorModel, simulate_capture
from nlos_lit.capture.errors import CaptureError

ENOUGH = int(np.ceil(-np.log(CHANCE)))  # counts whose absence by chance is less probable than CHANCE: 21


def flat(level: int, spots: int = 50, bins: int = 100) -> np.ndarray:
    return np.full((spots, bins), level, dtype=np.uint16)


@pytest.mark.parametrize(("level", "own"), [(1, 1), (2, 1), (1, 5)])
@pytest.mark.parametrize("at_the_end", [False, True])
def test_as_many_counts_must_be_missing_as_chance_demands(level, own, at_the_end):
    """Others hold ``level`` a bin and this spot ``own``: one count a bin is missing, in one run in all."""
    for missing, found in ((ENOUGH - 1, False), (ENOUGH, True)):
        counts = flat(level)
        counts[7] = own
        cut = slice(-missing, None) if at_the_end else slice(0, missing)
        counts[7, cut] = 0
        observed, told = find_unrecorded(counts)
        assert (observed is not None) == found == bool(told)
        if found:
            lost = np.zeros_like(observed)
            lost[7, cut] = True
            np.testing.assert_array_equal(~observed, lost)


def test_the_more_runs_are_looked_at_the_more_must_be_missing():
    counts = flat(1)
    counts[7, :ENOUGH] = 0
    counts[8, 50::2] = 0  # 25 more runs: ln 26 = 3.3
    assert find_unrecorded(counts)[0] is None
    counts[7, : ENOUGH + 4] = 0
    assert find_unrecorded(counts)[0] is not None


def test_a_dead_spot_among_bright_and_among_weak_ones():
    for bins, found in ((ENOUGH - 1, False), (ENOUGH, True)):
        counts = flat(1, bins=bins)
        counts[3] = 0
        observed, told = find_unrecorded(counts)
        assert (observed is not None) == found
    assert not observed[3].any()
    assert observed.sum() == 49 * bins
    assert told == ["not recorded: all bins of 1 of 50 spots (no count where others hold many)"]


def test_spots_cut_at_different_places_do_not_hide_one_another():
    counts = np.random.default_rng(1).poisson(5.0, (200, 300))
    cut = {3: slice(0, 40), 4: slice(0, 90), 5: slice(200, 300), 6: slice(100, 140), 7: slice(0, 300)}
    for spot, bins in cut.items():
        counts[spot, bins] = 0
    counts[150:190, :120] = 0
    observed, _ = find_unrecorded(counts)
    for spot, bins in [*cut.items(), (160, slice(0, 120))]:
        assert not observed[spot, bins].any()
        assert observed[spot].sum() == 300 - (bins.stop - bins.start)


def test_light_that_comes_later_is_not_cut_off():
    """Without any background, spots are dark until their first return, which differs from spot to spot."""
    counts = np.zeros((64, 300), dtype=np.int64)
    for spot in range(64):
        counts[spot, 100 + spot :] = 50
    assert find_unrecorded(counts)[0] is None
    counts[:, 200:] = 0
    for spot in range(64):
        counts[spot, 200 : 264 - spot] = 50
    assert find_unrecorded(counts)[0] is None


@pytest.mark.parametrize("mean_counts", [3.0, 30.0, 300.0, 3000.0])
@pytest.mark.parametrize("background", [0.0, 0.02, 0.3])
def test_dark_spots_of_simulated_captures_are_measurements(mean_counts, background):
    plan = ScanPlan(kind="confocal", nx=12, ny=12, width=1.5, bin_length=0.0096, n_bins=256)
    sensor = SensorModel(sigma=0.012, kappa=60.0, background=background, mean_counts=mean_counts)
    capture, _ = simulate_capture(SCENES["default"](), plan, sensor, seed=2)
    assert find_unrecorded(capture.counts)[0] is None


def test_empty_ends_are_taken_for_cut_only_where_the_format_cuts():
    counts = flat(3)
    counts[:, :10] = counts[:, 90:] = 0
    assert find_unrecorded(counts) == (None, [])
    observed, told = find_unrecorded(counts, cropped=True)
    assert observed.all(axis=0).nonzero()[0][[0, -1]].tolist() == [10, 89]
    assert told == ["not recorded: bins [0, 10) and [90, 100) of all spots (cut off)"]
    faint = np.zeros((50, 100), dtype=np.int64)
    faint[5, 20] = 4
    assert find_unrecorded(faint, cropped=True)[0] is None


@pytest.fixture
def late(tmp_path):
    """LCT file of 8 × 8 spots whose spot at the second x and the lowest y has no counts in 30 bins."""
    data = np.full((8, 8, 100), 4, dtype=np.uint16)
    data[1, 7, 50:80] = 0  # the file's second axis runs downwards
    path = tmp_path / "late.mat"
    scipy.io.savemat(path, {"rect_data": data, "width": 0.4})
    return path


def test_a_reader_finds_and_tells_them(late, caplog):
    with caplog.at_level(logging.INFO, "data_modules"):
        capture = read_capture(late)
    assert np.argwhere(~capture.observed).tolist() == [[8, bin_] for bin_ in range(50, 80)]
    np.testing.assert_allclose(capture.laser[8, :2], (-0.25, -0.35))
    told = "not recorded: bins [50, 80) of 1 of 64 spots (zeros where others hold many)"
    assert told in capture.provenance["steps"]
    assert f"late.mat: {told}" in caplog.messages


def test_a_user_may_say_that_zeros_are_measurements_or_that_values_are_no_counts(late):
    said = read_capture(late, options=ReaderOptions(observed="all"))
    assert said.observed is None
    assert "every bin was recorded, as asked" in said.provenance["steps"]
    expected = read_capture(late, options=ReaderOptions(counts=False))
    assert (expected.observed, expected.is_counts) == (None, False)
    with pytest.raises(CaptureError, match=r"observed must be all .* found 'none'"):
        ReaderOptions(observed="none")
    with pytest.raises(CaptureError, match="counts must be true or false; found 'yes'"):
        ReaderOptions(counts="yes")
