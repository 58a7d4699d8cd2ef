"""The level of counts that is there without the hidden scene."""

from __future__ import annotations

from torch import Tensor


def quietest_level(mean: Tensor) -> float:
    """Lowest mean over a sixteenth of the time bins: a rough background of any transient.

    Args:
        mean: ``[T]`` counts of each time bin, on average over the spots; NaN where none recorded it, such
            bins are left out.

    Returns:
        Counts per bin; it is too high where light arrives all the time, never far too low.

    Examples:
        >>> import torch
        >>> quietest_level(torch.tensor([9.0] * 8 + [2.0, 4.0] + [9.0] * 22))
        3.0
        >>> quietest_level(torch.tensor([9.0, float("nan"), 3.0]))
        3.0
    """
    mean = mean[~mean.isnan()]
    return float(mean.unfold(0, max(1, len(mean) // 16), 1).mean(1).min())
