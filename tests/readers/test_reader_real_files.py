"""The public captures and independent renders, where they lie beside the checkout."""

import hashlib

import h5py
import numpy as np
import pytest
from conftest import real_file

from data_modules.readers import ReaderOptions, detect_format, read_capture, write_capture

C = 299_792_458.0
CHART_SHA = "c4c1392150d024b57029632a5f05d85916ab34fbfea5b953876b189f141d6184"
RENDERS = [
    ("bunny_confocal_32_d3", "confocal", (32, 32), 1024, 0.006),
    ("bunny_confocal_32_d8", "confocal", (32, 32), 1024, 0.006),
    ("bunny_copper02_confocal_32_d3", "confocal", (32, 32), 1024, 0.006),
    ("bunny_single_32_d3", "single_laser", (32, 32), 1024, 0.006),
    ("sphereplate_single_32_d3", "single_laser", (32, 32), 1024, 0.006),
    ("su_corner_single_32_d3", "single_laser", (32, 32), 1024, 0.006),
    ("su_corner_single_32_d8", "single_laser", (32, 32), 1024, 0.006),
    ("z_confocal_64_d3", "confocal", (64, 64), 512, 0.006),
    ("z_single_32_d3", "single_laser", (32, 32), 1024, 0.006),
    ("z_exhaustive_8x8x8x8_d3", "exhaustive", (8, 8, 8, 8), 512, 0.006),
    ("tal_cli_raw_z_confocal_16", "confocal", (16, 16), 512, 0.01),
]


@pytest.mark.parametrize(("name", "kind", "shape", "bins", "length"), RENDERS)
def test_renders(name, kind, shape, bins, length):
    path = real_file(f"rendered/{name}.hdf5")
    assert detect_format(path) == "ytal"
    capture = read_capture(path)
    assert (capture.kind, capture.scan_shape, capture.n_bins) == (kind, shape, bins)
    assert (capture.bin_length, capture.t_start, capture.is_counts) == (length, 0.0, False)
    half = 1.0 if name.startswith("tal_cli") else (0.5 if name.startswith("z_") else None)
    if half:
        assert capture.sensor[:, 0].min() == pytest.approx(-half + half / shape[-1])
    with h5py.File(path) as file:
        i, j = 1, shape[1] - 2
        at = (i, j) if len(shape) == 2 else (i, j, 2, 3)
        spot = int(np.ravel_multi_index(at, shape))
        grid = file["sensor_grid_xyz"][()]
        np.testing.assert_allclose(capture.sensor[spot], grid[at[-2:]], atol=1e-9)
        if not name.startswith("tal_cli"):
            np.testing.assert_array_equal(capture.counts[spot], file["H"][(slice(None), *at)])


def test_tals_raw_scale_is_taken_off():
    path = real_file("rendered/tal_cli_raw_z_confocal_16.hdf5")
    raw, capture = read_capture(path, options=ReaderOptions(raw_scale=False)), read_capture(path)
    ratio = raw.counts.sum(axis=1) / capture.counts.sum(axis=1)
    # laser at (-0.5, 0, 0.25): nearest spots (-0.4375, ±0.0625) and (-0.5625, ±0.0625), furthest the corners
    # at x = 0.9375
    near, far = (
        np.pi * 0.25 / (dx**2 + dy**2 + 0.0625) ** 1.5 for dx, dy in ((0.0625, 0.0625), (1.4375, 0.9375))
    )
    assert ratio.max() == pytest.approx(near, rel=1e-4)
    assert ratio.min() == pytest.approx(far, rel=1e-4)
    assert near / far == pytest.approx(280, abs=1)


@pytest.mark.parametrize(
    ("name", "half", "sha"),
    [
        ("data_s_u", 0.35, "11a94722540e046ba3d86f7c00108948d1781428939302fd0e829d784a7f8f21"),
        ("data_diffuse_s", 0.35, "d0098f6e81e33cc1aab91bbf93962faeeeca3b2c1ef69f78bba16162e282264f"),
        ("data_dot_chart_65cm", 0.2, "1af7d23414fda1e366dc17fdf5f8ac6753b9e71a15c20d31669739278e293f6c"),
        (
            "data_resolution_chart_40cm",
            0.2,
            "c4c1392150d024b57029632a5f05d85916ab34fbfea5b953876b189f141d6184",
        ),
    ],
)
def test_lct_captures(name, half, sha):
    path = real_file(f"measured/{name}.mat")
    capture = read_capture(path)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == sha
    assert capture.provenance["format"] == "lct"
    assert (capture.kind, capture.scan_shape, capture.n_bins, capture.counts.dtype) == (
        "confocal",
        (64, 64),
        2048,
        np.uint16,
    )
    assert capture.bin_length == pytest.approx(C * 4e-12)
    assert capture.laser[:, :2].min() == pytest.approx(-half * 63 / 64)
    assert 560 <= capture.gate[0] <= 720
    assert capture.gate[1] == 2048
    assert capture.observed is None  # no false find among a million runs of zeros
    import scipy.io

    data = scipy.io.loadmat(path)["rect_data"]
    spot = 5 * 64 + 9  # sixth x, tenth y from below
    np.testing.assert_array_equal(capture.counts[spot], data[5, 63 - 9])


def _image(capture, depth: float, step: int, wavelength: float = 0.06) -> np.ndarray:
    """``[x, y]`` phasor-field back-projection onto 28 × 28 points of a plane.

    It uses every ``step``-th spot along both axes.
    """
    nx, ny = capture.scan_shape
    rows = np.arange(nx * ny).reshape(nx, ny)[::step, ::step].ravel()
    first = capture.gate[0]
    counts = capture.counts[rows].astype(np.float32)
    counts[:, :first] = 0
    wave = 2 * np.pi * np.fft.fftfreq(capture.n_bins, capture.bin_length)
    filtered = np.fft.ifft(
        np.fft.fft(counts, axis=1)
        * np.exp(-((wave - 2 * np.pi / wavelength) ** 2) * (wavelength / 2) ** 2 / 2),
        axis=1,
    )
    side = np.abs(capture.laser[:, :2]).max() * np.linspace(-1, 1, 28)
    voxels = np.stack([*np.meshgrid(side, side, indexing="ij"), np.full((28, 28), depth)], axis=-1).reshape(
        -1, 3
    )
    image = np.zeros(len(voxels), dtype=complex)
    for spot, transient in zip(rows, filtered, strict=True):
        path = sum(np.linalg.norm(voxels - point[spot], axis=1) for point in (capture.laser, capture.sensor))
        at = np.clip((path - capture.t_start) / capture.bin_length - 0.5, 0, capture.n_bins - 1)
        image += np.interp(at, np.arange(capture.n_bins), transient)
    return np.abs(image).reshape(28, 28)


def _seen(image: np.ndarray) -> np.ndarray:
    """As seen from the wall: rows from the top, columns from the left, where +x is left."""
    return image.T[::-1, ::-1]


def _ratio(seen: np.ndarray, stroke: tuple[slice, slice], gap: tuple[slice, slice]) -> float:
    """How much brighter a stroke of a letter is than a place of its mirror image.

    The place is one that only the mirrored or inverted letter would fill.
    """
    return float(seen[stroke].mean() / seen[gap].mean())


def test_the_diffuse_s_reads_as_s_from_the_wall():
    capture = read_capture(real_file("measured/data_diffuse_s.mat")).sum_spots(2).sum_bins(4)
    seen = _seen(_image(capture, 0.5, 1))
    assert _ratio(seen, np.s_[10:13, 8:11], np.s_[10:13, 17:20]) > 1.3  # open at the upper right
    assert _ratio(seen, np.s_[18:21, 18:21], np.s_[19:21, 7:10]) > 1.3  # and at the lower left


def test_the_slab_captures_scan_32_by_32_spots():
    options = ReaderOptions(bin_width_ps=16.0, wall_size=0.7)
    capture = read_capture(real_file("measured/slab/letter_u_60.mat"), options=options)
    assert (capture.kind, capture.scan_shape, capture.n_bins, capture.is_counts) == (
        "confocal", (32, 32), 512, True,
    )  # fmt: skip
    with h5py.File(real_file("measured/slab/letter_u_60.mat")) as file:
        assert capture.counts.sum() == pytest.approx(file["meas"][()].astype(np.float64).sum())
    # Light that came through the foam fills every spot, late and slowly.
    assert capture.counts.sum(1).min() > 300


def test_s_and_u_read_from_the_wall_and_stand_upright():
    capture = read_capture(real_file("measured/data_s_u.mat")).sum_spots(2).sum_bins(4)
    seen = np.max([_seen(_image(capture, depth, 1)) for depth in np.arange(0.6, 0.8, 0.02)], axis=0)
    assert _ratio(seen, np.s_[11:14, 6:9], np.s_[11:14, 14:17]) > 1.5
    assert _ratio(seen, np.s_[18:20, 15:18], np.s_[18:20, 7:10]) > 1.5
    late = capture.with_gate(first=1700 // 4)
    seen = np.max([_seen(_image(late, depth, 1)) for depth in np.arange(1.01, 1.12, 0.02)], axis=0)
    assert _ratio(seen, np.s_[18:20, 16:20], np.s_[5:8, 17:20]) > 1.5  # closed below, open above


def test_figure_4_reads_as_4_from_the_wall():
    folder = real_file("measured/figure_4")
    capture = read_capture(folder)
    assert (capture.kind, capture.scan_shape, capture.gate) == ("single_sensor", (64, 64), (300, 499))
    np.testing.assert_allclose(capture.sensor[0], (0.01, -0.08, 0.0), atol=1e-12)
    assert np.ptp(capture.laser, axis=0) == pytest.approx((1.26, 1.26, 0.0))
    assert np.median(capture.counts.sum(axis=1)) == pytest.approx(221_211.5)
    told = [step for step in capture.provenance["steps"] if step.startswith("not recorded")]
    assert [len(told), "100 of 4096" in told[0], "[300, 420) of 1000" in told[1]] == [3, True, True]
    dead = ~capture.observed.any(axis=1)
    late = ~dead & ~capture.observed[:, 300]
    assert (dead.sum(), late.sum()) == (100, 1000)
    assert capture.laser[late, 0].max() < -0.32  # one side of the wall
    assert capture.observed[late].all(axis=0).nonzero()[0][[0, -1]].tolist() == [420, 498]
    assert capture.observed[~dead & ~late].all(axis=0).nonzero()[0][[0, -1]].tolist() == [300, 498]
    seen = np.max([_seen(_image(capture, depth, 2, 0.08)) for depth in np.arange(0.88, 1.04, 0.02)], axis=0)
    assert (
        _ratio(seen, np.s_[17:21, 11:14], np.s_[17:21, 4:7]) > 1.5
    )  # the tail at the right, nothing at the lower left
    assert _ratio(seen, np.s_[8:11, 4:7], np.s_[17:21, 4:7]) > 1.5  # the arm at the upper left


@pytest.mark.parametrize(
    "name", ["measured/data_s_u.mat", "measured/figure_4", "rendered/z_exhaustive_8x8x8x8_d3.hdf5"]
)
def test_real_captures_survive_a_round_trip(tmp_path, name):
    capture = read_capture(real_file(name))
    back = read_capture(write_capture(tmp_path / "a.hdf5", capture))
    np.testing.assert_array_equal(back.observed, capture.observed)
    np.testing.assert_array_equal(back.counts, capture.counts)
    np.testing.assert_array_equal(back.laser, capture.laser)
    np.testing.assert_array_equal(back.scan_order, capture.scan_order)
    assert (back.gate, back.provenance, back.counts.dtype) == (
        capture.gate,
        capture.provenance,
        capture.counts.dtype,
    )
