"""Physical effects that the base model leaves out, each in the module of its name."""

from __future__ import annotations

from collections.abc import Iterable

from nlos_lit.capture.errors import UserError, suggest
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.registry import Registry

__all__ = ["EFFECTS", "Effect", "Extension", "build_effects"]

# In the order in which they act.
EFFECTS = Registry(
    [
        # path
        "retroreflection",
        "specular_lobe",
        "occlusion",
        "higher_order_bounces",
        # time: geometry, then delays, then the clock that measures both
        "wall_tilt",
        "wall_scale",
        "laser_sensor_baseline",
        "scene_motion",
        "time_drift",
        "line_delay",
        "timing_jitter",
        "time_offset",
        "clock_scale",
        # response
        "irf_tail",
        "ghost_pulse",
        # spot: factors of the background before what is added to it
        "power_drift",
        "wall_reflectance",
        "vignetting",
        "ambient_map",
        "ambient_drift",
        "hum",
        "background_slope",
        "hot_spots",
        "direct_leak",
        "direct_tail",
        # counting
        "afterpulsing",
        "pile_up",
        "tcspc_nonlinearity",
        "gate_edges",
        "spot_gate",
        "crosstalk",
    ]
)


def build_effects(names: Iterable[str], scan: Scan) -> list[Effect]:
    """Effects at their nulls, each once, in the order in which they act.

    Args:
        names: of the registry, in any order.
        scan: of the capture.

    Returns:
        One for each name.

    Raises:
        UserError: a name is not in the registry.
    """
    wanted, known = set(names), EFFECTS.names
    unknown = sorted(wanted - set(known))
    if unknown:
        raise UserError(f"there is no effect {', '.join(map(repr, unknown))}; {suggest(unknown[0], known)}")
    return [effect(scan) for effect in EFFECTS if effect.name in wanted]
