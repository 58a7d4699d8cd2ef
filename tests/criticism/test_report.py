"""The report: what it says, that every number is in it, that it needs nothing but itself; figures show what they should."""

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
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nlos_lit.capture import Capture
from nlos_lit.criticism import plots
from nlos_lit.criticism.quantities import UNIT_OF_KIND, amount, headline, number, plus_minus, probability, quantity
from nlos_lit.criticism.report import log_figures, report_html, write_report
from nlos_lit.criticism.result import Accepted, Diagnosis, Estimate, Gain, Profile, Scores, Screened, Unexplained
from nlos_lit.criticism.verdict import misfit, sureness, verdict
from nlos_lit.criticism.words import WORDS, describe
from nlos_lit.effects import build_effects
from nlos_lit.effects.scan import Scan

NAMES = re.findall(
    r"\w+",
    "retroreflection specular_lobe occlusion higher_order_bounces time_offset time_drift timing_jitter clock_scale wall_tilt "
    "laser_sensor_baseline irf_tail ghost_pulse power_drift wall_reflectance vignetting ambient_map hot_spots background_slope "
    "direct_leak pile_up afterpulsing tcspc_nonlinearity gate_edges",
)
NAN = float("nan")
TAIL = Accepted(
    "irf_tail",
    {"fraction": Estimate(0.2113, 0.021, "1"), "decay": Estimate(0.117, 0.0062, "m")},
    9123.0,
    3e-14,
    Gain(1.2417, 1.1903, 0.01234, (0.0111, 0.0137)),
    ["afterpulsing"],
    "a capture with other background light",
)
TILT = Accepted(
    "wall_tilt",
    {"tilt_x": Estimate(0.0413, 0.0009, "rad"), "tilt_y": Estimate(-0.0021, 0.0011, "rad")},
    961.0,
    0.0,
    Gain(1.1903, 1.0862, 0.0045, (0.0031, 0.0058)),
    split_by="a second scan in another order",
)
WITNESS = {
    "direct_pulse_counts": 1234567,
    "wall_gain_correlation": 0.803,
    "tail_decay_fitted_m": 0.117,
    "tail_decay_direct_m": [0.078, 0.111],
    "maps": {"direct": [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]], "fitted": [[0.1, 0.2, 0.28], [0.2, 0.41, None]]},
}


def screened() -> list[Screened]:
    rng = np.random.default_rng(3)
    found = []
    for k, name in enumerate(NAMES):
        statistic = float(np.exp(rng.uniform(0, 9)))
        limits = {"time_drift": {"coefficients": 0.0021}, "irf_tail": {"fraction": 0.0043}, "pile_up": {"detections": 1.5}}
        limit = {"ghost_pulse": {"fraction": math.inf}, **limits}.get(name, {"strength": 0.01 * (k + 1)})
        shape = {"decay": 0.15} if name == "irf_tail" else {}
        kept = {"time_offset": 0.0021, "ghost_pulse": NAN}.get(name, rng.uniform(0.1, 1))
        found.append(
            Screened(name, statistic, math.exp(-statistic / 2), kept, 1 + k, statistic / 2 - 3, {"fraction": 0.19}, shape, limit)
        )
    return found


def profiles(strength: float) -> list[Profile]:
    """Residuals with a bump at one place of each axis (the wall's at high x, low y), gone afterwards."""
    rng = np.random.default_rng(1)
    found = []
    for axis, unit, edges in (
        ("time", "bins", np.arange(200, 361, 4)),
        ("depth", "m", np.linspace(0.4, 1.2, 31)),
        ("scan", "spot", np.linspace(0, 4096, 65)),
        ("rate", "counts per spot", np.linspace(800, 2100, 11)),
    ):
        noise = rng.normal(size=len(edges) - 1)
        bump = strength * np.exp(-0.5 * ((np.arange(len(noise)) - 0.3 * len(noise)) / (0.06 * len(noise))) ** 2)
        found.append(Profile(axis, unit, edges.astype(float), noise + bump, noise))
    noise = rng.normal(size=(8, 6))
    before = noise.copy()
    before[7, 0] += strength
    before[2, 3] = noise[2, 3] = NAN
    found.append(Profile("wall", "m", np.linspace(-1, 1, 9), before, noise, np.linspace(-0.6, 0.6, 7)))
    return found


def diagnosis(**changes) -> Diagnosis:
    """Nothing accepted, at the noise, unless changed."""
    base = Scores(0.7219, 0.7113, 0.0167, 0.0152)
    capture = {
        "name": "letters <S&U>",
        "kind": "confocal",
        "spots": 4096,
        "bins": 512,
        "bin_length": 0.0048,
        "bin_width_ps": 16.0111,
        "counts_per_spot": 1503.25,
        "gate": [200, 512],
        "scan_order": "raster",
    }
    whole = Diagnosis(
        effects=[],
        groups=[],
        unexplained=Unexplained(False, "time", 31.7, 0.42),
        screened=screened(),
        base=base,
        extended=base,
        untouched_test={"base": base, "extended": base},
        witness=None,
        profiles=profiles(0.0),
        numerics={"splat_width": 0.00117},
        notes=["The splat's <width> was 0.62 bins."],
        capture=capture,
        toys=200,
        seconds=412.7,
        seed=17,
    )
    return dataclasses.replace(whole, **changes)


def two_found(**changes) -> Diagnosis:
    test = {"base": Scores(1.3, 0.94, 0.081, 0.043), "extended": Scores(1.03, 0.93, 0.054, 0.0431)}
    found = {
        "effects": [TAIL, TILT],
        "groups": [["wall_tilt", "time_drift"]],
        "base": Scores(1.2417, 0.9402, 0.0838, 0.0432),
        "extended": Scores(1.0351, 0.9251, 0.0537, 0.0433),
        "untouched_test": test,
        "profiles": profiles(45.0),
        "witness": WITNESS,
    }
    return diagnosis(**(found | changes))


CASES = {
    "nothing": diagnosis(),
    "two": two_found(),
    "unexplained": diagnosis(
        unexplained=Unexplained(True, "time", 912.0, 1e-9), base=Scores(1.1, 0.7, 0.05, 0.01), profiles=profiles(9.0), toys=0
    ),
    "bare": diagnosis(screened=[], profiles=[], untouched_test={}, numerics={}, notes=[], capture={}, toys=0),
    "nan": two_found(
        effects=[
            Accepted(
                "irf_tail",
                {"fraction": Estimate(0.2, NAN, "1"), "decay": Estimate(NAN, NAN, "m")},
                NAN,
                NAN,
                Gain(NAN, NAN, NAN, (NAN, NAN)),
            )
        ],
        extended=Scores(NAN, NAN, NAN, NAN),
        untouched_test={"base": Scores(NAN, NAN, NAN, NAN), "extended": Scores(NAN, NAN, NAN, NAN)},
        screened=[Screened("pile_up", NAN, NAN, NAN, 1, NAN, {"detections": NAN}, {}, {"detections": math.inf})],
        profiles=[Profile("time", "bins", np.arange(4.0), np.full(3, NAN), np.array([1.0, NAN, 4.0]))],
        witness={
            "direct_pulse_counts": 0,
            "wall_gain_correlation": None,
            "tail_decay_fitted_m": None,
            "tail_decay_direct_m": None,
            "maps": None,
        },
    ),
}


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
        self.sources += [value for name, value in attributes if name in ("src", "href", "srcset", "data", "action")]
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
    assert sorted(p.name for p in written[case].parent.iterdir()) == ["diagnosis.json", "figures", "report.html"]


@pytest.mark.parametrize("case", CASES)
def test_json_is_the_diagnosis(written, case):
    read = json.loads((written[case].parent / "diagnosis.json").read_text(encoding="utf-8"))
    assert read == CASES[case].to_dict()
    assert set(read) == {
        *("effects", "groups", "unexplained", "screened", "base", "extended", "untouched_test", "seconds", "seed"),
        *("witness", "profiles", "numerics", "notes", "capture", "toys"),
    }
    assert set(read["unexplained"]) == {"significant", "axis", "statistic", "p_value"}
    for effect in read["effects"]:
        assert set(effect) == {"name", "parameters", "statistic", "p_value", "heldout_gain", "confusable_with", "split_by"}
        assert all(set(p) == {"value", "stderr", "unit"} for p in effect["parameters"].values())
        assert set(effect["heldout_gain"]) == {"deviance_per_bin_before", "deviance_per_bin_after", "nats_per_photon", "ci95"}
        assert len(effect["heldout_gain"]["ci95"]) == 2
    for one in read["screened"]:
        assert {"name", "statistic", "p_value", "retained_information", "detectable"} <= set(one)


def test_json_of_values_that_are_not_numbers_is_null(written):
    read = json.loads((written["nan"].parent / "diagnosis.json").read_text(encoding="utf-8"))
    assert read["effects"][0]["parameters"]["fraction"] == {"value": 0.2, "stderr": None, "unit": "1"}
    assert read["screened"][0]["detectable"] == {"detections": None}
    assert read["profiles"][0]["before"] == [None] * 3


def test_verdicts():
    tail = "Your simulation misses a slow detector tail: 21 ± 2 % of the photons, τ = 0.39 ns"
    # excess on untouched spots: 1.30 - 0.94 = 0.36 before, 1.03 - 0.93 = 0.10 after, so 72 % explained
    assert verdict(two_found(effects=[TAIL], groups=[])) == f"{tail}; modelling it explains 72 % of the excess misfit."
    # without untouched spots: (1.2417 - 0.9402) = 0.3015, (1.0351 - 0.9251) = 0.11: 64 %
    assert "64 % of" in verdict(two_found(effects=[TAIL], groups=[], untouched_test={}))
    assert verdict(CASES["nothing"]) == "Nothing in the registry is needed: the fit is at the noise."
    assert verdict(CASES["unexplained"]) == "Something is wrong along the time axis that no known effect explains."
    both = verdict(CASES["two"])
    assert both.startswith("Your simulation misses 2 things: (1) a slow detector tail")
    assert "41.3 ± 0.9 mrad along x" in both
    assert "(or a time zero that drifts during the scan: this capture cannot tell which); modelling them" in both
    group = verdict(diagnosis(groups=[["pile_up", "time_offset"]]))
    assert group.startswith("Your simulation misses one of these, and this capture cannot tell which: pile-up")
    left = verdict(two_found(unexplained=Unexplained(True, "wall", 80.0, 1e-4)))
    assert left.endswith("Something is still wrong across the wall that no known effect explains.")
    # 0.0740 / 0.7113 above noise, not significant
    above = diagnosis(base=Scores(0.7853, 0.7113, 0.02, 0.015), untouched_test={})
    assert "at the noise" not in verdict(above)
    assert "10 % above counting noise" in verdict(above)


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
    assert "any one of these effects is 3.0 × 10⁻¹⁴. The gain holds" in sureness(CASES["two"])
    assert "200 simulated captures" in sureness(CASES["two"])
    assert "leaves what stays unexplained is 1.0 × 10⁻⁹." in sureness(CASES["unexplained"])
    assert "no simulated captures were run" in sureness(CASES["unexplained"])
    assert "Effects tested: 23, of which 1 barely identifiable in this capture, 2 not at all" in sureness(CASES["nothing"])
    doubtful = dataclasses.replace(TILT, heldout_gain=Gain(1.2, 1.19, 0.001, (-0.001, 0.003)))
    assert "The gain of 1 of 2 effects holds" in sureness(two_found(effects=[TAIL, doubtful]))
    assert "chance that noise alone would look" not in sureness(CASES["nan"])


def test_every_number_is_on_the_page(written):
    text = Page(written["two"].read_text(encoding="utf-8")).words
    for expected in (
        *("21 ± 2 %", "0.39 ± 0.02 ns", "117 ± 6 mm of path", "24.4 ± 1.3 bins", "9123", "3.0 × 10⁻¹⁴", "< 10⁻³⁰⁰"),
        *("0.0123 nats", "0.0111 … 0.0137", "1.242 → 1.190", "afterpulsing", "split by: a capture with other background light"),
        *("41.3 ± 0.9 mrad", "2.37 ± 0.05 °", "−2.1 ± 1.1 mrad", "a second scan in another order"),
        *("statistic 31.7, p = 0.42", "1.242 0.9402 0.08380 0.04320", "1.030 0.9300 0.05400 0.04310"),
        *(
            "splat width 0.00117",
            "1,234,567",
            "0.803",
            "0.260 ns … 0.370 ns",
            "4096",
            "1503.25",
            "seed 17",
            "toys 200",
            "seconds 412.7",
        ),
        *("[200, 512]", "raster", "letters <S&U>", "The splat's <width> was 0.62 bins."),
    ):
        assert expected in text, expected
    for one in CASES["two"].screened:
        assert number(one.statistic) in text
        assert number(one.predicted_gain) in text
        assert describe(one.name).phrase in text


def test_values_that_are_not_numbers_are_dashes(written):
    text = Page(written["nan"].read_text(encoding="utf-8")).words
    assert not re.search(r"\bnan\b|\binf\b|None", text)
    assert "20.0 ± ? %" in text


def test_markup_in_names_is_escaped(written):
    page = written["nothing"].read_text(encoding="utf-8")
    assert "letters &lt;S&amp;U&gt;" in page
    assert "<S&U>" not in page
    assert "<width>" not in page


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
    [(0.2113, 0.021, "0.21 ± 0.02"), (5.4321, 0.0123, "5.432 ± 0.012"), (1234.5, 56.0, "1230 ± 60"), (-0.001, 0.2, "0.0 ± 0.2"),
     (3.0, 0.0, "3.00 ± ?"), (2e-9, 3e-10, "2.00 × 10⁻⁹ ± 3 × 10⁻¹⁰")],
)  # fmt: skip
def test_values_are_rounded_where_their_error_is(value, stderr, text):
    assert plus_minus(value, stderr) == text


def test_units_people_think_in():
    # 0.01 m of path is 33.36 ps; light takes 1 ns for 299.8 mm
    assert quantity("time_offset", "offset", Estimate(0.01, 0.001, "m"), 0.005) == [
        "33 ± 3 ps",
        "10.0 ± 1.0 mm of path",
        "2.0 ± 0.2 bins",
    ]
    assert quantity("time_offset", "offset", Estimate(0.01, 0.001, "m"), None) == ["33 ± 3 ps", "10.0 ± 1.0 mm of path"]
    assert quantity("occlusion", "z", Estimate(0.25, 0.03, "m"), 0.005) == ["250 ± 30 mm"]
    assert quantity("pile_up", "detections", Estimate(0.8, 0.03, "1"), None) == ["0.80 ± 0.03"]
    assert quantity("direct_leak", "amplitude", Estimate(0.8, 0.03, "counts/bin"), None) == ["0.80 ± 0.03 counts/bin"]
    assert quantity("irf_tail", "fraction", Estimate(0.8, 0.03, "counts"), None) == ["0.80 ± 0.03 counts"]
    assert quantity("tcspc_nonlinearity", "period", Estimate(16.0, 0.2, "bins"), 0.002998)[1] == "160 ± 2 ps"
    assert amount("wall_tilt", "tilt_x", 0.04, None) == "40.0 mrad"
    assert (number(0), number(None), number(-1.5e-7, 2), number(math.inf)) == ("0", "–", "−1.5 × 10⁻⁷", "–")
    assert (probability(0.0), probability(0.031), probability(NAN)) == ("< 10⁻³⁰⁰", "0.031", "–")


def test_every_effect_has_words_and_a_headline_that_works():
    assert set(WORDS) == set(NAMES)
    for name, words in WORDS.items():
        assert words.cause.endswith(".")
        assert words.remedy.endswith(".")
        fields = re.findall(r"{(\w+)}", words.headline)
        assert fields
        text = headline(name, {field: Estimate(0.7, 0.1, "1") for field in fields})
        assert len(re.findall(r"\b(0\.70?|70)\b", text)) == len(fields), text


def test_words_speak_of_the_registry_s_parameters_in_their_units():
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.4, 0.4, 5), indexing="ij")
    wall, up = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), np.tile([0.0, 0.0, 1.0], (25, 1))
    counts = np.random.default_rng(2).poisson(3.0, (25, 120)).astype(np.uint16)
    scan = Scan.of(Capture(counts, wall, wall, up, up, bin_length=0.02, gate=(30, 110)))
    for effect in build_effects(NAMES, scan):
        words, declared = describe(effect.name), effect.declared
        with torch.no_grad():
            units = {name: q.unit for name, q in effect.quantities().items()} | {p.name: p.unit for p in declared.values()}
        assert {f"{name} {UNIT_OF_KIND[words.kind_of(name)]}" for name in units} == {f"{n} {u}" for n, u in units.items()}, (
            effect.name
        )
        for p in declared.values():
            assert words.null_of(p.name) == p.null, (effect.name, p.name)
        assert set(re.findall(r"{(\w+)}", words.headline)) - {"share"} <= set(units), effect.name


def test_an_effect_without_words_is_called_by_its_name():
    new = Accepted("dust_cloud", {"optical_depth": Estimate(0.4, 0.05, "1")}, 99.0, 1e-6, Gain(1.2, 1.1, 0.01, (0.005, 0.02)))
    text = verdict(two_found(effects=[new], groups=[]))
    assert text.startswith("Your simulation misses dust cloud: optical depth 0.40 ± 0.05; modelling it")
    assert headline("irf_tail", {"fraction": Estimate(0.2, 0.02, "1")}) == "fraction 20 ± 2 %"


def test_profiles_are_drawn_where_they_are():
    profile = profiles(45.0)[0]
    figure = plots.residual_profile(profile, 0.0048)
    before, after = figure.axes[:2]
    assert "before" in before.get_title("left")
    lines = [patch for patch in before.patches if hasattr(patch, "get_data") and patch.get_data().baseline is None]
    np.testing.assert_array_equal(lines[0].get_data().values, profile.before)
    np.testing.assert_array_equal(lines[0].get_data().edges, profile.edges)
    assert before.get_ylim() == after.get_ylim()
    assert f"{int((np.abs(profile.before) > 3).sum())} of 40 beyond 3σ (chance: 0.11)" in before.get_title("left")
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
