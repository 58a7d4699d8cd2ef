"""Figure 6: surfaces of all systems over a ladder of Poisson noise."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from nlos_lit.io.points import Points
from nlos_lit.io.tables import Row
from nlos_lit.metrics.geometry import depth_map
from nlos_lit.paper import plots
from nlos_lit.paper.methods import (
    OURS,
    classical_points,
    errors_of,
    geometry_row,
    glance_of,
    kept_choice,
    kept_row,
    known_truth,
    to_keep,
)
from nlos_lit.paper.record import CLASSICAL, Evidence, Glance
from nlos_lit.paper.subjects import BACKGROUND, Size, noisy_bunny
from nlos_lit.paper.trainings import own_training, published_training
from nlos_lit.paper.workspace import Arrays, Scene, Subject, Workspace

METHODS = tuple(name for name in CLASSICAL if name != "bp")
SHOWN = {
    "F-score": False,
    "depth error, median (mm)": True,
    "normal error, median (°)": False,
    "coverage": False,
    "off the truth": False,
}


def signal_to_noise(scene: Scene) -> float:
    """10 log₁₀ of Σ signal² / Σ variance over the gated bins, dB.

    From counts n and the known background b, signal² is estimated as (n - b)² - n and the variance as n.
    """
    counts = scene.capture.gated_counts().astype(np.float64)
    background = BACKGROUND * (counts.sum() / scene.capture.n_spots) / (1 + BACKGROUND * counts.shape[1])
    power = ((counts - background) ** 2 - counts).sum()
    return float(10 * np.log10(max(power, 1e-12) / counts.sum()))


def figure6(work: Workspace, size: Size) -> Evidence:
    """Errors of the surface against the counts of a spot, for all systems.

    Args:
        work: where captures, trainings and surfaces are kept.
        size: of the experiments.

    Returns:
        a row a level of noise and system, the curves and depth maps, the comparisons.
    """
    rows: list[Row] = []
    maps: list[list[plots.Image]] = []
    levels = []
    for counts in size.counts:
        subject = noisy_bunny(work, size, counts)
        scene = work.open(subject)
        found = _level(work, size, subject, scene)
        noise = signal_to_noise(scene)
        levels.append(f"{counts} counts\n{noise:.1f} dB")
        rows += [
            {
                "counts a spot": counts,
                "SNR (dB)": noise,
                "system": name,
                **kept_row(entry),
                "chosen with the truth": kept_choice(entry),
            }
            for name, entry in found.items()
        ]
        limits = plots.limits_of(known_truth(scene).depth)
        shown = [found[name] for name in (*METHODS, *OURS)]
        maps.append([plots.Image(entry["depth"], "depth", limits) for entry in shown])
    names = [*METHODS, *OURS]
    panels = [
        plots.Panel(
            what, "counts a spot", what, {n: _curve(rows, n, what) for n in names}, logx=True, logy=logy
        )
        for what, logy in SHOWN.items()
    ]
    ends = [scene.extent] * len(levels)
    columns = [*METHODS, "published", "ours, phasor", "ours, front", "ours, refined"]
    lowest, middle, highest = size.counts[0], size.counts[len(size.counts) // 2], size.counts[-1]
    return Evidence(
        "figure6",
        "Figure 6: Poisson noise",
        "Bunny with Poisson noise of rising strength: the surface stays recognisable over a wide range. "
        "Pictures only.",
        f"{noisy_bunny(work, size, highest).label.rsplit(',', 1)[0]}, signal and background scaled together. "
        "Points against the first true surface along z (2 cm in depth, one spot spacing sideways). Threshold "
        "and signal-to-noise parameter of the classical systems are chosen with the truth in hand at every "
        "level; the published system and ours keep one setting.",
        rows,
        {"ladder": plots.lines(panels), "depth": plots.images(maps, levels, columns, ends, side=1.45)},
        {
            "ladder": "Errors of the reconstructed surface against counts a spot. F-score, coverage: more "
            "is better; "
            "others: less is better.",
            "depth": "Depth (m) as seen from the wall, at each level of noise.",
        },
        [
            _glance(rows, counts, what, higher)
            for counts in (lowest, middle, highest)
            for what, higher in (("F-score", True), ("depth error, median (mm)", False))
        ],
    )


def _curve(rows: list[Row], name: str, what: str) -> tuple[list[float], list[float]]:
    chosen = [row for row in rows if row["system"] == name]
    return [row["counts a spot"] for row in chosen], [row[what] for row in chosen]


def _level(work: Workspace, size: Size, subject: Subject, scene: Scene) -> dict[str, Arrays]:
    runs = {"ours": own_training(work, size, subject), "paper": published_training(work, subject)}

    def entry(points: Points, chosen: dict[str, float]) -> dict[str, Any]:
        depth = depth_map(points, scene.grid.x, scene.grid.y)
        return {**to_keep(geometry_row(errors_of(points, scene)), chosen), "depth": depth}

    def classical(name: str) -> dict[str, Any]:
        return entry(*classical_points(scene, name, size.snrs))

    found = {name: work.kept(f"figure6/{subject.name}_{name}", partial(classical, name)) for name in METHODS}
    return found | {name: entry(take(runs[run], scene), {}) for name, (run, take) in OURS.items()}


def _glance(rows: list[Row], counts: int, what: str, higher: bool) -> Glance:
    value = {row["system"]: row[what] for row in rows if row["counts a spot"] == counts}
    return glance_of(f"{what}, {counts} counts a spot", "bunny, own simulator", value, higher)
