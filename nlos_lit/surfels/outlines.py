"""How far sheets reach: extended beyond their outlines, and cut back to where the counts see light.

Whether a place belongs to a sheet cannot be asked of each place by itself: its neighbours share the same
light, and the answer for one depends on that for the others. So sheets are extended by rings all around, and
the albedos of all surfels are solved for together. Expected counts are linear in them, and where nothing is,
the likeliest albedo is zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.effects.hooks import NOTHING, Hooks
from nlos_lit.functional.surfel_graph import level_of
from nlos_lit.functional.surfel_lattice import flank, ring, side
from nlos_lit.functional.surfel_paths import Runs
from nlos_lit.surfels.growth import APART, best_apart, occupied, within_depths
from nlos_lit.surfels.model import SurfelModel

RINGS = 2  # cells by which sheets are extended at a time
SOURCE = 0.1  # of the mean albedo: fainter surfels are not extended
BEGIN = 0.5  # of the sheet's albedo, where the search for a new surfel's begins
DIM = 0.1  # of the scene's level: fainter surfels are not there …
OPAQUE = 0.5  # … unless they hide more than this, which is what is taken of any until the counts say more
SEARCH, MEND = 30, 10  # iterations, among all candidates and when the others are gone
CHUNK = 1 << 20  # paths at a time


@torch.no_grad()
def extend(model: SurfelModel, grid: VolumeGrid, spots: Tensor) -> None:
    """Go on with all sheets by ``RINGS`` rings of cells, along their flanks and behind their rims, within the
    grid's depths.

    They hide nothing, and are hidden by what is there. Flanks and sides begin at surfels that are there: only
    of these is it known how they curve, and where their sheets ended when they were laid. So halves of wider
    surfels get no sides until they have been.

    Args:
        model: whose surfels get more neighbours.
        grid: of the volume.
        spots: ``[B]`` rows of the capture for which it is found out who is hidden.
    """
    origin = torch.tensor(model.lateral.origin, device=model.anchor.device)
    own, present, apart = model.albedo(), len(model), APART * float(model.cell.max())
    (centre, normal), albedo, curvature = model.placed(), own, model.curvature
    source = own > SOURCE * own.mean()
    flanks = flank(centre, normal, curvature, source, model.cell)
    sides = side(centre, normal, model.outward, source, model.cell)
    down, falling, which = (torch.cat(both) for both in zip(flanks, sides, strict=True))
    bend = torch.cat([curvature[flanks[2]], curvature.new_zeros(len(sides[2]), 3, 3)])
    chosen = best_apart(down, own[which], apart)
    chosen = chosen[~occupied(down[chosen], centre, apart)]
    for _ in range(RINGS):
        more = ring(centre, normal, albedo, albedo > SOURCE * own.mean(), origin, model.cell)
        centre, normal, albedo = (
            torch.cat([old, new]) for old, new in zip((centre, normal, albedo), more, strict=True)
        )
    flat = curvature.new_zeros(len(centre) - present, 3, 3)
    centre, normal = torch.cat([centre, down[chosen]]), torch.cat([normal, falling[chosen]])
    albedo = torch.cat([albedo, own[which[chosen]]])
    curvature = torch.cat([curvature, flat, bend[chosen]])
    inside = within_depths(centre, grid)
    inside[:present] = True
    centre, normal, albedo, curvature = (part[inside] for part in (centre, normal, albedo, curvature))
    hiders = model.hiders
    if len(hiders):
        new = hiders.new_zeros(*hiders.shape[:2], len(centre) - present, hiders.shape[3])
        new[:, spots] = model.hidden_by(spots, model.points_of(centre[present:], normal[present:]))
        hiders = torch.cat([hiders, new], 2)
    opacity = torch.cat([model.opacity(), own.new_zeros(len(centre) - present)])
    model.place(centre, normal, torch.cat([own, BEGIN * albedo[present:]]), opacity, curvature)
    if len(hiders):
        model.hiders = hiders


class _Linear(NamedTuple):
    """What albedos have to do with the light that arrives at some spots, while all else stands still."""

    spots: Tensor  # [B]
    runs: Runs  # of each surfel
    other: Tensor  # [B, T] light that arrives besides

    @classmethod
    @torch.no_grad()
    def of(cls, model: SurfelModel, spots: Tensor, hooks: Hooks) -> _Linear:
        paths, albedo = model.paths(spots, hooks), model.albedo()
        energy, time = model.arrivals(paths, spots, hooks, torch.ones_like(albedo))
        runs = Runs.of(energy, time, model.n_bins)
        direct = runs.send(albedo)
        whole = hooks.transients(direct, energy * albedo[:, None], albedo, paths, spots)
        return cls(spots, runs, whole - direct)


def solve_albedos(
    model: SurfelModel,
    spots: Tensor,
    counts: Tensor,
    weights: tuple[float, float, float],
    iterations: int,
    hooks: Hooks = NOTHING,
) -> None:
    """The likeliest albedos of all surfels together, all else as it is; a limited-memory quasi-Newton method.

    It minimises ``Σ (μ - H ln μ)`` and the albedos' own cost (:meth:`SurfelModel.albedo_cost`) over albedos ≥
    0. Each spot counts once, however few of all they are: what they leave open their noise must not say.
    Paths are traced once; light that takes other ways (fourth bounces) stays what it is.

    Args:
        model: whose albedos are set, linked.
        spots: ``[B]`` rows of the capture.
        counts: ``[B, T_gate]`` of them.
        weights: of steps between neighbours, of albedos above the scene's level, and of surfels that are
            there.
        iterations: at most.
        hooks: effects, which stand still.
    """
    device, level, m = counts.device, float(level_of(model.albedo())), len(model)
    size = max(1, CHUNK // max(1, m * model.quadrature**2))
    parts = [_Linear.of(model, part, hooks) for part in spots.split(size)]
    first = model.gate[0]

    def misfit(sent: Tensor, part: _Linear, seen: Tensor) -> tuple[float, np.ndarray]:
        arriving = (part.runs.send(sent) + part.other).requires_grad_()
        expected = model.record(arriving, part.spots, hooks)[:, first:].clamp_min(1e-9).double()
        nats = (expected - seen - torch.xlogy(seen.double(), expected / seen.clamp_min(1))).sum()
        return float(nats.detach()), part.runs.pull(torch.autograd.grad(nats, arriving)[0])

    def cost(levels: np.ndarray) -> tuple[float, np.ndarray]:
        x = torch.tensor(levels, dtype=torch.float32, device=device, requires_grad=True)
        prior = model.albedo_cost(*weights, level * x)
        total, slope = float(prior.detach()), torch.autograd.grad(prior, x)[0].double().cpu().numpy()
        sent = level * x.detach()
        each = [misfit(sent, part, seen) for part, seen in zip(parts, counts.split(size), strict=True)]
        return total + sum(nats for nats, _ in each), slope + level * sum(pull for _, pull in each)

    begin = (model.albedo().detach() / level).double().cpu().numpy()
    found = minimize(
        cost,
        begin,
        jac=True,
        method="L-BFGS-B",
        bounds=[(0.0, None)] * len(begin),
        options={"maxiter": iterations, "ftol": 1e-13, "gtol": 1e-3},
    )
    model.set_albedo(torch.tensor(level * found.x, dtype=torch.float32, device=device))


@torch.no_grad()
def cut_back(model: SurfelModel, before: Tensor) -> None:
    """Leave out surfels fainter than ``DIM`` of the scene's level that hide nothing.

    What was brighter before its neighbours were extended stays: its light may have gone to new ones beside
    it, which are too faint to stay themselves. So does what is opaque by what the counts say: a dark stripe
    sends next to nothing and stands before what is behind it all the same.

    Args:
        model: of the surfels.
        before: ``[N]`` albedos of the first N surfels, those that were there, before the others came.
    """
    albedo = model.albedo()
    kept, old = albedo > DIM * level_of(albedo), len(before)
    kept[:old] |= (before > DIM * level_of(before)) | (model.opacity()[:old] > OPAQUE)
    known, curvature = model.opacity()[:old][kept[:old]], model.curvature[kept]
    centre, normal = (part[kept] for part in model.placed())
    model.place(centre, normal, albedo[kept], known, curvature)
