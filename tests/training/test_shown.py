"""What is shown of a fit: residuals of the scanned points, transients with what was not recorded left out."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nlos_lit.capture import Capture
from nlos_lit.training.shown import spot_residuals, transients_of

UP = np.tile([0.0, 0.0, 1.0], (4, 1))
COUNTS = np.array([[9, 8, 8], [9, 1, 3], [9, 5, 0], [9, 0, 4]])


def capture(sensor: np.ndarray, observed: np.ndarray | None = None) -> Capture:
    laser = np.column_stack([np.arange(4) / 10, np.zeros((4, 2))])
    return Capture(COUNTS, laser, sensor, UP, UP, 0.1, gate=(1, 3), observed=observed)


def two_points() -> np.ndarray:
    return np.column_stack([[0.5, 0.3, 0.3, 0.5], [0.1, 0.2, 0.2, 0.1], np.zeros(4)])


def two(spots: torch.Tensor) -> torch.Tensor:
    return torch.full((len(spots), 2), 2.0)


@pytest.mark.parametrize("block", [1, 3, 256])
def test_residuals_of_spots_at_one_point_are_taken_together(block):
    places, residuals = spot_residuals(capture(two_points()), np.arange(4), two, block)
    assert places.tolist() == [[0.3, 0.2], [0.5, 0.1]]
    assert residuals == pytest.approx([(9 - 8) / np.sqrt(8), (20 - 8) / np.sqrt(8)])


def test_residuals_leave_out_what_was_not_recorded():
    observed = COUNTS > 0
    places, residuals = spot_residuals(capture(two_points(), observed), np.array([1, 2, 3]), two)
    assert places.tolist() == [[0.3, 0.2], [0.5, 0.1]]
    assert residuals == pytest.approx([(9 - 6) / np.sqrt(6), (4 - 2) / np.sqrt(2)])


def test_one_sensor_point_shows_the_lasers_places():
    places, residuals = spot_residuals(capture(np.zeros((4, 3))), np.arange(4), two)
    assert places[:, 0] == pytest.approx([0, 0.1, 0.2, 0.3])
    assert residuals == pytest.approx([6, 0, 0.5, 0])


def test_transients_have_gaps_where_nothing_was_recorded():
    figure = transients_of(capture(two_points(), COUNTS > 0), np.array([1, 2]), two(torch.arange(2)))
    measured = [axes.lines[0].get_ydata() for axes in figure.axes[:2]]
    np.testing.assert_array_equal(measured, [[1, 3], [5, np.nan]])
