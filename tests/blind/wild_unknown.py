"""What no registry knew, and the axes on which it shows; three kinds are those of `blind_inject`."""

from __future__ import annotations

import numpy as np
from blind_inject import missing_codes, saturation
from blind_scenes import FINE, PAD
from scipy.special import ndtr
from wild_inject import Hidden, Values, convolved
from wild_work import WildWork


def moving_object(work: WildWork, bins: float) -> Values:
    """The scene comes nearer to the wall, or goes away, in four steps in the middle of the scan."""
    lift = float(work.rng.choice([-1, 1])) * bins * work.bin / 2
    begin, lasts = work.rng.uniform(0.2, 0.45), work.rng.uniform(0.1, 0.35)
    step = np.clip(np.ceil(4 * (work.along - begin) / lasts), 0, 4).astype(int)
    light = work.light.copy()
    for k in range(1, 5):
        light[step == k] = work.scene.rendered(lift=lift * k / 4)[step == k]
    work.light = light
    return {"lift": lift, "begin": float(begin), "lasts": float(lasts), "rms": float((lift / 4 * step).std())}


def _widened(work: WildWork, spread: np.ndarray) -> None:
    """Response of every spot widened by a Gaussian of ``spread`` ``[S]`` bins."""
    spread = spread * FINE

    def widen(seen: np.ndarray, step: float) -> np.ndarray:
        n = seen.shape[1] + PAD * FINE
        wave = 2 * np.pi * np.fft.rfftfreq(n)
        blur = np.exp(-0.5 * (spread[:, None] * wave) ** 2)
        return np.maximum(np.fft.irfft(np.fft.rfft(seen, n, axis=1) * blur, n, axis=1)[:, : seen.shape[1]], 0)

    work.response.append(widen)


def widening_response(work: WildWork, bins: float) -> Values:
    """The laser's pulse grows wider as the scan goes on."""
    _widened(work, bins * work.along ** work.rng.uniform(0.7, 2.0))
    return {"widest": bins * work.bin}


def focus_response(work: WildWork, bins: float) -> Values:
    """Out of focus the response is wider: the farther a spot is from where the optics was focused."""
    centre = work.rng.uniform(-0.6, 0.6, 2)
    away = ((work.scene.places - centre) ** 2).sum(axis=1)
    _widened(work, bins * away / away.max())
    return {"widest": bins * work.bin, "x": float(centre[0]), "y": float(centre[1])}


def dead_columns(work: WildWork, loss: float) -> Values:
    """A few columns or rows of the scan get less light, each by itself."""
    axis = int(work.rng.integers(2))
    column = np.unique(work.scene.places[:, axis], return_inverse=True)[1]
    dark = work.rng.choice(column.max() + 1, int(work.rng.integers(2, 5)), replace=False)
    work.gain = work.gain * np.where(np.isin(column, dark), 1 - loss, 1)
    return {"loss": loss, "columns": float(len(dark))}


def rolling_gate(work: WildWork, share: float) -> Values:
    """The gate opens ever later while the scan goes on; at its end a share of the light has come before."""
    arrived = np.cumsum(work.scene.clean.sum(axis=0))
    last = float(np.searchsorted(arrived / arrived[-1], share) / FINE - PAD)
    opens = -4 + (last + 4) * work.along ** work.rng.uniform(0.7, 1.5)
    gate = ndtr((work.times - opens[:, None]) / 1.2)
    work.count(lambda m: m * np.maximum(gate, 1e-3))
    return {"last": last * work.bin}


def mode_hops(work: WildWork, fraction: float) -> Values:
    """A second pulse that comes and goes while the scan goes on."""
    late = int(work.rng.integers(6 * FINE, 24 * FINE))
    edges = np.sort(work.rng.uniform(0.05, 0.95, int(work.rng.integers(5, 10))))
    on = np.searchsorted(edges, work.along) % 2 == 1
    part = fraction * on[:, None]
    kernel = np.zeros(late + 1)
    kernel[late] = 1
    work.response.append(lambda seen, step: (1 - part) * seen + part * convolved(seen, kernel))
    return {"fraction": fraction, "delay": late * work.bin / FINE, "share": float(on.mean())}


def power_ripple(work: WildWork, amplitude: float) -> Values:
    """The laser's power ripples while the scan goes on, with harmonics."""
    rng, cycles = work.rng, float(work.rng.uniform(10, 40))
    wave = sum(
        size * np.sin(2 * np.pi * k * cycles * work.along + rng.uniform(0, 2 * np.pi))
        for k, size in ((1, 1.0), (2, rng.uniform(0.2, 0.5)), (3, rng.uniform(0.1, 0.3)))
    )
    work.gain = work.gain * (1 + amplitude * wave / np.abs(wave).max())
    return {"amplitude": amplitude, "cycles": cycles}


def gain_scatter(work: WildWork, rms: float) -> Values:
    """Every spot has a gain of its own."""
    work.gain = work.gain * np.exp(rms * work.rng.standard_normal(len(work.gain)))
    return {"rms": rms}


# They are drawn in turn. What has come to be known since stays among them, with names that are right: other
# captures of the sets would change with the list.
UNKNOWN: dict[str, Hidden] = {
    "moving_object": Hidden(
        moving_object, (0.5, 1.5, 5.0), ("scene_motion",), ("time_drift", "line_delay"), own=True
    ),
    "widening_response": Hidden(widening_response, (1.2, 2.5, 5.0), axes=("time×scan", "scan")),
    "focus_response": Hidden(focus_response, (1.5, 2.5, 5.0), axes=("time×wall", "wall")),
    "mode_hops": Hidden(mode_hops, (0.04, 0.1, 0.3), axes=("time×scan", "scan")),
    "dead_columns": Hidden(dead_columns, (0.1, 0.25, 0.6), axes=("wall",)),
    "power_ripple": Hidden(power_ripple, (0.06, 0.15, 0.4), axes=("scan",)),
    "gain_scatter": Hidden(gain_scatter, (0.05, 0.12, 0.3), axes=("wall", "scan", "spot")),
    "rolling_gate": Hidden(rolling_gate, (0.02, 0.08, 0.25), axes=("time×scan", "time", "scan")),
    "missing_codes": Hidden(missing_codes, (0.1, 0.3, 0.8), axes=("time",)),
    "saturation": Hidden(saturation, (0.08, 0.3, 1.2), axes=("rate",)),
}
