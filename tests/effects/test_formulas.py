"""Formulas: what each form and each place does, and the effect files that they are offered as."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from effect_contract import BIN, GATE, EffectContract, scene

from nlos_lit.effects import EFFECTS, Effect
from nlos_lit.effects.formulas import FORMS, FORMULAS, PLACES, formulas_of, written
from nlos_lit.effects.free_terms import FREE_NAMES

BY_NAME = {each.name: each for each in FORMULAS}
# Every place and every form once at least, with an effect of the registry's end of the same stage.
OFFERED = {
    "counts_over_scan_step": "crosstalk",
    "background_over_scan_wave": "direct_tail",
    "delay_over_scan_cubic": "clock_scale",
    "width_over_scan_power": "direct_tail",
    "counts_over_time_decay": "crosstalk",
    "counts_over_rate_log": "crosstalk",
}


def loaded(name: str, folder: Path, found: str = "a test.") -> type[Effect]:
    """The effect of an offered file."""
    file = folder / f"{name}.py"
    file.write_text(written(BY_NAME[name], found), encoding="utf-8")
    spec = importlib.util.spec_from_file_location(f"nlos_lit.effects.{name}", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    del sys.modules[module.__name__]
    (effect,) = (v for v in vars(module).values() if isinstance(v, type) and vars(v).get("name") == name)
    return effect


class TestOfferedFiles(EffectContract):
    """They keep to all that effects of the registry keep to."""

    @pytest.fixture(params=OFFERED)
    def built(self, request: pytest.FixtureRequest, tmp_path_factory) -> Iterator[type[Effect]]:
        effect = loaded(request.param, tmp_path_factory.mktemp("effects"))
        with EFFECTS.added(effect, after=OFFERED[request.param]):
            yield effect


def test_an_offered_file_does_what_was_fitted(tmp_path):
    scan = scene("confocal")[1]
    own, file = BY_NAME["counts_over_scan_wave"](scan), loaded("counts_over_scan_wave", tmp_path)(scan)
    for effect in (own, file):
        effect.set_all({"sine": 0.3, "cosine": -0.1, "frequency": 2.5})
    seen = torch.full((10, GATE[1]), 7.0)
    assert torch.equal(own.counting(seen, torch.arange(10)), file.counting(seen, torch.arange(10)))


def test_what_a_capture_is_called_cannot_become_code(tmp_path):
    hostile = 'x"""\nraise SystemExit\n"""\\'
    text = written(BY_NAME["counts_over_scan_step"], hostile)
    assert "Source: xraise SystemExit" in text
    assert "place −0.41 ± 3 %" in written(BY_NAME["counts_over_scan_step"], "place −0.41 ± 3 %")
    assert max(map(len, text.splitlines())) <= 110
    assert loaded("counts_over_scan_step", tmp_path, hostile).name == "counts_over_scan_step"


def test_names_are_those_of_nothing_else():
    names = [each.name for each in FORMULAS]
    assert len(set(names)) == len(names)
    assert not set(names) & {*EFFECTS.names, *FREE_NAMES}


def test_each_place_is_a_free_term_s_and_has_its_forms():
    found = {place.free.name: {each.form for each in formulas_of(place.free.name)} for place in PLACES}
    every = {form.form for form in FORMS}
    assert found.pop("free_width_scan") == {"step", "decay", "power", "log"}, "a variance is not negative"
    assert set(found) < FREE_NAMES
    assert all(forms == every for forms in found.values())
    assert {place.free.axis for place in PLACES} == {"scan", "time", "rate"}
    assert formulas_of("free_wall") == formulas_of("timing_jitter") == []


@pytest.mark.parametrize(
    ("form", "values", "at"),
    [
        ("step", {"height": 2.0, "place": 0.5}, [0.0, 1.0, 2.0]),
        ("decay", {"start": 2.0, "decay": 0.5}, [2.0, 2 / np.e, 2 / np.e**2]),
        ("power", {"end": 2.0, "exponent": 2.0}, [0.0, 0.5, 2.0]),
        ("wave", {"sine": 2.0, "cosine": 1.0, "frequency": 0.5}, [1.0, 2.0, -1.0]),
        ("log", {"slope": -2.0, "knee": 0.5}, [0.0, -2 * np.log(2), -2 * np.log(3)]),
        ("cubic", {"first": 1.0, "second": 2.0, "third": 0.5}, [0.0, 0.5 + 0.5 + 0.0625, 3.5]),
    ],
)
def test_forms_by_hand(form, values, at):
    """At the axis' start, middle and end."""
    built = BY_NAME[f"counts_over_time_{form}"](scene("confocal")[1])
    built.set_all(values)
    assert built.f(torch.tensor([0.0, 0.5, 1.0])).detach().numpy() == pytest.approx(at, abs=1e-5)


def test_places_by_hand():
    """The last spot of the scan, or the last bin, is where a power law reaches its end."""
    scan = scene("confocal")[1]
    last = torch.tensor([int(scan.rank.argmax())])

    def built(place: str, end: float) -> Effect:
        effect = BY_NAME[f"{place}_power"](scan)
        effect.set_all({"end": end, "exponent": 1.0})
        return effect

    ten = torch.full((1, GATE[1]), 10.0)
    e = np.e
    with torch.no_grad():
        assert built("counts_over_scan", 1.0).counting(ten, last)[0] == pytest.approx(10 * e)
        assert built("background_over_scan", 1.0).background(ten, last)[0] == pytest.approx(10 * e)
        later = built("delay_over_scan", 2 * BIN).time(torch.ones(1, 3, 1), None, last)
        assert later.flatten().tolist() == pytest.approx([1 + 2 * BIN] * 3)
        counted = built("counts_over_time", 1.0).counting(ten, last)[0]
        assert counted[[GATE[0], GATE[1] - 1]].tolist() == pytest.approx([10, 10 * e], rel=1e-5)
        bright = torch.full((1, 4), scan.mean_counts * e**2 / 4)
        assert built("counts_over_rate", 1.0).counting(bright, last)[0] == pytest.approx(
            (e * bright[0]).numpy(), rel=1e-5
        )


def test_a_width_over_the_scan_is_a_variance_in_bins():
    scan = scene("confocal")[1]
    wider = BY_NAME["width_over_scan_power"](scan)
    wider.set_all({"end": 9.0, "exponent": 1.0})
    pulse, bins = torch.zeros(2, GATE[1]), torch.arange(GATE[1], dtype=torch.float32)
    pulse[:, 30] = 1.0
    spots = torch.tensor([int(scan.rank.argmax()), int(scan.rank.argmin())])
    with torch.no_grad():
        seen = wider.gain(pulse, spots)
    assert seen.sum(1) == pytest.approx([1.0, 1.0], abs=1e-4)
    mean = (seen * bins).sum(1)
    assert mean == pytest.approx([30.0, 30.0], abs=1e-3)
    assert (seen * (bins - mean[:, None]) ** 2).sum(1) == pytest.approx([9.0, 0.0], abs=1e-2)
