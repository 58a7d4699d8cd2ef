"""Distances between surfaces where they are known."""

from __future__ import annotations

import numpy as np
import pytest

from data_modules.simulate import Mesh, join
from data_modules.simulate.scenes import plate
from nlos_lit.paper.surface_distance import distance_to, sample, surface_distances, visible_sample

WALL = np.array([[x, y, 0.0] for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)])


def test_samples_are_spread_over_the_area():
    """Two plates of 0.2 × 0.1 and 0.2 × 0.3 m: a quarter of the points on the first."""
    mesh = join(plate((0, 0, 0.5), 0.2, 0.1), plate((1, 0, 0.5), 0.2, 0.3))
    points, face = sample(mesh, 40_000)
    assert np.mean(points[:, 0] < 0.5) == pytest.approx(0.25, abs=0.01)
    assert np.mean(face < 2) == pytest.approx(0.25, abs=0.01)
    assert points[points[:, 0] > 0.5].mean(axis=0) == pytest.approx([1, 0, 0.5], abs=0.005)


def test_distance_to_a_plate():
    mesh = plate((0, 0, 0.5), 0.2, 0.4)
    points = np.array([[0.0, 0.0, 0.53], [0.13, 0.0, 0.5], [0.13, 0.24, 0.5], [0.05, -0.1, 0.5]])
    assert distance_to(mesh, points) == pytest.approx([0.03, 0.03, 0.05, 0.0], abs=1e-6)


def test_parallel_plates():
    truth = plate((0, 0, 0.6), 0.4, 0.4)
    found = surface_distances(plate((0, 0, 0.57), 0.4, 0.4), truth, sample(truth, 3000)[0], 3000).summary(
        0.02
    )
    for name in ("surface→truth", "truth→surface"):
        for what in ("RMSE", "95 %", "Hausdorff"):
            assert found[f"{what} {name} (mm)"] == pytest.approx(30, abs=0.01)
    assert found["truth within 20 mm"] == 0


def test_missing_regions_count_from_the_truth_only():
    """Half of the plate is reconstructed, perfectly.

    From the missing half the distance grows evenly from 0 to 0.2 m.
    """
    truth = plate((0, 0, 0.6), 0.4, 0.4)
    half = plate((-0.1, 0, 0.6), 0.2, 0.4)
    found = surface_distances(half, truth, sample(truth, 20_000)[0], 2000).summary(0.05)
    assert found["RMSE surface→truth (mm)"] == pytest.approx(0, abs=0.01)
    assert found["RMSE truth→surface (mm)"] == pytest.approx(1e3 * np.sqrt(0.5 * 0.2**2 / 3), rel=0.02)
    assert found["Hausdorff truth→surface (mm)"] == pytest.approx(200, abs=1)
    assert found["truth within 50 mm"] == pytest.approx(0.625, abs=0.01)


def test_no_reconstruction_is_no_number():
    truth = plate((0, 0, 0.6), 0.4, 0.4)
    found = surface_distances(None, truth, sample(truth, 100)[0]).summary(0.02)
    assert np.isnan(found["RMSE surface→truth (mm)"])
    assert np.isnan(found["Hausdorff truth→surface (mm)"])
    assert found["truth within 20 mm"] == 0


def test_only_what_the_wall_sees_is_sampled():
    """A plate in front hides the middle of one behind; a third faces away."""
    front, behind = plate((0, 0, 0.3), 0.5, 0.5), plate((0, 0, 0.4), 1.6, 0.3)
    away: Mesh = plate((0, 1.0, 0.5), 0.3, 0.3).flipped()
    seen = visible_sample(join(front, behind, away), WALL, 20_000)
    assert (seen[:, 1] < 0.5).all()
    assert (np.abs(seen[seen[:, 2] > 0.35, 0]) > 0.2).all()
    assert (np.abs(seen[seen[:, 2] > 0.35, 0]) > 0.5).any()
    assert np.abs(seen[seen[:, 2] < 0.35, 0]).min() < 0.02
