"""The report as a conversation: how sure, what next; calm where nothing was found."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from report_cases import CASES, TAIL, TAIL_ALONE, TILT, UNKNOWN, diagnosis, free, profiles, two_found

from nlos_lit.inference.result import Gain, Scores
from nlos_lit.report import diagnosis_figures as plots
from nlos_lit.report.advice import TELLS, confidence, next_step
from nlos_lit.report.page import report_html
from nlos_lit.report.style import RED
from nlos_lit.report.words import AXES

ABOVE = Scores(0.7853, 0.7113, 0.02, 0.015)


def test_confidence_is_said_in_words():
    alone = two_found(effects=[TAIL_ALONE], groups=[])
    assert confidence(alone).startswith("Good: the counts ask for it by more than is needed")
    assert confidence(two_found(effects=[TAIL], groups=[])).startswith(
        "Open: that something is there is well"
    )
    shaky = dataclasses.replace(TILT, heldout_gain=Gain(1.2, 1.19, 0.001, (-0.001, 0.003)))
    assert confidence(diagnosis(effects=[shaky])).startswith("Fair: ")
    assert confidence(CASES["nothing"]).startswith("Good, within limits: ")
    assert confidence(diagnosis(base=ABOVE, untouched_test={})).startswith("Limited: the simulation is 10 %")
    assert "criticism.toys=20" in confidence(dataclasses.replace(alone, toys=0))
    assert "criticism.toys" not in confidence(dataclasses.replace(alone, toys=20))
    assert "σ" not in confidence(alone)


def test_what_to_do_next_depends_on_what_was_found():
    scene = ["scene=capture", "scene.path=my file.mat"]
    alone = next_step(two_found(effects=[TAIL_ALONE], groups=[]), scene)
    assert alone.text.startswith("Measure the instrument response on the direct pulse")
    assert alone.command == "nlos train scene=capture 'scene.path=my file.mat' 'effects=[irf_tail]'"
    both = next_step(two_found(effects=[TAIL_ALONE, TILT], groups=[]), scene)
    assert "effects=[irf_tail,wall_tilt]" in both.command
    assert both.text.startswith("Measure the wall's plane")  # of the larger gain
    open_ = next_step(two_found(effects=[TAIL], groups=[]), scene)
    assert open_.text.startswith("Tell the candidates apart: take a capture with other background light")
    asking = next_step(two_found(effects=[TAIL], groups=[]), scene, Path("outputs/my file/one"))
    assert asking.command.splitlines()[0] == "nlos diagnose 'outputs/my file/one' --split-with FILE"
    assert asking.command.splitlines()[1] == open_.command
    assert next_step(CASES["nothing"], ["scene=su"]).command == "nlos train scene=su refine=true"
    assert "scene.volume.depth" in next_step(diagnosis(base=ABOVE, untouched_test={})).text


@pytest.mark.parametrize("axis", AXES)
def test_something_without_a_name_has_a_next_step(axis):
    unknown = free("free_time", axis)
    advice = next_step(diagnosis(unknown=[unknown]))
    assert advice.text.startswith(TELLS[axis])
    assert advice.command == ""


def test_the_page_begins_with_verdict_sureness_and_next_step():
    page = report_html(CASES["unexplained"], {})
    order = [
        page.index(text) for text in ("<h1", "How sure is that?", "Do this next", "How sure, in numbers")
    ]
    assert order == sorted(order)
    assert page.index("</header>") > order[2]
    assert 'class="term" tabindex="0" data-says=' in page
    assert page.count('<dfn class="term"') <= 14  # each word once
    assert "explore.html" not in page
    assert "explore.html" in report_html(CASES["unexplained"], {}, explorable=True)


def colours(figure) -> set[str]:
    found = set()
    for axes in figure.axes:
        for patch in axes.patches:
            found.add(to_hex(patch.get_facecolor()).upper())
    return found


def strong() -> list:
    return [dataclasses.replace(p, after=p.before) for p in profiles(8.0)]


def test_nothing_is_red_where_nothing_was_found():
    calm = diagnosis(profiles=strong())
    assert "at the noise" in report_html(calm, {})
    assert "Single bands reach" in report_html(calm, {})
    shown = plots.diagnosis_figures(calm)
    flat = [f for name, f in shown.items() if name.startswith("residual_") and name != "residual_wall"]
    assert flat
    assert all(RED not in colours(figure) for figure in flat)
    alarmed = plots.diagnosis_figures(diagnosis(profiles=strong(), unknown=[UNKNOWN["free_wall"]]))
    assert any(RED in colours(figure) for figure in alarmed.values())
    (mesh,) = [c for a in shown["residual_wall"].axes for c in a.collections if hasattr(c, "norm")][:1]
    assert mesh.norm.vmax > 1.9 * np.nanmax(np.abs(strong()[-1].before))  # half of the colour at most
    assert 'class="unexplained"' not in report_html(calm, {})
