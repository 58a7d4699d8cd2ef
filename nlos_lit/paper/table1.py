"""Table 1: what each component of the optimisation gives on the two-albedo scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from nlos_lit.io.tables import Row
from nlos_lit.paper import plots
from nlos_lit.paper.record import Evidence, Glance
from nlos_lit.paper.subjects import Size, bunny
from nlos_lit.paper.trainings import ablated, published_training, summary
from nlos_lit.paper.workspace import Workspace

# phasor kernel, albedo, laser-sensor model: config, MSE of the paper's Table 1
ROWS = {
    (True, False, False): ("phasor", 6.817e-3),
    (True, False, True): ("phasor_sensor", 6.627e-3),
    (False, True, False): ("albedo", 2.239e-3),
    (False, True, True): ("albedo_sensor", 2.217e-3),
    (True, True, False): ("phasor_albedo", 2.124e-3),
    (True, True, True): ("all", 1.971e-3),
}


def refined_mse(found: dict[str, Any]) -> float:
    """MSE of the surfels' transients: MSE and NMSE of the same spots differ by one factor."""
    return (
        found["transient_mse"]["heldout"]["final"]
        * found["refined"]["heldout"]["nmse"]
        / found["heldout"]["nmse"]["final"]
    )


def table1(work: Workspace, size: Size) -> Evidence:
    """Six combinations of components and the refinement: MSE of held-out transients.

    Args:
        work: where captures and trainings are kept.
        size: of the experiments.

    Returns:
        a row a combination, one figure, the comparison.
    """
    subject = bunny(work, size)
    rows: list[Row] = []
    here, paper = [], []
    for flags, (name, published) in ROWS.items():
        found = [summary(ablated(work, size, name, seed)) for seed in size.seeds]
        errors = [f["transient_mse"]["heldout"]["final"] for f in found]
        here.append(errors)
        paper.append(published)
        rows.append(
            _row(
                dict(zip(("phasor kernel", "albedo", "laser-sensor"), flags, strict=True)),
                errors,
                published,
                found,
            )
        )
    surfels = [refined_mse(found[0])]
    published_mse = summary(published_training(work, subject))["transient_mse"]["heldout"]["final"]
    flags_of_surfels = {"phasor kernel": "surfels", "albedo": True, "laser-sensor": True}
    rows.append(_row(flags_of_surfels, surfels, None, found[:1], refined=True))
    what = "MSE of held-out transients"
    worst, best, old_worst, old_best = np.mean(here[0]), np.mean(here[-1]), paper[0], paper[-1]
    labels = [
        " + ".join(n for n, on in zip(("kernel", "albedo", "laser-sensor"), flags, strict=True) if on)
        for flags in ROWS
    ]
    shown = plots.dots(
        [*labels, "refined by surfels"],
        {
            f"here, {len(size.seeds)} seeds": [*here, surfels],
            "paper (256×256, its own renders)": [*([p] for p in paper), []],
        },
        "MSE of transients, relative to their maximum",
        "Table 1: components of the optimisation",
    )
    return Evidence(
        "table1",
        "Table 1: what each component gives",
        "Two-albedo Bunny, 256×256 spots, renders of Chen et al.; MSE of transients of six combinations. "
        "From "
        f"the kernel alone to the full model the MSE falls by {old_worst / old_best:.3g} ×.",
        f"{subject.label}, albedos 1.0 above and 0.3 below; held-out spots; mean of {len(size.seeds)} seeds "
        "(start of batches), spread = largest minus smallest; surfels from the first seed. From the kernel "
        f"alone to the full model the MSE falls by {worst / best:.3g} ×, to the surfels by "
        f"{worst / np.mean(surfels):.3g} ×. MSEs of the two columns are of different captures: compare "
        "ratios.",
        rows,
        {"mse": shown},
        {"mse": f"{what} for each combination of optimised components; one mark a seed."},
        [Glance(what, subject.short, published_mse, {}, float(best), float(np.mean(surfels)))],
    )


def _row(
    flags: Row,
    errors: list[float],
    published: float | None,
    found: list[dict[str, Any]],
    refined: bool = False,
) -> Row:
    """Means over the seeds whose summaries are ``found``."""
    parts = [f["refined"] if refined else f for f in found]
    nmse = [p["heldout"]["nmse"] if refined else p["heldout"]["nmse"]["final"] for p in parts]
    geometry = [p["geometry"] for p in parts]

    def mean(key: str, factor: float = 1.0) -> float | None:
        """None where one of them found nothing to compare."""
        values = [g[key] for g in geometry]
        return None if None in values else factor * float(np.mean(values))

    fitted = flags["albedo"]
    return {
        **flags,
        "MSE": float(np.mean(errors)),
        "spread": float(np.ptp(errors)) if len(errors) > 1 else None,
        "paper's MSE": published,
        "NMSE": float(np.mean(nmse)),
        "NMSE of noise": found[0]["heldout"]["nmse"]["noise_floor"],
        "depth error, median (mm)": mean("depth_median_abs", 1e3),
        "normal error, median (°)": mean("normal_median_deg"),
        "coverage": mean("coverage"),
        "albedo ratio (true 3.33)": mean("albedo_ratio") if fitted else None,
    }
