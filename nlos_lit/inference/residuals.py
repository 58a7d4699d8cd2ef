"""Where the counts leave the model: signed significance of the residual along time, depth, wall, scan order
and count rate.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.hooks import NOTHING
from nlos_lit.inference.result import Profile
from nlos_lit.surfels.fit import SurfelFit

BANDS = 48
SIDE = 16


def profiles(before: SurfelFit, after: SurfelFit, scan: Scan, spots: Tensor) -> list[Profile]:
    """Residuals summed over bands of each axis, in standard deviations of their counts.

    NaN where a band has no spots. The wall's edges are metres in the world frame; depth is left out where
    nothing has one.

    Args:
        before: the base.
        after: the extended fit.
        scan: of the capture.
        spots: ``[S]`` rows of the capture.

    Returns:
        one profile an axis: time, depth, scan, rate, wall.
    """
    first, last = scan.gate
    counts = torch.from_numpy(before.capture.counts[spots.numpy(), first:last].astype(np.float32))
    models = [f.model.expected(spots, f.extension) for f in (before, after)]
    bins = counts.shape[1]

    def sums(band: Tensor, number: int) -> list[np.ndarray]:
        band = band.reshape(-1)
        total = [torch.zeros(number).index_add_(0, band, v.reshape(-1)) for v in (counts, *models)]
        return [torch.where(m > 0, (total[0] - m) / m.sqrt(), torch.nan).numpy() for m in total[1:]]

    def profile(axis: str, unit: str, edges: np.ndarray, band: Tensor) -> Profile:
        return Profile(axis, unit, edges, *sums(band, len(edges) - 1))

    def banded(values: Tensor, edges: np.ndarray) -> Tensor:
        return torch.from_numpy(
            np.clip(np.searchsorted(edges, values.numpy(), "right") - 1, 0, len(edges) - 2)
        )

    def per_spot(band: Tensor) -> Tensor:
        return band[:, None].expand(-1, bins)

    number = min(BANDS, bins)
    time_edges = first + np.linspace(0, bins, number + 1).round()
    time = banded(torch.arange(first, last) + 0.5, time_edges)[None].expand(len(spots), -1)
    order = np.linspace(0, scan.n_spots, min(BANDS, len(spots)) + 1)
    rank = (scan.rank[spots] + 1) / 2 * (scan.n_spots - 1)
    total = models[1].sum(1)
    rates = np.unique(np.quantile(total.numpy(), np.linspace(0, 1, 13)))
    depth = _mean_depth(after, spots)
    seen = depth[depth > 0]
    depths = (
        np.unique(np.quantile(seen.numpy(), np.linspace(0, 1, 25))) if len(seen) else np.array([0.0, 1.0])
    )
    place = scan.places[-1][spots]
    side = torch.clamp(((place + 1) / 2 * SIDE).long(), 0, SIDE - 1)
    wall = sums(per_spot(side[:, 0] * SIDE + side[:, 1]), SIDE**2)
    edges = [c + np.linspace(-scan.half, scan.half, SIDE + 1) for c in scan.centre.tolist()]
    found = [
        profile("time", "bin", time_edges, time),
        profile("scan", "spot", order, per_spot(banded(rank, order))),
        profile("rate", "counts/spot", rates, per_spot(banded(total, rates))),
        Profile("wall", "m", edges[0], wall[0].reshape(SIDE, SIDE), wall[1].reshape(SIDE, SIDE), edges[1]),
    ]
    if len(depths) > 1:
        inside = depth.reshape(-1) > 0
        band = torch.where(
            inside, banded(depth.reshape(-1), depths), torch.full((depth.numel(),), len(depths) - 1)
        )
        before_after = [v[:-1] for v in sums(band, len(depths))]
        found.insert(1, Profile("depth", "m", depths, *before_after))
    return found


@torch.no_grad()
def _mean_depth(fit: SurfelFit, spots: Tensor) -> Tensor:
    """``[S, T_gate]`` mean depth, m, of the surfels whose light arrives in a bin; 0 where hardly any does."""
    model, values = fit.model, []
    for part in spots.split(64):
        paths = model.paths(part)
        deep = paths._replace(contribution=paths.contribution * model.centre()[:, 2, None])
        light, weighted = (model.transients(p, part, NOTHING) for p in (paths, deep))
        values.append(
            torch.where(
                light > 0.01 * light.mean(), weighted / light.clamp_min(1e-30), torch.zeros_like(light)
            )
        )
    return torch.cat(values)[:, model.gate[0] :]
