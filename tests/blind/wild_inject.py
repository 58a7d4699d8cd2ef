"""Effects as hardware has them, each on purpose not the formula by which a fit would describe it.

Each injector takes the `WildWork` and a strength, and returns true values in SI units, under a registry's
names only where they mean the same. `EFFECTS` says which registry names are right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from blind_elements import Legs
from blind_scenes import FINE, PAD
from blind_work import blotches
from scipy.signal import fftconvolve, lfilter
from scipy.special import ndtr, ndtri
from wild_counting import afterpulses, crosstalk, pile_up
from wild_work import WildWork, walk, warm_up

Values = dict[str, float]


def tail_two_exponentials(work: WildWork, fraction: float) -> Values:
    fast, slow = work.bin * np.array([work.rng.uniform(4, 10), work.rng.uniform(25, 60)])
    share = float(work.rng.uniform(0.3, 0.7))

    def tail(seen: np.ndarray, step: float) -> np.ndarray:
        total = (1 - fraction) * seen
        for part, decay in ((share, fast), (1 - share, slow)):
            keep = np.exp(-step / decay)
            total = total + fraction * part * lfilter([1 - keep], [1, -keep], seen, axis=1)
        return total

    work.response.append(tail)
    return {"fraction": fraction, "share": share, "fast": float(fast), "slow": float(slow)}


def tail_power_law(work: WildWork, fraction: float) -> Values:
    knee, power = work.bin * float(work.rng.uniform(3, 8)), float(work.rng.uniform(1.6, 2.4))

    def tail(seen: np.ndarray, step: float) -> np.ndarray:
        late = (1 + step * np.arange(seen.shape[1]) / knee) ** -power
        return (1 - fraction) * seen + fraction * convolved(seen, late / late.sum())

    work.response.append(tail)
    return {"fraction": fraction, "knee": knee, "power": power}


def ghost_echoes(work: WildWork, fraction: float) -> Values:
    late, again = int(work.rng.integers(10 * FINE, 50 * FINE)), float(work.rng.uniform(0.25, 0.6))
    blur = np.hanning(2 * FINE + 3)[1:-1]
    blur /= blur.sum()

    def ghost(seen: np.ndarray, step: float) -> np.ndarray:
        total, echo, size = seen.copy(), seen, fraction
        for _ in range(4):
            echo = convolved(np.pad(echo, ((0, 0), (late - FINE, 0))), blur)[:, : seen.shape[1]]
            total += size * echo
            size *= again
        return total

    work.response.append(ghost)
    return {"fraction": fraction, "delay": late * work.bin / FINE, "again": again}


def convolved(seen: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Light ``[S, n]`` smeared towards later times; what leaves the axis is lost."""
    return fftconvolve(seen, kernel[None], axes=1)[:, : seen.shape[1]]


def time_offset(work: WildWork, bins: float) -> Values:
    offset = float(work.rng.choice([-1, 1])) * bins * work.bin
    work.delay = work.delay + offset
    return {"offset": offset}


def _drift(work: WildWork, bins: float, shape: np.ndarray) -> Values:
    drift = bins * work.bin * shape
    work.delay = work.delay + drift
    return {"peak_to_peak": float(np.ptp(drift)), "rms": float(drift.std())}


def time_warm_up(work: WildWork, bins: float) -> Values:
    return _drift(work, bins, warm_up(work))


def time_walk(work: WildWork, bins: float) -> Values:
    return _drift(work, bins, walk(work))


def jitter_heavy(work: WildWork, bins: float) -> Values:
    spots, student = len(work.delay), work.rng.random() < 0.5
    # Three degrees of freedom have the variance 3, the Laplace distribution has 2.
    drawn = (
        work.rng.standard_t(3, spots) / np.sqrt(3) if student else work.rng.laplace(size=spots) / np.sqrt(2)
    )
    jitter = bins * work.bin * np.clip(drawn, -6, 6)
    work.delay = work.delay + jitter
    return {"sigma": float(jitter.std())}


def clock_scale(work: WildWork, scale: float) -> Values:
    work.stretch = float(work.rng.choice([-1, 1])) * scale
    return {"scale": work.stretch}


def _power(work: WildWork, span: float, shape: np.ndarray) -> Values:
    work.gain = work.gain * (1 + span * shape)
    drift = np.log(1 + span * shape)
    return {"peak_to_peak": float(np.ptp(drift)), "rms": float(drift.std())}


def power_warm_up(work: WildWork, span: float) -> Values:
    return _power(work, span, warm_up(work))


def power_walk(work: WildWork, span: float) -> Values:
    return _power(work, span, walk(work))


def wall_blotches(work: WildWork, rms: float) -> Values:
    """Patches of another paint, with soft edges."""
    stain = np.tanh(1.5 * blotches(work))
    stain = (stain - stain.mean()) / stain.std()
    work.gain = work.gain * np.exp(rms * stain)
    return {"rms": rms}


def wall_scratches(work: WildWork, loss: float) -> Values:
    """A few dark lines, some spots wide, across the wall."""
    places, rng = work.scene.places, work.rng
    kept = np.ones(len(places))
    for _ in range(int(rng.integers(2, 5))):
        angle = rng.uniform(0, np.pi)
        across = places @ [np.cos(angle), np.sin(angle)] - rng.uniform(-0.6, 0.6)
        kept *= 1 - loss * rng.uniform(0.6, 1) * np.exp(-0.5 * (across / rng.uniform(0.06, 0.16)) ** 2)
    work.gain = work.gain * kept
    return {"rms": float(np.log(kept).std())}


def vignetting_cos4(work: WildWork, corner: float) -> Values:
    """cos⁴ of the field angle about a centre of its own; ``corner`` is what is lost half a side from it."""
    centre = work.rng.uniform(-0.35, 0.35, 2)
    slope = (1 - corner) ** -0.5 - 1
    away = ((work.scene.places - centre) ** 2).sum(axis=1)
    work.gain = work.gain / (1 + slope * away) ** 2
    points = work.scene.sensor[:, :2]
    half, middle = np.ptp(points, axis=0).max() / 2, (points.max(axis=0) + points.min(axis=0)) / 2
    x, y = middle + half * centre
    return {"strength": 2 * slope, "x": float(x), "y": float(y)}


def ambient_window(work: WildWork, share: float) -> Values:
    """A window beside the wall gives a share of the ambient light."""
    towards, rng = work.rng.uniform(0, 2 * np.pi), work.rng
    aside, height = rng.uniform(1.2, 2.0), rng.uniform(0.4, 1.0)
    offset = work.scene.places - aside * np.array([np.cos(towards), np.sin(towards)])
    light = ((offset**2).sum(axis=1) + height**2) ** -2
    shape = 1 - share + share * light / light.mean()
    work.background = work.background * shape[:, None]
    return {"rms": float(np.log(shape).std())}


def hum_harmonics(work: WildWork, depth: float) -> Values:
    """Lamps at the mains, beating with the scan: ambient light like a rectified sine, with its harmonics."""
    periods, phase = float(work.rng.uniform(5, 30)), work.rng.uniform(0, 2 * np.pi)
    lamp = np.abs(np.sin(np.pi * periods * work.along + phase)) ** work.rng.uniform(0.7, 1.6)
    swing = 1 - depth + depth * lamp / lamp.mean()
    work.background = work.background * swing[:, None]
    return {"depth": depth, "frequency": periods}


def hot_spots_log_normal(work: WildWork, times: float) -> Values:
    spots = len(work.gain)
    hot = work.rng.choice(spots, max(2, round(spots * work.rng.uniform(0.008, 0.03))), replace=False)
    extra = times * work.dark * np.exp(0.8 * work.rng.standard_normal(len(hot)))
    work.background = work.background.copy()
    work.background[hot] += extra[:, None]
    return {"level": float(extra.mean()), "number": float(len(hot))}


def background_curve(work: WildWork, slope: float) -> Values:
    """Background that rises or falls along the window, steeper at one end."""
    u = (work.times + 0.5) / len(work.times)
    curve = u ** work.rng.uniform(1.4, 2.4)
    curve = curve if work.rng.random() < 0.5 else curve[::-1]
    curve = 1 + slope * 2 * (curve - curve.mean())
    work.background = work.background * np.maximum(curve, 0.02)
    return {"first": float(curve[0]), "last": float(curve[-1])}


def leak_power_law(work: WildWork, times: float) -> Values:
    knee, power = float(work.rng.uniform(4, 12)), float(work.rng.uniform(1.3, 2.2))
    amplitude = times * work.dark
    work.background = work.background + amplitude * (1 + (work.times + 0.5) / knee) ** -power
    return {"amplitude": amplitude, "knee": knee * work.bin, "power": power}


def direct_tail_two(work: WildWork, times: float) -> Values:
    """What the direct light of the laser's spot leaves behind, the more the nearer the sensor looks to it."""
    scene, rng = work.scene, work.rng
    gap = np.linalg.norm(scene.sensor - scene.laser, axis=1)
    near = float(np.ptp(scene.sensor[:, 0])) * rng.uniform(0.15, 0.35)
    level = 1 / (1 + (gap / near) ** 2)
    late = scene.window.t_start + (work.times + 0.5) * work.bin - gap[:, None]
    fast, slow = rng.uniform(0.1, 0.25), rng.uniform(0.5, 1.2)
    decay = np.exp(-late / slow) + rng.uniform(1, 4) * np.exp(-late / fast)
    tail = level[:, None] * decay
    tail *= times * work.dark / tail.mean()
    work.background = work.background + tail
    return {"mean": times * work.dark, "fast": float(fast), "slow": float(slow)}


def gate_erf(work: WildWork, depth: float) -> Values:
    """Gate that opens and closes by an error function; ``depth`` is missing in the first bin."""
    width, end = float(work.rng.uniform(3, 10)), depth * float(work.rng.uniform(0.3, 1))
    opens, closes = -width * ndtri(1 - depth), -width * ndtri(1 - end)
    gate = ndtr((work.times - opens) / width) * ndtr((work.times[::-1] - closes) / width)
    work.count(lambda m: m * gate)
    return {"start": depth, "end": end, "soft": width * work.bin}


def spot_gates(work: WildWork, share: float) -> Values:
    """Some spots' gates open late, each at a bin of its own near a common one, and not all of the way."""
    rng, spots = work.rng, len(work.gain)
    arrived = np.cumsum(work.scene.clean.sum(axis=0))
    common = np.searchsorted(arrived / arrived[-1], rng.uniform(0.35, 0.85)) / FINE - PAD
    late = rng.choice(spots, round(spots * rng.uniform(0.015, 0.05)), replace=False)
    opens = common + rng.uniform(1, 4) * rng.standard_normal(len(late))
    lost = np.minimum(share * rng.uniform(0.8, 1.2, len(late)), 0.995)
    gate = np.ones((spots, len(work.times)))
    gate[late] = 1 - lost[:, None] * ndtr((opens[:, None] - work.times) / 0.7)
    work.count(lambda m: m * gate)
    return {"share": float(lost.mean()), "number": float(len(late)), "start": float(common)}


def code_widths(work: WildWork, rms: float) -> Values:
    period = int(work.rng.integers(3, 17))
    pattern = work.rng.standard_normal(period)
    pattern = np.clip((pattern - pattern.mean()) / pattern.std(), -2.5, 2.5) * rms
    width = 1 + pattern[work.times % period]
    work.count(lambda m: m * width)
    return {"rms": rms, "period": float(period)}


def retro_paint(work: WildWork, share: float) -> Values:
    """Paint with glass beads: a share of the light goes straight back instead of Lambert's way."""
    scene = work.scene
    middle = (scene.window.middle / 2) ** 2

    def beads(legs: Legs) -> np.ndarray:
        back = legs.d1 * legs.d2 / middle / np.maximum(np.sqrt(legs.cosine1 * legs.cosine2), 0.05)
        return 1 - share + share * back

    work.light = scene.rendered((beads,))
    return {"share": share}


def gloss(work: WildWork, strength: float) -> Values:
    """A Beckmann lobe about the half vector; of a lobe as bright at its middle and as wide the registry's
    strength is a quarter."""
    rough = float(work.rng.uniform(0.15, 0.45))

    def lobe(legs: Legs) -> np.ndarray:
        half = [a + b for a, b in zip(legs.to_laser, legs.to_sensor, strict=True)]
        length = np.sqrt(sum(h * h for h in half))
        cosine = sum(h * legs.elements.normal[:, k] for k, h in enumerate(half)) / np.maximum(length, 1e-9)
        square = np.maximum(cosine, 1e-3) ** 2
        return 1 + strength * np.exp((1 - 1 / square) / rough**2) / (4 * rough**2 * square**2)

    work.light = work.scene.rendered((lobe,))
    return {"strength": strength / 4, "rough": rough}


def fourth_bounces(work: WildWork, times: float) -> Values:
    """The scene's own fourth bounce, ``times`` as strong as its albedos make it."""
    more = times * work.scene.fourth()
    work.light = work.light + more
    return {"times": times, "share": float(more.sum() / work.light.sum())}


def occluder_ragged(work: WildWork, opacity: float) -> Values:
    """A torn or angular sheet between the wall and the scene."""
    scene, rng = work.scene, work.rng
    inner = np.flatnonzero((np.abs(scene.places) < 0.6).all(axis=1) & scene.seen.any(axis=1))
    spot = rng.choice(inner)
    target = scene.elements.centre[rng.choice(np.flatnonzero(scene.seen[spot]))]
    z = scene.elements.centre[:, 2].min() * rng.uniform(0.35, 0.6)
    x, y = (scene.sensor[spot] + (target - scene.sensor[spot]) * z / target[2])[:2]
    size = np.ptp(scene.sensor[:, 0]) * rng.uniform(0.11, 0.2)
    corners, ragged = int(rng.integers(3, 7)), rng.random() < 0.5
    waves = rng.uniform(0.05, 0.2, 4) * rng.choice([-1, 1], 4)
    start = rng.uniform(0, 2 * np.pi, 5)

    def outline(angle: np.ndarray) -> np.ndarray:
        if ragged:
            return size * (1 + sum(waves[k] * np.cos((k + 2) * angle + start[k]) for k in range(4)))
        sector = np.pi / corners
        return size * np.cos(sector) / np.cos((angle + start[4]) % (2 * sector) - sector)

    def sheet(legs: Legs) -> np.ndarray:
        through = 1.0
        for wall in (legs.laser, legs.sensor):
            f = z / legs.elements.centre[:, 2]
            u, v = (
                wall[:, k, None] * (1 - f) + legs.elements.centre[:, k] * f - c for k, c in enumerate((x, y))
            )
            hidden = np.hypot(u, v) < outline(np.arctan2(v, u))
            through = through * np.where(hidden, 1 - opacity, 1)
        return through

    work.light = scene.rendered((sheet,))
    return {"opacity": opacity, "x": float(x), "y": float(y), "z": float(z), "size": float(size)}


def wall_tilt_bow(work: WildWork, angle: float) -> Values:
    towards, bow = work.rng.uniform(0, 2 * np.pi), float(work.rng.uniform(-0.3, 0.3))
    tilt = angle * np.array([np.cos(towards), np.sin(towards)])
    half = np.abs(work.scene.sensor[:, :2]).max()

    def bent(points: np.ndarray) -> np.ndarray:
        flat = points[:, :2]
        lifted = points.copy()
        lifted[:, 2] = flat @ tilt + bow * angle * ((flat**2).sum(axis=1) - half**2 / 2) / half
        return lifted

    work.place_wall(bent)
    return {"tilt_x": float(tilt[0]), "tilt_y": float(tilt[1])}


def wall_scaled(work: WildWork, scale: float) -> Values:
    """Mirrors whose gains are off: x and y are not what the file says, by unlike factors."""
    off = scale * np.array([1.0, work.rng.uniform(0, 0.8)]) * work.rng.choice([-1, 1])
    off = off[work.rng.permutation(2)]
    work.place_wall(lambda points: points * [1 + off[0], 1 + off[1], 1])
    return {"scale_x": float(off[0]), "scale_y": float(off[1])}


def baseline_skewed(work: WildWork, length: float) -> Values:
    """The sensor looks beside the laser's point, not equally far everywhere."""
    towards, skew = work.rng.uniform(0, 2 * np.pi), work.rng.uniform(-0.25, 0.25, 2)
    baseline = length * np.array([np.cos(towards), np.sin(towards)])
    offset = baseline * (1 + work.scene.places @ skew)[:, None]
    work.look_aside(work.scene.laser + np.pad(offset, ((0, 0), (0, 1))))
    return {"baseline_x": float(baseline[0]), "baseline_y": float(baseline[1])}


@dataclass(frozen=True)
class Hidden:
    """What can be hidden.

    Args:
        inject: acts on the work.
        ladder: weak, medium, strong.
        right: names of the registry that say what it is.
        alike: names that describe nearly the same counts; right in a group with a right one, no false alarm.
        own: needs a scene whose surface is known. scan: ``confocal`` or ``single``; empty for both.
        families: where it can show; empty for all.
        axes: of an unknown; each of them is right.
    """

    inject: Callable[[WildWork, float], Values]
    ladder: tuple[float, float, float]
    right: tuple[str, ...] = ()
    alike: tuple[str, ...] = ()
    own: bool = False
    scan: str = ""
    families: tuple[str, ...] = ()
    axes: tuple[str, ...] = ()

    def suits(self, family: str, scan: str) -> bool:
        """Whether it can be hidden there."""
        fits = family != "render" if self.own else True
        return fits and self.scan in ("", scan) and (not self.families or family in self.families)


WALL = ("wall_reflectance", "vignetting", "power_drift")
DELAYS = ("line_delay", "scene_motion")
# In the order of the light's way.
EFFECTS: dict[str, Hidden] = {
    "retro_paint": Hidden(retro_paint, (0.03, 0.1, 0.4), ("retroreflection",), own=True, scan="confocal"),
    "gloss": Hidden(gloss, (0.05, 0.15, 0.5), ("specular_lobe",), own=True, scan="confocal"),
    "occluder_ragged": Hidden(occluder_ragged, (0.1, 0.3, 0.9), ("occlusion",), own=True),
    "fourth_bounces": Hidden(
        fourth_bounces,
        (0.5, 1.0, 2.0),
        ("higher_order_bounces",),
        own=True,
        scan="confocal",
        families=("sheet",),
    ),
    "wall_tilt_bow": Hidden(wall_tilt_bow, (0.006, 0.015, 0.04), ("wall_tilt",), own=True),
    "wall_scaled": Hidden(wall_scaled, (0.008, 0.025, 0.08), ("wall_scale",), own=True),
    "baseline_skewed": Hidden(
        baseline_skewed, (0.02, 0.06, 0.15), ("laser_sensor_baseline",), own=True, scan="confocal"
    ),
    "time_offset": Hidden(time_offset, (0.5, 1.5, 5.0), ("time_offset",)),
    "time_warm_up": Hidden(time_warm_up, (0.5, 1.2, 3.0), ("time_drift",), DELAYS),
    "time_walk": Hidden(time_walk, (0.5, 1.2, 3.0), ("time_drift",), DELAYS),
    "jitter_heavy": Hidden(jitter_heavy, (0.2, 0.5, 1.3), ("timing_jitter",)),
    "clock_scale": Hidden(clock_scale, (0.006, 0.02, 0.06), ("clock_scale",)),
    "tail_two_exponentials": Hidden(
        tail_two_exponentials, (0.02, 0.06, 0.18), ("irf_tail",), ("afterpulsing",)
    ),
    "tail_power_law": Hidden(tail_power_law, (0.02, 0.06, 0.18), ("irf_tail",), ("afterpulsing",)),
    "ghost_echoes": Hidden(ghost_echoes, (0.012, 0.035, 0.1), ("ghost_pulse",)),
    "power_warm_up": Hidden(power_warm_up, (0.1, 0.25, 0.6), ("power_drift",), ("wall_reflectance",)),
    "power_walk": Hidden(power_walk, (0.1, 0.25, 0.6), ("power_drift",), ("wall_reflectance",)),
    "wall_blotches": Hidden(wall_blotches, (0.03, 0.08, 0.2), ("wall_reflectance",), WALL[1:]),
    "wall_scratches": Hidden(wall_scratches, (0.06, 0.15, 0.4), ("wall_reflectance",), WALL[1:]),
    "vignetting_cos4": Hidden(vignetting_cos4, (0.05, 0.12, 0.35), ("vignetting",), ("wall_reflectance",)),
    "ambient_window": Hidden(ambient_window, (0.15, 0.4, 0.9), ("ambient_map",)),
    "hum_harmonics": Hidden(hum_harmonics, (0.15, 0.4, 0.95), ("hum",), ("ambient_drift",)),
    "hot_spots_log_normal": Hidden(hot_spots_log_normal, (0.7, 3.0, 12.0), ("hot_spots",)),
    "background_curve": Hidden(background_curve, (0.25, 0.5, 0.95), ("background_slope",), ("direct_leak",)),
    "leak_power_law": Hidden(leak_power_law, (1.5, 5.0, 15.0), ("direct_leak",), ("background_slope",)),
    "direct_tail_two": Hidden(
        direct_tail_two, (0.3, 1.0, 4.0), ("direct_tail",), ("direct_leak",), scan="single"
    ),
    "gate_erf": Hidden(gate_erf, (0.4, 0.8, 0.99), ("gate_edges",)),
    "spot_gates": Hidden(spot_gates, (0.3, 0.6, 0.97), ("spot_gate",)),
    "pile_up_dead_time": Hidden(pile_up, (0.06, 0.18, 0.5), ("pile_up",)),
    "afterpulses_two_traps": Hidden(afterpulses, (0.012, 0.04, 0.15), ("afterpulsing",), ("irf_tail",)),
    "crosstalk_fading": Hidden(crosstalk, (0.01, 0.03, 0.1), ("crosstalk",)),
    "code_widths": Hidden(code_widths, (0.025, 0.06, 0.15), ("tcspc_nonlinearity",)),
}
