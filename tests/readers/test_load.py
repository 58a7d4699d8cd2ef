"""From a scene's config to its capture."""

from __future__ import annotations

import hashlib
import http.server
import threading

import numpy as np
import pytest
from conftest import real_file
from small_capture import fields

import nlos_lit
from data_modules import load, plan
from data_modules.examine import examine
from data_modules.load import find_file, load_scene
from data_modules.readers import write_capture
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.surface_truth import SurfaceTruth
from nlos_lit.training.configs import compose
from nlos_lit.training.outcome import albedo_regions


def scene(name: str = "default", *overrides: str) -> dict:
    return compose("train", [f"scene={name}", *overrides])["scene"]


SMALL = ("scene.simulate.scan.nx=6", "scene.simulate.scan.ny=4")


def test_the_embedded_scene_is_simulated_with_its_truth(tmp_path):
    capture, truth = load_scene(scene("default", *SMALL), tmp_path, seed=3)
    assert capture.scan_shape == (6, 4)
    again, _ = load_scene(scene("default", *SMALL), tmp_path, seed=3)
    other, _ = load_scene(scene("default", *SMALL), tmp_path, seed=4)
    assert np.array_equal(capture.counts, again.counts)
    assert not np.array_equal(capture.counts, other.counts)
    assert np.nanmin(truth.depth) == pytest.approx(0.5, abs=0.01)


def test_a_given_path_replaces_the_scenes_own_data_and_is_summed_and_gated(tmp_path):
    capture, _ = load_scene(scene("default", *SMALL), tmp_path, seed=0)
    write_capture(tmp_path / "x.hdf5", capture)
    changed = scene(
        "letters",
        f"scene.path={tmp_path}/x.hdf5",
        "scene.sum_bins=2",
        "scene.gate=[20,100]",
        "scene.sum_spots=2",
    )
    read, truth = load_scene(changed, tmp_path, seed=0)
    assert truth is None
    assert read.scan_shape == (3, 2)
    assert read.gate == (20, 100)
    assert read.counts.sum() == capture.counts.sum()
    assert read.bin_length == pytest.approx(2 * capture.bin_length)


def test_a_file_in_the_data_folder_is_found(tmp_path):
    (tmp_path / "data_s_u.mat").write_bytes(b"x")
    assert find_file(scene("su"), tmp_path) == tmp_path / "data_s_u.mat"
    with pytest.raises(
        UserError, match=r"needs data_diffuse_s.mat.*comes from the supplement of O'Toole.*scene.path=FILE"
    ):
        find_file(scene("diffuse_s"), tmp_path)


def test_a_file_is_read_once(tmp_path, monkeypatch):
    """Also where its data are planned for, and from Python."""
    capture, _ = load_scene(scene("default", *SMALL), tmp_path, seed=0)
    write_capture(tmp_path / "x.hdf5", capture)
    read = []
    own = load.read_capture
    monkeypatch.setattr(load, "read_capture", lambda *given, **more: read.append(1) or own(*given, **more))
    load_scene(scene("capture", f"scene.path={tmp_path}/x.hdf5"), tmp_path, seed=0)
    assert len(read) == 1
    measured = nlos_lit.load(tmp_path / "x.hdf5")
    measured.reconstruct("lct")
    measured.reconstruct("phasor", "scene.volume.depth=[0.4,0.9]")
    assert len(read) == 1, "what was read to look at it is what is reconstructed"
    measured.reconstruct("lct", "scene.reader.flip_x=true")
    assert len(read) == 2


def test_first_returns_are_worked_out_once(tmp_path, monkeypatch):
    capture, _ = load_scene(scene("default", *SMALL), tmp_path, seed=0)
    worked = []
    own = plan._returns
    monkeypatch.setattr(plan, "_returns", lambda of: worked.append(of) or own(of))
    examine(capture)
    plan.returns(capture)
    assert [of is capture for of in worked] == [True, False], "of the capture, and of its summed bins"


LOST = "the capture's largest value is .*what is computed of values"


@pytest.mark.parametrize(
    ("largest", "sentence"),
    [(1e38, r"the largest value of H in a\.hdf5 is 1e\+38; usual are"), (2e12, LOST), (1e-40, LOST)],
)
def test_values_that_no_sum_of_squares_holds_are_refused(tmp_path, largest, sentence):
    counts = np.full((12, 10), 1e-3 * largest)
    counts[0, 0] = largest
    write_capture(tmp_path / "a.hdf5", Capture(**fields(counts=counts, is_counts=False)))
    with pytest.raises(UserError, match=sentence):
        load_scene(scene("capture", f"scene.path={tmp_path}/a.hdf5"), tmp_path, seed=0)


def test_a_foreign_config_downloads_nothing(tmp_path, monkeypatch):
    def fetch(*_):
        raise AssertionError("an address of a stranger was asked")

    monkeypatch.setattr(load.pooch, "retrieve", fetch)
    theirs = {"file": "../../.bashrc", "origin": "", "url": "http://127.0.0.1:1/x", "sha256": "0" * 64}
    with pytest.raises(UserError, match=r"127\.0\.0\.1:1/x is no address of this project's own scenes"):
        find_file(scene("su") | {"source": theirs}, tmp_path / "a" / "b")
    assert scene("su")["source"] in load.shipped_sources()


def test_a_known_address_is_downloaded_and_its_checksum_checked(tmp_path, monkeypatch):
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "capture.bin").write_bytes(b"photons")

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, directory=str(tmp_path / "site"), **kwargs)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/capture.bin"
        known = scene("su") | {"source": {"file": "got.bin", "origin": "here", "url": url, "sha256": None}}
        known["source"]["sha256"] = hashlib.sha256(b"photons").hexdigest()
        monkeypatch.setattr(load, "shipped_sources", lambda: [known["source"]])
        assert find_file(known, tmp_path / "data").read_bytes() == b"photons"
        known["source"] |= {"file": "other.bin", "sha256": hashlib.sha256(b"electrons").hexdigest()}
        with pytest.raises(UserError, match=r"could not download .* put it at .*other.bin"):
            find_file(known, tmp_path / "data")
        assert not (tmp_path / "data" / "other.bin").exists()
        server.shutdown()


def test_albedo_regions_are_the_bright_and_the_dark_half():
    albedo = np.array([[1.0, 0.9, 0.3], [np.nan, 0.35, 0.0]])
    truth = SurfaceTruth(np.arange(2.0), np.arange(3.0), np.ones((2, 3)), None, albedo)
    bright, dark = albedo_regions(truth)
    assert bright.tolist() == [[True, True, False], [False, False, False]]
    assert dark.tolist() == [[False, False, True], [False, True, False]]
    plain = SurfaceTruth(np.arange(2.0), np.arange(3.0), np.ones((2, 3)), None, np.full((2, 3), 0.5))
    assert albedo_regions(plain) is None


def test_su_as_its_config_says():
    capture, _ = load_scene(scene("su", f"scene.path={real_file('measured/data_s_u.mat')}"), "data", seed=0)
    assert (capture.n_spots, capture.n_bins, capture.gate) == (4096, 512, (200, 512))
    assert capture.bin_width_ps == pytest.approx(16)


@pytest.mark.parametrize(
    ("name", "file", "path"),
    [("dot_chart", "data_dot_chart_65cm", 1.3), ("resolution_chart", "data_resolution_chart_40cm", 0.8)],
)
def test_charts_as_their_configs_say(name, file, path):
    """The mean transient in the gate rises within 5 cm of twice the distance in the file's name."""
    said = scene(name, f"scene.path={real_file(f'measured/{file}.mat')}")
    capture, _ = load_scene(said, "data", seed=0)
    first, last = capture.gate
    mean = capture.mean_transient()[first:last]
    rise = first + int(np.argmax(mean > (mean[:4].mean() + mean.max()) / 2))
    assert capture.observed is None
    assert capture.t_start + rise * capture.bin_length == pytest.approx(path, abs=0.05)
    near, far = said["volume"]["depth"]
    assert near < path / 2 < far


def test_figure_4_as_its_config_says():
    capture, _ = load_scene(scene("figure_4", f"scene.path={real_file('measured/figure_4')}"), "data", seed=0)
    assert capture.kind == "single_sensor"
    assert capture.bin_width_ps == pytest.approx(16)
    assert (~capture.observed[:, 300:499].any(axis=1)).sum() == 100


def test_the_readers_options_come_from_the_scene(tmp_path):
    capture, _ = load_scene(scene("default", *SMALL), tmp_path, seed=0)
    write_capture(tmp_path / "x.hdf5", capture)
    options = ("scene.reader.counts=false", "scene.reader.observed=all")
    read, _ = load_scene(scene("capture", f"scene.path={tmp_path}/x.hdf5", *options), tmp_path, seed=0)
    assert (read.is_counts, read.observed) == (False, None)


def test_a_render_with_its_truth():
    render, truth_file = real_file("rendered/z_confocal_64_d3.hdf5"), real_file("rendered/z_gt.h5")
    capture, truth = load_scene(
        scene("capture", f"scene.path={render}", f"scene.truth={truth_file}"), "data", seed=0
    )
    assert not capture.is_counts
    assert np.isfinite(truth.depth).any()
    assert np.nanmax(truth.depth) < 3
