"""Every effect once: it is what the first screening of a quickly fitted base asks for.

It is hidden in a capture of its own.
"""

from __future__ import annotations

import dataclasses

import pytest
from blind_inject import EFFECTS
from blind_judge import SURFELS, pipeline_for
from blind_truth import Spec, make_capture

from data_modules.readers import read_capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.criticise import CriticismSettings, look
from nlos_lit.inference.split import split_spots

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
QUICK = dataclasses.replace(SURFELS, contest=60, rounds=2, steps=120, more=0)
NEARLY = 0.8  # share of the first one's predicted gain: whole diagnoses refit several rivals
UNSEEN = {
    "wall_tilt": "a tilted wall and a turned scene are the same to second order",
    "higher_order_bounces": "late, weak surfels imitate them until a rebuild",
}


@pytest.mark.parametrize("name", [n for n in EFFECTS if n not in UNSEEN])
def test_what_is_hidden_is_asked_for(name, tmp_path):
    scenes = EFFECTS[name].scenes
    scene = "letters" if not scenes or "letters" in scenes else scenes[0]
    make_capture(Spec(scene, (name,), (3,), 1500, 5), tmp_path / "capture.hdf5")
    capture = read_capture(tmp_path / "capture.hdf5", "auto")
    pipeline = dataclasses.replace(pipeline_for(capture), surfels=QUICK)
    split, scan = split_spots(capture), Scan.of(capture)
    fit = pipeline.fit(capture, split, pipeline.image(capture), Extension([]), 0)
    found = look(fit, split, scan, CriticismSettings(spots=160), 0).candidates
    hidden = next(c for c in found if c.effect.name == name)
    assert hidden.p_value < 1e-6
    assert hidden.gain > NEARLY * found[0].gain, [(c.effect.name, round(c.gain)) for c in found[:5]]
