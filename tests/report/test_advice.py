"""The report as a conversation: how sure, what next; calm where nothing was found."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from report_cases import CASES, TAIL, TAIL_ALONE, TILT, UNKNOWN, diagnosis, free, profiles, two_found

from nlos_lit.inference.advise import AGAIN
from nlos_lit.inference.result import Diagnosis, Estimate, Followed, Gain, Likely, Scores
from nlos_lit.report import diagnosis_figures as plots
from nlos_lit.report.advice import TELLS, confidence, next_step
from nlos_lit.report.page import report_html, write_report
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
    little = dataclasses.replace(TAIL_ALONE, needed=TAIL_ALONE.evidence)
    assert "might look so, too" in confidence(two_found(effects=[little], groups=[]))
    assert confidence(CASES["nothing"]).startswith("Good, within limits: ")
    limited = diagnosis(base=ABOVE, untouched_test={})
    assert confidence(limited).startswith("Limited: the simulation is 10 %")
    likely = dataclasses.replace(limited, likely=[Likely("wall_reflectance", 4889, 1073, 0.38, 220, 671)])
    assert confidence(likely).startswith("Open: what is likely predicts parts of the wall that nothing was")
    advice = next_step(likely, ["scene=su"])
    assert advice.text.startswith("To be certain: ")
    assert advice.command == "nlos train scene=su 'effects=[wall_reflectance]'"
    free = dataclasses.replace(likely.likely[0], name="free_time")
    two = dataclasses.replace(likely, likely=[free, *likely.likely])
    assert next_step(two, ["scene=su"]) == advice, "no model can be given a free term"
    assert "scene.volume.depth" in next_step(dataclasses.replace(likely, likely=[free])).text
    assert "criticism.toys=20" in confidence(dataclasses.replace(alone, toys=0))
    assert "criticism.toys" not in confidence(dataclasses.replace(alone, toys=20))
    assert "σ" not in confidence(alone)


def test_what_to_do_next_depends_on_what_was_found():
    scene = ["scene=capture", "scene.path=my file.mat"]
    alone = next_step(two_found(effects=[TAIL_ALONE], groups=[]), scene)
    assert alone.text.startswith("Measure the instrument response on the direct pulse")
    assert alone.command == "nlos train scene=capture 'scene.path=my file.mat' 'effects=[irf_tail]'"
    along = next_step(two_found(effects=[TAIL_ALONE], groups=[], along=["pile_up"]), scene)
    assert along.command.endswith("'effects=[irf_tail,pile_up]'"), "the model that was measured"
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


def following(share: float, offered: bool) -> Diagnosis:
    """A free term along the scan that comes so near to a step."""
    numbers = {"height": Estimate(-0.117, 0.004, "1"), "place": Estimate(0.412, 0.003, "1")}
    curve = np.where(np.arange(65) < 26, 0.0, -0.117)
    formula = Followed("counts_over_scan_step", "height σ((x - place)/0.01)", numbers, share, offered, curve)
    term = dataclasses.replace(UNKNOWN["free_scan"], formula=formula)
    return dataclasses.replace(CASES["unexplained"], unknown=[term])


def test_a_formula_that_a_free_term_follows_is_told_and_left_as_a_file(tmp_path):
    page = write_report(following(0.97, True), tmp_path)
    text, file = page.read_text(), tmp_path / "effects" / "counts_over_scan_step.py"
    said = "It follows a step over the course of the scan"
    assert said in text
    assert said in next_step(following(0.97, True)).text
    assert "97 % of its gain" in text
    assert "class CountsOverScanStep(Step, CountsOverScan)" in file.read_text()
    assert "97 % of the gain of a free term" in " ".join(file.read_text().split())


def test_a_formula_that_keeps_too_little_is_told_and_not_offered(tmp_path):
    text = write_report(following(0.42, False), tmp_path).read_text()
    assert "No formula that was tried follows it; the nearest is a step" in text
    assert "which keeps 42 % of its gain" in text
    assert not (tmp_path / "effects").exists()
    assert "follows" not in next_step(following(0.42, False)).text


@pytest.mark.parametrize(
    ("order", "said"),
    [
        (39.0, "By calculation the same scan again would tell as much as others: 20 nats."),
        (140.0, "By calculation a second scan in another order would tell 140 nats, the same scan again 20."),
    ],
)
def test_what_another_capture_would_tell_is_said_where_names_are_open(order, said):
    """From twice as much on."""
    told = {AGAIN: 20.0, "a second scan in another order": order, "a capture with the laser off": 1.0}
    open_ = two_found(
        effects=[dataclasses.replace(TAIL, advised=told)], groups=[["irf_tail", "afterpulsing"]]
    )
    assert said in next_step(open_).text
    assert said in report_html(open_, {})
    assert "By calculation" not in next_step(two_found(effects=[TAIL], groups=[])).text


def test_the_formula_is_drawn_over_the_free_term():
    figure = plots.diagnosis_figures(following(0.97, True))["unknown_free_scan"]
    (line,) = [one for one in figure.axes[0].lines if len(one.get_ydata()) == 65]
    assert line.get_ydata()[[0, -1]].tolist() == pytest.approx([0.0, 100 * np.expm1(-0.117)])
    assert figure.axes[0].get_legend().get_texts()[0].get_text() == "a step over the course of the scan"
