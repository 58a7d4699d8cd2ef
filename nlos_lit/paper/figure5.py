"""Figure 5: imaging parameters over the iterations, on a capture with known response and on a real one."""

from __future__ import annotations

from functools import partial

import numpy as np

from nlos_lit.io.tables import Row
from nlos_lit.paper import plots
from nlos_lit.paper.record import Evidence, Glance
from nlos_lit.paper.subjects import BACKGROUND, Size, bunny, exposed
from nlos_lit.paper.trainings import history, own_training, state_at, summary
from nlos_lit.paper.workspace import Scene, Subject, Workspace

SETTLED = 0.01  # a parameter has settled where it stays within this share of its final value
REFINED_NAMES = {"I_l": "intensity", "eta_s": "background"}


def settled_at(values: list[float]) -> int:
    """First iteration (from 1) after which all values lie within ``SETTLED`` of the last.

    Examples:
        >>> settled_at([2.0, 1.5, 1.005, 1.0])
        3
    """
    far = np.flatnonzero(np.abs(np.array(values) / values[-1] - 1) > SETTLED)
    return int(far[-1]) + 2 if len(far) else 1


def figure5(work: Workspace, size: Size) -> Evidence:
    """Imaging parameters over the iterations, on a capture with known response and on a real one.

    Args:
        work: where captures and trainings are kept.
        size: of the experiments.

    Returns:
        a row a capture and parameter, a figure a capture, the comparison of σ_ls.
    """
    rows: list[Row] = []
    shown, captions = {}, {}
    known = bunny(work, size)
    real = exposed(work, size, size.minutes[-1])
    for subject in (known, real):
        folder = own_training(work, size, subject)
        scene = work.open(subject)
        track, found = history(folder), summary(folder)
        truth = _truth(scene) if subject is known else {}
        units = {name: entry["unit"] for name, entry in found["parameters"].items()}
        states = {
            when: work.kept(f"figure5/{subject.name}_{when}", partial(state_at, folder, when))
            for when in ("first", "final")
        }
        for name, values in track.items():
            refined = found["refined"]["parameters"].get(REFINED_NAMES.get(name, name))
            rows.append(
                {
                    "capture": subject.short,
                    "parameter": name,
                    "unit": units[name],
                    "after 1": values[0],
                    "final": values[-1],
                    "truth": truth.get(name),
                    f"within {100 * SETTLED:.0f} % from iteration": settled_at(values),
                    "refined": refined and refined["value"],
                }
            )
        first, final = states["first"], states["final"]
        kernels = {f"{w} iteration": (float(s["omega_pf"]), float(s["sigma_pf"])) for w, s in states.items()}
        lines = {
            "measured": (first["path"], first["measured"]),
            "first iteration": (first["path"], first["rendered"]),
            "final iteration": (final["path"], final["rendered"]),
        }
        shown[subject.name] = plots.convergence(track, units, truth, kernels, lines, subject.label)
        captions[subject.name] = (
            f"Convergence, {subject.label}: parameters, virtual illumination, measured against rendered."
        )
    return Evidence(
        "figure5",
        "Figure 5: convergence of the system parameters",
        "Bike (real): Ω_pf, σ_pf, σ_ls, I_l, κ_s, η_s settle; the rendered transient comes to resemble the "
        "measured one. Curves only.",
        f"{known.label}, whose response is known, and {real.label}. 'refined' is what the surfels find from "
        "there.",
        rows,
        shown,
        captions,
        [_response_glance(rows, known)],
    )


def _truth(scene: Scene) -> dict[str, float]:
    mean = 5000.0
    return {
        "sigma_ls": scene.capture.bin_length,
        "kappa_s": 0.6 / scene.capture.bin_length,
        "eta_s": BACKGROUND * mean,
    }


def _response_glance(rows: list[Row], subject: Subject) -> Glance:
    row = next(r for r in rows if r["capture"] == subject.short and r["parameter"] == "sigma_ls")
    error = [abs(row[name] / row["truth"] - 1) for name in ("final", "refined")]
    return Glance("relative error of σ_ls", subject.short, None, {}, *error)
