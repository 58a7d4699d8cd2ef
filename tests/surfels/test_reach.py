"""Numbers of an effect that a prior expects to be small take steps as small."""

from __future__ import annotations

import pytest
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, surfels

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.surfels.fit import Round, SurfelFit

pytestmark = FORWARD_MODE


def fitted(*effects: str, prior_scale: float) -> SurfelFit:
    """A fit of a measurement without effects, with these."""
    scene = capture_of(raster(16))
    model = surfels(scene, level=4.0)
    measured = drawn(model, Extension([]), scene)
    extension = Extension([effect_of(name, Scan.of(measured)) for name in effects])
    for effect in extension.effects:
        effect.prior_scale = prior_scale
    return fit_of(model, measured, extension)


def test_reach_is_what_the_prior_expects_and_one_step_at_most():
    """The drift's k-th function has a deviation of 4/k bins, times the scale; a step is a bin."""
    drift, tail = fitted("time_drift", "irf_tail", prior_scale=1.0).extension.effects
    assert tail.reach() == {}
    (reach,) = drift.reach().values()
    assert reach[:4].tolist() == [1.0] * 4
    assert reach[[7, 15]].tolist() == pytest.approx([0.5, 0.25], rel=0.02)
    drift.prior_scale = 0.125
    (reach,) = drift.reach().values()
    assert reach[[0, 1, 7]].tolist() == pytest.approx([0.5, 0.25, 0.0625], rel=0.02)


def test_a_step_goes_as_far_as_that():
    """The first step of Adam is as long as its rate, whatever the gradient is."""
    fit = fitted("power_drift", "irf_tail", prior_scale=0.05)
    drift, tail = fit.extension.effects
    tail.set("fraction", 0.2)
    before = drift.raw_drift.detach().clone(), tail.raw_fraction.detach().clone()
    fit.schedule([Round(3, onward=True)])
    fit.begin_round()
    fit.step()
    moved = (drift.raw_drift - before[0]).detach().abs() / fit.settings.effect_rate
    assert moved.tolist() == pytest.approx(drift.reach()[drift.raw_drift].tolist(), rel=1e-3)
    assert float(moved[-1]) < 0.1
    there = float((tail.raw_fraction - before[1]).detach().abs())
    assert there == pytest.approx(fit.settings.effect_rate, rel=1e-3), "no prior"


def test_a_field_of_many_numbers_does_not_shake(monkeypatch):
    def size() -> float:
        fit = fitted("free_scan_delay", prior_scale=0.03)
        fit.go_on(40)
        return float(fit.extension.effects[0].values().detach().square().mean().sqrt())

    reined = size()
    monkeypatch.setattr(Extension, "reach", lambda self: {})
    assert reined < size() / 2
