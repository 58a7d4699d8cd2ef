"""Which formula a free term follows: few numbers in place of dozens of coefficients, and a file to keep them.

A free term says along which axis something is wrong, a formula what it is. Formulas that act where the term
does (:mod:`nlos_lit.effects.formulas`) are laid through its fitted values by least squares. The scene goes on
with the nearest of them in the term's place, and spots that were not fitted say how much of the term's gain
each keeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.formulas import Formula, formulas_of
from nlos_lit.effects.free_terms import Free
from nlos_lit.inference.members import Findings
from nlos_lit.inference.scenes import Scenes, copy_effects, go_on
from nlos_lit.surfels.fit import SurfelFit

TRIED = 3  # formulas with which the scene goes on
KEEPS = 0.9  # share of the free term's gain from which on a formula is offered as an effect


@dataclass(frozen=True)
class Follower:
    """The formula that keeps most of a free term's gain.

    Args:
        name: of the formula.
        fit: the scene with it in place of the free term.
        share: of the free term's own gain on the select spots that it keeps.
    """

    name: str
    fit: SurfelFit
    share: float

    @property
    def offered(self) -> bool:
        """It keeps enough to be an effect of its own."""
        return self.share >= KEEPS


def distil(scenes: Scenes, scan: Scan, found: Findings) -> dict[str, Follower]:
    """Formulas of the free terms that were accepted.

    Args:
        scenes: of the capture.
        scan: of it.
        found: by the search.

    Returns:
        by the free term's name; nothing for one that acts along no single axis, or gains nothing any more.
    """
    followers = {}
    for member in found.accepted:
        follower = _of_term(scenes, scan, found.final, member.name, member.trial.gain.nats)
        if follower is not None:
            followers[member.name] = follower
    return followers


def _of_term(scenes: Scenes, scan: Scan, final: SurfelFit, name: str, gain: float) -> Follower | None:
    """The one of a term whose own gain is that."""
    formulas = formulas_of(name)
    if not formulas or gain <= 0:
        return None
    free = next(e for e in final.extension.effects if e.name == name)
    assert isinstance(free, Free)
    expected = final.model.expected(final.train, final.extension)
    laid = [lay(formula(scan), free, final.train, expected) for formula in formulas]
    tried = [formula for _, formula in sorted(laid, key=lambda pair: pair[0])][:TRIED]

    def with_it(formula: Formula) -> SurfelFit:
        effects = [e for e in final.extension.effects if e.name != name]
        fit = final.copy(copy_effects(Extension(effects), [formula]), scenes.seed)
        fit.match_energy()  # a constant is none of a formula's, and may have been of the term's
        return go_on(fit)

    jobs = [(f"going on without {name}", f"all_but_{name}", partial(scenes.without, final, [name]))]
    for formula in tried:
        text, kept = f"going on with {formula.name}", f"{formula.name}_for_{name}"
        jobs.append((text, kept, partial(with_it, formula)))
    neither, *fits = scenes.several(jobs)
    values = [float(scenes.value(fit).sum()) for fit in fits]
    best = max(range(len(tried)), key=lambda k: values[k])
    kept_of_it = (values[best] - float(scenes.value(neither).sum())) / gain
    return Follower(tried[best].name, fits[best], kept_of_it)


@torch.no_grad()
def lay(formula: Formula, free: Free, spots: Tensor, expected: Tensor) -> tuple[float, Formula]:
    """Lay a formula through the values of a free term, by least squares.

    Args:
        formula: that is set, in place.
        free: the term.
        spots: ``[B]`` that were fitted.
        expected: ``[B, T_gate]`` of them, with the term.

    Returns:
        the mean square that it leaves, a constant taken out, and the formula.
    """
    x, values, weight = formula.seen_in(free, spots, expected)
    root = (weight / weight.sum()).sqrt().double()[:, None]
    found = []
    for shape in formula.shape_grid():
        formula.set_all(shape)
        columns = torch.nn.functional.pad(formula.basis(x), (0, 1), value=1.0).double()
        solved = torch.linalg.lstsq(root * columns, root * values.double()[:, None], driver="gelsd").solution
        bounded = solved[:-1, 0]
        for k, p in enumerate(formula.amplitudes):
            bounded[k] = bounded[k].clamp(p.lower, p.upper)
        off = values - columns[:, :-1] @ bounded
        off = off - (root[:, 0].square() * off).sum()
        found.append((float((root[:, 0] * off).square().sum()), shape, bounded))
    least, shape, amplitudes = min(found, key=lambda entry: entry[0])
    formula.set_all(shape)
    for p, value in zip(formula.amplitudes, amplitudes.tolist(), strict=True):
        formula.set(p.name, value)
    return least, formula


@torch.no_grad()
def laid_through(formula: Formula, free: Free, fit: SurfelFit, edges: Tensor) -> np.ndarray:
    """A formula at places of an axis, as high as the free term that it follows.

    Args:
        formula: of ``fit``.
        free: the term.
        fit: with the formula.
        edges: ``[K]`` of the axis.

    Returns:
        ``[K]``.
    """
    at, values, weight = formula.seen_in(free, fit.train, fit.model.expected(fit.train, fit.extension))
    constant = (weight * (values - formula.f(at))).sum() / weight.sum()
    return (formula.f(formula.along(edges)) + constant).numpy()
