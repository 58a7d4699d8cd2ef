"""Physical effects that the base model leaves out; ``EFFECTS`` lists them in the order in which they act."""

from __future__ import annotations

from collections.abc import Iterable

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.afterpulsing import Afterpulsing
from nlos_lit.effects.ambient_map import AmbientMap
from nlos_lit.effects.background_slope import BackgroundSlope
from nlos_lit.effects.clock_scale import ClockScale
from nlos_lit.effects.direct_leak import DirectLeak
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.gate_edges import GateEdges
from nlos_lit.effects.ghost_pulse import GhostPulse
from nlos_lit.effects.higher_order_bounces import HigherOrderBounces
from nlos_lit.effects.hot_spots import HotSpots
from nlos_lit.effects.irf_tail import IrfTail
from nlos_lit.effects.laser_sensor_baseline import LaserSensorBaseline
from nlos_lit.effects.occlusion import Occlusion
from nlos_lit.effects.pile_up import PileUp
from nlos_lit.effects.power_drift import PowerDrift
from nlos_lit.effects.retroreflection import Retroreflection
from nlos_lit.effects.specular_lobe import SpecularLobe
from nlos_lit.effects.tcspc_nonlinearity import TcspcNonlinearity
from nlos_lit.effects.time_drift import TimeDrift
from nlos_lit.effects.time_offset import TimeOffset
from nlos_lit.effects.timing_jitter import TimingJitter
from nlos_lit.effects.vignetting import Vignetting
from nlos_lit.effects.wall_reflectance import WallReflectance
from nlos_lit.effects.wall_tilt import WallTilt

__all__ = ["EFFECTS", "Effect", "Extension", "build_effects"]

EFFECTS: tuple[type[Effect], ...] = (
    # path
    Retroreflection,
    SpecularLobe,
    Occlusion,
    HigherOrderBounces,
    # time: geometry, then delays, then the clock that measures both
    WallTilt,
    LaserSensorBaseline,
    TimeDrift,
    TimingJitter,
    TimeOffset,
    ClockScale,
    # response
    IrfTail,
    GhostPulse,
    # spot: factors of the background before what is added to it
    PowerDrift,
    WallReflectance,
    Vignetting,
    AmbientMap,
    BackgroundSlope,
    HotSpots,
    DirectLeak,
    # counting
    Afterpulsing,
    PileUp,
    TcspcNonlinearity,
    GateEdges,
)


def build_effects(names: Iterable[str], scan: Scan) -> list[Effect]:
    """Effects at their nulls, each once, in the order in which they act.

    Raises:
        UserError: a name is not in the registry.
    """
    wanted, known = set(names), {effect.name: effect for effect in EFFECTS}
    unknown = sorted(wanted - set(known))
    if unknown:
        raise UserError(f"there is no effect {', '.join(map(repr, unknown))}; choose from {', '.join(known)}")
    return [effect(scan) for effect in EFFECTS if effect.name in wanted]
