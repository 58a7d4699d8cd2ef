"""Figures: what lies where (in pixels), units on axes, and the awkward inputs a first iteration gives."""

from __future__ import annotations

import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.points import Points
from nlos_lit.report import figures, style

GRID = VolumeGrid(origin=(-0.3, -0.2, 0.5), pitch=(0.1, 0.1, 0.05), shape=(8, 7, 5))
RNG = np.random.default_rng(5)


def spot_volume() -> tuple[np.ndarray, tuple[float, float, float]]:
    """One bright voxel at +x, +y, near the wall: left, up and in front as the wall sees it."""
    volume = np.full(GRID.shape, 0.01)
    volume[1, 5, 4] = 1.0
    return volume, (0.2, 0.2, 0.55)


def pixels(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[::-1].astype(
        int
    )  # row 0 at the bottom, as display coordinates have it


def place(axes, x: float, y: float) -> tuple[int, int]:
    return tuple(np.round(axes.transData.transform((x, y))).astype(int))


def share(axes, x: float, y: float) -> np.ndarray:
    """Position in the panel, 0 … 1 from the left and from the bottom."""
    return axes.transAxes.inverted().transform(axes.transData.transform((x, y)))


def test_a_voxel_appears_where_the_wall_sees_it():
    volume, (x, y, z) = spot_volume()
    figure = figures.volume_projections(volume, GRID)
    image = pixels(figure)
    front, side, top, depth = figure.axes[:4]
    for axes, spot, quadrant in (
        (front, (x, y), (0, 1)),
        (side, (z, y), (0, 1)),
        (top, (x, z), (0, 0)),
        (depth, (x, y), (0, 1)),
    ):
        assert tuple(np.round(share(axes, *spot))) == quadrant, axes.get_title()
        column, row = place(axes, *spot)
        bright = image[row, column, :3]
        other_column, other_row = place(axes, spot[0] - 0.2 * (1 if spot[0] == x else -1), spot[1])
        assert np.abs(bright - image[other_row, other_column, :3]).max() > 60, axes.get_title()
        if axes is not depth:
            assert bright.sum() > 600  # the colour map's bright end
    shown = depth.images[0].get_array()
    assert shown.compressed() == pytest.approx([z])
    assert front.get_ylabel() == "y (m)"
    assert top.get_ylabel() == "z (m)"


def test_front_axes_run_in_metres_over_whole_voxels():
    front = figures.volume_projections(spot_volume()[0], GRID).axes[0]
    np.testing.assert_allclose(front.get_xlim(), (0.35, -0.35))
    np.testing.assert_allclose(front.get_ylim(), (-0.25, 0.25))


def test_depth_map_leaves_out_weak_columns():
    volume = np.zeros(GRID.shape)
    volume[2, 0, 0], volume[6, 3, 1] = 1.0, 0.19
    shown = figures.volume_projections(volume, GRID).axes[3].images[0].get_array()
    assert shown.compressed() == pytest.approx([0.6])
    shown = figures.volume_projections(volume, GRID, threshold=0.15).axes[3].images[0].get_array()
    assert sorted(shown.compressed()) == pytest.approx([0.6, 0.8])


def test_albedo_shows_the_mask_only():
    albedo = np.full(GRID.shape, 0.9)
    mask = np.zeros(GRID.shape, dtype=bool)
    mask[2, 1, 3] = mask[5, 1, 3] = True
    albedo[2, 1, 3], albedo[5, 1, 3] = 0.2, 0.4
    figure = figures.albedo_projection(albedo, mask, GRID)
    shown = figure.axes[0].images[0].get_array()
    assert shown.compressed() == pytest.approx([0.4])
    assert tuple(np.round(share(figure.axes[0], -0.2, 0.1))) == (1, 1)
    image = pixels(figure)
    right, up = place(figure.axes[0], -0.2, 0.1)
    left, _ = place(figure.axes[0], 0.2, 0.1)
    assert np.ptp(image[up, left, :3]) == 0  # grey
    assert np.abs(image[up, right, :3] - image[up, left, :3]).max() > 30


def test_normals_are_coloured_as_the_wall_sees_them():
    """Red is the wall's right, -x; green +y; blue the wall, -z."""
    normals = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    positions = np.array(
        [[-0.2, 0.0, 0.9], [0.0, 0.2, 0.8], [0.2, 0.0, 0.7]]
    )  # far to near, the order they are drawn in
    figure = figures.surface_plot(Points(positions, normals, np.ones(3)))
    np.testing.assert_allclose(
        figure.axes[1].collections[0].get_facecolors()[:, :3],
        [[1, 0.5, 0.5], [0.5, 1, 0.5], [0.5, 0.5, 1]],
        atol=1e-6,
    )
    assert share(figure.axes[0], -0.2, 0.0)[0] > share(figure.axes[0], 0.2, 0.0)[0]


def test_the_three_dimensional_view_is_not_mirrored():
    figure = figures.surface_plot(
        Points(np.array([[0.2, 0.1, 0.5], [-0.2, -0.1, 0.9]]), np.tile([0.0, 0.0, -1.0], (2, 1)), np.ones(2))
    )
    pixels(figure)
    from mpl_toolkits.mplot3d import proj3d

    solid = figure.axes[2]
    origin, px, py, pz = (
        np.array(proj3d.proj_transform(p[0], p[2], p[1], solid.get_proj()))
        for p in ((0, 0, 0.7), (0.1, 0, 0.7), (0, 0.1, 0.7), (0, 0, 0.8))
    )
    assert px[0] < origin[0]  # +x to the left
    assert py[1] > origin[1]  # +y up
    assert solid.elev > 0
    assert pz[1] > origin[1]  # seen from above, what is farther from the wall is higher: the wall is in front


def test_kernel_has_the_period_and_the_width_it_says():
    omega, sigma = 170.0, 0.02
    axes = figures.kernel_plot(omega, sigma).axes[0]
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    at = {
        name: np.interp(100 * np.pi / (2 * omega), *xy.T)
        for name, xy in lines.items()
        if name in ("real", "imaginary")
    }
    assert at["real"] == pytest.approx(0, abs=1e-3)  # a quarter period
    assert at["imaginary"] == pytest.approx(np.exp(-((np.pi / (2 * omega * sigma)) ** 2) / 2), abs=1e-3)
    assert np.interp(2.0, *lines["envelope"].T) == pytest.approx(np.exp(-0.5), abs=1e-3)
    assert axes.get_xlabel() == "path length (cm)"


@pytest.mark.parametrize("spots", [1, 2, 5])
def test_transients_have_one_panel_a_spot(spots):
    rendered = RNG.uniform(1, 20, (spots, 30))
    path = 0.9 + 0.01 * np.arange(30)
    labels = [f"spot {k}" for k in range(spots)]
    figure = figures.transients_plot(
        RNG.poisson(rendered), rendered, path, labels, band=(0.8 * rendered, 1.2 * rendered)
    )
    pixels(figure)
    used = [axes for axes in figure.axes if axes.axison]
    assert len(used) == spots
    for k, axes in enumerate(used):
        np.testing.assert_array_equal(axes.lines[1].get_ydata(), rendered[k])
        assert axes.get_ylabel() == "counts"
    upper = used[0].child_axes[0]
    assert upper.get_xlabel() == "time (ns)"
    np.testing.assert_allclose(upper.get_xlim(), np.array([0.9, 1.19]) / 0.299792458)


def test_what_was_not_recorded_is_a_shaded_gap_in_the_measured_transient():
    observed = np.ones((2, 30), dtype=bool)
    observed[1, 5:9] = False
    figure = figures.transients_plot(
        np.ones((2, 30)), np.ones((2, 30)), np.arange(30.0), ["whole", "cut"], observed=observed
    )
    whole, cut = figure.axes[:2]
    assert np.isfinite(whole.lines[0].get_ydata()).all()
    assert np.flatnonzero(np.isnan(cut.lines[0].get_ydata())).tolist() == [5, 6, 7, 8]
    assert [len(axes.collections) for axes in (whole, cut)] == [0, 1]
    reach = cut.collections[0].get_paths()[0].vertices[:, 0]
    assert 4 <= reach.min() <= 5
    assert 8 <= reach.max() <= 9


def test_response_axes():
    figure = figures.laser_sensor_plot(np.array([0.1, 0.6, 0.3]), bin_length=0.006, first=-0.006)
    pixels(figure)
    line = figure.axes[0].lines[0]
    np.testing.assert_allclose(line.get_xdata(), [-0.6, 0.0, 0.6])
    np.testing.assert_allclose(
        figure.axes[0].child_axes[0].get_xlim(), np.array([-1, 1]) * 0.006 / 299792458 * 1e12
    )


def test_losses_are_logarithmic_only_when_they_can_be():
    assert figures.loss_plot({"total": [2.0, 1.0], "part": [1.0, 0.5]}).axes[0].get_yscale() == "log"
    assert figures.loss_plot({"total": [2.0, 1.0], "part": [0.0, 0.5]}).axes[0].get_yscale() == "linear"


def test_parameters_have_a_panel_and_a_unit_each():
    names = {
        "omega_pf": "rad/m",
        "sigma_pf": "m",
        "sigma_ls": "m",
        "I_l": "counts",
        "kappa_s": "1/m",
        "eta_s": "counts/bin",
    }
    figure = figures.parameter_plot({name: [1.0, 2.0, 3.0] for name in names}, names)
    assert [axes.get_ylabel() for axes in figure.axes] == list(names.values())


def test_depth_error_is_estimate_minus_truth_in_millimetres():
    truth = np.array([[0.5, 0.6], [np.nan, 0.7]])
    estimate = np.array([[0.51, np.nan], [0.5, 0.695]])
    figure = figures.depth_error_map(estimate, truth, np.array([-0.1, 0.1]), np.array([0.0, 0.2]))
    pixels(figure)
    error = figure.axes[2].images[0].get_array()  # imshow's rows are y
    np.testing.assert_allclose(error.filled(np.nan), [[10, np.nan], [np.nan, -5]], atol=1e-6)


NOWHERE = Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
PLANE = Points(np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5]]), np.tile([0.0, 0.0, -1.0], (2, 1)), np.ones(2))


@pytest.mark.parametrize(
    "figure",
    [
        lambda: figures.volume_projections(np.zeros(GRID.shape), GRID),
        lambda: figures.albedo_projection(np.ones(GRID.shape), np.zeros(GRID.shape, dtype=bool), GRID),
        lambda: figures.surface_plot(NOWHERE),
        lambda: figures.surface_plot(PLANE),
        lambda: figures.surface_plot(Points(PLANE.positions[:1], PLANE.normals[:1], np.ones(1))),
        lambda: figures.loss_plot({}),
        lambda: figures.loss_plot({"total": [1.0]}),
        lambda: figures.parameter_plot({"omega_pf": [170.0]}, {"omega_pf": "rad/m"}),
        lambda: figures.transients_plot(np.zeros((1, 4)), np.zeros((1, 4)), np.arange(4.0), ["dark"]),
        lambda: figures.depth_error_map(
            np.full((3, 2), np.nan), np.full((3, 2), np.nan), np.arange(3.0), np.arange(2.0)
        ),
    ],
)
def test_empty_results_still_draw(figure, tmp_path):
    style.save_figure(figure(), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == 1


def test_the_style_stays_inside():
    before = dict(matplotlib.rcParams)
    figures.kernel_plot(170.0, 0.02)
    assert dict(matplotlib.rcParams) == before
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()
