"""The report: what it says, that every number is in it, that it needs nothing but itself; figures show what
they should.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from report_cases import (
    CASES,
    FREE_NAMES,
    NAN,
    TAIL,
    TAIL_ALONE,
    TILT,
    UNKNOWN,
    diagnosis,
    free,
    screened,
    two_found,
)

from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.result import Accepted, Estimate, Gain, Likely, Scores, Screened
from nlos_lit.report import diagnosis_figures as plots
from nlos_lit.report.page import report_html, write_report
from nlos_lit.report.quantities import (
    UNIT_OF_KIND,
    amount,
    headline,
    number,
    percent,
    plus_minus,
    probability,
    quantity,
)
from nlos_lit.report.verdict import at_noise, misfit, rivals, sureness, tone, verdict
from nlos_lit.report.words import AXES, describe


class Page(HTMLParser):
    """Text, attributes that load or lead somewhere, and whether tags close in order."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open, self.text, self.sources, self.tags, self.label = [], [], [], set(), []
        self.feed(page)
        assert self.open == []
        self.words = re.sub(r"\s+", " ", " ".join(self.text))

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.sources += [
            value for name, value in attributes if name in ("src", "href", "srcset", "data", "action")
        ]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.text.append(data)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict:
    folders = {name: tmp_path_factory.mktemp(name) for name in CASES}
    return {name: write_report(found, folders[name]) for name, found in CASES.items()}


@pytest.mark.parametrize("case", CASES)
def test_the_page_needs_nothing_but_itself(written, case):
    page = written[case].read_text(encoding="utf-8")
    assert written[case].name == "report.html"
    seen = Page(page)
    assert seen.tags.isdisjoint({"script", "link", "iframe", "object", "base"})
    assert all(source.startswith("data:image/png;base64,") for source in seen.sources)
    assert not re.search(r"https?:|url\(|@import", page)
    files = sorted((written[case].parent / "figures").glob("*.png"))
    inlined = [base64.b64decode(source.split(",")[1]) for source in seen.sources]
    assert sorted(inlined) == sorted(file.read_bytes() for file in files)
    assert len(files) == len(plots.diagnosis_figures(CASES[case]))
    assert sorted(p.name for p in written[case].parent.iterdir()) == [
        "diagnosis.json",
        "figures",
        "report.html",
    ]


@pytest.mark.parametrize("case", CASES)
def test_json_is_the_diagnosis(written, case):
    read = json.loads((written[case].parent / "diagnosis.json").read_text(encoding="utf-8"))
    assert read == CASES[case].to_dict()
    assert set(read) == {
        *(
            "effects",
            "unknown",
            "groups",
            "unexplained",
            "screened",
            "base",
            "extended",
            "untouched_test",
            "seconds",
            "seed",
        ),
        *(
            "witness",
            "profiles",
            "needed",
            "chance",
            "notes",
            "capture",
            "toys",
            "further",
            "likely",
            "along",
        ),
    }
    assert set(read["unexplained"]) == {"significant", "axis", "evidence"}
    for effect in [*read["effects"], *read["unknown"]]:
        assert set(effect) == {
            "name",
            "parameters",
            "evidence",
            "heldout_gain",
            "weights",
            "split_by",
            "advised",
            "axis",
            "shape",
            "formula",
            "needed",
            "tried",
            "explained",
            "misfit",
        }
        assert all(set(p) == {"value", "stderr", "unit"} for p in effect["parameters"].values())
        assert set(effect["heldout_gain"]) == {
            "deviance_per_bin_before",
            "deviance_per_bin_after",
            "nats_per_photon",
            "ci95",
        }
        assert len(effect["heldout_gain"]["ci95"]) == 2
    for one in read["screened"]:
        assert set(one) == {field.name for field in dataclasses.fields(Screened)}
    for term in read["unknown"]:
        assert set(term["shape"]) == {"axis", "unit", "edges", "values", "edges_y"}


def test_json_of_values_that_are_not_numbers_is_null(written):
    read = json.loads((written["nan"].parent / "diagnosis.json").read_text(encoding="utf-8"))
    assert read["effects"][0]["parameters"]["fraction"] == {"value": 0.2, "stderr": None, "unit": "1"}
    assert read["screened"][0]["detectable"] == {"detections": None}
    assert read["profiles"][0]["before"] == [None] * 3


def test_the_verdict_where_nothing_is_needed():
    assert verdict(CASES["nothing"]) == "Nothing in the registry is needed: the fit is at the noise."
    # 0.0740 / 0.7113 above noise, not significant
    above = diagnosis(base=Scores(0.7853, 0.7113, 0.02, 0.015), untouched_test={})
    assert "at the noise" not in verdict(above)
    assert "10 % above counting noise" in verdict(above)
    assert tone(CASES["nothing"]) == "fine"


def test_the_verdict_on_one_effect():
    tail = "Your simulation misses a slow detector tail: 21 ± 2 % of the photons, τ = 0.39 ns"
    one = two_found(effects=[TAIL_ALONE], groups=[])
    # excess on untouched spots: 1.30 - 0.94 = 0.36 before, 1.03 - 0.93 = 0.10 after, so 72 % explained
    assert verdict(one) == f"{tail}; modelling it explains 72 % of the excess misfit."
    # without untouched spots: (1.2417 - 0.9402) = 0.3015, (1.0351 - 0.9251) = 0.11: 64 %
    assert "64 % of" in verdict(dataclasses.replace(one, untouched_test={}))
    # What predicts untouched spots worse explains nothing, not -10 %: 0.396 above noise instead of 0.36.
    worse = {**one.untouched_test, "extended": Scores(1.326, 0.93, 0.02, 0.015)}
    assert verdict(dataclasses.replace(one, untouched_test=worse)) == (
        f"{tail}; modelling it explains none of the excess misfit."
    )
    unknown_size = dataclasses.replace(TAIL_ALONE, parameters={})
    assert verdict(two_found(effects=[unknown_size], groups=[])).startswith(
        "Your simulation misses a slow detector tail; modelling it"
    )
    assert "<li>" not in report_html(one, {}).split("</header>")[0]
    assert tone(one) == "found"


def test_the_verdict_on_several_effects():
    several = two_found(effects=[TAIL_ALONE, TILT], groups=[])
    both = verdict(several)
    assert both.startswith("Your simulation misses 2 things: (1) a slow detector tail: 21 ± 2 % of")
    assert "; (2) a relay wall that is tilted against the scan's plane: 41.3 ± 0.9 mrad along x" in both
    assert both.endswith("; modelling them explains 72 % of the excess misfit.")
    assert (
        verdict(several, listed=False)
        == "Your simulation misses 2 things; modelling them explains 72 % of the excess misfit."
    )
    page = report_html(several, {})
    head = page[page.index("<h1") : page.index("</header>")]
    assert "mrad" not in head[: head.index("</h1>")]
    assert head.count("<li>") == 2
    assert "41.3 ± 0.9 mrad along x" in head


def test_the_verdict_on_what_cannot_be_told_apart():
    weighed = verdict(two_found(effects=[TAIL], groups=[["irf_tail", "afterpulsing"]]))
    assert weighed == (
        "Your simulation misses a slow detector tail (81 %) or afterpulsing (counts that trigger further"
        " counts; 19 %): this capture cannot tell which; the former would be 21 ± 2 % of the photons,"
        " τ = 0.39 ns; modelling it explains 72 % of the excess misfit."
    )
    three = dataclasses.replace(TAIL, weights={"free_time": 0.09, "irf_tail": 0.6, "pile_up": 0.31})
    assert rivals(two_found(), three) == {"pile_up": 0.31, "free_time": 0.09, "afterpulsing": None}
    text = verdict(two_found(effects=[three], groups=[]))
    assert "misses a slow detector tail (60 %), pile-up" in text
    assert "31 %) or something unknown along the time axis (9 %): this" in text
    assert "which; the first would be 21 ± 2 %" in text
    unweighed = verdict(two_found(effects=[TILT]))
    assert "scan's plane or a time zero that drifts during the scan: this capture cannot" in unweighed


def test_the_verdict_on_something_without_a_name():
    # held-out: 1.1 - 0.7 = 0.4 of excess, 0.9 - 0.7 = 0.2 left
    wrong = "Something is wrong along the time axis that no known effect explains."
    assert verdict(CASES["unexplained"]) == f"{wrong} A free term holds 50 % of the excess misfit."
    assert tone(CASES["unexplained"]) == "unexplained"
    at_noise = diagnosis(base=Scores(0.7, 0.71, 0, 0), untouched_test={}, unknown=[UNKNOWN["free_time"]])
    assert verdict(at_noise) == wrong
    several = [
        *(
            UNKNOWN[name]
            for name in ("free_response_wall", "free_spot_gain", "free_response_scan", "free_wall")
        ),
        *(free("free_lines", "wall"), free("free_rate", "rate")),
    ]
    assert verdict(diagnosis(unknown=several)).startswith(
        "Something is wrong along the time axis, differently across the wall, from spot to spot, along the"
        " time axis, differently over the course of the scan, across the wall and with the count rate that"
        " no known effect explains. 6 free terms hold "
    )
    open_ = free("free_wall", "wall", weights={"free_wall": 0.7, "vignetting": 0.3})
    assert "explains, unless it is " in verdict(diagnosis(unknown=[open_]))
    assert "(30 %): this capture cannot tell. A free" in verdict(diagnosis(unknown=[open_]))


def test_the_verdict_on_names_and_something_else():
    one = two_found(effects=[TAIL_ALONE], groups=[], unknown=[UNKNOWN["free_wall"]])
    # held-out: 1.0862 - 1.0262 = 0.06 of 1.2417 - 0.9402 = 0.3015
    assert verdict(one) == (
        "Your simulation misses a slow detector tail: 21 ± 2 % of the photons, τ = 0.39 ns. Something else is"
        " wrong across the wall that no known effect explains; a free term holds 20 % of the excess misfit."
        " Modelling all of them explains 72 % of the excess misfit."
    )
    several = verdict(CASES["both"], listed=False)
    assert several == (
        "Your simulation misses 2 things. Something else is wrong across the wall and over the course of the"
        " scan that no known effect explains; 2 free terms hold 40 % of the excess misfit. Modelling all of"
        " them explains 72 % of the excess misfit."
    )
    assert tone(CASES["both"]) == "unexplained"
    # where the gain is not known, nothing is said of it
    assert verdict(CASES["nan"]).endswith("across the wall that no known effect explains.")


def test_misfit_parts_add_up_and_keep_to_their_bounds():
    m = misfit(CASES["two"])
    assert (m.noise, m.explained, m.unexplained) == pytest.approx((0.94, 0.26, 0.10))
    assert m.untouched
    worse = misfit(two_found(untouched_test={"base": Scores(1.2, 1, 0, 0), "extended": Scores(1.3, 1, 0, 0)}))
    assert (worse.explained, worse.unexplained, worse.share) == pytest.approx((0.0, 0.2, -0.5))
    below = misfit(two_found(untouched_test={"base": Scores(1.2, 1, 0, 0), "extended": Scores(0.9, 1, 0, 0)}))
    assert (below.explained, below.unexplained, below.share) == pytest.approx((0.2, 0.0, 1.5))
    assert misfit(diagnosis(base=Scores(0.7, 0.71, 0, 0), untouched_test={})).share is None


def test_sureness_is_not_more_than_there_is():
    assert sureness(CASES["two"]).startswith(
        "The evidence for each of them is at least 961 nats; 8.16 are needed. The gain holds on wall blocks"
    )
    assert sureness(two_found(effects=[TAIL])).startswith("The evidence for it is 9123 nats; 8.16 are")
    assert "each of them is at least 512 nats" in sureness(CASES["both"])
    assert sureness(CASES["nothing"]).startswith("The most evidence, 5.48 nats, is for something unknown in")
    assert "8.16 are needed." in sureness(CASES["nothing"])
    own, other = (dataclasses.replace(TILT, needed=bar) for bar in (8.3, 249.0))
    assert "it is 961 nats; 8.30 are needed." in sureness(diagnosis(effects=[own]))
    assert "at least 961 nats; 8.30 – 249 are needed." in sureness(diagnosis(effects=[own, other]))
    assert "8.16 are needed, but other spots did not confirm it." in sureness(diagnosis(screened=screened()))
    assert "Effects tested: 23, of which 1 barely identifiable in this capture, 2 not at all" in sureness(
        CASES["nothing"]
    )
    assert "Free terms tested: 14." in sureness(CASES["nothing"])
    doubtful = dataclasses.replace(TILT, heldout_gain=Gain(1.2, 1.19, 0.001, (-0.001, 0.003)))
    assert "The gain of 1 of 2 terms holds" in sureness(two_found(effects=[TAIL, doubtful]))
    assert "nats" not in sureness(CASES["nan"])
    assert "captures" not in sureness(CASES["nan"])


@pytest.mark.parametrize(
    ("chance", "toys", "said"),
    [
        (0.42, 200, "Of 200 simulated captures without any effect, at most a share of 0.42 gave as much."),
        (1e-9, 200, "at most a share of 0.0050 gave"),  # 1/201
        (1e-9, 98, "at most a share of 0.011 gave"),  # 1/99 = 0.0101
        (0.0, 0, "without any effect: by theory, level < 10⁻³⁰⁰; no simulated captures were run."),
        (1e-9, 0, "by theory, level 1.0 × 10⁻⁹; no simulated"),
    ],
)
def test_counting_allows_no_smaller_chance_than_it_can(chance, toys, said):
    assert said in sureness(diagnosis(chance=chance, toys=toys))


def test_every_number_is_on_the_page(written):
    text = Page(written["two"].read_text(encoding="utf-8")).words
    for expected in (
        *(
            "21 ± 2 %",
            "0.39 ± 0.02 ns",
            "117 ± 6 mm of path",
            "24.4 ± 1.3 bins",
            "9123",
            "961",
        ),
        *(
            "0.0123 nats",
            "0.0111 … 0.0137",
            "1.242 → 1.190",
            "afterpulsing (19 %)",
            "split by: a capture with other background light",
        ),
        *("41.3 ± 0.9 mrad", "2.37 ± 0.05 °", "−2.1 ± 1.1 mrad", "a second scan in another order"),
        *(
            "along the time axis: 3.17 nats, 8.16 needed",
            "1.242 0.9402 0.08380 0.04320",
            "1.030 0.9300 0.05400 0.04310",
        ),
        *(
            "1,234,567",
            "0.803",
            "0.260 ns … 0.370 ns",
            "4096",
            "1503.25",
            "seed 17",
            "toys 200",
            "time taken (s) 412.7",
        ),
        *("[200, 512]", "raster", "letters <S&U>", "The splat's <width> was 0.62 bins."),
    ):
        assert expected in text, expected
    for one in CASES["two"].screened:
        assert number(one.evidence) in text
        assert describe(one.name).phrase in text


def test_scatter_is_said_where_it_is_large():
    text = Page(report_html(CASES["two"], {})).words
    one, other = (
        next(s for s in CASES["two"].screened if s.name == name) for name in ("time_drift", "pile_up")
    )
    assert f"{number(one.evidence)} {percent(one.retained_information)} 3.4 6 fraction" in text
    assert f"{number(other.evidence)} {percent(other.retained_information)} 20 fraction" in text  # 1.4


def test_free_terms_have_a_section_of_their_own(written):
    text = Page(written["both"].read_text(encoding="utf-8")).words
    part = text[text.index("What no known effect explains") : text.index("Why, and what to do on the rig")]
    assert "The most evidence is across the wall: 512 nats, 8.16 needed." in part
    for said in ("free_wall", "rms 12.0 ± 1.0 %", "1.086 → 1.026", "0.00210 nats a photon"):
        assert said in part, said
    assert "rms 23.3 ± 1.3 ps = 7.0 ± 0.4 mm of path = 1.46 ± 0.08 bins" in part
    assert "The free term free_scan_delay: something unknown in the delay over the course" in part
    assert "The free term free_wall: something unknown across the wall; 0 is no change." in part
    calm = Page(written["nothing"].read_text(encoding="utf-8")).words
    assert "No free term is needed. The most evidence of one is along the time axis: 3.17 nats" in calm
    assert "Numerics" not in calm + text


@pytest.mark.parametrize("term", FREE, ids=lambda term: term.name)
def test_every_free_term_has_words(term):
    known = describe(term.name)
    assert known.free
    assert known.phrase.startswith("something unknown ")
    assert headline(term.name, {"rms": Estimate(0.12, 0.01, known.number("rms").unit)}).endswith(" rms")
    assert term.axis in AXES
    assert not any(describe(effect.name).free for effect in EFFECTS)


def test_the_cases_hold_every_free_term():
    assert {term.name for term in FREE} == set(FREE_NAMES)


def test_values_that_are_not_numbers_are_dashes(written):
    text = Page(written["nan"].read_text(encoding="utf-8")).words
    assert not re.search(r"\bnan\b|\binf\b|None", text)
    assert "20.0 ± ? %" in text


def test_markup_in_names_is_escaped(written):
    page = written["nothing"].read_text(encoding="utf-8")
    assert "letters &lt;S&amp;U&gt;" in page
    assert "<S&U>" not in page
    assert "<width>" not in page
    wild = free("free_<b>", "<em>axis", weights={"free_<b>": 0.5, "<u>": 0.5}, split_by="<s>&")
    page = report_html(diagnosis(unknown=[wild], groups=[["free_<b>", "<u>"]]), {})
    assert Page(page).tags.isdisjoint({"em", "u", "s"})
    assert page.count("free_&lt;b&gt;") >= 3
    for said in ("&lt;em&gt;axis", "&lt;u&gt; (50 %)", "&lt;s&gt;&amp;"):
        assert said in page, said


def test_what_was_accepted_with_little_evidence_at_first_is_explained():
    """The table holds what was asked for beside the scene without effects."""
    (has,) = (s.evidence for s in two_found().screened if s.name == "irf_tail")
    for more, told in ((0.1, True), (-0.1, False)):
        page = report_html(two_found(effects=[TAIL_ALONE], groups=[], needed=has + more), {})
        assert ("Accepted with less here" in Page(page).words) is told


def test_what_could_not_have_been_seen_is_said():
    text = Page(report_html(CASES["nothing"], {})).words
    limits = text[text.index("What could not have been seen") :]
    assert "ghost_pulse at no possible strength barely identifiable" in limits
    assert "pile_up at no possible strength" in limits  # 1.5 detections a cycle
    assert "time_offset strength 0.167 ns barely identifiable" in limits  # 50 mm of path
    assert "irf_tail fraction 0.430 %" in limits
    assert "time_drift coefficients 7.00 ps" in limits  # 2.1 mm of path
    order = [limits.index(name) for name in ("ghost_pulse", "time_offset", "irf_tail")]
    assert order == sorted(order)


@pytest.mark.parametrize(
    ("value", "stderr", "text"),
    [
        (0.2113, 0.021, "0.21 ± 0.02"),
        (5.4321, 0.0123, "5.432 ± 0.012"),
        (1234.5, 56.0, "1230 ± 60"),
        (-0.001, 0.2, "0.0 ± 0.2"),
        (3.0, 0.0, "3.00 ± ?"),
        (2e-9, 3e-10, "2.00 × 10⁻⁹ ± 3 × 10⁻¹⁰"),
    ],
)
def test_values_are_rounded_where_their_error_is(value, stderr, text):
    assert plus_minus(value, stderr) == text


def test_units_people_think_in():
    # 0.01 m of path is 33.36 ps; light takes 1 ns for 299.8 mm
    assert quantity("time_offset", "offset", Estimate(0.01, 0.001, "m"), 0.005) == [
        "33 ± 3 ps",
        "10.0 ± 1.0 mm of path",
        "2.0 ± 0.2 bins",
    ]
    assert quantity("time_offset", "offset", Estimate(0.01, 0.001, "m"), None) == [
        "33 ± 3 ps",
        "10.0 ± 1.0 mm of path",
    ]
    assert quantity("occlusion", "z", Estimate(0.25, 0.03, "m"), 0.005) == ["250 ± 30 mm"]
    assert quantity("pile_up", "detections", Estimate(0.8, 0.03, "1"), None) == ["0.80 ± 0.03"]
    assert quantity("direct_leak", "amplitude", Estimate(0.8, 0.03, "counts/bin"), None) == [
        "0.80 ± 0.03 counts/bin"
    ]
    assert quantity("irf_tail", "fraction", Estimate(0.8, 0.03, "counts"), None) == ["0.80 ± 0.03 counts"]
    assert quantity("tcspc_nonlinearity", "period", Estimate(16.0, 0.2, "bins"), 0.002998)[1] == "160 ± 2 ps"
    assert amount("wall_tilt", "tilt_x", 0.04, None) == "40.0 mrad"
    assert (number(0), number(None), number(-1.5e-7, 2), number(math.inf)) == ("0", "–", "−1.5 × 10⁻⁷", "–")
    assert (probability(0.0), probability(0.031), probability(NAN)) == ("< 10⁻³⁰⁰", "0.031", "–")
    assert (probability(0.0311), probability(0.999), probability(3e-14)) == ("0.032", "1.0", "3.0 × 10⁻¹⁴")


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_every_effect_has_words_and_a_headline_that_works(effect):
    words = describe(effect.name).words
    assert words.cause.endswith(".")
    assert words.remedy.endswith(".")
    fields = re.findall(r"{(\w+)}", words.headline)
    assert fields
    text = headline(effect.name, {field: Estimate(0.7, 0.1, "1") for field in fields})
    assert len(re.findall(r"\b(0\.70?|70)\b", text)) == len(fields), text


@pytest.mark.parametrize("built", EFFECTS, ids=lambda effect: effect.name)
def test_words_speak_of_the_registry_s_parameters_in_their_units(built):
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.4, 0.4, 5), indexing="ij")
    wall, up = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), np.tile([0.0, 0.0, 1.0], (25, 1))
    counts = np.random.default_rng(2).poisson(3.0, (25, 120)).astype(np.uint16)
    effect = built(Scan.of(Capture(counts, wall, wall, up, up, bin_length=0.02, gate=(30, 110))))
    words, declared = describe(effect.name), effect.declared
    with torch.no_grad():
        units = {name: q.unit for name, q in effect.quantities().items()} | {
            p.name: p.unit for p in declared.values()
        }
    assert {f"{name} {UNIT_OF_KIND[words.kind_of(name)]}" for name in units} == {
        f"{n} {u}" for n, u in units.items()
    }
    for p in declared.values():
        assert words.null_of(p.name) == p.null, p.name
    assert set(re.findall(r"{(\w+)}", words.words.headline)) - {"share"} <= set(units)


def test_what_the_words_of_an_effect_say_of_its_numbers():
    """Worked out by hand."""
    for effect, shape in (("irf_tail", "decay"), ("tcspc_nonlinearity", "period"), ("occlusion", "z")):
        assert describe(effect).null_of(shape) is None
    assert describe("retroreflection").null_of("falloff") == 4.0
    assert describe("higher_order_bounces").kind_of("share") == "percent"
    assert describe("hot_spots").kind_of("number") == "plain"
    assert describe("time_drift").kind_of("peak_to_peak") == "time"
    assert describe("power_drift").kind_of("peak_to_peak") == "percent"
    assert [describe(e).number("fraction").share for e in ("irf_tail", "ghost_pulse")] == [True, True]
    assert not describe("clock_scale").number("scale").share


def test_an_effect_without_words_is_called_by_its_name():
    new = Accepted(
        "dust_cloud",
        {"optical_depth": Estimate(0.4, 0.05, "1")},
        99.0,
        Gain(1.2, 1.1, 0.01, (0.005, 0.02)),
    )
    text = verdict(two_found(effects=[new], groups=[]))
    assert text.startswith("Your simulation misses dust cloud: optical depth 0.40 ± 0.05; modelling it")
    assert headline("irf_tail", {"fraction": Estimate(0.2, 0.02, "1")}) == "fraction 20 ± 2 %"


def test_what_is_likely_is_told_and_not_named():
    """Where the fit is at the noise nothing is left for it to explain."""
    wall = Likely("wall_reflectance", 4889.0, 1073.0, 0.38, 220.0, 671.0)
    above = Scores(0.7853, 0.7113, 0.02, 0.015)
    said = diagnosis(base=above, untouched_test={}, likely=[wall])
    assert tone(said) == "unexplained"
    assert verdict(said).startswith("No cause is certain for what is left, 10 % above counting noise.")
    assert "explains 38 % of it elsewhere on the wall" in verdict(said)
    page = report_html(said, {})
    assert "What is likely, and not certain" in page
    assert "predicted better by 4889 ± 1073 nats" in page
    named = verdict(two_found(effects=[TAIL_ALONE], groups=[], likely=[wall]))
    alone = verdict(two_found(effects=[TAIL_ALONE], groups=[]))
    beside = alone.replace("modelling it explains", "modelling it with what is likely besides explains")
    assert beside != alone
    assert named.startswith(f"{beside} Likely besides")
    assert named.endswith(", 38 % of what is left elsewhere on the wall.")
    calm = diagnosis(base=Scores(0.7113, 0.7113, 0.015, 0.015), untouched_test={}, likely=[wall])
    assert (tone(calm), at_noise(calm)) == ("fine", True)
    assert "What is likely" not in report_html(diagnosis(base=above, untouched_test={}), {})
