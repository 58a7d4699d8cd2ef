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
    Unexplained,
)

NAMES = (
    *("retroreflection", "specular_lobe", "occlusion", "higher_order_bounces", "time_offset", "time_drift"),
    *("timing_jitter", "clock_scale", "wall_tilt", "laser_sensor_baseline", "irf_tail", "ghost_pulse"),
    *("power_drift", "wall_reflectance", "vignetting", "ambient_map", "hot_spots", "background_slope"),
    *("direct_leak", "pile_up", "afterpulsing", "tcspc_nonlinearity", "gate_edges"),
)
NAN = float("nan")
TAIL = Accepted(
    "irf_tail",
    {"fraction": Estimate(0.2113, 0.021, "1"), "decay": Estimate(0.117, 0.0062, "m")},
    9123.0,
    3e-14,
    Gain(1.2417, 1.1903, 0.01234, (0.0111, 0.0137)),
    ["afterpulsing"],
    "a capture with other background light",
)
TILT = Accepted(
    "wall_tilt",
    {"tilt_x": Estimate(0.0413, 0.0009, "rad"), "tilt_y": Estimate(-0.0021, 0.0011, "rad")},
    961.0,
    0.0,
    Gain(1.1903, 1.0862, 0.0045, (0.0031, 0.0058)),
    split_by="a second scan in another order",
)
WITNESS = {
    "direct_pulse_counts": 1234567,
    "wall_gain_correlation": 0.803,
    "tail_decay_fitted_m": 0.117,
    "tail_decay_direct_m": [0.078, 0.111],
    "maps": {"direct": [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]], "fitted": [[0.1, 0.2, 0.28], [0.2, 0.41, None]]},
}


def screened() -> list[Screened]:
    rng = np.random.default_rng(3)
    found = []
    for k, name in enumerate(NAMES):
        statistic = float(np.exp(rng.uniform(0, 9)))
        limits = {
            "time_drift": {"coefficients": 0.0021},
            "irf_tail": {"fraction": 0.0043},
            "pile_up": {"detections": 1.5},
        }
        limit = {"ghost_pulse": {"fraction": math.inf}, **limits}.get(name, {"strength": 0.01 * (k + 1)})
        shape = {"decay": 0.15} if name == "irf_tail" else {}
        kept = {"time_offset": 0.0021, "ghost_pulse": NAN}.get(name, rng.uniform(0.1, 1))
        found.append(
            Screened(
                name,
                statistic,
                math.exp(-statistic / 2),
                kept,
                1 + k,
                statistic / 2 - 3,
                {"fraction": 0.19},
                shape,
                limit,
                1.0 + k,
            )
        )
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
        groups=[],
        unexplained=Unexplained(False, "time", 31.7, 0.42),
        screened=screened(),
        base=base,
        extended=base,
        untouched_test={"base": base, "extended": base},
        witness=None,
        profiles=profiles(0.0),
        numerics={"splat_width": 0.00117},
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
        "groups": [["wall_tilt", "time_drift"]],
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
        unexplained=Unexplained(True, "time", 912.0, 1e-9),
        base=Scores(1.1, 0.7, 0.05, 0.01),
        profiles=profiles(9.0),
        toys=0,
    ),
    "bare": diagnosis(screened=[], profiles=[], untouched_test={}, numerics={}, notes=[], capture={}, toys=0),
    "nan": two_found(
        effects=[
            Accepted(
                "irf_tail",
                {"fraction": Estimate(0.2, NAN, "1"), "decay": Estimate(NAN, NAN, "m")},
                NAN,
                NAN,
                Gain(NAN, NAN, NAN, (NAN, NAN)),
            )
        ],
        extended=Scores(NAN, NAN, NAN, NAN),
        untouched_test={"base": Scores(NAN, NAN, NAN, NAN), "extended": Scores(NAN, NAN, NAN, NAN)},
        screened=[
            Screened("pile_up", NAN, NAN, NAN, 1, NAN, {"detections": NAN}, {}, {"detections": math.inf}, 1.0)
        ],
        profiles=[Profile("time", "bins", np.arange(4.0), np.full(3, NAN), np.array([1.0, NAN, 4.0]))],
        witness={
            "direct_pulse_counts": 0,
            "wall_gain_correlation": None,
            "tail_decay_fitted_m": None,
            "tail_decay_direct_m": None,
            "maps": None,
        },
    ),
}
