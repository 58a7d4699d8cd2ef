"""Each format's axes, times, units and kind, against places worked out by hand."""

import h5py
import numpy as np
import pytest
import reader_files as files

from data_modules.readers import READERS, ReaderOptions, detect_format, read_capture
from nlos_lit.capture.errors import CaptureError

UNITS = ReaderOptions(bin_width_ps=10.0)
CUBE = ReaderOptions(bin_width_ps=10.0, wall_size=0.8)
C = files.C

# writer, options, format, kind, scan, laser point, sensor point, path at the middle of the bright bin, bin
# length, value
TABLE = [
    ("ytal", {}, None, "ytal", "confocal", (3, 2), (0.2, -0.1), (0.2, -0.1), 0.5 + 33.5 * 0.01, 0.01, 9),
    ("lct", {}, None, "lct", "confocal", (4, 2), (0.3, 0.2), (0.3, 0.2), 300.5 * C * 4e-12, C * 4e-12, 9),
    ("fk", {}, None, "fk", "confocal", (4, 2), (0.75, -0.5), (0.75, -0.5), 35.5 * C * 32e-12, C * 32e-12, 9),
    (
        "fk",
        {"beside": True},
        None,
        "fk",
        "confocal",
        (4, 2),
        (0.75, -0.5),
        (0.75, -0.5),
        35.5 * C * 32e-12,
        C * 32e-12,
        9,
    ),
    (
        "phasor_field",
        {},
        None,
        "phasor_field",
        "single_sensor",
        (4, 3),
        (-0.01, 0.02),
        (0.03, 0.0),
        150.5 * C * 8e-12,
        C * 8e-12,
        9,
    ),
    ("zaragoza", {}, None, "zaragoza", "confocal", (3, 2), (0.0, 0.4), (0.0, 0.4), 0.505, 0.01, 9),
    (
        "zaragoza",
        {"reverse": True},
        None,
        "zaragoza",
        "confocal",
        (3, 2),
        (0.0, 0.4),
        (0.0, 0.4),
        0.505,
        0.01,
        9,
    ),
    (
        "zaragoza",
        {"exhaustive": True},
        None,
        "zaragoza",
        "exhaustive",
        (2, 1, 3, 2),
        (0.4, 0.0),
        (0.0, 0.4),
        0.505,
        0.01,
        9,
    ),
    ("chen", {}, None, "chen", "confocal", (8, 8), (0.625, 0.375), (0.625, 0.375), 0.045, 0.01, 0.5),
    (
        "chen",
        {"run_length": False},
        None,
        "chen",
        "confocal",
        (8, 8),
        (0.625, 0.375),
        (0.625, 0.375),
        0.045,
        0.01,
        0.5,
    ),
    ("ahn", {}, None, "tsai_ahn", "confocal", (2, 2), (-0.1, -0.2), (-0.1, -0.2), 33.5 * 0.002, 0.002, 9),
    (
        "ahn",
        {"confocal": False},
        None,
        "tsai_ahn",
        "single_sensor",
        (2, 2),
        (-0.1, -0.2),
        (-0.3, 0.1),
        33.5 * 0.002,
        0.002,
        9,
    ),
    (
        "tsai",
        {},
        UNITS,
        "tsai_ahn",
        "confocal",
        (2, 3),
        (0.2, -0.1),
        (0.2, -0.1),
        33.5 * C * 1e-11,
        C * 1e-11,
        9,
    ),
    (
        "cube",
        {},
        CUBE,
        "tsai_ahn",
        "confocal",
        (4, 2),
        (-0.3, 0.2),
        (-0.3, 0.2),
        33.5 * C * 1e-11,
        C * 1e-11,
        9,
    ),
    (
        "cid",
        {},
        None,
        "cid",
        "single_sensor",
        (3, 2),
        (0.02, 0.01),
        (0.0, -0.01),
        33.5 * C * 16e-12,
        C * 16e-12,
        9,
    ),
]


@pytest.mark.parametrize("row", TABLE, ids=lambda row: f"{row[0]}-{'-'.join(map(str, row[1])) or 'plain'}")
def test_the_bright_bin_lies_where_the_format_says(tmp_path, row):
    writer, arguments, options, fmt, kind, scan, laser, sensor, path, length, value = row
    file = files.WRITERS[writer](tmp_path, **arguments)
    assert detect_format(file) == fmt
    capture = read_capture(file, options=options)
    spot, bin_ = np.unravel_index(np.argmax(capture.counts), capture.counts.shape)
    assert capture.counts[spot, bin_] == value
    assert (capture.counts == value).sum() == 1
    np.testing.assert_allclose(capture.laser[spot], (*laser, 0.0), atol=1e-7)
    np.testing.assert_allclose(capture.sensor[spot], (*sensor, 0.0), atol=1e-7)
    np.testing.assert_allclose(
        capture.laser_normal, np.tile([0.0, 0.0, 1.0], (capture.n_spots, 1)), atol=1e-12
    )
    assert capture.bin_length == pytest.approx(length, rel=1e-9)
    tolerance = {"zaragoza": 0.5, "fk": 1e-6}.get(fmt, 1e-6) * length  # whole bins of delay are taken off
    assert capture.t_start + (bin_ + 0.5) * capture.bin_length == pytest.approx(path, abs=tolerance)
    assert capture.kind == kind
    assert capture.scan_shape == scan
    assert capture.provenance["format"] == fmt
    assert capture.is_counts == (fmt not in ("zaragoza", "chen"))
    grid = (capture.laser if np.ptp(capture.laser) > 0 else capture.sensor)[: int(np.prod(scan))].reshape(
        *scan, 3
    )
    if len(scan) == 2:
        assert (np.diff(grid[..., 0], axis=0) > 0).all()
        assert (np.diff(grid[..., 1], axis=1) > 0).all()


def test_every_reader_says_what_it_is():
    assert [reader.NAME for reader in READERS] == [
        "ytal",
        "lct",
        "fk",
        "phasor_field",
        "zaragoza",
        "chen",
        "tsai_ahn",
        "cid",
    ]
    for reader in READERS:
        assert "\n" not in reader.DESCRIPTION
        assert reader.NAME not in ("", "auto")


def test_a_name_does_not_matter(tmp_path):
    file = files.lct(tmp_path).rename(tmp_path / "wrong.hdf5")
    assert read_capture(file).provenance["format"] == "lct"


@pytest.mark.parametrize("part", ["C_i.mat", "C_d.mat", "sub_Sig.mat", "."])
def test_cid_from_the_folder_or_any_of_its_files(tmp_path, part):
    files.cid(tmp_path)
    capture = read_capture(tmp_path / part)
    assert capture.gate == (20, 50)
    assert capture.counts.max() == files.BRIGHT
    assert capture.scan_order.tolist() == [1, 0, 3, 2, 5, 4]  # the file lists falling heights


def test_scan_order_is_over_the_files_own_axes(tmp_path):
    file = files.lct(tmp_path)  # 4 × 2 in the file, second axis downwards
    plain = read_capture(file)
    assert plain.scan_order.tolist() == [1, 0, 3, 2, 5, 4, 7, 6]
    serpentine = read_capture(file, options=ReaderOptions(scan_order="serpentine"))
    assert serpentine.scan_order.tolist() == [1, 0, 2, 3, 5, 4, 6, 7]
    columns = read_capture(file, options=ReaderOptions(scan_order="columns"))
    assert columns.scan_order.tolist() == [4, 0, 5, 1, 6, 2, 7, 3]
    own = read_capture(file, options=ReaderOptions(scan_order=np.arange(8)[::-1]))
    assert own.scan_order.tolist() == [6, 7, 4, 5, 2, 3, 0, 1]
    with pytest.raises(CaptureError, match="scan_order"):
        read_capture(file, options=ReaderOptions(scan_order="spiral"))


def test_options_move_what_they_name(tmp_path):
    file = files.lct(tmp_path)
    options = ReaderOptions(
        bin_width_ps=8.0,
        wall_size=(1.6, 0.4),
        t_start=0.1,
        gate=(5, 390),
        flip_x=True,
        flip_y=True,
        swap_xy=True,
        exposure_s=2.5,
    )
    capture = read_capture(file, options=options)
    spot, bin_ = np.unravel_index(np.argmax(capture.counts), capture.counts.shape)
    # the format says (0.6, 0.1); swapped (0.1, 0.6); flipped (-0.1, -0.6)
    np.testing.assert_allclose(capture.laser[spot], (-0.1, -0.6, 0.0), atol=1e-12)
    assert capture.scan_shape == (2, 4)
    assert (bin_, capture.gate, capture.t_start, capture.exposure_s) == (300, (5, 390), 0.1, 2.5)
    assert capture.bin_width_ps == pytest.approx(8.0)
    assert "gate [5, 390) as asked" in capture.provenance["steps"]


def test_the_gate_begins_behind_the_direct_pulse(tmp_path):
    import scipy.io

    bins = np.arange(2048)
    pulse = 3000 * np.exp(-bins / 40.0)
    scene = 200 * np.exp(-((bins - 1200) ** 2) / 5000.0)
    data = np.rint(np.broadcast_to(pulse + scene + 1, (3, 3, 2048))).astype(np.uint16)
    scipy.io.savemat(tmp_path / "capture.mat", {"rect_data": data, "width": 0.35})
    first, last = read_capture(tmp_path / "capture.mat").gate
    assert last == 2048
    # 3000·exp(-t/40) sinks below 1e-4 of its peak after 40·ln(10 000) = 368 bins; whole counts end after
    # 40·ln(6000) = 348
    assert 320 < first < 380


@pytest.mark.parametrize(
    ("writer", "options", "option"),
    [
        ("lct", {"raw_scale": True}, "raw_scale"),
        ("ytal", {"bin_width_ps": 4.0}, "bin_width_ps"),
        ("ytal", {"wall_size": 1.0}, "wall_size"),
        ("zaragoza", {"wall_size": 1.0}, "wall_size"),
        ("tsai", {"bin_width_ps": 4.0, "wall_size": 1.0}, "wall_size"),
    ],
)
def test_an_option_that_means_nothing_is_refused(tmp_path, writer, options, option):
    with pytest.raises(CaptureError, match=option):
        read_capture(files.WRITERS[writer](tmp_path), options=ReaderOptions(**options))


def test_what_the_file_does_not_say_is_asked_for(tmp_path):
    with pytest.raises(CaptureError, match="bin_width_ps and wall_size"):
        read_capture(files.plain_cube(tmp_path))


def test_the_longest_axis_is_time_where_axes_stand_the_other_way_round(tmp_path):
    usual = read_capture(files.fk(tmp_path))
    with h5py.File(tmp_path / "scene.mat", "r+") as file:
        for name in ("meas", "tofgrid"):
            turned = file[name][()].T  # as programs write it that do not turn axes for MATLAB
            del file[name]
            file[name] = turned if name == "meas" else turned.T
    capture = read_capture(tmp_path / "scene.mat")
    np.testing.assert_array_equal(capture.counts, usual.counts)
    np.testing.assert_array_equal(capture.laser, usual.laser)
    assert any("longest axis" in step for step in capture.provenance["steps"])


def test_a_forced_format_reads_what_detection_would_not(tmp_path):
    capture = read_capture(files.plain_cube(tmp_path), "fk")  # f-k data re-saved as MATLAB v5
    spot = int(np.argmax(capture.counts.max(axis=1)))
    np.testing.assert_allclose(capture.laser[spot], (-0.5, 0.75, 0.0), atol=1e-12)
    with pytest.raises(CaptureError, match="no rect_data; it holds meas 4×2×60"):
        read_capture(files.plain_cube(tmp_path), "lct")
    with pytest.raises(CaptureError, match="unknown format"):
        read_capture(files.plain_cube(tmp_path), "data_type_5")
