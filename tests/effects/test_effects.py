"""The contract, for every effect of the registry, and the registry."""

from __future__ import annotations

import pytest
from effect_contract import EffectContract, capture

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS, Effect, build_effects
from nlos_lit.effects.effect import STAGES
from nlos_lit.effects.registry import effect_of

# Where they act, whether they need single paths.
PATH, TIME, RESPONSE, SPOT, COUNTING = (
    ("path", True),
    ("time", True),
    ("response", False),
    ("spot", False),
    ("counting", False),
)
KNOWN = {
    "retroreflection": PATH,
    "specular_lobe": PATH,
    "occlusion": PATH,
    "higher_order_bounces": PATH,
    "wall_tilt": TIME,
    "wall_scale": TIME,
    "laser_sensor_baseline": TIME,
    "scene_motion": TIME,
    "time_drift": TIME,
    "line_delay": TIME,
    "timing_jitter": TIME,
    "time_offset": TIME,
    "clock_scale": TIME,
    "irf_tail": RESPONSE,
    "ghost_pulse": RESPONSE,
    "power_drift": SPOT,
    "wall_reflectance": SPOT,
    "vignetting": SPOT,
    "ambient_map": SPOT,
    "ambient_drift": SPOT,
    "hum": SPOT,
    "background_slope": SPOT,
    "hot_spots": SPOT,
    "direct_leak": SPOT,
    "direct_tail": SPOT,
    "afterpulsing": COUNTING,
    "pile_up": COUNTING,
    "tcspc_nonlinearity": COUNTING,
    "gate_edges": COUNTING,
    "spot_gate": COUNTING,
    "crosstalk": COUNTING,
}


class TestEveryEffect(EffectContract):
    @pytest.fixture(params=EFFECTS, ids=lambda effect: effect.name)
    def built(self, request: pytest.FixtureRequest) -> type[Effect]:
        return request.param


def test_every_effect_is_named_once_and_as_its_module():
    assert len(set(EFFECTS.names)) == len(EFFECTS) == len(set(EFFECTS))
    assert [effect.__module__.rpartition(".")[2] for effect in EFFECTS] == EFFECTS.names
    with pytest.raises(ImportError, match=r"smooth\.py defines no effect whose name is 'smooth'"):
        effect_of("smooth")


def test_stage_and_need_of_paths_follow_from_the_hooks():
    """Worked out by hand from the equations; effects to come need no line here."""
    assert set(KNOWN) <= set(EFFECTS.names)
    for name, expected in KNOWN.items():
        effect = EFFECTS.named(name)
        assert (effect.stage, effect.needs_paths) == expected, name
        assert "stage" in vars(effect), "it is computed for each class"
    moving = {name for name in KNOWN if EFFECTS.named(name)(Scan.of(capture("single"))).moves_light}
    assert moving == {
        *("retroreflection", "specular_lobe", "occlusion", "wall_tilt", "wall_scale"),
        *("laser_sensor_baseline", "scene_motion", "time_drift", "timing_jitter", "time_offset"),
        *("clock_scale", "line_delay", "power_drift", "wall_reflectance", "vignetting"),
    }


def test_a_hook_inherited_counts_as_overridden():
    class Late(EFFECTS.named("time_offset")):
        name = "late"

    class Both(EFFECTS.named("irf_tail")):
        name = "both"

        def time(self, length, paths, spots):
            return length

    assert (Late.stage, Late.needs_paths) == ("time", True)
    assert (Both.stage, Both.needs_paths, Both.hooks) == ("time", True, {"time", "response"})


def test_effects_act_in_the_order_of_stages():
    stages = [STAGES.index(effect.stage) for effect in EFFECTS]
    assert stages == sorted(stages)
    last = ["afterpulsing", "pile_up", "tcspc_nonlinearity", "gate_edges", "spot_gate", "crosstalk"]
    assert [name for name in EFFECTS.names if name in last] == last


def test_witnesses():
    said = {kind: {e.name for e in EFFECTS if e.witness == kind} for kind in ("energy", "tail", "delay")}
    assert said["energy"] >= {"wall_reflectance", "power_drift", "vignetting"}
    assert said["tail"] >= {"irf_tail", "afterpulsing"}
    assert said["delay"] == {"timing_jitter"}


def test_an_effect_can_be_added_for_a_while():
    class Sun(EFFECTS.named("ambient_map")):
        name = "sun"

    before = EFFECTS.names
    with EFFECTS.added(Sun, after="ambient_map"):
        assert EFFECTS.names[EFFECTS.index(Sun) - 1] == "ambient_map"
        assert [e.name for e in build_effects(["hot_spots", "sun"], Scan.of(capture("single")))] == [
            "sun",
            "hot_spots",
        ]
    assert EFFECTS.names == before
    assert EFFECTS.named("sun") is None


def test_what_would_tell_two_effects_apart_is_found_from_either_side():
    assert EFFECTS.splitting("wall_tilt", "time_drift") == EFFECTS.splitting("time_drift", "wall_tilt")
    assert "serpentine" in EFFECTS.splitting("wall_tilt", "time_drift")
    assert EFFECTS.splitting("wall_tilt", "pile_up") == ""
    assert EFFECTS.splitting("dust", "pile_up") == ""


def test_build_effects_follows_the_registry_and_refuses_unknown_names():
    scan = Scan.of(capture("single"))
    names = [
        effect.name for effect in build_effects(["pile_up", "time_offset", "afterpulsing", "pile_up"], scan)
    ]
    assert names == ["time_offset", "afterpulsing", "pile_up"]
    assert build_effects([], scan) == []
    with pytest.raises(UserError, match=r"'sun'.*there are retroreflection, .*gate_edges"):
        build_effects(["sun", "pile_up"], scan)
