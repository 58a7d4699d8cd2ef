"""Figures of the report show what they should."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure
from report_cases import CASES, TAIL, profiles, screened
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nlos_lit.report import diagnosis_figures as plots
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
    axes = plots.screening_ranking(screened(), ["irf_tail"]).axes[0]
    ranked = sorted(screened(), key=lambda s: -s.predicted_gain)
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert [name.removesuffix(" ✔") for name in names] == [one.name for one in ranked]
    assert [name for name in names if name.endswith("✔")] == ["irf_tail ✔"]
    for bar, one in zip(axes.patches, ranked, strict=True):
        assert bar.get_x() + bar.get_width() == pytest.approx(max(one.statistic, 1.0))
        assert (bar.get_hatch() is not None) == (one.name in ("time_offset", "ghost_pulse"))


def test_deviance_steps_run_from_base_to_the_untouched_spots():
    axes = plots.deviance_steps(CASES["two"]).axes[0]
    heldout, untouched = axes.lines[:2]
    np.testing.assert_allclose(heldout.get_ydata(), [1.2417, 1.1903, 1.0862, 1.0351])
    np.testing.assert_allclose(untouched.get_ydata(), [1.3, 1.03])
    low, high = plots.deviance_steps(CASES["nothing"]).axes[0].get_ylim()
    assert (0.7219 - 0.7113) / (high - low) < 0.15  # 1.5 % above noise is drawn small


def test_intervals_are_95_percent_and_show_the_null():
    figure = plots.accepted_effects([TAIL], 0.0048)
    fraction, decay = figure.axes
    segment = fraction.collections[0].get_segments()[0]
    assert segment[:, 0] == pytest.approx([21.13 - 1.96 * 2.1, 21.13 + 1.96 * 2.1])
    assert [line.get_xdata()[0] for line in fraction.lines if line.get_linestyle() == "--"] == [0.0]
    assert not [line for line in decay.lines if line.get_linestyle() == "--"]


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
