"""Synthetic diagnoses for the tests of the report."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from nlos_lit.inference.result import (
    Accepted,
    Diagnosis,
    Estimate,
    Gain,
    Profile,
    Scores,
    Screened,
    Shape,
    Unexplained,
)

NAMES = (
    *("retroreflection", "specular_lobe", "occlusion", "higher_order_bounces", "time_offset", "time_drift"),
    *("timing_jitter", "clock_scale", "wall_tilt", "laser_sensor_baseline", "irf_tail", "ghost_pulse"),
    *("power_drift", "wall_reflectance", "vignetting", "ambient_map", "hot_spots", "background_slope"),
    *("direct_leak", "pile_up", "afterpulsing", "tcspc_nonlinearity", "gate_edges"),
)
FREE_NAMES = (
    *("free_scan_delay", "free_wall_delay", "free_scan_background", "free_wall_background", "free_time"),
    *("free_wall", "free_lines", "free_scan", "free_rate", "free_response_scan", "free_response_wall"),
    *("free_width_scan", "free_width_wall"),
    "free_spot_gain",
)
NAN = float("nan")
TAIL = Accepted(
    "irf_tail",
    {
        "fraction": Estimate(0.2113, 0.021, "1"),
        "decay": Estimate(0.117, 0.0062, "m"),
        "slow": Estimate(0.2113, 0.021, "1"),
    },
    9123.0,
    Gain(1.2417, 1.1903, 0.01234, (0.0111, 0.0137)),
    {"afterpulsing": 0.19, "irf_tail": 0.81},
    "a capture with other background light",
)
TAIL_ALONE = dataclasses.replace(TAIL, weights={"irf_tail": 1.0}, split_by="")
TILT = Accepted(
    "wall_tilt",
    {"tilt_x": Estimate(0.0413, 0.0009, "rad"), "tilt_y": Estimate(-0.0021, 0.0011, "rad")},
    961.0,
    Gain(1.1903, 1.0862, 0.0045, (0.0031, 0.0058)),
    split_by="a second scan in another order",
)


def free(name: str, axis: str, shape: Shape | None = None, **changes) -> Accepted:
    """A free term that was needed: 12 % rms or 7 mm, and 0.06 of deviance per bin."""
    size = Estimate(0.007, 0.0004, "m") if name.endswith("delay") else Estimate(0.12, 0.01, "1")
    gain = Gain(1.0862, 1.0262, 0.0021, (0.0016, 0.0026))
    whole = Accepted(name, {"rms": size}, 512.0, gain, {name: 1.0}, "", axis, shape)
    return dataclasses.replace(whole, **changes)


def _bump(*numbers: int) -> np.ndarray:
    """Smooth, 0.3 at a third of each axis and -0.1 far away."""
    places = np.meshgrid(*(np.linspace(0, 1, n) for n in numbers), indexing="ij")
    return 0.4 * np.exp(-12 * sum((p - 1 / 3) ** 2 for p in places)) - 0.1


WALL, GATE = np.linspace(-1, 1, 9), np.linspace(200, 512, 17)
SHAPES = {
    "free_time": Shape("time", "1", np.linspace(200, 512, 41), _bump(40)),
    "free_scan": Shape("scan", "1", np.linspace(0, 4096, 65), _bump(64)),
    "free_rate": Shape("rate", "1", 1500 * np.exp(np.linspace(-2, 2, 11)), _bump(10)),
    "free_spot_gain": Shape("spot", "1", np.arange(4097.0), 0.1 * np.sin(np.arange(4096.0) ** 2)),
    "free_scan_delay": Shape("scan", "m", np.linspace(0, 4096, 25), 0.02 * _bump(24)),
    "free_wall": Shape("wall", "1", WALL, _bump(8, 6), np.linspace(-0.6, 0.6, 7)),
    "free_wall_delay": Shape("wall", "m", WALL, 0.02 * _bump(8, 8), WALL),
    "free_wall_background": Shape("wall", "1", WALL, _bump(8, 8), WALL),
    "free_width_scan": Shape("scan", "bins²", np.linspace(0, 4096, 65), 4 * _bump(64)),
    "free_width_wall": Shape("wall", "bins²", WALL, 4 * _bump(8, 8), WALL),
    "free_response_scan": Shape("time×scan", "1", GATE, _bump(16, 64), np.linspace(0, 4096, 65)),
    "free_response_wall": Shape("time×wall", "1", GATE, _bump(16, 8), WALL),
}
UNKNOWN = {name: free(name, shape.axis, shape) for name, shape in SHAPES.items()}
WITNESS = {
    "direct_pulse_counts": 1234567,
    "wall_gain_correlation": 0.803,
    "wall_gain_by_chance": 0.412,
    "tail_decay_fitted_m": 0.117,
    "tail_decay_direct_m": [0.078, 0.111],
    "maps": {"direct": [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]], "fitted": [[0.1, 0.2, 0.28], [0.2, 0.41, None]]},
    "delay_correlation": 0.594,
    "delays": {"direct": [-4e-4, 1e-4, 9e-4], "fitted": [-6e-4, -1e-4, 7e-4]},
}


def screened(most: float = 9.0) -> list[Screened]:
    """Evidence between ``e^-1`` and ``e^most`` nats for every effect and free term."""
    rng = np.random.default_rng(3)
    found = []
    for k, name in enumerate((*NAMES, *FREE_NAMES)):
        evidence = float(np.exp(rng.uniform(-1, most)))
        limits = {
            "time_drift": {"coefficients": 0.0021},
            "irf_tail": {"fraction": 0.0043},
            "pile_up": {"detections": 1.5},
        }
        limit = {"ghost_pulse": {"fraction": math.inf}, **limits}.get(name, {"strength": 0.01 * (k + 1)})
        shape = {"decay": 0.15} if name == "irf_tail" else {}
        kept = {"time_offset": 0.0021, "ghost_pulse": NAN}.get(name, rng.uniform(0.1, 1))
        scatter = {"time_drift": 3.4, "pile_up": 1.4}.get(name, 1.0)
        found.append(Screened(name, evidence, kept, scatter, 1 + k, {"fraction": 0.19}, shape, limit))
    return found


def profiles(strength: float) -> list[Profile]:
    """Residuals with a bump at one place of each axis (the wall's at high x, low y), gone afterwards."""
    rng = np.random.default_rng(1)
    found = []
    for axis, unit, edges in (
        ("time", "bins", np.arange(200, 361, 4)),
        ("depth", "m", np.linspace(0.4, 1.2, 31)),
        ("scan", "spot", np.linspace(0, 4096, 65)),
        ("rate", "counts per spot", np.linspace(800, 2100, 11)),
    ):
        noise = rng.normal(size=len(edges) - 1)
        bump = strength * np.exp(
            -0.5 * ((np.arange(len(noise)) - 0.3 * len(noise)) / (0.06 * len(noise))) ** 2
        )
        found.append(Profile(axis, unit, edges.astype(float), noise + bump, noise))
    noise = rng.normal(size=(8, 6))
    before = noise.copy()
    before[7, 0] += strength
    before[2, 3] = noise[2, 3] = NAN
    found.append(Profile("wall", "m", np.linspace(-1, 1, 9), before, noise, np.linspace(-0.6, 0.6, 7)))
    return found


def diagnosis(**changes) -> Diagnosis:
    """Nothing accepted, at the noise, unless changed."""
    base = Scores(0.7219, 0.7113, 0.0167, 0.0152)
    capture = {
        "name": "letters <S&U>",
        "kind": "confocal",
        "spots": 4096,
        "bins": 512,
        "bin_length": 0.0048,
        "bin_width_ps": 16.0111,
        "counts_per_spot": 1503.25,
        "gate": [200, 512],
        "scan_order": "raster",
    }
    whole = Diagnosis(
        effects=[],
        unknown=[],
        groups=[],
        unexplained=Unexplained(False, "time", 3.17),
        screened=screened(1.8),
        base=base,
        extended=base,
        untouched_test={"base": base, "extended": base},
        witness=None,
        profiles=profiles(0.0),
        needed=8.16,
        chance=0.42,
        notes=["The splat's <width> was 0.62 bins."],
        capture=capture,
        toys=200,
        seconds=412.7,
        seed=17,
    )
    return dataclasses.replace(whole, **changes)


def two_found(**changes) -> Diagnosis:
    test = {"base": Scores(1.3, 0.94, 0.081, 0.043), "extended": Scores(1.03, 0.93, 0.054, 0.0431)}
    found = {
        "effects": [TAIL, TILT],
        "groups": [["irf_tail", "afterpulsing"], ["wall_tilt", "time_drift"]],
        "screened": screened(),
        "chance": 1e-9,
        "base": Scores(1.2417, 0.9402, 0.0838, 0.0432),
        "extended": Scores(1.0351, 0.9251, 0.0537, 0.0433),
        "untouched_test": test,
        "profiles": profiles(45.0),
        "witness": WITNESS,
    }
    return diagnosis(**(found | changes))


CASES = {
    "nothing": diagnosis(),
    "two": two_found(),
    "unexplained": diagnosis(
        unknown=[UNKNOWN["free_time"]],
        unexplained=Unexplained(True, "time", 512.0),
        screened=screened(),
        base=Scores(1.1, 0.7, 0.05, 0.01),
        extended=Scores(0.9, 0.7, 0.03, 0.01),
        untouched_test={},
        profiles=profiles(9.0),
        chance=1e-9,
        toys=0,
    ),
    "both": two_found(
        unknown=[UNKNOWN[name] for name in ("free_wall", "free_scan_delay")],
        unexplained=Unexplained(True, "wall", 512.0),
    ),
    "bare": diagnosis(screened=[], profiles=[], untouched_test={}, notes=[], capture={}, toys=0),
    "nan": two_found(
        effects=[
            Accepted(
                "irf_tail",
                {
                    "fraction": Estimate(0.2, NAN, "1"),
                    "slow": Estimate(0.2, NAN, "1"),
                    "decay": Estimate(NAN, NAN, "m"),
                },
                NAN,
                Gain(NAN, NAN, NAN, (NAN, NAN)),
            )
        ],
        unknown=[
            Accepted(
                "free_time",
                {"rms": Estimate(NAN, NAN, "1")},
                NAN,
                Gain(NAN, NAN, NAN, (NAN, NAN)),
                axis="time",
                shape=Shape("time", "1", np.arange(4.0), np.full(3, NAN)),
            ),
            Accepted(
                "free_wall",
                {},
                NAN,
                Gain(NAN, NAN, NAN, (NAN, NAN)),
                axis="wall",
                shape=Shape("wall", "m", np.arange(4.0), np.full((3, 2), NAN), np.arange(3.0)),
            ),
        ],
        groups=[],
        chance=NAN,
        extended=Scores(NAN, NAN, NAN, NAN),
        untouched_test={"base": Scores(NAN, NAN, NAN, NAN), "extended": Scores(NAN, NAN, NAN, NAN)},
        screened=[Screened("pile_up", NAN, NAN, NAN, 1, {"detections": NAN}, {}, {"detections": math.inf})],
        profiles=[Profile("time", "bins", np.arange(4.0), np.full(3, NAN), np.array([1.0, NAN, 4.0]))],
        witness={
            "direct_pulse_counts": 0,
            "wall_gain_correlation": None,
            "tail_decay_fitted_m": None,
            "tail_decay_direct_m": None,
            "maps": None,
            "delay_correlation": None,
            "delays": None,
        },
    ),
}
