"""Every effect once: it is what the first pool of a quickly fitted, coarse base asks for.

It is hidden in a capture of its own. A free term along its axis, or an effect that is declared to look like
it, may stand before it: the rebuilt scenes decide between those.
"""

from __future__ import annotations

import dataclasses

import pytest
from blind_inject import EFFECTS
from blind_judge import SURFELS, pipeline_for
from blind_truth import Spec, make_capture

from data_modules.readers import read_capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS as REGISTRY
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.criticise import CriticismSettings, needed
from nlos_lit.inference.pool import ask
from nlos_lit.inference.split import split_spots

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
QUICK = dataclasses.replace(SURFELS, contest=60, rounds=2, steps=120, more=0)
# Free terms that are as good a description: both widen the response.
ALONG = {name: ("free_response_scan", "free_response_wall") for name in ("irf_tail", "afterpulsing")}
SCATTER = (
    "too strong for one linear step, whose error scatters between wall blocks; free terms stand before it"
)
UNSEEN = {
    "retroreflection": "a free map over the wall and the reflectance stand before it, by 5 % of its evidence",
    "specular_lobe": SCATTER,
    "occlusion": SCATTER,
    "vignetting": SCATTER,
    "wall_scale": SCATTER,
    "hum": SCATTER,
    "higher_order_bounces": "late, weak surfels imitate them until a rebuild",
    "wall_tilt": "a tilted wall and a turned scene are the same to second order",
    "laser_sensor_baseline": "a drift and free delays over the wall stand before it",
    "ghost_pulse": "the base imitates nine tenths of it and is wrong itself",
    "crosstalk": "the base imitates nine tenths of it; maps over the wall stand before it",
}


def unseen(name: str) -> list[pytest.MarkDecorator]:
    return [pytest.mark.xfail(reason=UNSEEN[name], strict=True)] if name in UNSEEN else []


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=unseen(name)) for name in EFFECTS],
)
def test_what_is_hidden_is_asked_for(name, tmp_path):
    scenes = EFFECTS[name].scenes
    scene = "letters" if not scenes or "letters" in scenes else scenes[0]
    make_capture(Spec(scene, (name,), (3,), 1500, 5), tmp_path / "capture.hdf5")
    capture = read_capture(tmp_path / "capture.hdf5", "auto")
    pipeline = dataclasses.replace(pipeline_for(capture), surfels=QUICK)
    split, scan = split_spots(capture), Scan.of(capture)
    fit = pipeline.fit(capture, split, pipeline.image(capture), Extension([]), 0)
    found = ask(fit, split, scan, 160, 0)
    place = [c.name for c in found].index(name)
    said = [(c.name, round(c.evidence)) for c in found[: place + 1]]
    assert found[place].evidence > needed(found, CriticismSettings(), 0.0), said
    assert place <= 1, said
    if place:
        before = found[0].name
        assert before in ALONG.get(name, ()) or REGISTRY.splitting(name, before), said
