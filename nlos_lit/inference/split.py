"""Which spots are fitted, which select between explanations, which nothing but the last figure may see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.wall_blocks import wall_blocks

ROLES = ("fit", "fit", "select", "fit", "fit", "test", "fit", "select")
STRIDE = 3  # coprime to the number of roles: every row and column of blocks has all roles


@dataclass(frozen=True)
class Split:
    """Rows of the capture by role, and the wall block of every spot.

    Args:
        fit: rows that are fitted.
        select: rows that select between explanations.
        test: rows that nothing but the last figure may see.
        block: ``[S]`` of all spots, contiguous patches.
    """

    fit: np.ndarray
    select: np.ndarray
    test: np.ndarray
    block: np.ndarray


def split_spots(capture: Capture, blocks: int = 8) -> Split:
    """Contiguous patches of the wall: five eighths to fit, a quarter to select, an eighth untouched.

    Contiguous, because random spots leak through their neighbours. Spots without a single gated count were
    not measured.

    Args:
        capture: that is split.
        blocks: patches along each side, about.

    Returns:
        rows by role.

    Raises:
        UserError: a role is left without spots.
    """
    block = wall_blocks(capture, blocks)
    row, column = np.divmod(block, blocks)
    role = np.array(ROLES)[(row + STRIDE * column) % len(ROLES)]
    first, last = capture.gate
    measured = capture.counts[:, first:last].any(1)
    parts = {name: np.flatnonzero((role == name) & measured) for name in ("fit", "select", "test")}
    for name, spots in parts.items():
        if len(spots) < 8:
            raise UserError(
                f"only {len(spots)} measured spots are left to {name}; "
                "a diagnosis needs a scan of at least 16 × 16 spots"
            )
    return Split(**parts, block=block)
