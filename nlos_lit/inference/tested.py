"""The linear problem of a fit: which fitted spots it is asked on, and how fine the scene may change in it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nlos_lit.inference.problem import Problem, build_problem
from nlos_lit.inference.split import Split
from nlos_lit.surfels.fit import SurfelFit

WORK = 5e10  # multiplications of the nuisance columns with each other, some 1 s of one core


def tested_rows(fit: SurfelFit, split: Split, most: int, seed: int) -> np.ndarray:
    """Which fitted spots the pool is asked on.

    Args:
        fit: that is criticised.
        split: of its spots.
        most: spots, at most.
        seed: of the choice.

    Returns:
        sorted rows of ``split.fit`` (and of the fit's counts).
    """
    return np.sort(np.random.default_rng(seed).permutation(len(split.fit))[:most])


def patches_for(rows: int) -> int:
    """How many groups of surfels the work allows, see ``WORK``.

    Args:
        rows: of the problem, spots times bins.

    Examples:
        >>> patches_for(320_000), patches_for(72_000)
        (197, 416)
    """
    return int((WORK / rows) ** 0.5 / 2)


def problem_of(
    fit: SurfelFit, split: Split, most: int, seed: int, with_effects: bool = True
) -> tuple[Problem, Tensor]:
    """The linear problem of a fit's tested spots.

    Args:
        fit: that is criticised.
        split: of its spots.
        most: spots, at most.
        seed: of their choice.
        with_effects: the fit's effects may change in it, too.

    Returns:
        the problem, and ``[S]`` the number of each spot's wall block.
    """
    rows = tested_rows(fit, split, most, seed)
    spots = torch.from_numpy(split.fit[rows])
    patches = patches_for(len(rows) * fit.counts.shape[1])
    problem = build_problem(
        fit.model, fit.extension, spots, fit.counts[rows], with_effects=with_effects, patches=patches
    )
    return problem, torch.from_numpy(np.unique(split.block[split.fit[rows]], return_inverse=True)[1])
