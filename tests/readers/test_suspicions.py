"""What looks wrong in a capture is told, and nothing of one that is as it should be."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from conftest import real_file

from data_modules import suspicions
from data_modules.readers import ReaderOptions, read_capture
from data_modules.scan_direction import _changes, scan_direction
from nlos_lit.capture import Capture

SIDE, BINS, FIRST, PULSE = 24, 400, 60, 200


def clean(seed: int = 0, background: float = 0.4) -> Capture:
    """Poisson counts: a direct pulse at path 0, and a board 0.6 m away that is as bright as it is uneven."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(0.02 * np.arange(SIDE), 0.02 * np.arange(SIDE), indexing="ij")
    wall = np.stack([x.ravel(), y.ravel(), np.zeros(SIDE**2)], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], wall.shape)
    late = np.arange(BINS) - PULSE - 0.5 * (x.ravel() + y.ravel())[:, None] / 0.02
    scene = np.where(late > 0, np.exp(-late / 15) * (1 - np.exp(-late / 3)), 0.0)
    pulse = 300 * np.exp(-np.arange(BINS) / 6)
    gain = 1 + 0.3 * np.sin(5 * x.ravel()) + 0.05 * rng.normal(size=SIDE**2)
    counts = rng.poisson(gain[:, None] * (pulse + 20 * scene) + background).astype(np.uint32)
    return Capture(counts, wall, wall, up, up, 0.006, gate=(FIRST, BINS), scan_shape=(SIDE, SIDE))


CLEAN = clean()
VALUES = CLEAN.counts.astype(np.float64)
RNG = np.random.default_rng(1)
SOME = RNG.permutation(SIDE**2)[: int(0.7 * SIDE**2)]  # most of the spots


def counts(values: np.ndarray) -> Capture:
    return dataclasses.replace(CLEAN, counts=values)


def cut(first: int, last: int) -> Capture:
    values = CLEAN.counts.copy()
    values[SOME, first:last] = 0
    return counts(values)


def spots(which: np.ndarray | slice | int, factor: float) -> Capture:
    values = VALUES.copy()
    values[which] = RNG.poisson(factor * values[which]) if factor else 0
    return counts(values.astype(np.uint32))


def moved(which: slice, z: float = 0.0, sideways: float = 0.0) -> Capture:
    wall = CLEAN.laser.copy()
    wall[which, 2] += z
    wall[:, :2] += sideways * RNG.normal(size=(len(wall), 2))
    return dataclasses.replace(CLEAN, laser=wall, sensor=wall)


COLUMN = np.arange(SIDE**2).reshape(SIDE, SIDE)[5]
ROW = np.arange(SIDE**2).reshape(SIDE, SIDE)[:, 7]
SMOOTH = (VALUES + np.roll(VALUES, 1, 1) + np.roll(VALUES, -1, 1)) / 3
WRONG = {
    "roots": (counts(np.sqrt(VALUES).astype("f4")), "the square root of a whole number: photon"),
    "roots over the largest": (
        counts((np.sqrt(VALUES) / np.sqrt(VALUES.max())).astype("f4")),
        "the square root of a whole number times 0.0",
    ),
    "rounded roots": (counts(np.rint(np.sqrt(VALUES))), "scatter less .* or their root taken"),
    "over the largest": (
        counts((VALUES / VALUES.max()).astype("f4")),
        f"a whole number times {1 / VALUES.max():.6g}",
    ),
    "four times": (counts(4 * CLEAN.counts), "a multiple of 4"),
    "mean of three": (counts((VALUES / 3).astype("f4")), "a whole number times 0.333333"),
    "halves": (counts((VALUES * 0.371 + 0.01 * VALUES**1.3).astype("f4")), "are not whole numbers"),
    "smoothed": (counts(np.rint(SMOOTH)), "scatter less along time"),
    "flickering": (
        counts(RNG.poisson(VALUES * RNG.gamma(2, 0.5, VALUES.shape))),
        "scatter more along time than photons do: their variance is [12]",
    ),
    "saturated": (counts(np.minimum(CLEAN.counts, 15)), "hold exactly the largest value 15 .* saturated"),
    "a dead column": (spots(COLUMN, 0), r"24 of 576 spots hold no counts .* \(column 5 along x\)"),
    "a hot row": (spots(ROW, 4), r"24 of 576 spots are 3.* brighter .*\(row 7 along y\): hot\?"),
    "a hot spot": (spots(100, 4), r"1 of 576 spots are [34].* brighter .*\(first: spot 100\)"),
    "a weak spot": (spots(100, 0.2), "1 of 576 spots are .* darker .*partly dead"),
    "cropped before": (cut(0, 130), r"403 of 576 spots hold zeros up to bin 130, .* cropped, not dark\?"),
    "cropped behind": (cut(300, BINS), "403 of 576 spots hold zeros from bin 300, "),
    "cropped between": (cut(100, 150), "403 of 576 spots hold zeros up to bin 150, "),
    "a sheet in front": (moved(slice(0, 100), 0.15), "wall points lie up to 0.07.* m off their plane"),
    "a wall elsewhere": (moved(slice(None), 0.15), r"wall's plane reaches z = 0.15 m \(tilted by 0°\)"),
    "irregular": (moved(slice(0), 0, 0.002), "form no regular lattice .*not evenly spaced along x"),
    "backwards": (
        dataclasses.replace(CLEAN, counts=CLEAN.counts[:, ::-1].copy(), gate=(0, BINS - FIRST)),
        "light rises more slowly than it falls; does time run backwards",
    ),
    "time zero": (dataclasses.replace(CLEAN, t_start=0.1), "pulse peaks at path 0.103 m.* t_start=-0.003"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_told(name):
    capture, sentence = WRONG[name]
    told = suspicions.suspicions(capture)
    assert any(re.search(sentence, line) for line in told), told


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("background", [0.01, 0.4, 20.0])
def test_poisson_counts_look_right(seed, background):
    capture = clean(seed, background)
    assert suspicions.suspicions(capture) == ()
    for share in (0.25, 1.0):
        ratio, error = suspicions.dispersion(capture.with_gate(FIRST, PULSE), share)
        assert abs(ratio - 1) < 4 * error  # 15 captures, two ratios each: 0.2 % to be beyond by chance
        assert error < 0.2


@pytest.mark.slow
def test_fifteen_hundred_poisson_captures_look_right():
    """Any size and level, light or none, all spots alike: a false alarm has a chance of 11 checks × 1e-6."""
    told = []
    for seed in range(1500):
        rng = np.random.default_rng(seed)
        side, bins = rng.integers(8, 20), rng.integers(60, 300)
        wall = 0.02 * np.stack([*np.indices((side, side)).reshape(2, -1), np.zeros(side**2)], axis=1)
        up = np.broadcast_to([0.0, 0.0, 1.0], wall.shape)
        late = np.maximum(np.arange(bins) - bins // 2, 0)
        light = 10 ** rng.uniform(-1, 2) * np.exp(-late / 20) * (1 - np.exp(-late / 4))
        values = rng.poisson(10 ** rng.uniform(-2, 2) + light, (side**2, bins)).astype(np.uint32)
        shape = (int(side), int(side))
        capture = Capture(values, wall, wall, up, up, 0.005, t_start=1.0, scan_shape=shape)
        told += suspicions.suspicions(capture)
    assert told == []


def test_scatter_has_a_size_and_an_error_that_hold():
    """Gamma-distributed light of variance v and mean 1: variance over mean is 1 + v·mean."""
    rng = np.random.default_rng(3)
    mean = np.full((SIDE**2, BINS), 2.0)
    draws = [
        suspicions.dispersion(counts(rng.poisson(mean * rng.gamma(4, 0.25, mean.shape))), 1.0)
        for _ in range(12)
    ]
    ratios, errors = np.transpose(draws)
    assert ratios.mean() == pytest.approx(1 + 2 / 4, abs=4 * errors.mean() / np.sqrt(12))
    assert ratios.std() == pytest.approx(errors.mean(), rel=0.7)  # twelve draws know it to 20 %


def test_what_was_marked_as_not_recorded_is_told_once():
    observed = np.ones(CLEAN.counts.shape, dtype=bool)
    observed[COLUMN] = False
    observed[ROW[:3], 100:150] = False
    marked = dataclasses.replace(CLEAN, counts=np.where(observed, CLEAN.counts, 0), observed=observed)
    assert suspicions.suspicions(marked) == (
        "24 of 576 spots are dead (column 5 along x); left out",
        "3 of 576 spots are cropped inside the gate; bins 150 to 399 are whole; the bins that were not "
        "recorded are left out",
    )


def test_numbers_of_few_digits_are_no_counts():
    """Radiance files have eight bits a number: each is a multiple of the smallest step of them all."""
    values = np.exp(np.random.default_rng(0).normal(-4, 2, 5000))
    exponent = np.floor(np.log2(values)) - 7
    rounded = np.unique(np.rint(values / 2**exponent) * 2**exponent)
    assert suspicions.common_unit(rounded) is None
    assert suspicions.common_unit(np.unique(values.astype("f4")).astype(float)) is None


CHARTS = ("data_dot_chart_65cm.mat", "data_resolution_chart_40cm.mat")
MEASURED = [
    *((f"data_{n}.mat", {}) for n in ("s_u", "diffuse_s")),
    *((name, {"scan_order": "columns"}) for name in CHARTS),
    *((f"slab/letter_{n}.mat", {"bin_width_ps": 16.0, "wall_size": 0.7}) for n in ("s", "u_50", "u_70")),
]


@pytest.mark.parametrize(("name", "given"), MEASURED)
def test_nothing_is_told_of_good_real_captures(name, given):
    capture = read_capture(real_file(f"measured/{name}"), options=ReaderOptions(**given))
    assert suspicions.suspicions(capture) == ()
    assert suspicions.dispersion(capture, 0.25)[0] == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("name", CHARTS)
def test_charts_were_scanned_along_the_other_axis(name):
    told = suspicions.suspicions(read_capture(real_file(f"measured/{name}")))
    assert [bool(re.search("along the other axis; say so .scan_order=columns", line)) for line in told] == [
        True
    ]


def switched(order: np.ndarray, times: float = 3.0) -> Capture:
    """A lamp that is on for stretches of the scan, taken in another order than the capture says."""
    on = np.searchsorted([100, 130, 300, 410], order) % 2 == 1
    lamp = np.random.default_rng(2).poisson(0.4 * (times - 1) * on[:, None], CLEAN.counts.shape)
    return counts(CLEAN.counts + lamp.astype(np.uint32))


def test_light_that_comes_and_goes_says_along_which_axis_was_scanned():
    grid = np.arange(SIDE**2).reshape(SIDE, SIDE)
    across, along = switched(grid.T.ravel()), switched(grid.ravel())
    assert any("along the other axis" in line for line in suspicions.suspicions(across))
    assert suspicions.suspicions(along) == ()
    said = dataclasses.replace(across, scan_order=grid.T.ravel())
    assert suspicions.suspicions(said) == ()
    back = grid.copy()
    back[1::2] = back[1::2, ::-1]
    assert suspicions.suspicions(dataclasses.replace(switched(back.ravel()), scan_order=back.ravel())) == ()
    assert any(
        "along the other axis" in line
        for line in suspicions.suspicions(dataclasses.replace(along, scan_order=grid.T.ravel()))
    )


def test_changes_of_white_noise_are_none_and_steps_are_worked_out_by_hand():
    """A step of 6 standard deviations in the middle of every line of 24, looked at along and across it.

    Windows of four on either side of a spot see it from nine spots: they hold 1 … 4 … 1 spots of the other
    level, and 8 changes of 6 · (1, 2, 3, 4, 4, 3, 2, 1)/4 are among 16 a line; of their squares' mean half
    the window is taken.
    """
    step = np.zeros((24, 24))
    step[:, 12:] = 6
    squares = [36 * (k / 4) ** 2 for k in (1, 2, 3, 4, 4, 3, 2, 1)]
    assert _changes(step) == pytest.approx(sum(squares) / 16 * 4 / 2 - 1)
    assert _changes(step.T) == pytest.approx(-1)
    noise = np.random.default_rng(0).normal(size=(400, 400))
    assert _changes(noise) == pytest.approx(0, abs=0.02)


def test_a_scan_that_is_no_grid_has_no_direction():
    assert scan_direction(dataclasses.replace(CLEAN, scan_shape=None)) is None
    mixed = np.random.default_rng(0).permutation(SIDE**2)
    assert scan_direction(dataclasses.replace(CLEAN, scan_order=mixed)) is None


def test_of_figure_4_is_told_what_its_file_lacks():
    told = suspicions.suspicions(read_capture(real_file("measured/figure_4")))
    assert [line[:42] for line in told] == [
        "100 of 4096 spots are dead; left out",
        "1000 of 4096 spots are cropped inside the ",
    ]


@pytest.mark.parametrize(
    "name",
    [
        "bunny_confocal_32_d8",
        "bunny_copper02_confocal_32_d3",
        "su_corner_single_32_d8",
        "tal_cli_raw_z_confocal_16",
        "z_exhaustive_8x8x8x8_d3",
    ],
)
def test_nothing_is_told_of_renders(name):
    assert suspicions.suspicions(read_capture(real_file(f"rendered/{name}.hdf5"))) == ()
