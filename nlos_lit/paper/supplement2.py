"""The supplement's Figure 2: states of one training at several iterations."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from nlos_lit.paper import plots
from nlos_lit.paper.methods import kept_row, known_truth
from nlos_lit.paper.record import Evidence
from nlos_lit.paper.subjects import Size, bunny
from nlos_lit.paper.trainings import VISIBLE, full_model, state_at, summary
from nlos_lit.paper.workspace import Workspace


def supplement2(work: Workspace, size: Size) -> Evidence:
    """States of one training at several iterations.

    Args:
        work: where captures, trainings and states are kept.
        size: of the experiments; its ``steps`` are the iterations.

    Returns:
        a row a state, and one figure.
    """
    subject = bunny(work, size)
    last = full_model(work, size)
    folders: dict[int, Path] = {}
    for steps in size.steps[1:-1]:
        start = folders[max(folders)] if folders else None
        settings = ["ablation=all", f"seed={size.seeds[0]}", f"scene.iterations={steps}"]
        folders[steps] = work.train(f"bunny_after_{steps}", subject, *settings, start=start)
    folders[size.steps[-1]] = last
    states = [work.kept("supplement2/0", partial(state_at, last, "first"))]
    states += [
        work.kept(f"supplement2/{steps}", partial(state_at, folder, "final"))
        for steps, folder in folders.items()
    ]
    nmse = [
        summary(last)["heldout"]["nmse"]["initial"],
        *(summary(f)["heldout"]["nmse"]["final"] for f in folders.values()),
    ]
    rows = [
        {
            "iteration": steps,
            "held-out NMSE": error,
            "λ (cm)": 200 * np.pi / float(state["omega_pf"]),
            "σ_pf (cm)": 100 * float(state["sigma_pf"]),
            **kept_row(state),
        }
        for steps, error, state in zip(size.steps, nmse, states, strict=True)
    ]
    scene = work.open(subject)
    limits = plots.limits_of(known_truth(scene).depth)
    shown = plots.progress(
        [f"iteration {steps}" for steps in size.steps],
        [plots.Image(s["front"]) for s in states],
        [plots.Image(s["depth"], "depth", limits) for s in states],
        [(float(s["omega_pf"]), float(s["sigma_pf"])) for s in states],
        [(s["path"], s["measured"], s["rendered"]) for s in states],
        scene.extent,
    )
    return Evidence(
        "supplement2",
        "Supplement Figure 2: progress of the optimisation",
        "Erato and Dragon at 0, 10, 50 and 100 iterations: after 50 very close to the converged result. "
        "Pictures only.",
        f"{subject.label}; the surface as seen from {VISIBLE} wall points.",
        rows,
        {"progress": shown},
        {
            "progress": "Maximum of the volume along z, depth (m), virtual illumination, and the brightest "
            "held-out transient."
        },
    )
