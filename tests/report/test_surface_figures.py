"""The overview of a surface: every panel to one scale, things where the wall sees them."""

from __future__ import annotations

import numpy as np
import pytest

from nlos_lit.report.surface_figures import Front, FrontImage, overview

X, Y = np.array([-0.1, 0.0, 0.1]), np.array([-0.2, 0.0, 0.2, 0.4])
FINE = np.linspace(-0.15, 0.15, 7)
PLACES = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], indexing="ij"), axis=-1).reshape(4, 2)


def front(seen: bool = True) -> Front:
    """One surfel at (0.1, 0.4), half a metre away, that looks up; or nothing."""
    nothing = np.full((3, 4), np.nan)
    normals = np.full((3, 4, 3), np.nan)
    albedo, depth = nothing.copy(), nothing.copy()
    if seen:
        albedo[2, 3], depth[2, 3], normals[2, 3] = 0.7, 0.5, (0, 1, 0)
    return Front(albedo, depth, normals, X, Y)


def panels(residuals: np.ndarray, seen: bool = True) -> list:
    values = np.zeros((7, 7))
    values[6, 0] = 1.0  # at x = 0.15, y = -0.15
    figure = overview(FrontImage(values, FINE, FINE), front(seen), PLACES, residuals, "as it is")
    figure.canvas.draw()
    return figure.axes[:5]


def test_panels_share_axes_in_metres_and_the_walls_view():
    axes = panels(np.array([1.0, -2.0, 0.5, 8.0]))
    assert {(a.get_xlim(), a.get_ylim()) for a in axes} == {((0.53, -0.53), (-0.53, 0.53))}
    assert {a.get_xlabel() for a in axes} == {"x (m)"}
    assert axes[0].get_ylabel() == "y (m)"
    sizes = [a.get_window_extent().bounds[2:] for a in axes]
    assert np.ptp(sizes, axis=0) == pytest.approx([0, 0], abs=1)


def at(image, x: float, y: float):
    """What an image shows at a place, m."""
    left, right, low, high = image.get_extent()
    values = np.ma.getdata(image.get_array())
    rows, columns = values.shape[:2]
    return values[int((y - low) / (high - low) * rows), int((x - left) / (right - left) * columns)]


def test_each_panel_shows_its_own_where_it_lies():
    image, albedo, depth, normals, wall = panels(np.array([1.0, -2.0, 0.5, 8.0]))
    assert at(image.images[0], 0.15, -0.15) == 1
    assert at(albedo.images[0], 0.1, 0.4) == 0.7
    assert at(depth.images[0], 0.1, 0.4) == 0.5
    assert at(normals.images[0], 0.1, 0.4) == pytest.approx([0.5, 1, 0.5])  # green: up
    assert at(normals.images[0], 0.0, 0.0) == pytest.approx(3 * [0xD9 / 255])
    squares = wall.collections[0]
    assert squares.get_array().tolist() == [1, -2, 0.5, 8]
    corners = squares.get_paths()[2].vertices
    assert corners.min(0) == pytest.approx([0, -1])  # spots are 1 m apart
    assert corners.max(0) == pytest.approx([1, 0])
    low, high = squares.get_clim()
    assert low == -high
    assert 3 < high < 8


def test_noise_alone_and_no_surface_at_all_are_drawn():
    axes = panels(np.zeros(4), seen=False)
    assert axes[4].collections[0].get_clim() == (-3, 3)
    assert np.isnan(np.ma.filled(axes[2].images[0].get_array(), np.nan)).all()
