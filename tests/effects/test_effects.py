"""The contract, for every effect of the registry."""

from __future__ import annotations

import sys

import pytest
from effect_contract import EffectContract, capture, registered

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS, build_effects
from nlos_lit.effects.effect import STAGES


class TestRetroreflection(EffectContract, effect=registered("retroreflection"), falloff=2.3, cosine=0.4):
    pass


class TestSpecularLobe(EffectContract, effect=registered("specular_lobe"), strength=0.3, exponent=11.0):
    pass


class TestOcclusion(
    EffectContract, effect=registered("occlusion"), opacity=0.7, x=0.05, y=-0.08, z=0.25, radius=0.2
):
    pass


class TestHigherOrderBounces(EffectContract, effect=registered("higher_order_bounces"), strength=2.0):
    pass


class TestWallTilt(EffectContract, effect=registered("wall_tilt"), tilt_x=0.03, tilt_y=-0.05):
    pass


class TestLaserSensorBaseline(
    EffectContract, effect=registered("laser_sensor_baseline"), baseline_x=0.03, baseline_y=-0.02
):
    pass


class TestTimeDrift(EffectContract, effect=registered("time_drift"), drift=0.02):
    pass


class TestTimingJitter(EffectContract, effect=registered("timing_jitter"), offset=0.03):
    pass


class TestTimeOffset(EffectContract, effect=registered("time_offset"), offset=0.033):
    pass


class TestClockScale(EffectContract, effect=registered("clock_scale"), scale=0.03):
    pass


class TestIrfTail(EffectContract, effect=registered("irf_tail"), fraction=0.2, decay=0.15):
    pass


class TestGhostPulse(EffectContract, effect=registered("ghost_pulse"), fraction=0.12, delay=0.249):
    pass


class TestPowerDrift(EffectContract, effect=registered("power_drift"), drift=0.3):
    pass


class TestWallReflectance(EffectContract, effect=registered("wall_reflectance"), gain_map=0.2):
    pass


class TestVignetting(EffectContract, effect=registered("vignetting"), strength=0.4):
    pass


class TestAmbientMap(EffectContract, effect=registered("ambient_map"), level_map=0.3):
    pass


class TestBackgroundSlope(EffectContract, effect=registered("background_slope"), slope=0.3):
    pass


class TestHotSpots(EffectContract, effect=registered("hot_spots"), extra=1.5):
    pass


class TestDirectLeak(EffectContract, effect=registered("direct_leak"), amplitude=3.0, decay=0.2):
    pass


class TestAfterpulsing(EffectContract, effect=registered("afterpulsing"), probability=0.2, decay=0.3):
    pass


class TestPileUp(EffectContract, effect=registered("pile_up"), detections=0.5):
    pass


class TestTcspcNonlinearity(
    EffectContract, effect=registered("tcspc_nonlinearity"), sine=0.05, cosine=-0.03, period=9.3
):
    pass


class TestGateEdges(EffectContract, effect=registered("gate_edges"), start=0.6, end=0.4, width=3.3):
    pass


def test_every_effect_is_tested_and_named_once():
    contracts = [
        c
        for c in vars(sys.modules[__name__]).values()
        if isinstance(c, type) and issubclass(c, EffectContract)
    ]
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
    names = [
        effect.name for effect in build_effects(["pile_up", "time_offset", "afterpulsing", "pile_up"], scan)
    ]
    assert names == ["time_offset", "afterpulsing", "pile_up"]
    assert build_effects([], scan) == []
    with pytest.raises(UserError, match=r"'sun'.*choose from retroreflection, .*gate_edges"):
        build_effects(["sun", "pile_up"], scan)
