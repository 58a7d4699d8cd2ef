"""How uneven the patches of fitted scenes truly are, and how uneven the pool takes them to be.

    python benchmarks/uneven.py 2 4 21         development captures without effects, of scenes of our own

The light of the true surface is put together by the surfel that is nearest to it, and fitted as the surfels'
own light times 1 plus linear functions of the wall point. Printed are root mean squares of coefficients,
weighted by light, over groups of surfels that lie together; then what the counts alone ask for, of 32 groups,
which is what the pool reckons with (docs/notebook.md).
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blind")]
GROUPS = (1, 8, 32, 128)
FAINTEST = 1e-3  # of a group's mean light: spots that see less of it say nothing


def lights(model, scene) -> tuple[Tensor, Tensor]:
    """``[S, M]`` light that each surfel sends, and that the true surface nearest to it does."""
    from scipy.spatial import cKDTree

    from nlos_lit.functional.surfel_paths import quadrature, trace

    elements = scene.elements
    place, normal, shine, seen = (
        torch.from_numpy(v).float()
        for v in (elements.centre, elements.normal, elements.area * elements.albedo, 1.0 * scene.seen)
    )
    centre, _ = model.placed()
    nearest = torch.from_numpy(cKDTree(centre.numpy()).query(elements.centre)[1])
    fitted, true = [], []
    for spots in torch.arange(len(model.laser)).split(48):
        fitted.append(model.paths(spots).contribution.sum(2) * model.albedo())
        paths = trace(place, normal, torch.ones(2), quadrature(1), model.walls(spots))
        light = paths.contribution[:, :, 0] / paths.area * shine * seen[spots]
        true.append(torch.zeros(len(spots), len(centre)).index_add_(1, nearest, light))
    return torch.cat(fitted), torch.cat(true)


def unevenness(fitted: Tensor, true: Tensor, towards: Tensor, group: Tensor) -> float:
    """Root mean square of the coefficients of ``towards`` ``[S, J]`` over groups ``[M]`` of surfels."""
    number = int(group.max()) + 1
    own, real = (torch.zeros(len(v), number).index_add_(1, group, v).double() for v in (fitted, true))
    functions = torch.cat([torch.ones(len(towards), 1), towards], 1).double()
    total, weight = 0.0, 0.0
    for k in range(number):
        there = own[:, k] > FAINTEST * own[:, k].mean()
        root = own[there, k].sqrt()[:, None]
        found = torch.linalg.lstsq(functions[there] * root, real[there, k, None] / root).solution[:, 0]
        if len(root) and found[0] > 0:
            light = float(real[:, k].sum())
            total += light * float((found[1:] / found[0]).clamp(-2, 2).square().mean())
            weight += light
    return (total / weight) ** 0.5


def asked(fit, split) -> float:
    """The deviation that the pool takes 32 patches to have, from the counts."""
    from nlos_lit.inference.evidence import UNEVENNESS, Projector
    from nlos_lit.inference.problem import build_problem
    from nlos_lit.inference.tested import patches_for, tested_rows

    rows = tested_rows(fit, split, most=1024, seed=0)
    counts, spots = fit.counts[rows], torch.from_numpy(split.fit[rows])
    problem = build_problem(fit.model, fit.extension, spots, counts, patches=patches_for(counts.numel()))
    return float(UNEVENNESS[Projector(problem).width])


@torch.no_grad()
def report(index: int) -> None:
    """Print one development capture's rows, of its parsimonious and of its fine scene."""
    from blind_judge import pipeline_for
    from judge_wild import hidden

    from nlos_lit.effects.extension import Extension
    from nlos_lit.inference.problem import patches_of, towards_wall
    from nlos_lit.inference.split import split_spots

    truth, capture = hidden("development", index)
    spec = truth.spec
    if spec.effects or not truth.scene.own:
        print(f"{index}: skipped, not an effect-free scene of our own")
        return
    pipeline, split = pipeline_for(capture), split_spots(capture)
    with torch.enable_grad():
        base = pipeline.fit(capture, split, pipeline.image(capture), Extension([]), 0)
        fine = pipeline.grow(base, 0)
    for name, fit in (("base", base), ("fine", fine)):
        model = fit.model
        found = lights(model, truth.scene)
        groups = [patches_of(model, n) for n in GROUPS] + [torch.arange(len(model))]
        rows = [(int(g.max()) + 1, unevenness(*found, towards_wall(model), g)) for g in groups]
        said = ", ".join(f"{number}: {value:.3f}" for number, value in rows)
        said += f"; asked for {asked(fit, split):.3f}"
        print(f"{index} {spec.family} {spec.scan} {spec.level:g} {name}: {said}", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    for wanted in sys.argv[1:]:
        report(int(wanted))
