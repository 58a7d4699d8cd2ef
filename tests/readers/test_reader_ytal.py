"""y-tal: every kind of scan both ways, the first and last way, tal's raw scale."""

import dataclasses
import json

import h5py
import numpy as np
import pytest
import reader_files as files

from data_modules.readers import ReaderOptions, read_capture, write_capture
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

TAL_KEYS = {
    "H",
    "H_format",
    "delta_t",
    "t_start",
    "t_accounts_first_and_last_bounces",
    "scene_info",
    "volume_format",
} | {
    f"{device}_{part}"
    for device in ("laser", "sensor")
    for part in ("xyz", "grid_xyz", "grid_normals", "grid_format")
}


def _grid(nx: int, ny: int, offset: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(
        0.1 * np.arange(nx) - 0.123456789 + offset, 0.07 * np.arange(ny) + offset / 3, indexing="ij"
    )
    return np.stack([x.ravel(), y.ravel(), 0.001 * np.arange(nx * ny)], axis=1)


def _capture(kind: str) -> Capture:
    rng = np.random.default_rng(3)
    a, b = _grid(3, 2), _grid(2, 4, 0.011)
    product = np.repeat(a, len(b), axis=0), np.tile(b, (len(a), 1))
    laser, sensor, shape = {
        "confocal": (a, a, (3, 2)),
        "single_laser": (np.tile([[0.3, -0.2, 0.0]], (6, 1)), a, (3, 2)),
        "single_sensor": (a, np.tile([[0.3, -0.2, 0.0]], (6, 1)), (3, 2)),
        "exhaustive": (*product, (3, 2, 2, 4)),
        "paired_grids": (a, a + np.array([0.01, 0.0, 0.0]), (3, 2)),
        "irregular_confocal": (rng.random((5, 3)), None, None),
        "irregular_single": (np.tile([[0.3, -0.2, 0.0]], (5, 1)), rng.random((5, 3)), None),
        "irregular_single_sensor": (rng.random((5, 3)), np.tile([[0.3, -0.2, 0.0]], (5, 1)), None),
        "irregular_pairs": (rng.random((5, 3)), rng.random((5, 3)), None),
        "irregular_product": (*product, None),
        "one_spot": (a[:1], a[:1], (1, 1)),
    }[kind]
    sensor = laser if sensor is None else sensor
    spots = len(laser)
    return Capture(
        counts=rng.poisson(3, (spots, 17)).astype(np.uint16),
        laser=laser,
        sensor=sensor,
        laser_normal=np.tile([0.0, 0.0, 1.0], (spots, 1)),
        sensor_normal=np.tile([0.0, 0.0, 1.0], (spots, 1)),
        bin_length=0.0047966793,
        t_start=-0.31415926535,
        gate=(2, 15),
        scan_shape=shape,
        scan_order=rng.permutation(spots),
        exposure_s=0.125,
        provenance={"source": "lab", "note": 'quotes ", colons: and ü', "steps": ["made by hand"]},
    )


KINDS = [
    ("confocal", 1), ("single_laser", 1), ("single_sensor", 2), ("exhaustive", 2), ("paired_grids", 1),
    ("irregular_confocal", 3), ("irregular_single", 3), ("irregular_single_sensor", 3),
    ("irregular_pairs", 3), ("irregular_product", 4), ("one_spot", 1),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "h_format"), KINDS)
def test_round_trip_is_lossless(tmp_path, kind, h_format):
    capture = _capture(kind)
    path = write_capture(tmp_path / "a.hdf5", capture)
    back = read_capture(path)
    for field in dataclasses.fields(Capture):
        value, other = getattr(capture, field.name), getattr(back, field.name)
        if isinstance(value, np.ndarray):
            assert value.dtype == other.dtype, field.name
            np.testing.assert_array_equal(value, other, err_msg=field.name)
        else:
            assert value == other, field.name
    with h5py.File(path) as file:
        assert set(file) == TAL_KEYS
        assert not list(file.attrs)
        assert file["H_format"][()].tolist() == [h_format]
        kinds = {
            "H": "float32",
            "H_format": "int32",
            "delta_t": "float64",
            "t_start": "float64",
            "laser_grid_format": "int32",
        }
        assert {name: file[name].dtype.name for name in kinds} == kinds
        assert file["t_accounts_first_and_last_bounces"][()] == np.bool_(False)
        assert file["H"].shape[0] == 17


def test_what_was_not_recorded_survives_a_round_trip(tmp_path):
    whole = _capture("exhaustive")
    observed = np.random.default_rng(4).random(whole.counts.shape) < 0.8
    capture = dataclasses.replace(whole, counts=whole.counts * observed, observed=observed)
    path = write_capture(tmp_path / "a.hdf5", capture)
    np.testing.assert_array_equal(read_capture(path).observed, observed)
    with h5py.File(path) as file:
        assert set(file) == TAL_KEYS | {"nlos_lit_observed"}
        assert file["nlos_lit_observed"].shape == file["H"].shape
        np.testing.assert_array_equal(file["nlos_lit_observed"][:, 2, 1, 0, 3], observed[43])
    moved = read_capture(path, options=ReaderOptions(exposure_s=2.0))
    np.testing.assert_array_equal(moved.observed, observed)
    assert read_capture(path, options=ReaderOptions(observed="all")).observed is None
    with h5py.File(path, "r+") as file:
        file["nlos_lit_observed"][0, 0, 0, 0, 0] = 2
    with pytest.raises(CaptureError, match=r"nlos_lit_observed in a.hdf5 must be 0 or 1 for each value of H"):
        read_capture(path)


@pytest.mark.parametrize(
    ("values", "said", "counts"),
    [(3.0, None, True), (3.5, None, False), (3.0, False, False), (3.5, True, True)],
)
def test_whole_numbers_are_counts_unless_the_user_says_otherwise(tmp_path, values, said, counts):
    path = files.ytal(tmp_path, H=np.full((60, 3, 2), values, dtype=np.float32))
    capture = read_capture(path, options=ReaderOptions(counts=said))
    assert capture.is_counts == counts
    assert any("as asked" in step for step in capture.provenance["steps"]) == (said is not None)


def test_the_written_array_has_tals_axes(tmp_path):
    capture = _capture("exhaustive")
    with h5py.File(write_capture(tmp_path / "a.hdf5", capture)) as file:
        assert file["H"].shape == (17, 3, 2, 2, 4)
        spot = ((2 * 2 + 1) * 2 + 0) * 4 + 3
        np.testing.assert_array_equal(file["H"][:, 2, 1, 0, 3], capture.counts[spot])
        np.testing.assert_array_equal(file["laser_grid_xyz"][2, 1], capture.laser[spot])
        np.testing.assert_array_equal(file["sensor_grid_xyz"][0, 3], capture.sensor[spot])


def test_scene_info_is_yaml_that_a_safe_loader_reads(tmp_path):
    import yaml

    with h5py.File(write_capture(tmp_path / "a.hdf5", _capture("confocal"))) as file:
        facts = yaml.safe_load(file["scene_info"][()].decode())["nlos_lit"]
    assert facts["provenance"]["note"] == 'quotes ", colons: and ü'
    assert facts["gate"] == [2, 15]


def test_nothing_is_overwritten_or_left_behind(tmp_path):
    path = write_capture(tmp_path / "a.hdf5", _capture("confocal"))
    before = path.read_bytes()
    with pytest.raises(CaptureError, match="exists already"):
        write_capture(path, _capture("exhaustive"))
    assert path.read_bytes() == before
    write_capture(path, _capture("exhaustive"), overwrite=True)
    assert read_capture(path).kind == "exhaustive"
    with pytest.raises(CaptureError, match="JSON"):
        write_capture(
            tmp_path / "b.hdf5", dataclasses.replace(_capture("confocal"), provenance={"bad": {1, 2}})
        )
    with pytest.raises(CaptureError, match="cannot write"):
        write_capture(tmp_path / "no_folder" / "b.hdf5", _capture("confocal"))
    assert [file.name for file in tmp_path.iterdir()] == ["a.hdf5"]


def test_counts_beyond_float32_are_refused(tmp_path):
    capture = _capture("confocal")
    counts = capture.counts.astype(np.uint32)
    counts[0, 0] = 2**24 + 1
    with pytest.raises(CaptureError, match="16777216"):
        write_capture(tmp_path / "a.hdf5", dataclasses.replace(capture, counts=counts))


def test_options_apply_to_our_own_files(tmp_path):
    path = write_capture(tmp_path / "a.hdf5", _capture("confocal"))
    moved = read_capture(path, options=ReaderOptions(gate=(1, 9), exposure_s=3.0))
    assert (moved.gate, moved.exposure_s) == ((1, 9), 3.0)
    assert moved.provenance["steps"] == ["made by hand", "gate [1, 9) as asked"]
    assert moved.provenance["source"] == "lab"
    with pytest.raises(CaptureError, match="raw_scale"):
        read_capture(path, options=ReaderOptions(raw_scale=True))


@pytest.mark.parametrize("edit", ['{"dtype": "object"}', "{", "[]", "null", '{"gate": 1}'])
def test_altered_facts_are_refused(tmp_path, edit):
    with pytest.raises(CaptureError, match="scene_info"):
        read_capture(files.ytal(tmp_path, scene_info=f"nlos_lit: {edit}\n"))


def altered(path, values=None, **changes) -> None:
    """Other facts, and other values of the first spot's first bins, in a file that we wrote."""
    with h5py.File(path, "r+") as file:
        facts = json.loads(file["scene_info"][()].decode().removeprefix("nlos_lit: "))
        del file["scene_info"]
        file["scene_info"] = "nlos_lit: " + json.dumps({**facts, **changes})
        if values is not None:
            file["H"][: len(values), 0, 0] = values


@pytest.mark.parametrize(
    ("values", "changes", "sentence"),
    [
        (None, {"dtype": "object"}, "scene_info"),
        ([300], {"dtype": "uint8"}, "holds 0 to 300, which uint8 does not hold"),
        ([-1], {"dtype": "uint32"}, "holds -1 to .*, which uint32 does not hold"),
        ([2.0**64], {"dtype": "uint64"}, "which uint64 does not hold"),
        ([1e6], {"dtype": "float16"}, "which float16 does not hold"),
        ([0.3], {}, "which uint16 does not hold"),
        ([0.3], {"dtype": "float32"}, "no whole numbers where scene_info says photon counts"),
        (None, {"is_counts": 0.3}, "scene_info"),
        (
            None,
            {"exposure_s": float("nan")},
            "exposure_s must be a positive .*; found nan",
        ),
        (None, {"exposure_s": -2}, "exposure_s must be a positive .*; found -2"),
        (None, {"exposure_s": 10**400}, "exposure_s must be a positive .*; found 10000"),
        (None, {"scan_shape": [2, 3]}, r"spots \(3, 2\) where scan_shape \(2, 3\)"),
        (None, {"scan_shape": None}, r"spots \(3, 2\) where scan_shape None"),
        (None, {"gate": [2, 18]}, "gate"),
        (None, {"scan_order": [0, 0, 1, 2, 3, 4]}, "scan_order must be a permutation"),
    ],
)
def test_facts_that_the_arrays_contradict_are_refused(tmp_path, values, changes, sentence):
    path = write_capture(tmp_path / "a.hdf5", _capture("confocal"))
    altered(path, values, **changes)
    with pytest.raises(CaptureError, match=sentence):
        read_capture(path)


def test_values_that_are_no_whole_numbers_are_not_written_as_counts(tmp_path):
    capture = _capture("confocal")
    with pytest.raises(CaptureError, match="whole numbers"):
        write_capture(tmp_path / "a.hdf5", capture.with_counts(capture.counts / 2))


def test_first_and_last_way_are_taken_off_by_whole_bins(tmp_path):
    # from (0, 0, 0.3) to (±0.4, 0, 0): 0.5 m, twice; to (0, 0, 0): 0.3 m, twice
    grid = np.array([[[-0.4, 0, 0]], [[0, 0, 0]], [[0.4, 0, 0]]], dtype=np.float32)
    values = np.ones((200, 3, 1), dtype=np.float32)
    values[130, 2, 0] = 9  # path 1.3 + half a bin, less 1.0
    values[130, 1, 0] = 7  # path 1.3 + half a bin, less 0.6
    normals = np.broadcast_to(np.array([0.0, 0.0, 1.0]), grid.shape)
    changes = {"H": values, "t_start": 0.0, "t_accounts_first_and_last_bounces": np.bool_(True)}
    changes |= {
        f"{name}_grid_{part}": v
        for name in ("laser", "sensor")
        for part, v in (("xyz", grid), ("normals", normals))
    }
    capture = read_capture(files.ytal(tmp_path, **changes))
    assert capture.n_bins == 100
    for value, path, x in ((9, 0.305, 0.4), (7, 0.705, 0.0)):
        spot, bin_ = np.argwhere(capture.counts == value)[0]
        assert capture.t_start + (bin_ + 0.5) * 0.01 == pytest.approx(path, abs=1e-6)
        assert capture.laser[spot, 0] == pytest.approx(x)
    assert any("took 60 to 100 bins" in step for step in capture.provenance["steps"])


def test_rounding_of_the_first_and_last_way_is_told_and_small(tmp_path):
    values = files.cube((120, 3, 2), (90, 2, 0), np.float32)
    path = files.ytal(
        tmp_path, H=values, t_accounts_first_and_last_bounces=np.bool_(True), t_start=0.0, delta_t=0.013
    )
    capture = read_capture(path)
    bin_ = np.argwhere(capture.counts == files.BRIGHT)[0, 1]
    way = 2 * np.linalg.norm([0.2, -0.1, -0.3])
    assert capture.t_start + (bin_ + 0.5) * 0.013 == pytest.approx(90.5 * 0.013 - way, abs=0.013)
    assert "whole bins" in capture.provenance["steps"][0]


TAL = "args:\n  command: render\nconfig:\n  bin_width_opl: 0.01\ntal_version: 0.20.0\n"


@pytest.mark.parametrize(
    ("text", "asked", "corrected"),
    [
        (TAL, None, True),
        (TAL, False, False),
        ("name: spot\n", None, False),
        ("name: spot\n", True, True),
        ("# tal_version: 1\n", None, False),
    ],
)
def test_tals_raw_scale(tmp_path, text, asked, corrected):
    capture = read_capture(files.ytal(tmp_path, scene_info=text), options=ReaderOptions(raw_scale=asked))
    # the laser at (0, 0, 0.3) and the bright spot at (0.2, -0.1): d² = 0.14, cos = 0.3/√0.14, so π·cos/d² =
    # 17.99
    assert capture.counts.max() == pytest.approx(9 / 17.99 if corrected else 9, rel=1e-3)
    assert any("raw scale" in step for step in capture.provenance["steps"]) == corrected


def test_raw_scale_needs_the_laser(tmp_path):
    with pytest.raises(CaptureError, match="laser_xyz"):
        read_capture(files.ytal(tmp_path, scene_info=TAL, laser_xyz=h5py.Empty(np.float64)))


def test_huge_scene_info_with_python_tags_is_not_parsed(tmp_path):
    tagged = "bomb: !!python/object/apply:os.system ['touch pwned']\n" + "x: [1.0, 2.0, 3.0]\n" * 500_000
    capture = read_capture(files.ytal(tmp_path, scene_info=tagged))
    assert "scene_info" not in capture.provenance
    assert capture.counts.max() == files.BRIGHT


def test_a_wall_that_faces_elsewhere_is_turned(tmp_path):
    # wall in the plane x = 0 facing +x, y up: seen from the wall the file's -z is to the left, which is our
    # +x
    grid = np.stack(np.meshgrid([0.0], [-0.1, 0.1], [-0.2, 0.0, 0.2], indexing="ij"), axis=-1)[0].astype(
        np.float32
    )
    normals = np.broadcast_to(np.array([1.0, 0.0, 0.0]), grid.shape)
    changes = {
        f"{name}_grid_{part}": v
        for name in ("laser", "sensor")
        for part, v in (("xyz", grid), ("normals", normals))
    }
    capture = read_capture(files.ytal(tmp_path, H=files.cube((60, 2, 3), (33, 0, 2), np.float32), **changes))
    spot = int(np.argmax(capture.counts.max(axis=1)))
    np.testing.assert_allclose(capture.laser[spot], (-0.2, -0.1, 0.0), atol=1e-7)
    np.testing.assert_allclose(capture.laser_normal, np.tile([0.0, 0.0, 1.0], (6, 1)), atol=1e-12)
    assert capture.scan_shape == (3, 2)


def test_irregular_spots(tmp_path):
    rng = np.random.default_rng(0)
    laser, sensor = rng.random((2, 3)), rng.random((4, 3))
    normals = {
        f"{name}_grid_normals": np.tile([0, 0, 1], (len(p), 1))
        for name, p in (("laser", laser), ("sensor", sensor))
    }
    values = rng.random((60, 2, 4)).astype(np.float32)
    path = files.ytal(
        tmp_path,
        H=values,
        H_format=np.array([4], np.int32),
        laser_grid_xyz=laser,
        sensor_grid_xyz=sensor,
        **normals,
    )
    capture = read_capture(path)
    assert (capture.kind, capture.scan_shape, capture.n_spots) == ("irregular", None, 8)
    np.testing.assert_array_equal(capture.counts[4 + 3], values[:, 1, 3])
    np.testing.assert_array_equal(capture.laser[7], laser[1])
    np.testing.assert_array_equal(capture.sensor[7], sensor[3])
