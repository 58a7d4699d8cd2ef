"""Figure 6: a ladder of Poisson noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from nlos_lit.io.points import Points
from nlos_lit.metrics.geometry import depth_map
from nlos_lit.paper import plots
from nlos_lit.paper.methods import OURS, classical_points, errors_of, geometry_row
from nlos_lit.paper.record import CLASSICAL, Evidence, Glance, Row
from nlos_lit.paper.subjects import BACKGROUND, Size, noisy_bunny
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
    """10 log₁₀ of Σ signal² / Σ variance over the gated bins, dB: signal² estimated from counts as (n - b)² -
    n, variance as n.
    """
    counts = scene.capture.gated_counts().astype(np.float64)
    background = BACKGROUND * (counts.sum() / scene.capture.n_spots) / (1 + BACKGROUND * counts.shape[1])
    power = ((counts - background) ** 2 - counts).sum()
    return float(10 * np.log10(max(power, 1e-12) / counts.sum()))


def figure6(work: Workspace, size: Size) -> Evidence:
    """Errors of the surface against the counts of a spot, for all systems."""
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
            {"counts a spot": counts, "SNR (dB)": noise, "system": name, **_row(entry)}
            for name, entry in found.items()
        ]
        limits = tuple(np.nanquantile(scene.truth.depth, (0.01, 0.99)))
        shown = [found[name] for name in (*METHODS, *OURS)]
        maps.append([plots.Image(entry["depth"], "depth", limits) for entry in shown])
    names = [*METHODS, *OURS]
    panels = [
        plots.Panel(
            what, "counts a spot", what,
            {name: _curve(rows, name, what) for name in names},
            logx=True, logy=logy,
        )
        for what, logy in SHOWN.items()
    ]  # fmt: skip
    ends = [scene.extent] * len(levels)
    columns = [*METHODS, "published", "ours, phasor", "ours, front", "ours, refined"]
    lowest, highest = size.counts[0], size.counts[-1]
    return Evidence(
        "figure6",
        "Figure 6: Poisson noise",
        "Bunny with Poisson noise of rising strength: the surface stays recognisable over a wide range. Pictures only.",
        f"{noisy_bunny(work, size, highest).label.rsplit(',', 1)[0]}, signal and background scaled together. Points against the "
        "first true surface along z (2 cm in depth, one spot spacing sideways). Threshold and signal-to-noise parameter of the "
        "classical systems are chosen with the truth in hand at every level; the published system and ours keep one setting.",
        rows,
        {"ladder": plots.lines(panels), "depth": plots.images(maps, levels, columns, ends, side=1.45)},
        {
            "ladder": "Errors of the reconstructed surface against counts a spot. F-score, coverage: more is better; "
            "others: less is better.",
            "depth": "Depth (m) as seen from the wall, at each level of noise.",
        },
        [_glance(rows, counts, what, higher) for counts in (lowest, size.counts[len(size.counts) // 2], highest)
         for what, higher in (("F-score", True), ("depth error, median (mm)", False))],
    )  # fmt: skip


def _curve(rows: list[Row], name: str, what: str) -> tuple[list[float], list[float]]:
    chosen = [row for row in rows if row["system"] == name]
    return [row["counts a spot"] for row in chosen], [row[what] for row in chosen]


def _level(work: Workspace, size: Size, subject: Subject, scene: Scene) -> dict[str, Arrays]:
    runs = {
        "ours": work.train(subject.name, subject, "refine=true"),
        "paper": work.train(f"{subject.name}_paper", subject, "model=paper"),
    }

    def entry(points: Points, chosen: dict[str, float]) -> dict[str, Any]:
        errors = {f"row_{key}": value for key, value in geometry_row(errors_of(points, scene)).items()}
        return {
            **errors,
            "depth": depth_map(points, scene.grid.x, scene.grid.y),
            **{f"chosen_{k}": v for k, v in chosen.items()},
        }

    found = {}
    for name in METHODS:
        found[name] = work.kept(
            f"figure6/{subject.name}_{name}", lambda m=name: entry(*classical_points(scene, m, size.snrs))
        )
    found |= {name: entry(take(runs[run], scene), {}) for name, (run, take) in OURS.items()}
    return found


def _row(entry: Arrays) -> Row:
    values = {
        key.removeprefix("row_"): float(value) for key, value in entry.items() if key.startswith("row_")
    }
    chosen = ", ".join(
        f"{key.removeprefix('chosen_')} {float(v):.3g}"
        for key, v in entry.items()
        if key.startswith("chosen_")
    )
    return {**values, "chosen with the truth": chosen or None}


def _glance(rows: list[Row], counts: int, what: str, higher: bool) -> Glance:
    value = {row["system"]: row[what] for row in rows if row["counts a spot"] == counts}
    classical = {name: v for name, v in value.items() if name in CLASSICAL}
    return Glance(f"{what}, {counts} counts a spot", "bunny, own simulator", value.get("published system"), classical,
                  value["ours, phasor surface"], value["ours, refined"], higher)  # fmt: skip
