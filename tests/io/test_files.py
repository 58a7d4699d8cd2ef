"""Files of results: exact round trips, files other programs open, nothing half-written."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.files import plain, whole_file, write_json
from nlos_lit.io.points import Points, grey_levels, read_points, write_points
from nlos_lit.io.volumes import read_volume, write_volume

GRID = VolumeGrid(origin=(-0.3, -0.2, 0.5), pitch=(0.1, 0.05, 0.02), shape=(2, 3, 4))


def three_points() -> Points:
    return Points(
        positions=np.array([[0.1, -0.2, 0.7], [0.0, 0.25, 0.5], [-0.3, 0.0, 1.25]]),
        normals=np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, -0.6, -0.8]]),
        albedo=np.array([0.25, 0.5, 1.0]),
        intensity=np.array([3.0, 2.0, 0.5]),
    )


def test_volume_round_trip(tmp_path):
    volume = np.arange(24, dtype=np.float32).reshape(GRID.shape)
    write_volume(tmp_path / "new" / "volume.h5", volume, GRID, albedo=volume * 0.5)
    back, grid, extras = read_volume(tmp_path / "new" / "volume.h5")
    np.testing.assert_array_equal(back, volume)
    assert grid == GRID
    assert list(extras) == ["albedo"]
    np.testing.assert_array_equal(extras["albedo"], volume * 0.5)


def test_volume_file_explains_itself(tmp_path):
    write_volume(tmp_path / "v.h5", np.zeros(GRID.shape), GRID)
    with h5py.File(tmp_path / "v.h5") as file:
        np.testing.assert_allclose(file["x"][()], [-0.3, -0.2, -0.1])
        np.testing.assert_allclose(file["y"][()], [-0.2, -0.15, -0.1, -0.05])
        np.testing.assert_allclose(file["z"][()], [0.5, 0.52])
        assert {file[name].attrs["unit"] for name in "xyz"} == {"m"}
        assert file["volume"].attrs["axes"] == "z, x, y"


def test_a_volume_of_another_shape_than_its_grid_is_refused(tmp_path):
    with pytest.raises(ValueError, match="albedo has shape"):
        write_volume(tmp_path / "v.h5", np.zeros(GRID.shape), GRID, albedo=np.zeros((3, 4, 2)))
    assert list(tmp_path.iterdir()) == []


def test_a_volume_with_a_nan_is_no_result(tmp_path):
    volume = np.ones(GRID.shape)
    volume[1, 1, 1] = np.nan
    with pytest.raises(UserError, match="1 of 24 voxels of the albedo are NaN or infinite"):
        write_volume(tmp_path / "v.h5", np.ones(GRID.shape), GRID, albedo=volume)
    assert list(tmp_path.iterdir()) == []


def test_reading_what_is_no_volume(tmp_path):
    (tmp_path / "text.h5").write_text("not HDF5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["H"] = [1.0]
    with h5py.File(tmp_path / "flat.h5", "w") as file:
        file["volume"] = [1.0]
        file.attrs["origin"] = file.attrs["pitch"] = (0.0, 0.0, 1.0)
    for name in ("missing", "text", "other", "flat"):
        with pytest.raises(UserError, match="volume"):
            read_volume(tmp_path / f"{name}.h5")


def test_points_round_trip(tmp_path):
    points = three_points()
    write_points(tmp_path / "points.ply", points)
    back = read_points(tmp_path / "points.ply")
    for field in dataclasses.fields(Points):
        np.testing.assert_allclose(getattr(back, field.name), getattr(points, field.name), atol=1e-7)
    assert read_points(_written(tmp_path, dataclasses.replace(points, intensity=None))).intensity is None


def _written(folder: Path, points: Points) -> Path:
    write_points(folder / "other.ply", points)
    return folder / "other.ply"


def test_no_points_make_a_readable_file(tmp_path):
    empty = Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert len(read_points(_written(tmp_path, empty))) == 0


def test_open3d_opens_the_points(tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    points = three_points()
    write_points(tmp_path / "points.ply", points)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "points.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), points.positions, atol=1e-7)
    np.testing.assert_allclose(np.asarray(cloud.normals), points.normals, atol=1e-7)
    white = 0.98  # 98th percentile of (0.25, 0.5, 1): 96 % of the way from 0.5 to 1
    np.testing.assert_allclose(
        np.asarray(cloud.colors), np.repeat([[0.25 / white], [0.5 / white], [1.0]], 3, axis=1), atol=1 / 510
    )
    exact = open3d.t.io.read_point_cloud(str(tmp_path / "points.ply")).point
    np.testing.assert_array_equal(exact["albedo"].numpy().ravel(), points.albedo.astype(np.float32))
    np.testing.assert_array_equal(exact["intensity"].numpy().ravel(), points.intensity.astype(np.float32))


def test_grey_levels_of_nothing_and_of_black():
    assert grey_levels(np.zeros(0)).shape == (0,)
    np.testing.assert_array_equal(grey_levels(np.zeros(3)), 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normals": np.zeros((3, 3))}, "unit vectors"),
        ({"normals": np.ones((2, 3))}, r"normals must be \[3, 3\]"),
        ({"albedo": np.array([0.1, np.nan, 0.2])}, "albedo of the points holds NaN"),
        ({"intensity": np.ones((3, 1))}, "intensity must be"),
    ],
)
def test_points_check_themselves(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(three_points(), **change)


def test_damaged_point_files(tmp_path):
    whole = _written(tmp_path, three_points()).read_bytes()
    start = whole.index(b"end_header\n") + len(b"end_header\n")
    nan = np.array([np.nan], "<f4").tobytes()
    damaged = {
        "cut": (whole[:-1], "is cut"),
        "no header end": (whole[:100], "not a binary"),
        "text": (b"x y z\n", "not a binary"),
        "ascii": (whole.replace(b"binary_little_endian", b"ascii"), "not a binary"),
        "no albedo": (whole.replace(b"float albedo", b"float colour"), "x, y, z, nx, ny, nz and albedo"),
        "twice": (whole.replace(b"float ny", b"float nx"), "x, y, z, nx, ny, nz and albedo"),
        "list": (
            whole.replace(b"property float nx", b"property list uchar int nx"),
            "x, y, z, nx, ny, nz and albedo",
        ),
        "count": (whole.replace(b"vertex 3", b"vertex -3"), "x, y, z, nx, ny, nz and albedo"),
        "NaN": (whole[:start] + nan + whole[start + 4 :], "is damaged"),
    }
    for name, (content, message) in damaged.items():
        path = tmp_path / f"{name}.ply"
        path.write_bytes(content)
        with pytest.raises(UserError, match=message):
            read_points(path)
    with pytest.raises(UserError, match="cannot read"):
        read_points(tmp_path / "missing.ply")


def test_an_interrupt_leaves_the_old_file(tmp_path):
    target = tmp_path / "result.json"
    target.write_text("old")

    def interrupted():
        with whole_file(target) as partial:
            partial.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_json_is_strict_and_plain(tmp_path):
    data = {
        "points": three_points(),
        "n": np.int64(3),
        "bad": [float("nan"), np.float32("inf")],
        "path": Path("a/b"),
        4: (True, None),
    }
    write_json(tmp_path / "summary.json", data)
    back = json.loads((tmp_path / "summary.json").read_text(), parse_constant=pytest.fail)
    assert back["points"]["albedo"] == [0.25, 0.5, 1.0]
    assert back["n"] == 3
    assert back["bad"] == [None, None]
    assert back["path"] == "a/b"
    assert back["4"] == [True, None]


def test_json_refuses_what_it_cannot_say(tmp_path):
    with pytest.raises(TypeError, match="object has no JSON form"):
        write_json(tmp_path / "summary.json", {"a": object()})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(TypeError, match="type has no JSON form"):
        plain(Points)


def test_export_needs_no_open3d():
    code = (
        "import sys, nlos_lit.io.files, nlos_lit.io.meshes, nlos_lit.report.figures, "
        "nlos_lit.training.summary; sys.exit('open3d' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
