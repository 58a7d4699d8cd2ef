"""The documentation's example of a new effect, followed to the letter."""

from __future__ import annotations

import dataclasses
import doctest
import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from effect_contract import BIN, EffectContract, scene
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, raster, surfels
from report_cases import diagnosis, screened

from data_modules.simulate import ScanPlan, SensorModel
from data_modules.simulate.scenes import plate
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS, Effect, build_effects
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE, FREE_NAMES
from nlos_lit.inference.problem import build_problem
from nlos_lit.inference.result import Accepted, Estimate, Gain
from nlos_lit.inference.screening import screen
from nlos_lit.report.page import report_html, write_report
from nlos_lit.report.quantities import headline
from nlos_lit.report.verdict import verdict
from nlos_lit.report.words import describe
from nlos_lit.surfels.measure import measure

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
(CODE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
(NAME,) = re.findall(r"\*\*The file\*\* is `nlos_lit/effects/(\w+)\.py`", PAGE)
(LINE,) = re.findall(r"\*\*The line\*\* is `(.*?)`", PAGE)
(AFTER,) = re.findall(r"here after `\"(\w+)\",`", PAGE)


@pytest.fixture(scope="module")
def glow(tmp_path_factory) -> Iterator[type[Effect]]:
    """The example as a file, and its line in the registry; its own where somebody has followed the page."""
    if there := EFFECTS.named(NAME):
        yield there
        return
    file = tmp_path_factory.mktemp("effects") / f"{NAME}.py"
    file.write_text(CODE, encoding="utf-8")
    full = f"nlos_lit.effects.{NAME}"
    spec = importlib.util.spec_from_file_location(full, file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[full] = module
    spec.loader.exec_module(module)
    (effect,) = (v for v in vars(module).values() if isinstance(v, type) and vars(v).get("name") == NAME)
    with EFFECTS.added(effect, after=AFTER):
        yield effect
    del sys.modules[full]


class TestTheExample(EffectContract):
    @pytest.fixture
    def built(self, glow: type[Effect]) -> type[Effect]:
        return glow


def test_the_line_names_the_file():
    assert f'"{NAME}",' == LINE


def test_the_example_s_own_examples_run(glow):
    tests = doctest.DocTestFinder().find(sys.modules[glow.__module__])
    ran = [doctest.DocTestRunner().run(one) for one in tests]
    assert sum(r.attempted for r in ran) > 3
    assert sum(r.failed for r in ran) == 0


def test_the_example_does_what_it_says(glow):
    built = glow(scene("confocal")[1])
    built.set("fraction", 0.3)
    built.set("duration", 4.5 * BIN)
    kernel = torch.zeros(10)
    kernel[3] = 1.0
    by_hand = torch.zeros(3 + 64)
    by_hand[3:7] = 0.3 / 4.5
    by_hand[7] = 0.3 * 0.5 / 4.5
    by_hand[3] += 1
    assert built.response(kernel, 3).detach() == pytest.approx(by_hand, abs=1e-5)


def test_the_example_acts_where_its_line_stands(glow):
    assert EFFECTS.index(glow) == EFFECTS.names.index(AFTER) + 1
    scan = scene("confocal")[1]
    acting = build_effects(["pile_up", NAME, "irf_tail"], scan)
    assert [effect.name for effect in acting] == ["irf_tail", NAME, "pile_up"]
    assert (glow.stage, glow.needs_paths) == ("response", False)


def test_the_example_is_simulated(glow):
    """With a strength given it adds that share of the light; with none it has its typical one."""
    mesh, plan = plate((0.0, 0.0, 0.4), 0.3, 0.3), ScanPlan(nx=3, ny=2, width=0.5, height=0.4, n_bins=200)
    sensor = SensorModel(mean_counts=800, background=0.1)
    values = {f"{NAME}.fraction": 0.3, f"{NAME}.duration": 20 * plan.bin_length}
    plain, _ = measure(mesh, plan, sensor, None, [], {})
    glowing, _ = measure(mesh, plan, sensor, None, [NAME], values)
    more = (glowing.counts - plain.counts).sum(1) / (plain.counts - 0.1).sum(1)
    assert more == pytest.approx(np.full(6, 0.3), rel=1e-3)
    told = glowing.provenance["effects"][NAME]
    assert told["fraction"] == {"value": pytest.approx(0.3), "unit": "1"}
    assert told["duration"] == {"value": pytest.approx(20 * plan.bin_length), "unit": "m"}
    usual, _ = measure(mesh, plan, sensor, 1, [NAME], {})
    assert usual.provenance["effects"][NAME]["fraction"]["value"] == pytest.approx(0.2)


@FORWARD_MODE
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_the_example_is_found_among_all_effects(glow, seed):
    """Counts drawn with it, a base without it: nothing else in the pool has as much evidence.

    It is weak enough that one linear step reaches it, and the light bright enough to tell it from a tail.
    """
    measured = capture_of(raster(8))
    scan, model = Scan.of(measured), surfels(measured, level=30.0)
    hidden = effect_of(NAME, scan, fraction=0.02, duration=0.3)
    counts = drawn(model, Extension([hidden]), measured, seed=seed)
    spots = torch.arange(measured.n_spots)
    problem = build_problem(model, Extension([]), spots, torch.from_numpy(counts.gated_counts()))
    candidates = screen(problem, [e(scan) for e in [*EFFECTS, *FREE]], spots % 6)
    assert {c.name for c in candidates} == {*EFFECTS.names, *FREE_NAMES}
    best = candidates[0]
    assert best.name == NAME
    assert best.evidence > 20
    assert best.shape["duration"] == pytest.approx(0.3, rel=0.5)


def test_the_example_is_reported_in_its_words(glow, tmp_path):
    sizes = {"fraction": Estimate(0.213, 0.021, "1"), "duration": Estimate(0.117, 0.006, "m")}
    tells, gain = EFFECTS.splitting("irf_tail", NAME), Gain(1.2, 1.1, 0.01, (0.005, 0.02))
    found = Accepted(NAME, sizes, 900.0, gain, {NAME: 0.8, "irf_tail": 0.2}, tells)
    of_it = dataclasses.replace(screened()[0], name=NAME, detectable={"fraction": 1.2})
    whole = diagnosis(effects=[found], groups=[[NAME, "irf_tail"]], screened=[*screened(), of_it])
    assert headline(NAME, sizes) == "21 ± 2 % of the pulse's energy, over 0.39 ns"
    assert "Your simulation misses a laser that keeps glowing after its pulse (80 %) or" in verdict(whole)
    assert "the former would be 21 ± 2 %" in verdict(whole)
    page = report_html(whole, {})
    words = describe(NAME).words
    assert words == glow.words
    for sentence in (words.cause, words.remedy, glow.split_by["irf_tail"]):
        assert sentence.replace("'", "&#x27;") in page
    assert re.search(rf"{NAME}</td><td[^>]*>at no possible strength", page), "a share cannot exceed 1"
    assert write_report(whole, tmp_path).exists()
