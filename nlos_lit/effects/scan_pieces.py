"""Pieces of the order of acquisition: equal stretches, and the lines in which a wall is scanned."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan

SHORTEST = 4  # spots of a line, on average; a scan whose lines are shorter has none


def bands(place: Tensor, number: int) -> Tensor:
    """Indicators of equal bands.

    Args:
        place: ``[n]`` from 0 to 1.
        number: of bands.

    Returns:
        ``[n, number]`` one where a place lies in the band, else zero.

    Examples:
        >>> bands(torch.tensor([0.0, 0.6, 1.0]), 2)
        tensor([[1., 0.],
                [0., 1.],
                [0., 1.]])
    """
    index = (place * number).long().clamp(0, number - 1)
    return torch.nn.functional.one_hot(index, number).float()


def stretches(scan: Scan, number: int) -> Tensor:
    """``[S, number]`` indicators of equal bands of the order of acquisition.

    Args:
        scan: of the capture.
        number: of bands.

    Returns:
        one in the band of each spot, else zero.
    """
    return bands((scan.rank + 1) / 2, number)


def lines(scan: Scan) -> tuple[Tensor, Tensor]:
    """In which line of the scan each spot was taken, and where within it.

    A line ends where the step to the next spot is neither the usual step nor its reverse: at a fly-back or a
    turn. A scan without lines (scattered spots, say) is cut into as many equal stretches as a square scan of
    as many spots has lines.

    Args:
        scan: of the capture.

    Returns:
        ``[S]`` number of the line from 0 on in the order of acquisition, and ``[S]`` place from -1 at its
        first spot to 1 at its last.
    """
    order = torch.argsort(scan.rank)
    spots = len(order)
    number = torch.zeros(spots, dtype=torch.long)
    number[order] = _cut(torch.cat(scan.places, 1)[order])
    if int(number.max()) + 1 > spots / SHORTEST:
        number[order] = torch.arange(spots) * math.isqrt(spots) // spots
    size = torch.bincount(number)
    first = size.cumsum(0) - size
    place = torch.empty_like(number)
    place[order] = torch.arange(spots)
    steps = size[number] - 1
    return number, (2 * (place - first[number]) - steps) / steps.clamp_min(1)


def _cut(places: Tensor) -> Tensor:
    """``[S]`` number of the line of each place ``[S, D]``, both in the order of acquisition."""
    step = places.diff(dim=0)
    if not len(step):
        return torch.zeros(len(places), dtype=torch.long)
    length = step.norm(dim=1)
    usual = length.median()
    # The direction of most steps, whichever way they go.
    common = step[(length - usual).abs() <= 0.2 * usual]
    usual_step = usual * torch.linalg.svd(common, full_matrices=False)[2][0]
    off = torch.minimum((step - usual_step).norm(dim=1), (step + usual_step).norm(dim=1))
    ends = torch.cat([torch.zeros(1, dtype=torch.bool), off > 0.5 * usual])
    return ends.long().cumsum(0)
