"""Trainings that several tables and figures share, and what they left."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from omegaconf import OmegaConf

from nlos_lit.metrics.geometry import depth_map, geometry_errors
from nlos_lit.paper.methods import geometry_row, to_keep
from nlos_lit.paper.subjects import Size, bunny
from nlos_lit.paper.workspace import Subject, Workspace
from nlos_lit.training.run_folder import Run, open_run, prepare_run
from nlos_lit.training.shown import shown_spots, surface_points

VISIBLE = 16  # wall points whose view of the surface is shown


def ablated(work: Workspace, size: Size, name: str, seed: int) -> Path:
    """The training of one row of Table 1; the full model's is refined, too, from the first seed.

    Args:
        work: where trainings are kept.
        size: of the experiments.
        name: of the row's config in conf/ablation.
        seed: start of the batches.

    Returns:
        the finished run's folder.
    """
    settings = [f"ablation={name}", f"seed={seed}"]
    if name == "all" and seed == size.seeds[0]:
        settings.append("refine=true")
    return work.train(f"bunny_{name}_{seed}", bunny(work, size), *settings)


def full_model(work: Workspace, size: Size) -> Path:
    """Table 1's last row, first seed: other experiments look at it, too.

    Args:
        work: where trainings are kept.
        size: of the experiments.

    Returns:
        the finished run's folder.
    """
    return ablated(work, size, "all", size.seeds[0])


def published_training(work: Workspace, subject: Subject) -> Path:
    """The paper's own formulation, trained on a subject.

    Args:
        work: where trainings are kept.
        subject: what to train on.

    Returns:
        the finished run's folder.
    """
    return work.train(f"{subject.name}_paper", subject, "model=paper")


def own_training(work: Workspace, size: Size, subject: Subject) -> Path:
    """The default model, trained on a subject and refined; the bunny's is Table 1's.

    Args:
        work: where trainings are kept.
        size: of the experiments.
        subject: what to train on.

    Returns:
        the finished run's folder.
    """
    if subject.name == "bunny":
        return full_model(work, size)
    return work.train(subject.name, subject, "refine=true")


def summary(folder: Path) -> dict[str, Any]:
    """A run's ``summary.json``."""
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def history(folder: Path) -> dict[str, list[float]]:
    """Imaging parameters after every iteration, as the run's checkpoint keeps them."""
    state = torch.load(folder / "checkpoints" / "last.ckpt", map_location="cpu", weights_only=True)
    values = state["callbacks"]["History"]["values"]
    return {
        name.removeprefix("parameters/"): v for name, v in values.items() if name.startswith("parameters/")
    }


def untrained(folder: Path) -> Run:
    """A finished run as it was before its first iteration."""
    config = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    return prepare_run(cast(dict[str, Any], config))


@torch.no_grad()
def state_of(run: Run, spot: int) -> dict[str, Any]:
    """Volume's front, surface and one transient of a run as it stands.

    Args:
        run: a training, finished or not begun.
        spot: whose transient is rendered.

    Returns:
        ``front`` and ``depth`` ``[nx, ny]`` (depth in m), ``measured`` and ``rendered`` ``[T]`` counts a bin
        over ``path`` ``[T]`` (m), ``omega_pf`` (rad/m) and ``sigma_pf`` (m), and the errors of the surface
        where the truth is known, as `to_keep` names them.
    """
    pipeline, capture = run.module.pipeline, run.capture
    grid = pipeline.phasor.grid
    points = surface_points(pipeline, capture, shown_spots(capture.n_spots, VISIBLE))
    rendering = pipeline(torch.tensor([spot]))
    errors: dict[str, Any] = {}
    if run.truth is not None:
        spacing = float(np.abs(grid.pitch[:2]).max())
        errors = to_keep(geometry_row(geometry_errors(points, run.truth, lateral_tolerance=spacing)))
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


def state_at(folder: Path, when: str) -> dict[str, Any]:
    """A finished run's state before or after its training, at the brightest held-out spot.

    Args:
        folder: of the run.
        when: ``first`` for the state before the first iteration, ``final`` for the trained one.

    Returns:
        see `state_of`.
    """
    run = untrained(folder) if when == "first" else open_run(folder)
    return state_of(run, brightest_heldout(run))
