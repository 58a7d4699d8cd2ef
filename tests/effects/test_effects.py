"""The contract, for every effect of the registry."""

from __future__ import annotations

import sys

import pytest
from effect_contract import EffectContract, capture, registered

from nlos_lit.effects import EFFECTS, Scan, build_effects
from nlos_lit.effects.base import STAGES
from nlos_lit.errors import UserError


class TestRetroreflection(EffectContract):
    effect = registered("retroreflection")
    values = {"falloff": 2.3, "cosine": 0.4}


class TestSpecularLobe(EffectContract):
    effect = registered("specular_lobe")
    values = {"strength": 0.3, "exponent": 11.0}


class TestOcclusion(EffectContract):
    effect = registered("occlusion")
    values = {"opacity": 0.7, "x": 0.05, "y": -0.08, "z": 0.25, "radius": 0.2}


class TestHigherOrderBounces(EffectContract):
    effect = registered("higher_order_bounces")
    values = {"strength": 2.0}


class TestWallTilt(EffectContract):
    effect = registered("wall_tilt")
    values = {"tilt_x": 0.03, "tilt_y": -0.05}


class TestLaserSensorBaseline(EffectContract):
    effect = registered("laser_sensor_baseline")
    values = {"baseline_x": 0.03, "baseline_y": -0.02}


class TestTimeDrift(EffectContract):
    effect = registered("time_drift")
    values = {"drift": 0.02}


class TestTimingJitter(EffectContract):
    effect = registered("timing_jitter")
    values = {"offset": 0.03}


class TestTimeOffset(EffectContract):
    effect = registered("time_offset")
    values = {"offset": 0.033}


class TestClockScale(EffectContract):
    effect = registered("clock_scale")
    values = {"scale": 0.03}


class TestIrfTail(EffectContract):
    effect = registered("irf_tail")
    values = {"fraction": 0.2, "decay": 0.15}


class TestGhostPulse(EffectContract):
    effect = registered("ghost_pulse")
    values = {"fraction": 0.12, "delay": 0.249}


class TestPowerDrift(EffectContract):
    effect = registered("power_drift")
    values = {"drift": 0.3}


class TestWallReflectance(EffectContract):
    effect = registered("wall_reflectance")
    values = {"gain_map": 0.2}


class TestVignetting(EffectContract):
    effect = registered("vignetting")
    values = {"strength": 0.4}


class TestAmbientMap(EffectContract):
    effect = registered("ambient_map")
    values = {"level_map": 0.3}


class TestBackgroundSlope(EffectContract):
    effect = registered("background_slope")
    values = {"slope": 0.3}


class TestHotSpots(EffectContract):
    effect = registered("hot_spots")
    values = {"extra": 1.5}


class TestDirectLeak(EffectContract):
    effect = registered("direct_leak")
    values = {"amplitude": 3.0, "decay": 0.2}


class TestAfterpulsing(EffectContract):
    effect = registered("afterpulsing")
    values = {"probability": 0.2, "decay": 0.3}


class TestPileUp(EffectContract):
    effect = registered("pile_up")
    values = {"detections": 0.5}


class TestTcspcNonlinearity(EffectContract):
    effect = registered("tcspc_nonlinearity")
    values = {"sine": 0.05, "cosine": -0.03, "period": 9.3}


class TestGateEdges(EffectContract):
    effect = registered("gate_edges")
    values = {"start": 0.6, "end": 0.4, "width": 3.3}


def test_every_effect_is_tested_and_named_once():
    contracts = [c for c in vars(sys.modules[__name__]).values() if isinstance(c, type) and issubclass(c, EffectContract)]
    tested = {c.effect for c in contracts if c is not EffectContract}
    assert tested == set(EFFECTS)
    assert len(EFFECTS) == 23
    assert len({effect.name for effect in EFFECTS}) == 23


def test_effects_act_in_the_order_of_stages():
    stages = [STAGES.index(effect.stage) for effect in EFFECTS]
    assert stages == sorted(stages)
    assert [e.name for e in EFFECTS][-4:] == ["afterpulsing", "pile_up", "tcspc_nonlinearity", "gate_edges"]


def test_build_effects_follows_the_registry_and_refuses_unknown_names():
    scan = Scan.of(capture("single"))
    names = [effect.name for effect in build_effects(["pile_up", "time_offset", "afterpulsing", "pile_up"], scan)]
    assert names == ["time_offset", "afterpulsing", "pile_up"]
    assert build_effects([], scan) == []
    with pytest.raises(UserError, match=r"'sun'.*choose from retroreflection, .*gate_edges"):
        build_effects(["sun", "pile_up"], scan)
