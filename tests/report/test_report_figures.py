"""Figures of the report show what they should."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from report_cases import CASES, SHAPES, TAIL, UNKNOWN, free, profiles, screened, two_found
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nlos_lit.inference.result import Shape
from nlos_lit.report import diagnosis_figures as plots
from nlos_lit.report import style
from nlos_lit.report.page import log_figures, write_report


def test_profiles_are_drawn_where_they_are():
    profile = profiles(45.0)[0]
    figure = plots.residual_profile(profile, 0.0048)
    before, after = figure.axes[:2]
    assert "before" in before.get_title("left")
    lines = [
        patch for patch in before.patches if hasattr(patch, "get_data") and patch.get_data().baseline is None
    ]
    np.testing.assert_array_equal(lines[0].get_data().values, profile.before)
    np.testing.assert_array_equal(lines[0].get_data().edges, profile.edges)
    assert before.get_ylim() == after.get_ylim()
    assert f"{int((np.abs(profile.before) > 3).sum())} of 40 beyond 3σ (chance: 0.11)" in before.get_title(
        "left"
    )
    same = plots.residual_profile(dataclasses.replace(profile, after=profile.before), None)
    assert len(same.axes) == 1


def test_wall_maps_share_one_symmetric_scale_and_lie_as_seen_from_the_wall():
    profile = profiles(45.0)[-1]
    figure = plots.residual_wall(profile)
    before, after = (axes.collections[0] for axes in figure.axes[:2])
    assert before.norm.vmin == -before.norm.vmax
    assert (before.norm.vmin, before.norm.vmax) == (after.norm.vmin, after.norm.vmax)
    assert figure.axes[0].get_xlim() == (1, -1)
    values = before.get_array()
    assert values.shape == (6, 8)  # rows are y
    assert values[0, 7] == profile.before[7, 0]
    assert values.mask[3, 2]


def test_screening_bars_hatch_what_is_barely_identifiable():
    axes = plots.screening_ranking(screened(), 8.16, ["irf_tail", "free_wall"]).axes[0]
    ranked = sorted(screened(), key=lambda s: -s.evidence)
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert [name.removesuffix(" ✔") for name in names] == [one.name for one in ranked]
    assert {name for name in names if name.endswith("✔")} == {"irf_tail ✔", "free_wall ✔"}
    colours = {}
    for bar, one in zip(axes.patches, ranked, strict=True):
        assert bar.get_x() + bar.get_width() == pytest.approx(max(one.evidence, 1.0))
        assert (bar.get_hatch() is not None) == (one.name in ("time_offset", "ghost_pulse"))
        colours[one.name] = to_hex(bar.get_facecolor()).upper()
    assert colours["irf_tail"] == style.BLUE
    assert colours["pile_up"] == colours["vignetting"] == style.SKY
    assert colours["free_wall"] == style.PINK
    assert colours["free_time"] == colours["free_spot_gain"] not in (style.SKY, style.BLUE, style.PINK)
    (line,) = axes.lines
    assert list(line.get_xdata()) == [8.16, 8.16]
    assert axes.get_xlim()[0] == 1
    assert axes.get_xscale() == "log"
    texts = [text.get_text() for text in axes.texts]
    assert len(texts) == len(ranked)
    assert [t.split("   ")[1] for t, one in zip(texts, ranked, strict=True) if one.name == "time_offset"] == [
        "keeps 0.21 %"
    ]


def test_deviance_without_each_term_and_of_the_untouched_spots():
    axes = plots.deviances(CASES["two"]).axes[0]
    heldout, untouched = axes.lines[:2]
    np.testing.assert_allclose(heldout.get_ydata(), [1.2417, 1.2417, 1.1903, 1.0351])
    np.testing.assert_allclose(untouched.get_ydata(), [1.3, 1.03])
    both = plots.deviances(two_found(unknown=[free("free_wall", "wall")])).axes[0]
    labels = [label.get_text().replace("\n", "") for label in both.get_xticklabels()]
    assert labels[:5] == ["base", "withoutirf_tail", "withoutwall_tilt", "withoutfree_wall", "with all"]
    (one,) = two_found().effects[:1]
    alone = plots.deviances(dataclasses.replace(two_found(), effects=[one])).axes[0]
    assert [label.get_text() for label in alone.get_xticklabels()][:2] == ["base", "with all"]
    low, high = plots.deviances(CASES["nothing"]).axes[0].get_ylim()
    assert (0.7219 - 0.7113) / (high - low) < 0.15  # 1.5 % above noise is drawn small


def test_intervals_are_95_percent_and_show_the_null():
    figure = plots.accepted_effects([TAIL], 0.0048)
    fraction, decay, _ = figure.axes
    segment = fraction.collections[0].get_segments()[0]
    assert segment[:, 0] == pytest.approx([21.13 - 1.96 * 2.1, 21.13 + 1.96 * 2.1])
    assert [line.get_xdata()[0] for line in fraction.lines if line.get_linestyle() == "--"] == [0.0]
    assert not [line for line in decay.lines if line.get_linestyle() == "--"]


def test_every_free_term_that_was_needed_has_a_figure(tmp_path):
    shown = plots.diagnosis_figures(two_found(unknown=[*UNKNOWN.values(), free("free_lines", "wall")]))
    assert {name for name in shown if name.startswith("unknown_")} == {f"unknown_{name}" for name in SHAPES}
    assert not any(name.startswith("unknown_") for name in plots.diagnosis_figures(CASES["two"]))
    effects = plots.diagnosis_figures(two_found(unknown=[UNKNOWN["free_wall"]]))["effects"]
    assert [axes.get_ylabel() for axes in effects.axes][-1] == "free_wall\nrms"
    for name, figure in shown.items():
        style.save_figure(figure, tmp_path / f"{name}.png")
    write_report(two_found(unknown=[UNKNOWN["free_wall"]]), tmp_path / "report")
    assert (tmp_path / "report" / "figures" / "unknown_free_wall.png").exists()


def test_a_free_term_along_one_axis_is_a_step_in_percent():
    shape = Shape("time", "1", np.array([10.0, 20.0, 30.0]), np.log([1.25, 0.5]))
    (axes,) = plots.free_shape("free_time", shape, 0.0048).axes
    line = next(p for p in axes.patches if p.get_data().baseline is None)
    np.testing.assert_allclose(line.get_data().values, [25, -50])
    np.testing.assert_allclose(line.get_data().edges, shape.edges)
    assert axes.get_ylabel() == "change of the counts (%)"
    assert axes.get_xlabel() == "time bin"
    assert axes.child_axes[0].get_xlabel().endswith("(ns)")
    assert axes.get_title("left") == "something unknown along the time axis"


def test_a_delay_is_in_bins_where_they_are_known():
    shape = Shape("scan", "m", np.array([0.0, 5.0, 10.0]), np.array([0.0096, -0.0048]))
    for bin_length, values, label in (
        (0.0048, [2, -1], "delay (bins of 4.80 mm)"),
        (None, [9.6, -4.8], "delay (mm of path)"),
    ):
        (axes,) = plots.free_shape("free_scan_delay", shape, bin_length).axes
        line = next(p for p in axes.patches if p.get_data().baseline is None)
        np.testing.assert_allclose(line.get_data().values, values)
        assert axes.get_ylabel() == label


def test_a_width_is_shown_in_squared_bins():
    for bin_length in (0.0048, None):
        (axes,) = plots.free_shape("free_width_scan", SHAPES["free_width_scan"], bin_length).axes
        line = next(p for p in axes.patches if p.get_data().baseline is None)
        np.testing.assert_allclose(line.get_data().values, SHAPES["free_width_scan"].values)
        assert axes.get_ylabel() == "change of the response's variance (bins²)"


def test_a_free_term_over_two_axes_is_an_image_around_0():
    values = np.log([[1.1, 1.0, 1.0], [1.0, 1.0, 0.8]])
    edges, edges_y = np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 2.0, 3.0])
    wall = plots.free_shape("free_wall_background", Shape("wall", "1", edges, values, edges_y)).axes[0]
    product = plots.free_shape("free_response_scan", Shape("time×scan", "1", edges, values, edges_y)).axes[0]
    for axes in (wall, product):
        mesh = axes.collections[0]
        assert mesh.norm.vmin == -mesh.norm.vmax
        assert 10 < mesh.norm.vmax <= 20
        np.testing.assert_allclose(mesh.get_array(), 100 * np.expm1(values.T), atol=1e-9)  # rows are y
    assert wall.get_xlim() == (2, 0)  # as seen from the wall
    assert wall.child_axes[0].get_ylabel() == "change of the background (%), 99 % inside"
    assert product.get_xlim() == (0, 2)
    assert (product.get_xlabel(), product.get_ylabel()) == ("time bin", "scan order")


def test_single_spots_are_dots():
    shape = SHAPES["free_spot_gain"]
    (axes,) = plots.free_shape("free_spot_gain", shape).axes
    x, y = axes.lines[-1].get_data()
    np.testing.assert_allclose(x, np.arange(4096) + 0.5)
    np.testing.assert_allclose(y, 100 * np.expm1(shape.values))
    assert not axes.patches


def test_extra_figures_come_last_and_may_not_hide_others(tmp_path):
    extra = {"surface (front)": Figure(figsize=(1, 1))}
    page = write_report(CASES["bare"], tmp_path, extra).read_text(encoding="utf-8")
    assert "More figures" in page
    assert (tmp_path / "figures" / "surface_front_.png").exists()
    with pytest.raises(ValueError, match="different names"):
        write_report(CASES["bare"], tmp_path, {"deviance": Figure()})


def test_figures_reach_tensorboard(tmp_path):
    shown = plots.diagnosis_figures(CASES["bare"])
    log_figures(tmp_path, shown)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert events.Tags()["images"] == [f"diagnosis/{name}" for name in shown]
