"""Figure 7 and supplement Figure 1: front views at shorter exposures of a real capture."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import rankdata

from nlos_lit.baselines import reconstruct
from nlos_lit.io.tables import Row
from nlos_lit.io.volumes import read_volume
from nlos_lit.paper import plots
from nlos_lit.paper.methods import front_of_points, run_points
from nlos_lit.paper.record import Evidence, Glance
from nlos_lit.paper.subjects import Size, exposed
from nlos_lit.paper.trainings import own_training, published_training, summary
from nlos_lit.paper.workspace import Scene, Workspace

BY_HAND = "lct, best of sweep"
ALIKE = ("lct 0.1", "fk", "rsd", "ours, phasor surface")  # whose mean image says where the letters are
ON = 0.4  # pixels of that image above this are letters
DARK = 0.5  # this share of its pixels, the darkest, is background; the rest is left out


def separation(front: np.ndarray, letters: np.ndarray, background: np.ndarray) -> float:
    """Probability that a pixel of a letter is brighter than one of the background.

    This is the area under the ROC curve; a tie counts half.

    Args:
        front: ``[nx, ny]`` intensities.
        letters: ``[nx, ny]`` True on letters.
        background: ``[nx, ny]`` True on the background.

    Returns:
        0.5 for an image that tells nothing, 1 for a perfect one.

    Examples:
        >>> front = np.array([3.0, 5.0, 1.0, 4.0])
        >>> letters = np.array([True, True, False, False])
        >>> separation(front, letters, ~letters)
        0.75
    """
    values = np.concatenate([front[letters], front[background]])
    n = int(letters.sum())
    ranks = rankdata(values)[:n].sum()
    return float((ranks - n * (n + 1) / 2) / (n * int(background.sum())))


def contrast(front: np.ndarray, letters: np.ndarray, background: np.ndarray) -> float:
    """Mean of the letters' amplitude above the background's, in standard deviations of the background.

    Args:
        front: ``[nx, ny]`` intensities; amplitudes are their square roots.
        letters: ``[nx, ny]`` True on letters.
        background: ``[nx, ny]`` True on the background.

    Returns:
        the contrast; 0 where letters are as bright as the background.

    Examples:
        >>> letters = np.array([True, True, False, False])
        >>> contrast(np.array([16.0, 16.0, 1.0, 9.0]), letters, ~letters)
        2.0
    """
    amplitude = np.sqrt(front)
    return float(
        (amplitude[letters].mean() - amplitude[background].mean())
        / max(float(amplitude[background].std()), 1e-12)
    )


def figure7(work: Workspace, size: Size) -> Evidence:
    """Front views at four exposures; how well letters and background separate.

    Args:
        work: where captures, trainings and volumes are kept.
        size: of the experiments.

    Returns:
        a row an exposure and system, front views and curves, the comparisons.
    """
    fronts: dict[int, dict[str, np.ndarray]] = {}
    scores: dict[int, dict[str, dict[str, Any]]] = {}
    for minutes in size.minutes:
        fronts[minutes], scores[minutes], scene = _exposure(work, size, minutes)
    whole = fronts[size.minutes[-1]]
    letters, background = consensus([whole[name] for name in ALIKE if name in whole])
    rows: list[Row] = []
    for minutes, found in fronts.items():
        sweep = [name for name in found if name.startswith("lct ")]
        by_hand = max(sweep, key=lambda name: separation(found[name], letters, background))
        found[BY_HAND] = found[by_hand]
        for name, front in found.items():
            row = {
                "exposure (min)": minutes,
                "system": f"{name} ({by_hand})" if name == BY_HAND else name,
                "separation": separation(front, letters, background),
                "contrast (σ)": contrast(front, letters, background),
            }
            held = scores[minutes].get(name)
            if held is not None:
                row |= {"held-out NMSE": held["nmse"], "NMSE of noise": held["floor"]}
            rows.append(row)
    names = [BY_HAND, "fk", "rsd", "published system", "ours, phasor surface", "ours, refined"]
    grid = [[plots.Image(found[name]) for name in names] for found in fronts.values()]
    swept = [[plots.Image(found[n]) for n in found if n.startswith("lct ")] for found in fronts.values()]
    ends = [scene.extent] * len(size.minutes)
    labels = [f"{minutes} min" for minutes in size.minutes]
    panels = [_panel(rows, what, names) for what in ("separation", "contrast (σ)")]
    return Evidence(
        "figure7",
        "Figure 7 and supplement Figure 1: exposure",
        "Resolution and Bike, 10, 30, 60 and 180 min: LCT, f-k and phasor fields lose detail or drown in "
        "noise, the calibrated result stays clear, also against LCT with its SNR parameter set by hand "
        "between "
        "0.001 and 1. Pictures only.",
        f"{exposed(work, size, size.minutes[-1]).label}: the whole file is called {size.minutes[-1]} min and "
        "thinned binomially to the paper's ratios; only the ratios mean something. There is no true surface, "
        "so letters and background are where the mean of LCT, f-k, phasor field and ours at full exposure is "
        f"above {ON}, and its darkest half. Separation: probability that a letter's pixel is brighter than "
        "one "
        "of the background (0.5: nothing, 1: perfect; no threshold or brightness scale enters). Contrast: in "
        "amplitudes.",
        rows,
        {
            "volumes": plots.images(grid, labels, [n.replace("ours, ", "ours,\n") for n in names], ends),
            "sweep": plots.images(swept, labels, [f"lct, snr {snr:g}" for snr in size.snrs], ends),
            "separation": plots.lines(panels, columns=2),
        },
        {
            "volumes": "Maximum of the volume along z at each exposure (refined: albedo of the surfels), "
            "each scaled to "
            "its own 99.5th percentile.",
            "sweep": "The light-cone transform with its signal-to-noise parameter from "
            f"{size.snrs[0]:g} to {size.snrs[-1]:g}.",
            "separation": "How well letters and background separate against exposure.",
        },
        [_glance(rows, minutes) for minutes in size.minutes],
    )


def consensus(fronts: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Masks of letters and of background from the mean of several images' amplitudes.

    Each image is taken relative to its 99th percentile.

    Args:
        fronts: ``[nx, ny]`` intensities each.

    Returns:
        ``[nx, ny]`` True where the mean is above `ON`, and ``[nx, ny]`` True in the darkest `DARK` of the
        pixels.
    """
    mean = np.mean([np.clip(np.sqrt(f) / np.quantile(np.sqrt(f), 0.99), 0, 1) for f in fronts], axis=0)
    return mean > ON, mean <= np.quantile(mean, DARK)


def _exposure(
    work: Workspace, size: Size, minutes: int
) -> tuple[dict[str, np.ndarray], dict[str, Any], Scene]:
    subject = exposed(work, size, minutes)
    scene = work.open(subject)
    ours, paper = own_training(work, size, subject), published_training(work, subject)

    def classical() -> dict[str, Any]:
        tried: dict[str, dict[str, Any]] = {
            f"lct {snr:g}": {"method": "lct", "snr": snr, "falloff": scene.falloff} for snr in size.snrs
        }
        tried |= {"fk": {"method": "fk", "falloff": scene.falloff}, "rsd": {"method": "rsd"}}
        return {
            name: reconstruct(scene.capture, scene.grid, **options).max(0).values.numpy()
            for name, options in tried.items()
        }

    fronts = dict(work.kept(f"figure7/{subject.name}", classical))
    fronts["ours, phasor surface"] = read_volume(ours / "volume.h5")[0].max(0)
    fronts["ours, refined"] = front_of_points(run_points(ours, refined=True), scene.grid.x, scene.grid.y)
    fronts["published system"] = read_volume(paper / "volume.h5")[0].max(0)
    found, other = summary(ours), summary(paper)["heldout"]["nmse"]
    held = found["heldout"]["nmse"]
    scores = {
        "ours, phasor surface": {"nmse": held["final"], "floor": held["noise_floor"]},
        "ours, refined": {"nmse": found["refined"]["heldout"]["nmse"], "floor": held["noise_floor"]},
        "published system": {"nmse": other["final"], "floor": other["noise_floor"]},
    }
    return fronts, scores, scene


def _values(rows: list[Row], what: str, name: str) -> tuple[list[float], list[float]]:
    chosen = [row for row in rows if row["system"].split(" (")[0] == name]
    return [row["exposure (min)"] for row in chosen], [row[what] for row in chosen]


def _panel(rows: list[Row], what: str, names: list[str]) -> plots.Panel:
    series = {"lct" if name == BY_HAND else name: _values(rows, what, name) for name in names}
    return plots.Panel(what, "exposure (min)", what, series, logx=True)


def _glance(rows: list[Row], minutes: int) -> Glance:
    value = {
        row["system"].split(" (")[0]: row["separation"] for row in rows if row["exposure (min)"] == minutes
    }
    classical = {"lct, best by hand": value[BY_HAND], "fk": value["fk"], "rsd": value["rsd"]}
    return Glance(
        f"separation of letters, {minutes} min",
        "SU, real",
        value["published system"],
        classical,
        value["ours, phasor surface"],
        value["ours, refined"],
        higher=True,
    )
