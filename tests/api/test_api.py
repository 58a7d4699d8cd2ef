"""From a file to a picture in Python: load, plan, reconstruct, show, save."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

import nlos_lit
from nlos_lit.api.measurement import Measurement, quoted
from nlos_lit.api.results import Picture, Surface
from nlos_lit.capture.errors import CaptureError, UserError
from nlos_lit.commands.simulate import simulate
from nlos_lit.io.points import read_points
from nlos_lit.io.volumes import read_volume


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A small confocal capture of the embedded scene; its name needs quotes."""
    path = tmp_path_factory.mktemp("own") / "our lab's.hdf5"
    simulate([f"out={path}", "nx=16", "ny=16", "bin_length=0.01", "n_bins=256", "mean_counts=2000"])
    return path


@pytest.fixture(scope="module")
def measured(file):
    return nlos_lit.load(file)


def test_a_file_tells_of_itself(measured):
    assert isinstance(measured, Measurement)
    assert measured.name == "our_lab_s"
    assert measured.capture.n_spots == 256
    assert "photon counts" in str(measured)
    near, far = measured.plan().depth
    assert 0.2 < near < 0.7 < far < 1.5  # the scene lies 0.5 to 0.9 m away


def test_a_picture_shows_and_saves_itself(measured, tmp_path):
    picture = measured.reconstruct("lct")
    assert isinstance(picture, Picture)
    assert picture.values.max() == pytest.approx(1)
    shown = picture._repr_html_()
    assert "our_lab_s by lct" in shown
    assert "data:image/png;base64," in shown
    depth = picture.depth
    assert depth.shape == picture.values.shape[1:]
    assert 0.4 < np.nanmedian(depth) < 1.0
    folder = picture.save(tmp_path / "saved")
    values, grid, _ = read_volume(folder / "volume.h5")
    np.testing.assert_allclose(values, picture.values, atol=1e-6)
    assert grid == picture.grid
    assert len(read_points(folder / "points.ply")) == len(picture.points)
    assert (folder / "volume.png").stat().st_size > 10_000


def test_settings_are_those_of_the_commands(measured):
    picture = measured.reconstruct("phasor", "scene.volume.depth=[0.5,0.8]")
    assert (picture.grid.z[0], picture.grid.z[-1]) == (pytest.approx(0.5), pytest.approx(0.8, abs=0.02))
    with pytest.raises(UserError, match=r"did you mean scene\.volume\.depth\b"):
        measured.reconstruct("lct", "scene.volume.dept=[0.5,0.8]")
    with pytest.raises(UserError, match="there is no method 'ltc'; did you mean"):
        measured.reconstruct("ltc")
    with pytest.raises(UserError, match="spans depths of 50 to 60 m, and light comes back from"):
        measured.reconstruct("lct", "scene.volume.depth=[50,60]")
    with pytest.raises(CaptureError, match="outside the capture's time window"):
        measured.reconstruct("lct", "scene.volume.depth=[50,60]", "force=true")


def test_surfels_are_fitted(measured, tmp_path):
    small = ("model.rays=16", "surfels.rounds=1", "surfels.steps=4", "surfels.more=0", "surfels.max_seeds=60")
    small = (*small, "surfels.subdivide=1", "surfels.quadrature=1", "surfels.batch=8", "surfels.contest=0")
    surface = measured.reconstruct("surfels", *small)
    assert isinstance(surface, Surface)
    assert "surfels in" in surface.sentence
    assert "held-out NMSE" in surface.sentence
    folder = surface.save(tmp_path / "surface")
    assert len(read_points(folder / "points.ply")) == len(surface.points) > 0


def test_a_result_is_shown_in_the_systems_viewer(measured, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr("nlos_lit.api.results.webbrowser.open", opened.append)
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    measured.reconstruct("lct").show()
    assert opened[0].startswith("file:///")
    assert "our_lab_s by lct" in capsys.readouterr().out


def test_paths_are_quoted():
    assert quoted("plain/file-1.mat") == "plain/file-1.mat"
    assert quoted("a b=c.mat") == "'a b=c.mat'"


def test_importing_the_package_is_quick():
    code = "import sys, nlos_lit; print(*{n.split('.')[0] for n in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not set(done.stdout.split()) & {"torch", "numpy", "h5py", "matplotlib", "hydra"}
