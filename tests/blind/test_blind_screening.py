"""Every effect once: it is tried first, or in the place of one that is, beside a quickly fitted, coarse base.

It is hidden in a capture of its own.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
from blind_inject import EFFECTS
from blind_judge import SURFELS, pipeline_for
from blind_truth import Spec, make_capture

from data_modules.readers import read_capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS as NAMES
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.pool import ask
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.inference.split import split_spots

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
QUICK = dataclasses.replace(SURFELS, contest=60, rounds=2, steps=120, more=0)
QUICKER = dataclasses.replace(QUICK, contest=30, steps=50)
UNSEEN = {
    "ghost_pulse": "surfels are the echo; a scene begun with it names it (test_blind_diagnosis.py)",
    "crosstalk": "of 40 % a scene fitted without it does nine tenths; 10 % are found (docs/blind.md)",
    "higher_order_bounces": "late, weak surfels imitate them until a rebuild",
    "laser_sensor_baseline": "a scene that lies aside by half of it is the same to first order",
    "wall_tilt": "a tilted wall and a turned scene are the same to second order",
}


# One for each stage of the model that effects act on, and one number a spot; the others are slow together.
# These show at half the bins of a coarser base, too.
ALWAYS = (
    "irf_tail",
    "wall_reflectance",
    "ambient_map",
    "time_drift",
    "pile_up",
    "retroreflection",
    "hot_spots",
)


def marks(name: str) -> list[pytest.MarkDecorator]:
    rare = [] if name in ALWAYS else [pytest.mark.slow]
    return [*rare, pytest.mark.xfail(reason=UNSEEN[name], strict=True)] if name in UNSEEN else rare


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=marks(name)) for name in EFFECTS],
)
def test_what_is_hidden_is_tried(name, tmp_path):
    scenes = EFFECTS[name].scenes
    scene = "letters" if not scenes or "letters" in scenes else scenes[0]
    make_capture(Spec(scene, (name,), (3,), 1500, 5), tmp_path / "capture.hdf5")
    sum_bins, surfels, spots = (2, QUICKER, 96) if name in ALWAYS else (1, QUICK, 160)
    capture = read_capture(tmp_path / "capture.hdf5", "auto").sum_bins(sum_bins)
    pipeline = dataclasses.replace(pipeline_for(capture), surfels=surfels)
    split, scan = split_spots(capture), Scan.of(capture)
    fit = pipeline.fit(capture, split, pipeline.image(capture), Extension([]), 0)
    settings = CriticismSettings()
    least = math.log((len(NAMES) + len(FREE)) / settings.level)
    found = ask(fit, split, scan, spots, 0, least, 2)
    said = [(c.name, round(c.evidence), round(c.loud)) for c in found.candidates[:6]]
    tried = [[t.candidate.name, *(r.name for r in t.rivals)] for t in found.together]
    single = next((c.name for c in found.candidates if c.effect.per_spot and c.evidence > least), None)
    assert name == single or any(name in names for names in tried), (said, tried)
