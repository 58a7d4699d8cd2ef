"""How far fitted scenes lie from the true light, and how far they would lie, had they begun on the surface.

    python benchmarks/scene_error.py 2 4 21         development captures without effects
    python benchmarks/scene_error.py 2 truth=1      also scenes begun on the true surface
    python benchmarks/scene_error.py 2 surfels.evenness=0 constant.surfels.outlines.DIM=0.2

Printed is one JSON line a scene: the Kullback-Leibler divergence of its expected counts from the true ones,
in nats over the fitted and over the select spots. Noise has no part in it. What stands there is what a
missing effect must stand out from (docs/notebook.md). On fitted spots it has two parts, both to second order:
what the scene took up of the noise raises its likelihood over the true light's by as much as it costs
(``variance_nats``), what it cannot follow lowers it (``bias_nats``). One thread.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blind")]
STEEP = 0.12  # cosine of the tilt beyond which the true surface is not seen from the wall
LAYER = 2  # cells along z between two sheets


def expected_of(fit, spots: np.ndarray) -> np.ndarray:
    """The fit's expected counts ``[B, T_gate]`` of some spots."""
    return fit.model.expected(torch.from_numpy(spots), fit.extension).double().clamp_min(1e-9).numpy()


def divergence(true: np.ndarray, own: np.ndarray) -> float:
    """Nats by which the ``true`` expected counts ``[B, T_gate]`` lie from the fit's ``own``."""
    return float((true * np.log(true.clip(1e-12) / own) - true + own).sum())


def gain_over_truth(counts: np.ndarray, true: np.ndarray, own: np.ndarray) -> float:
    """Nats by which ``counts`` are likelier under the fit's ``own`` expected ones than the ``true`` ones."""
    return float((counts * np.log(own / true.clip(1e-9)) - own + true).sum())


def on_surface(fit, elements, parts: int):
    """A copy of a fit, its surfels on the true surface, one a cell, ``parts`` times finer along each side.

    A round of batches follows, so that albedos, response and small errors of the cells are fitted.
    """
    from nlos_lit.effects.extension import Extension
    from nlos_lit.surfels.fit import Round

    again = fit.copy(Extension([]), 0)
    model = again.model
    cell = float(model.cell.max()) / parts
    model.lateral, model.cell = model.lateral._replace(pitch=(cell, cell)), model.cell / parts
    model.place(*cells_of(elements.of(elements.normal[:, 2] < -STEEP), cell))
    again.match_energy()
    again.schedule([Round(2 * again.settings.steps, settling=True)])
    again.finish()
    return again


def cells_of(elements, cell: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Centres, normals and albedos of one surfel a lateral cell and sheet, the mean of what lies in it."""
    index = np.round(elements.centre[:, :2] / cell).astype(int)
    order = np.lexsort((elements.centre[:, 2], index[:, 1], index[:, 0]))
    sorted_index, z = index[order], elements.centre[order, 2]
    new = (np.diff(sorted_index, axis=0) != 0).any(1) | (np.diff(z) > LAYER * cell)
    found = []
    for rows in np.split(order, np.flatnonzero(new) + 1):
        area = elements.area[rows]
        normal = (elements.normal[rows] * area[:, None]).sum(0)
        normal /= np.linalg.norm(normal)
        whole = cell**2 / max(-normal[2], STEEP)
        light = (elements.albedo[rows] * area).sum() / whole
        found.append((np.average(elements.centre[rows], axis=0, weights=area), normal, light))
    centre, normal, light = (torch.from_numpy(np.array(v)).float() for v in zip(*found, strict=True))
    return centre, normal, light.clamp_min(1e-4)


def scenes(pipeline, capture, split, elements):
    """What a diagnosis fits, then fits begun on the true surface, where its elements are given."""
    from nlos_lit.effects.extension import Extension

    base = pipeline.fit(capture, split, pipeline.image(capture), Extension([]), 0)
    yield "parsimonious", base
    yield "fine", pipeline.grow(base, 0)
    if elements is not None:
        for parts in (1, 2):
            yield f"on the true surface, cells/{parts}", on_surface(base, elements, parts)


def report(number: int, from_truth: bool, options: dict[str, str]) -> None:
    """Print one development capture's rows."""
    from blind_judge import pipeline_for
    from judge_wild import hidden
    from surface import changed

    from nlos_lit.inference.heldout import score
    from nlos_lit.inference.split import split_spots

    truth, capture = hidden("development", number)
    first, last = capture.gate
    expected = truth.expected[:, first:last] if truth.expected.shape[1] > last - first else truth.expected
    expected = expected.astype(np.float64)
    pipeline, split = pipeline_for(capture), split_spots(capture)
    pipeline = replace(pipeline, surfels=replace(pipeline.surfels, **changed(options)))
    began = time.process_time()
    elements = truth.scene.elements if from_truth and truth.scene.own else None
    for what, fit in scenes(pipeline, capture, split, elements):
        seconds, found = time.process_time() - began, score(fit, split.select)
        own, true = expected_of(fit, split.fit), expected[split.fit]
        fitted, gain = divergence(true, own), gain_over_truth(fit.counts.double().numpy(), true, own)
        row = {
            "set": "development",
            "number": number,
            "family": truth.spec.family,
            "counts_per_spot": truth.spec.level,
            "changed": options,
            "scene": what,
            "surfels": len(fit.model),
            "fitted_nats": round(fitted, 1),
            "variance_nats": round((fitted + gain) / 2, 1),
            "bias_nats": round((fitted - gain) / 2, 1),
            "fitted_spots": len(split.fit),
            "select_nats": round(divergence(expected[split.select], expected_of(fit, split.select)), 1),
            "select_spots": len(split.select),
            "over_noise": round(found.deviance_per_bin / found.deviance_noise, 4),
            "cpu_seconds": round(seconds, 1),
        }
        print(json.dumps(row), flush=True)
        began = time.process_time()


if __name__ == "__main__":
    torch.set_num_threads(1)
    given = dict(a.split("=", 1) for a in sys.argv[1:] if "." in a)
    for wanted in (int(a) for a in sys.argv[1:] if a.isdigit()):
        report(wanted, "truth=1" in sys.argv, given)
