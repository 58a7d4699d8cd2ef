"""What a diagnosis keeps for further captures, and reads again."""

from __future__ import annotations

import copy
import dataclasses
import math
from pathlib import Path

import pytest
from report_cases import CASES, TAIL

from nlos_lit.capture.errors import UserError
from nlos_lit.commands.split_with import check_kept, check_told
from nlos_lit.inference.further import open_terms
from nlos_lit.inference.result import Diagnosis, Further, Tried
from nlos_lit.io.files import write_json
from nlos_lit.training.configs import compose

TRIED = {"irf_tail": Tried([3.0, -1.0]), "afterpulsing": Tried([2.0, 0.5], {"decay": [0.1]})}
AGAIN = Further(
    "scan_2", list(TRIED), {"irf_tail": 4.0, "afterpulsing": 9.0}, {"afterpulsing": 0.9}, True,
    {"irf_tail": 0.2, "afterpulsing": 0.8}, ["irf_tail", "afterpulsing"],
)  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_diagnosis_is_read_as_it_was_written(name, tmp_path):
    kept = dataclasses.replace(CASES[name], effects=[dataclasses.replace(TAIL, tried=TRIED)], further=[AGAIN])
    write_json(tmp_path / "diagnosis.json", kept.to_dict())
    back = Diagnosis.read(tmp_path / "diagnosis.json")
    assert back.to_dict() == kept.to_dict()
    assert back.effects[0] == kept.effects[0]
    assert back.further == [AGAIN]
    assert [type(p.before) for p in back.profiles] == [type(p.before) for p in kept.profiles]
    assert math.isnan(back.chance) == (not math.isfinite(kept.chance))


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"effects": 3}', "{" * 9999])
def test_what_is_no_diagnosis_is_one_sentence(text, tmp_path):
    (tmp_path / "diagnosis.json").write_text(text)
    with pytest.raises(UserError, match=r"diagnosis.json holds no diagnosis of this version"):
        Diagnosis.read(tmp_path / "diagnosis.json")


def test_a_further_capture_needs_something_that_is_open():
    known = dataclasses.replace(TAIL, tried=TRIED)
    whole = dataclasses.replace(CASES["both"], effects=[known])
    assert open_terms(whole) == [known]
    alone = dataclasses.replace(known, weights={"irf_tail": 1.0})
    with pytest.raises(UserError, match=r"leaves no two names open.*it names irf_tail alone"):
        open_terms(dataclasses.replace(whole, effects=[alone]))
    with pytest.raises(UserError, match="it names no effect"):
        open_terms(dataclasses.replace(whole, effects=[]))
    with pytest.raises(UserError, match="of an earlier version"):
        open_terms(dataclasses.replace(whole, effects=[TAIL]))


def altered(*path, to) -> dict:
    """A diagnosis that leaves a name open, as its file holds it, with one place altered."""
    known = dataclasses.replace(TAIL, tried=TRIED)
    whole = dataclasses.replace(CASES["both"], effects=[known], unknown=[], further=[]).to_dict()
    inside = whole
    for name in path[:-1]:
        inside = inside[name]
    inside[path[-1]] = to
    return whole


FIRST = ("effects", 0)
NATS = (*FIRST, "tried", "irf_tail", "nats")


@pytest.mark.parametrize(
    ("path", "to", "told"),
    [
        ((*FIRST, "name"), "<b>", "names '<b>', which is no effect of this version"),
        ((*FIRST, "name"), 3, "holds no diagnosis of this version"),
        ((*FIRST, "weights"), {"irf_tail": 0.5, "os.system": 0.5}, "names 'os.system', which is no effect"),
        ((*FIRST, "weights"), {"irf_tail": "much"}, "holds no diagnosis of this version"),
        (NATS, [1.0], "numbers of the diagnosis were altered"),
        (NATS, [None, 1.0], "numbers of the diagnosis were altered"),
        ((*FIRST, "tried"), [], "holds no diagnosis of this version"),
        (("capture", "wall"), "here", "numbers of the diagnosis were altered"),
        (("capture",), {"name": "x"}, "in .* was altered|lacks|holds no view"),
        (("notes",), [3], "holds no diagnosis of this version"),
    ],
)
def test_an_altered_diagnosis_is_refused_before_a_second_capture_is_asked(path, to, told, tmp_path):
    write_json(tmp_path / "diagnosis.json", altered(*path, to=to))
    with pytest.raises(UserError, match=told):
        check_told(tmp_path)


@pytest.mark.parametrize(
    ("path", "to", "told"),
    [
        (("scene", "reader"), [1], "it lacks scene.reader.bin_width_ps"),
        (("scene", "reader", "bin_width_ps"), "wide", "scene.reader.bin_width_ps must be a number above 0"),
        (("scene", "sum_bins"), 0, "scene.sum_bins must be a whole number"),
        (("scene",), 7, "config.yaml lacks its scene or its model"),
        (("model", "rays"), -4, "model.rays must be a whole number"),
        (("model", "nonsense"), 4, "there is no key model.nonsense"),
    ],
)
def test_an_altered_config_is_refused_before_a_second_capture_is_read(path, to, told):
    settings = compose("diagnose")
    kept = copy.deepcopy(settings)
    check_kept(kept, settings, Path("run"))
    inside = kept
    for name in path[:-1]:
        inside = inside[name]
    inside[path[-1]] = to
    with pytest.raises(UserError, match=told):
        check_kept(kept, settings, Path("run"))
