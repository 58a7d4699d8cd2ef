"""Bad files: one sentence each, whatever is wrong, and never a changed file."""

import pickle
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import reader_files as files
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from data_modules.readers import ReaderOptions, detect_format, read_capture
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

OPTIONS = {"tsai": ReaderOptions(bin_width_ps=10.0), "cube": ReaderOptions(bin_width_ps=10.0, wall_size=0.8)}
QUICK = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def _outcome(path: Path, options: ReaderOptions | None = None) -> str:
    """What reading comes to: a `Capture`, or a `CaptureError` of one sentence.

    There is no other way out, and the file stays as it is.
    """
    before = path.read_bytes()
    sentence = None
    try:
        assert isinstance(read_capture(path, options=options), Capture)
    except CaptureError as error:
        sentence = str(error)
    assert path.read_bytes() == before
    assert sentence is None or (sentence and "\n" not in sentence)
    return "read" if sentence is None else "refused"


@pytest.fixture(scope="module")
def valid() -> dict[str, bytes]:
    held = {}
    for name, write in files.WRITERS.items():
        with tempfile.TemporaryDirectory() as folder:
            held[name] = write(Path(folder)).read_bytes()
    return held


def _in_place(folder: Path, name: str) -> Path:
    return files.WRITERS[name](folder)


@pytest.mark.parametrize("name", files.WRITERS)
def test_reading_changes_no_file(tmp_path, name):
    assert _outcome(_in_place(tmp_path, name), options=OPTIONS.get(name)) == "read"


@QUICK
@given(
    data=st.binary(max_size=600),
    head=st.sampled_from([b"", b"\x89HDF\r\n\x1a\n", b"#?RADIANCE\n\n-Y 8 +X 8\n", b"\x00\x00\x00\x18ftyp"]),
)
def test_random_bytes(data, head):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        path.write_bytes(head + data)
        assert _outcome(path) in ("read", "refused")


@QUICK
@given(data=st.binary(min_size=8, max_size=600))
def test_random_bytes_behind_a_matlab_header(data):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.mat"
        path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + data)
        assert _outcome(path) == "refused"


@pytest.mark.parametrize("name", files.WRITERS)
@QUICK
@given(share=st.floats(0, 0.999))
def test_truncated_files(valid, name, share):
    with tempfile.TemporaryDirectory() as folder:
        path = _in_place(Path(folder), name)
        path.write_bytes(valid[name][: int(share * len(valid[name]))])
        assert _outcome(path, options=OPTIONS.get(name)) in ("read", "refused")


@pytest.mark.parametrize("name", files.WRITERS)
@QUICK
@given(data=st.data())
def test_mutated_files(valid, name, data):
    held = bytearray(valid[name])
    for _ in range(data.draw(st.integers(1, 6))):
        held[data.draw(st.integers(0, len(held) - 1))] = data.draw(st.integers(0, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = _in_place(Path(folder), name)
        path.write_bytes(bytes(held))
        assert _outcome(path, options=OPTIONS.get(name)) in ("read", "refused")


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("name", files.WRITERS)
def test_a_file_cut_short_is_refused(tmp_path, valid, name, share):
    path = _in_place(tmp_path, name)
    path.write_bytes(valid[name][: int(share * len(valid[name]))])
    assert _outcome(path, options=OPTIONS.get(name)) == "refused"


def test_no_file_and_folders(tmp_path):
    with pytest.raises(CaptureError, match="there is no file"):
        read_capture(tmp_path / "nothing.mat")
    with pytest.raises(CaptureError, match="folder"):
        read_capture(tmp_path)
    (tmp_path / "empty.hdf5").touch()
    with pytest.raises(CaptureError, match="is empty"):
        read_capture(tmp_path / "empty.hdf5")


def test_wrong_keys_are_listed_beside_what_is_known(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"histogram": np.ones((3, 4, 5)), "bins": 5})
    with pytest.raises(
        CaptureError, match=r"histogram 3×4×5, bins 1×1.*lct: rect_data \[nx, ny, T\] and width"
    ):
        detect_format(tmp_path / "a.mat")


def test_a_pickle_is_not_opened(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "pwned",))

    (tmp_path / "a.hdf5").write_bytes(pickle.dumps(Bomb()))
    np.save(tmp_path / "b.npy", np.array([Bomb()], dtype=object), allow_pickle=True)
    for name in ("a.hdf5", "b.npy"):
        assert _outcome(tmp_path / name) == "refused"
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (np.full((4, 2, 30), np.nan), "NaN"),
        (np.full((4, 2, 30), np.inf), "infinite"),
        (-np.ones((4, 2, 30)), "negative"),
        (np.zeros((4, 2, 30)), "every count is zero"),
        (np.ones((4, 2)), "lct: rect_data"),
        (np.ones((4, 2, 0)), "is empty"),
        (np.ones((4, 2, 30)) * 1j, "real numbers|lct: rect_data"),
        (np.array([["text"]], dtype=object), "lct: rect_data"),
    ],
)
def test_unusable_counts(tmp_path, values, sentence):
    scipy.io.savemat(tmp_path / "a.mat", {"rect_data": values, "width": 0.35})
    with pytest.raises(CaptureError, match=sentence):
        read_capture(tmp_path / "a.mat")


@pytest.mark.parametrize("width", [0.0, -0.3, np.nan, np.ones(3)])
def test_an_unusable_wall(tmp_path, width):
    scipy.io.savemat(tmp_path / "a.mat", {"rect_data": np.ones((4, 2, 30)), "width": width})
    with pytest.raises(CaptureError, match="width"):
        read_capture(tmp_path / "a.mat")


@pytest.mark.parametrize(
    "changes",
    [
        {"H": np.ones((60, 3, 3), np.float32)},
        {"H": np.ones((60, 6), np.float32)},
        {"H": np.ones((0, 3, 2), np.float32)},
        {"H": np.array([b"x"])},
        {"H_format": np.array([7], np.int32)},
        {"delta_t": 0.0},
        {"delta_t": np.nan},
        {"delta_t": np.ones(4)},
        {"delta_t": None},
        {"sensor_grid_xyz": np.full((3, 2, 3), np.nan, np.float32)},
        {"sensor_grid_xyz": np.ones((3, 2))},
        {"sensor_grid_normals": np.zeros((3, 2, 3))},
        {"sensor_grid_normals": np.ones((2, 3, 3))},
        {"laser_grid_xyz": np.ones((2, 2, 3))},
        {"t_accounts_first_and_last_bounces": np.bool_(True), "laser_xyz": h5py.Empty(np.float64)},
        {"t_accounts_first_and_last_bounces": np.bool_(True), "delta_t": 1e-4},
    ],
    ids=lambda changes: "-".join(changes),
)
def test_unusable_ytal(tmp_path, changes):
    assert _outcome(files.ytal(tmp_path, **changes)) == "refused"


def test_a_claim_larger_than_the_file_can_hold_is_refused_before_it_is_read(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.create_dataset("H", shape=(4096, 4096, 4096), dtype="f4", chunks=(64, 64, 64))
        file["delta_t"] = 0.01
        file["sensor_grid_xyz"] = np.zeros((4, 4, 3))
        file["laser_grid_xyz"] = np.zeros((4, 4, 3))
    with pytest.raises(CaptureError, match="claims 274878 MB"):
        read_capture(tmp_path / "a.hdf5")


def test_links_out_of_the_file_are_not_followed(tmp_path):
    files.ytal(tmp_path)
    with h5py.File(tmp_path / "b.hdf5", "w") as file:
        for name in ("H", "delta_t", "sensor_grid_xyz", "laser_grid_xyz"):
            file[name] = h5py.ExternalLink(str(tmp_path / "capture.hdf5"), name)
    assert _outcome(tmp_path / "b.hdf5") == "refused"


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"\x89PNG\r\n\x1a\n" + bytes(64), "a PNG picture"),
        (b"\xff\xd8\xff\xe0" + bytes(64), "a JPEG picture"),
        (b"x,y,counts\n1,2,3\n", "a text file"),
        (b"\x93NUMPY\x01\x00", "a NumPy array without geometry"),
        (bytes(range(1, 60)), "neither HDF5, MATLAB nor Radiance HDR: it begins with"),
    ],
)
def test_what_is_no_capture_at_all_is_called_by_its_name(content, kind, tmp_path):
    (tmp_path / "other").write_bytes(content)
    with pytest.raises(CaptureError, match=f"other is {kind}.*; a capture is an HDF5, MATLAB or Radiance"):
        read_capture(tmp_path / "other")


def test_a_video_is_told_from_a_capture(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"\x00\x00\x00\x18ftypmp42" + bytes(64))
    with pytest.raises(CaptureError, match="video"):
        read_capture(tmp_path / "video.mp4")


@pytest.mark.parametrize(
    "values",
    [
        {"bin_width_ps": 0.0},
        {"bin_width_ps": np.nan},
        {"wall_size": -1.0},
        {"wall_size": (1.0, 2.0, 3.0)},
        {"t_start": np.inf},
        {"gate": (1, 2, 3)},
        {"gate": "ab"},
        {"bin_width_ps": "4 ps"},
        {"wall_size": "ab"},
    ],
)
def test_impossible_options(values):
    with pytest.raises(CaptureError):
        ReaderOptions(**values)


def test_delays_that_leave_nothing(tmp_path):
    with pytest.raises(CaptureError, match="leave nothing"):
        read_capture(files.fk(tmp_path), options=ReaderOptions(bin_width_ps=0.5))
    files.matlab73(
        tmp_path / "scene.mat", {"meas": files.cube((2, 4, 64), (1, 0, 40)), "tofgrid": np.zeros((3, 4))}
    )
    with pytest.raises(CaptureError, match="tofgrid"):
        read_capture(tmp_path / "scene.mat")
