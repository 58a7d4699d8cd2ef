"""What a run keeps to be looked at: thinned out evenly, summed exactly, honest about both."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from small_capture import NORMAL, fields

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.points import Points
from nlos_lit.io.views import read_view
from nlos_lit.training import explored
from nlos_lit.training.explored import Scene, chosen_spots, facts_of, keep, mark_interrupted, pooled, view_of


def scan(side: int, bins: int, **changes) -> Capture:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, side), np.linspace(-0.5, 0.5, side), indexing="ij")
    wall = np.stack([x.ravel(), y.ravel(), np.zeros(side**2)], axis=1)
    up = np.tile(NORMAL, (side**2, 1))
    counts = np.random.default_rng(0).poisson(3.0, (side**2, bins)).astype(np.uint16)
    given = dict(counts=counts, laser=wall, sensor=wall, laser_normal=up, sensor_normal=up, bin_length=0.01)
    return Capture(**(given | changes))


def test_a_small_capture_is_kept_whole():
    capture = Capture(**fields(gate=(2, 10)))
    view = view_of(capture, {}, Scene(), facts_of({"name": "small"}, capture, "running", ["begun"]))
    np.testing.assert_array_equal(view.spots, np.arange(12))
    np.testing.assert_array_equal(view.counts, capture.counts[:, 2:])
    assert view.path == pytest.approx((0.7, 0.1))  # 0.5 + 2 · 0.1
    assert view.facts["kept"]["spots"] == "12 of 12"
    assert view.facts["origin"]["capture"]["sha256"] == capture.digest()


def test_many_spots_and_bins_are_thinned_and_summed_alike():
    observed = np.ones((64**2, 600), dtype=bool)
    observed[0, 4] = False
    capture = scan(64, 600)
    capture = scan(64, 600, counts=np.where(observed, capture.counts, 0), observed=observed)

    def twice(spots: torch.Tensor) -> torch.Tensor:
        return 2 * torch.from_numpy(capture.counts[spots.numpy()].astype(np.float32))

    view = view_of(capture, {"twice": twice}, Scene(), facts_of({"name": "n"}, capture, "finished", []))
    assert len(view.spots) == 32**2
    assert len(np.unique(view.places[:, 0])) == len(np.unique(view.places[:, 1])) == 32
    assert view.counts.shape == (1024, 200)  # of three bins each
    assert np.isnan(view.counts[0, 1])
    assert np.isnan(view.counts).sum() == 1
    known = np.isfinite(view.counts)
    np.testing.assert_array_equal(view.models["twice"][known], 2 * view.counts[known])
    spot = view.spots[17]
    np.testing.assert_array_equal(view.counts[17], capture.counts[spot].reshape(200, 3).sum(1))
    assert view.path[1] == pytest.approx(0.03)


def test_irregular_spots_are_chosen_in_their_order():
    places = np.random.default_rng(0).uniform(size=(100, 2))
    assert len(chosen_spots(places, 30)) == 25  # every fourth
    again = np.concatenate([places, places])
    np.testing.assert_array_equal(chosen_spots(again, 100), np.arange(100))


def test_a_large_volume_keeps_what_is_thin():
    values = np.zeros((300, 100, 10))
    values[151, 57, 3] = 1.0
    grid = VolumeGrid((0.0, 0.0, 1.0), (0.1, 0.1, 0.01), values.shape)
    small, where = pooled(values, grid)
    assert small.shape == where.shape == (100, 50, 10)
    k, i, j = np.unravel_index(small.argmax(), small.shape)
    assert small.sum() == 1
    assert (where.z[k], where.x[i], where.y[j]) == pytest.approx((2.51, 5.65, 0.3))


def test_many_points_are_thinned(monkeypatch):
    monkeypatch.setattr(explored, "POINTS", 10)
    cloud = Points(np.zeros((25, 3)), np.tile(NORMAL, (25, 1)), np.arange(25.0))
    capture = Capture(**fields())
    view = view_of(capture, {}, Scene({"p": cloud}), facts_of({"name": "n"}, capture, "running", []))
    np.testing.assert_array_equal(view.clouds["p"].albedo, np.arange(0, 25, 3))
    assert view.facts["kept"]["p"] == "every 3. point"


def test_a_stopped_run_says_so(tmp_path):
    capture = Capture(**fields())
    mark_interrupted(tmp_path)  # nothing there: nothing done
    assert list(tmp_path.iterdir()) == []
    keep(tmp_path, view_of(capture, {}, Scene(), facts_of({"name": "n"}, capture, "running", ["half"])))
    mark_interrupted(tmp_path)
    assert read_view(tmp_path).facts["status"] == "interrupted"
    assert "interrupted:" in (tmp_path / "explore.html").read_text(encoding="utf-8")
