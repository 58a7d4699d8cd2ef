"""Figure 5 and supplement Figure 2: how a training goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from nlos_lit.callbacks import surface_points
from nlos_lit.evidence import plots
from nlos_lit.evidence.ablation import full_model, summary
from nlos_lit.evidence.methods import geometry_row
from nlos_lit.evidence.record import Evidence, Glance, Row
from nlos_lit.evidence.subjects import BACKGROUND, Size, bunny, exposed
from nlos_lit.evidence.workspace import Scene, Subject, Workspace
from nlos_lit.geometry_metrics import depth_map, geometry_errors
from nlos_lit.results import shown_spots
from nlos_lit.runs import Run, open_run, prepare_run

SETTLED = 0.01  # a parameter has settled where it stays within this share of its final value
REFINED_NAMES = {"I_l": "intensity", "eta_s": "background"}
VISIBLE = 16  # wall points whose view of the surface is shown


def history(folder: Path) -> dict[str, list[float]]:
    """Imaging parameters after every iteration, as the run's checkpoint keeps them."""
    state = torch.load(folder / "checkpoints" / "last.ckpt", map_location="cpu", weights_only=True)
    values = state["callbacks"]["History"]["values"]
    return {name.removeprefix("parameters/"): v for name, v in values.items() if name.startswith("parameters/")}


def settled_at(values: list[float]) -> int:
    """First iteration (from 1) after which all values lie within ``SETTLED`` of the last."""
    far = np.flatnonzero(np.abs(np.array(values) / values[-1] - 1) > SETTLED)
    return int(far[-1]) + 2 if len(far) else 1


def untrained(folder: Path) -> Run:
    """A finished run as it was before its first iteration."""
    return prepare_run(OmegaConf.to_container(OmegaConf.load(folder / "config.yaml")))


@torch.no_grad()
def state_of(run: Run, spot: int) -> dict[str, Any]:
    """Volume's front, surface and one transient of a run as it stands."""
    pipeline, capture = run.module.pipeline, run.capture
    grid = pipeline.phasor.grid
    points = surface_points(run.module, capture, shown_spots(capture.n_spots, VISIBLE))
    rendering = pipeline(torch.tensor([spot]))
    errors = {}
    if run.truth is not None:
        spacing = float(np.abs(grid.pitch[:2]).max())
        errors = {f"row_{k}": v for k, v in geometry_row(geometry_errors(points, run.truth, lateral_tolerance=spacing)).items()}
    return {
        "front": pipeline.phasor().max(0).values.numpy(),
        "depth": depth_map(points, grid.x, grid.y),
        "measured": capture.gated_counts()[spot],
        "rendered": rendering.expected[0].numpy(),
        "path": capture.path_gate[0] + (np.arange(rendering.expected.shape[1]) + 0.5) * capture.bin_length,
        "omega_pf": float(pipeline.phasor.omega_pf()),
        "sigma_pf": float(pipeline.phasor.sigma_pf()),
        **errors,
    }


def brightest_heldout(run: Run) -> int:
    """The held-out spot with the most counts."""
    held = run.data.heldout_spots
    return int(held[run.capture.gated_counts()[held].sum(1).argmax()])


def figure5(work: Workspace, size: Size) -> Evidence:
    """Imaging parameters over the iterations, on a capture with known response and on a real one."""
    rows: list[Row] = []
    shown, captions = {}, {}
    known = bunny(work, size)
    real = exposed(work, size, size.minutes[-1])
    for subject, folder in ((known, full_model(work, size)), (real, work.train(real.name, real, "refine=true"))):
        scene = work.open(subject)
        track, found = history(folder), summary(folder)
        truth = _truth(scene) if subject is known else {}
        units = {name: entry["unit"] for name, entry in found["parameters"].items()}
        states = {
            when: work.kept(f"figure5/{subject.name}_{when}", lambda f=folder, w=when: _state(f, w)) for when in ("first", "final")
        }
        for name, values in track.items():
            refined = found["refined"]["parameters"].get(REFINED_NAMES.get(name, name))
            rows.append({
                "capture": subject.short, "parameter": name, "unit": units[name], "after 1": values[0], "final": values[-1],
                "truth": truth.get(name), f"within {100 * SETTLED:.0f} % from iteration": settled_at(values),
                "refined": refined and refined["value"],
            })  # fmt: skip
        first, final = states["first"], states["final"]
        kernels = {f"{w} iteration": (float(s["omega_pf"]), float(s["sigma_pf"])) for w, s in states.items()}
        lines = {"measured": (first["path"], first["measured"]), "first iteration": (first["path"], first["rendered"]),
                 "final iteration": (final["path"], final["rendered"])}  # fmt: skip
        shown[subject.name] = plots.convergence(track, units, truth, kernels, lines, subject.label)
        captions[subject.name] = f"Convergence, {subject.label}: parameters, virtual illumination, measured against rendered."
    return Evidence(
        "figure5",
        "Figure 5: convergence of the system parameters",
        "Bike (real): Ω_pf, σ_pf, σ_ls, I_l, κ_s, η_s settle; the rendered transient comes to resemble the measured one. Curves "
        "only.",
        f"{known.label}, whose response is known, and {real.label}. 'refined' is what the surfels find from there.",
        rows, shown, captions, [_response_glance(rows, known)],
    )  # fmt: skip


def _truth(scene: Scene) -> dict[str, float]:
    mean = 5000.0
    return {"sigma_ls": scene.capture.bin_length, "kappa_s": 0.6 / scene.capture.bin_length, "eta_s": BACKGROUND * mean}


def _response_glance(rows: list[Row], subject: Subject) -> Glance:
    row = next(r for r in rows if r["capture"] == subject.short and r["parameter"] == "sigma_ls")
    error = [abs(row[name] / row["truth"] - 1) for name in ("final", "refined")]
    return Glance("relative error of σ_ls", subject.short, None, {}, *error)


def _state(folder: Path, when: str) -> dict[str, Any]:
    run = untrained(folder) if when == "first" else open_run(folder)
    return state_of(run, brightest_heldout(run))


def supplement2(work: Workspace, size: Size) -> Evidence:
    """States of one training at several iterations."""
    subject = bunny(work, size)
    last = full_model(work, size)
    folders: dict[int, Path] = {}
    for steps in size.steps[1:-1]:
        start = folders[max(folders)] if folders else None
        folders[steps] = work.train(f"bunny_after_{steps}", subject, "ablation=all", f"seed={size.seeds[0]}",
                                    f"scene.iterations={steps}", start=start)  # fmt: skip
    folders[size.steps[-1]] = last
    states = [work.kept("supplement2/0", lambda: _state(last, "first"))]
    states += [work.kept(f"supplement2/{steps}", lambda f=folder: _state(f, "final")) for steps, folder in folders.items()]
    nmse = [summary(last)["heldout"]["nmse"]["initial"], *(summary(f)["heldout"]["nmse"]["final"] for f in folders.values())]
    rows = [
        {"iteration": steps, "held-out NMSE": error, "λ (cm)": 200 * np.pi / float(s["omega_pf"]),
         "σ_pf (cm)": 100 * float(s["sigma_pf"]),
         **{k.removeprefix("row_"): float(v) for k, v in s.items() if k.startswith("row_")}}
        for steps, error, s in zip(size.steps, nmse, states, strict=True)
    ]  # fmt: skip
    scene = work.open(subject)
    limits = tuple(np.nanquantile(scene.truth.depth, (0.01, 0.99)))
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
        "Erato and Dragon at 0, 10, 50 and 100 iterations: after 50 very close to the converged result. Pictures only.",
        f"{subject.label}; the surface as seen from {VISIBLE} wall points.",
        rows,
        {"progress": shown},
        {"progress": "Maximum of the volume along z, depth (m), virtual illumination, and the brightest held-out transient."},
    )
