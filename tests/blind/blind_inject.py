"""What can be hidden in a capture of the blind test, each by formulas of its own.

The light's way is in `Work.expected`. Each injector takes the `Work` and a strength and returns the true
values of the reported quantities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from blind_elements import Legs
from blind_scenes import FINE, PAD
from blind_work import Work, blotches, wave
from scipy.optimize import brentq
from scipy.signal import fftconvolve, lfilter


def retroreflection(work: Work, falloff: float) -> dict[str, float]:
    if not work.scene.confocal:
        raise ValueError("a render's falloff can be changed only in a confocal scan")
    power = (4 - falloff) / 2
    if work.scene.elements is None:
        axis = work.scene.window.fine
        work.light = work.light * ((axis.edges[:-1] + axis.step / 2) / 2) ** (2 * power)
        return {"falloff": falloff, "cosine": 1.0}
    cosine = 1 - power
    work.light = work.scene.rendered(
        (lambda p: (p.d1 * p.d2) ** power * np.maximum(p.cosine1 * p.cosine2, 1e-12) ** (cosine - 1),)
    )
    return {"falloff": falloff, "cosine": cosine}


def specular_lobe(work: Work, strength: float) -> dict[str, float]:
    p = float(np.exp(work.rng.uniform(np.log(6), np.log(48))))

    def lobe(legs: Legs) -> np.ndarray:
        half = [a + b for a, b in zip(legs.to_laser, legs.to_sensor, strict=True)]
        length = np.sqrt(sum(h * h for h in half))
        cosine = sum(h * legs.elements.normal[:, k] for k, h in enumerate(half)) / length
        return 1 + strength * (p + 2) / 2 * np.maximum(cosine, 0) ** p

    work.light = work.scene.rendered((lobe,))
    return {"strength": strength, "p": p}


def occlusion(work: Work, opacity: float) -> dict[str, float]:
    scene, rng = work.scene, work.rng
    # The disc stands on a line of sight from the inner wall, so that it is sure to hide something.
    inner = np.flatnonzero((np.abs(scene.places) < 0.6).all(axis=1))
    spot = rng.choice(inner)
    target = scene.elements.centre[rng.choice(np.flatnonzero(scene.seen[spot]))]
    nearest = scene.elements.centre[:, 2].min()
    z = nearest * rng.uniform(0.35, 0.6)
    x, y = (scene.laser[spot] + (target - scene.laser[spot]) * z / target[2])[:2]
    radius = np.ptp(scene.laser[:, 0]) * rng.uniform(0.09, 0.16)

    def disc(legs: Legs) -> np.ndarray:
        through = 1.0
        for wall in (legs.laser, legs.sensor):
            f = z / legs.elements.centre[:, 2]
            off = [
                wall[:, k, None] * (1 - f) + legs.elements.centre[:, k] * f - c for k, c in enumerate((x, y))
            ]
            through = through * np.where(off[0] ** 2 + off[1] ** 2 < radius**2, 1 - opacity, 1)
        return through

    work.light = work.scene.rendered((disc,))
    return {"opacity": opacity, "x": float(x), "y": float(y), "z": float(z), "radius": float(radius)}


def higher_order_bounces(work: Work, share: float) -> dict[str, float]:
    more = work.scene.fourth()
    ends = slice(PAD * FINE, -PAD * FINE)
    physical = more[:, ends].sum() / work.light[:, ends].sum()
    scale = share / (1 - share) / physical
    work.light = work.light + scale * more
    return {"share": share, "strength": float(scale)}


def time_offset(work: Work, bins: float) -> dict[str, float]:
    offset = float(work.rng.choice([-1, 1])) * bins * work.bin
    work.delay = work.delay + offset
    return {"offset": offset}


def time_drift(work: Work, bins: float) -> dict[str, float]:
    drift = bins * work.bin * wave(work)
    work.delay = work.delay + drift
    return {"peak_to_peak": float(np.ptp(drift)), "rms": float(drift.std())}


def timing_jitter(work: Work, bins: float) -> dict[str, float]:
    jitter = bins * work.bin * work.rng.standard_normal(len(work.delay))
    work.delay = work.delay + jitter
    return {"sigma": bins * work.bin, "rms": float(jitter.std())}


def clock_scale(work: Work, scale: float) -> dict[str, float]:
    work.stretch = float(work.rng.choice([-1, 1])) * scale
    return {"scale": work.stretch}


def wall_tilt(work: Work, angle: float) -> dict[str, float]:
    towards = work.rng.uniform(0, 2 * np.pi)
    tilt = angle * np.array([np.cos(towards), np.sin(towards)])
    wall = work.scene.laser.copy()
    # The points stand elsewhere; which way the wall faces there is left as it is.
    wall[:, 2] = (wall[:, :2] - wall[:, :2].mean(axis=0)) @ tilt
    work.light = work.scene.rendered(wall=wall)
    return {"tilt_x": float(tilt[0]), "tilt_y": float(tilt[1])}


def wall_scale(work: Work, scale: float) -> dict[str, float]:
    scale = scale * float(work.rng.choice([-1, 1]))
    stated = work.scene.laser
    middle = (stated.min(axis=0) + stated.max(axis=0)) / 2
    work.light = work.scene.rendered(wall=middle + (1 + scale) * (stated - middle))
    return {"scale": scale}


def laser_sensor_baseline(work: Work, length: float) -> dict[str, float]:
    towards = work.rng.uniform(0, 2 * np.pi)
    baseline = length * np.array([np.cos(towards), np.sin(towards)])
    work.light = work.scene.apart(work.scene.laser + np.array([*baseline, 0]))
    return {"baseline_x": float(baseline[0]), "baseline_y": float(baseline[1])}


def irf_tail(work: Work, fraction: float) -> dict[str, float]:
    decay = work.bin * float(np.exp(work.rng.uniform(np.log(8), np.log(40))))

    def tail(seen: np.ndarray, step: float) -> np.ndarray:
        keep = np.exp(-step / decay)
        return (1 - fraction) * seen + fraction * lfilter([1 - keep], [1, -keep], seen, axis=1)

    work.response.append(tail)
    return {"fraction": fraction, "decay": decay}


def ghost_pulse(work: Work, fraction: float) -> dict[str, float]:
    late = int(work.rng.integers(12 * FINE, 70 * FINE))

    def ghost(seen: np.ndarray, step: float) -> np.ndarray:
        seen = seen.copy()
        seen[:, late:] += fraction * seen[:, :-late].copy()
        return seen

    work.response.append(ghost)
    return {"fraction": fraction, "delay": late * work.bin / FINE}


def power_drift(work: Work, span: float) -> dict[str, float]:
    drift = span * wave(work)
    work.gain = work.gain * np.exp(drift)
    return {"peak_to_peak": float(np.ptp(drift)), "rms": float(drift.std())}


def wall_reflectance(work: Work, rms: float) -> dict[str, float]:
    work.gain = work.gain * np.exp(rms * blotches(work))
    return {"rms": rms}


def vignetting(work: Work, strength: float) -> dict[str, float]:
    work.gain = work.gain * np.exp(-strength * (work.scene.places**2).sum(axis=1))
    return {"strength": strength}


def ambient_map(work: Work, rms: float) -> dict[str, float]:
    work.background = work.background * np.exp(rms * blotches(work))[:, None]
    return {"rms": rms}


def hum(work: Work, amplitude: float) -> dict[str, float]:
    periods, phase = float(work.rng.uniform(5, 28)), work.rng.uniform(0, 2 * np.pi)
    swing = 1 + amplitude * np.sin(np.pi * periods * (work.rank + 1) + phase)
    work.background = work.background * swing[:, None]
    return {"amplitude": amplitude, "frequency": periods}


def hot_spots(work: Work, times: float) -> dict[str, float]:
    hot = work.rng.choice(len(work.gain), max(1, len(work.gain) // 100), replace=False)
    extra = times * work.dark * work.rng.uniform(0.6, 1.4, len(hot))
    work.background = work.background.copy()
    work.background[hot] += extra[:, None]
    return {"level": float(extra.mean()), "number": float(len(hot))}


def background_slope(work: Work, slope: float) -> dict[str, float]:
    slope = slope * float(work.rng.choice([-1, 1]))
    bins = len(work.times)
    work.background = work.background * (1 + slope * (2 * (work.times + 0.5) / bins - 1))
    return {"slope": slope}


def direct_leak(work: Work, times: float) -> dict[str, float]:
    amplitude, decay = times * work.dark, float(work.rng.uniform(6, 25))
    work.background = work.background + amplitude * np.exp(-(work.times + 0.5) / decay)
    return {"amplitude": amplitude, "decay": decay * work.bin}


def direct_tail(work: Work, times: float) -> dict[str, float]:
    level, decay = times * work.dark, float(work.rng.uniform(6, 25)) * work.bin
    reach = float(work.rng.uniform(0.05, 0.4))
    window = work.scene.window
    apart = np.sqrt(((work.scene.laser - work.scene.sensor) ** 2).sum(axis=1, keepdims=True))
    since = window.t_start + (work.times + 0.5) * work.bin - apart
    # Every spot's own pulse, then a glow that fades; as strong as is said where it is strongest at first.
    glow = np.where(since > 0, np.exp((window.t_start - since) / decay), 0) / (1 + apart / reach) ** 2
    work.background = work.background + level * glow / glow[:, 0].max()
    return {"strongest": level, "decay": decay, "reach": reach}


def afterpulsing(work: Work, probability: float) -> dict[str, float]:
    decay = float(np.exp(work.rng.uniform(np.log(10), np.log(40))))
    late = np.exp(-np.arange(1, 60 * decay) / decay)
    kernel = np.concatenate([[1.0], probability * late / late.sum()])
    work.counting.append(lambda m: np.maximum(fftconvolve(m, kernel[None], axes=1)[:, : m.shape[1]], 0))
    return {"probability": probability, "decay": decay * work.bin}


def pile_up(work: Work, detections: float) -> dict[str, float]:
    def first_only(m: np.ndarray) -> np.ndarray:
        total = m.sum(axis=1)

        def recorded(cycles: float) -> float:
            return float(np.mean(-np.expm1(-total / cycles)))

        cycles = brentq(lambda n: recorded(n) - detections, total.mean() / 50, total.mean() / detections)
        x = m / cycles
        before = np.cumsum(x, axis=1) - x
        return cycles * -np.expm1(-x) * np.exp(-before)

    work.counting.append(first_only)
    return {"detections": detections}


def tcspc_nonlinearity(work: Work, amplitude: float) -> dict[str, float]:
    period, phase = float(work.rng.uniform(5, 24)), work.rng.uniform(0, 2 * np.pi)
    ripple = 1 + amplitude * np.sin(2 * np.pi * work.times / period + phase)
    work.counting.append(lambda m: m * ripple)
    return {"rms": amplitude / 2**0.5, "period": period}


def gate_edges(work: Work, depth: float) -> dict[str, float]:
    width, end = float(work.rng.uniform(4, 15)), depth * float(work.rng.uniform(0.3, 1))
    rise = (1 - depth * np.exp(-work.times / width)) * (1 - end * np.exp(-work.times[::-1] / width))
    work.counting.append(lambda m: m * rise)
    return {"start": depth, "end": end, "width": width}


def spot_gate(work: Work, share: float) -> dict[str, float]:
    spots = len(work.gain)
    late = work.rng.choice(spots, max(1, spots // 40), replace=False)
    arrived = np.cumsum(work.scene.clean.sum(axis=0)) / work.scene.clean.sum()
    opens = int(np.searchsorted(arrived, work.rng.uniform(0.3, 0.8)) // FINE) - PAD

    def closed(m: np.ndarray) -> np.ndarray:
        m = m.copy()
        m[late, :opens] *= 1 - share
        return m

    work.counting.append(closed)
    return {"share": share, "number": float(len(late)), "start": float(opens)}


def crosstalk(work: Work, leak: float) -> dict[str, float]:
    lag, taken = int(work.rng.integers(1, 9)), np.argsort(work.rank)

    def again(m: np.ndarray) -> np.ndarray:
        more = np.zeros_like(m)
        more[taken[lag:]] = leak * m[taken[:-lag]]
        return m + more

    work.counting.append(again)
    return {"leak": leak, "lag": float(lag)}


def mains_ripple(work: Work, amplitude: float) -> dict[str, float]:
    cycles, phase = work.rng.uniform(12, 20), work.rng.uniform(0, 2 * np.pi)
    work.gain = work.gain * (1 + amplitude * np.sin(np.pi * cycles * (work.rank + 1) + phase))
    return {"amplitude": amplitude, "cycles": float(cycles)}


def dead_stripe(work: Work, loss: float) -> dict[str, float]:
    angle, offset = np.deg2rad(work.rng.uniform(20, 70)), work.rng.uniform(-0.3, 0.3)
    across = work.scene.places @ [np.cos(angle), np.sin(angle)] - offset
    along = work.scene.places @ [-np.sin(angle), np.cos(angle)]
    inside = (np.abs(across) < 0.14) & (np.abs(along) < 0.9)
    work.gain = work.gain * np.where(inside, 1 - loss, 1)
    return {"loss": loss, "spots": float(inside.sum())}


def missing_codes(work: Work, loss: float) -> dict[str, float]:
    arrival = np.cumsum(work.scene.clean.sum(axis=0)) / work.scene.clean.sum()
    first = int(np.searchsorted(arrival, work.rng.uniform(0.3, 0.7)) // FINE) - PAD
    work.counting.append(
        lambda m: m * np.where((work.times >= first) & (work.times < first + 5), 1 - loss, 1)
    )
    return {"loss": loss, "first": float(first)}


def saturation(work: Work, ratio: float) -> dict[str, float]:
    def compress(m: np.ndarray) -> np.ndarray:
        total = m.sum(axis=1, keepdims=True)
        return m / (1 + ratio * total / total.mean())

    work.counting.append(compress)
    return {"ratio": ratio}


def moving_object(work: Work, lift: float) -> dict[str, float]:
    work.light = np.where((work.rank < 0)[:, None], work.light, work.scene.rendered(lift=lift))
    return {"lift": lift}


@dataclass(frozen=True)
class Kind:
    """An injector, its strengths from just detectable to gross, and the axis on which an unknown shows."""

    inject: Callable[[Work, float], dict[str, float]]
    ladder: tuple[float, float, float, float]
    scenes: tuple[str, ...] = ()  # empty: all
    axis: str = ""


OWN = ("default", "letters", "sphere_before_plate", "corner")
EFFECTS: dict[str, Kind] = {
    "retroreflection": Kind(retroreflection, (3.8, 3.5, 3.0, 2.0), (*OWN, "z_confocal", "bunny_confocal")),
    "specular_lobe": Kind(specular_lobe, (0.01, 0.03, 0.1, 0.4), OWN),
    "occlusion": Kind(occlusion, (0.1, 0.25, 0.5, 1.0), OWN),
    "higher_order_bounces": Kind(higher_order_bounces, (0.01, 0.03, 0.08, 0.2), ("corner", "bunny_confocal")),
    "time_offset": Kind(time_offset, (0.5, 1.0, 3.0, 6.0)),
    "time_drift": Kind(time_drift, (0.3, 0.7, 1.5, 4.0)),
    "timing_jitter": Kind(timing_jitter, (0.3, 0.6, 1.2, 2.5)),
    "clock_scale": Kind(clock_scale, (0.004, 0.012, 0.03, 0.08)),
    "wall_tilt": Kind(wall_tilt, (0.005, 0.01, 0.02, 0.04), OWN),
    "wall_scale": Kind(wall_scale, (0.01, 0.02, 0.05, 0.1), OWN),
    "laser_sensor_baseline": Kind(laser_sensor_baseline, (0.02, 0.05, 0.12, 0.25), OWN),
    "irf_tail": Kind(irf_tail, (0.03, 0.06, 0.12, 0.25)),
    "ghost_pulse": Kind(ghost_pulse, (0.02, 0.04, 0.08, 0.15)),
    "power_drift": Kind(power_drift, (0.1, 0.2, 0.4, 0.6)),
    "wall_reflectance": Kind(wall_reflectance, (0.05, 0.1, 0.2, 0.35)),
    "vignetting": Kind(vignetting, (0.1, 0.2, 0.5, 1.0)),
    "ambient_map": Kind(ambient_map, (0.1, 0.25, 0.5, 1.0)),
    "hum": Kind(hum, (0.1, 0.25, 0.5, 0.95)),
    "hot_spots": Kind(hot_spots, (1.0, 3.0, 10.0, 30.0)),
    "background_slope": Kind(background_slope, (0.1, 0.25, 0.5, 0.9)),
    "direct_leak": Kind(direct_leak, (0.5, 1.5, 5.0, 15.0)),
    "direct_tail": Kind(direct_tail, (0.5, 1.5, 5.0, 15.0)),
    "afterpulsing": Kind(afterpulsing, (0.02, 0.05, 0.12, 0.3)),
    "pile_up": Kind(pile_up, (0.05, 0.1, 0.3, 0.6)),
    "tcspc_nonlinearity": Kind(tcspc_nonlinearity, (0.02, 0.04, 0.08, 0.15)),
    "gate_edges": Kind(gate_edges, (0.1, 0.25, 0.5, 0.9)),
    "spot_gate": Kind(spot_gate, (0.2, 0.5, 0.8, 0.99)),
    "crosstalk": Kind(crosstalk, (0.02, 0.05, 0.15, 0.4)),
}
UNKNOWN: dict[str, Kind] = {
    "mains_ripple": Kind(mains_ripple, (0.05, 0.1, 0.2, 0.4), axis="scan"),
    "dead_stripe": Kind(dead_stripe, (0.1, 0.2, 0.5, 0.8), axis="wall"),
    "missing_codes": Kind(missing_codes, (0.1, 0.25, 0.6, 0.9), axis="time"),
    "saturation": Kind(saturation, (0.05, 0.15, 0.5, 1.5), axis="rate"),
    "moving_object": Kind(moving_object, (0.0025, 0.005, 0.01, 0.02), OWN, axis="scan"),
}
ORDER = (*EFFECTS, *UNKNOWN)  # in which hidden effects act, wherever order matters
