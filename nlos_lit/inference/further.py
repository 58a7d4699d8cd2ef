"""What another capture of the same scene says of names that the first could not tell apart.

Each capture has a scene of its own, and only the names that are open are tried. What each gains over none of
them, on wall blocks that were not fitted, is added to what it gained on the captures before. A term that
belongs to the wall or the rig must have the values that it had: a map that is another one in every capture is
no map of the wall.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.assemble import facts_of, nats_by_block, tried_with
from nlos_lit.inference.base_pipeline import BasePipeline
from nlos_lit.inference.candidates import Candidate
from nlos_lit.inference.diagnose import split_of
from nlos_lit.inference.heldout import log_likelihood, weights
from nlos_lit.inference.pool import ask, lit_by
from nlos_lit.inference.problem import acting_order
from nlos_lit.inference.result import Accepted, Diagnosis, Estimate, Further, Tried
from nlos_lit.inference.scenes import begun_with, copy_effects, go_on, solve_spots
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.inference.split import Split
from nlos_lit.inference.uncertainty import uncertainty_of
from nlos_lit.runtime.steps import Report, Steps
from nlos_lit.surfels.fit import SurfelFit

# Of the gain of values fitted anew that those of before keep, if both are the same; chosen while looking at
# the pairs of tests/blind/test_blind_further.py.
HALF = 0.5
SAME = 0.02  # of the scanned wall's larger side, within which two scans are of the same wall points


def open_terms(diagnosis: Diagnosis) -> list[Accepted]:
    """Accepted effects that may be others.

    Args:
        diagnosis: so far.

    Returns:
        At least one.

    Raises:
        UserError: there is none, or it was written before groups were kept with what they gained, or altered.
    """
    _check(diagnosis)
    found = [term for term in diagnosis.effects if term.confusable_with]
    if not found:
        raise UserError(
            "this diagnosis leaves no two names open that another capture could tell apart: "
            + (f"it names {', '.join(t.name for t in diagnosis.effects)} alone" if diagnosis.effects else
               "it names no effect")
        )  # fmt: skip
    if any(set(term.weights) - set(term.tried) for term in found):
        raise UserError("this diagnosis is of an earlier version; diagnose the first capture again")
    return found


def _check(diagnosis: Diagnosis) -> None:
    """See that the terms of a diagnosis, which may come from anywhere, are such as there are.

    Raises:
        UserError: they are not.
    """
    known = {cls.name for cls in [*EFFECTS, *FREE]}
    wall = diagnosis.capture.get("wall", [0.0] * 4)
    fine = isinstance(wall, list) and len(wall) == 4 and _numbers(wall)
    for term in [*diagnosis.effects, *diagnosis.unknown]:
        strange = sorted({term.name, *term.weights, *term.tried} - known)
        if strange:
            raise UserError(
                f"the diagnosis names {strange[0]!r}, which is no effect of this version; diagnose the first "
                "capture again"
            )
        blocks = {len(one.nats) for one in term.tried.values()}
        fine &= len(blocks) <= 1 and 0 not in blocks
        fine &= all(_numbers(one.nats) for one in term.tried.values())
        fine &= all(_numbers(given) for one in term.tried.values() for given in one.values.values())
    if not fine:
        raise UserError("the numbers of the diagnosis were altered; diagnose the first capture again")


def _numbers(values: list[Any]) -> bool:
    return all(isinstance(value, int | float) and math.isfinite(value) for value in values)


def ask_further(
    diagnosis: Diagnosis,
    capture: Capture,
    pipeline: BasePipeline,
    options: CriticismSettings,
    *,
    name: str,
    seed: int,
    report: Report = lambda text, passed, left: None,
) -> Diagnosis:
    """Ask another capture which of the open names stay.

    Args:
        diagnosis: of the first capture, and of further ones.
        capture: of the same scene and rig, in another order, at another power, …
        pipeline: image and fit of its base.
        options: of the criticism.
        name: of the capture.
        seed: of everything random.
        report: called as steps begin, see :class:`~nlos_lit.runtime.steps.Steps`.

    Returns:
        The diagnosis with the weights of all captures together. Where another name than the accepted one is
        left, that takes its place; its evidence and gain stay those that were measured with the other.

    Raises:
        UserError: nothing is open, or the capture cannot be diagnosed.
    """
    asked = open_terms(diagnosis)
    steps = Steps(report)
    steps.plan(image=1, fit=sum(2 + len(term.weights) for term in asked), screen=len(asked))
    image = steps("image", "imaging", "image", partial(pipeline.image, capture))
    split, scan = split_of(capture), Scan.of(capture)
    same = same_wall(diagnosis.capture, facts_of(capture, name))
    terms = [*diagnosis.effects, *diagnosis.unknown]
    for term in asked:
        others = sorted((_begun(t, scan, same) for t in terms if t.name != term.name), key=acting_order)
        fitting = partial(pipeline.fit, capture, split, image, Extension(others), seed)
        base = solve_spots(steps("fit", "fitting the base", "base", fitting))
        asking = _Asking(base, split, scan, options, seed, steps, same)
        diagnosis = _with(diagnosis, term, *asking.settled(term, name))
    return diagnosis


def same_wall(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether two captures' facts say that the same part of the wall was scanned.

    Args:
        before, now: of :func:`~nlos_lit.inference.assemble.facts_of`.

    Returns:
        False also where one does not say it.

    Examples:
        >>> same_wall({"wall": [0.0, 1.0, 0.0, 1.0]}, {"wall": [0.01, 1.0, 0.0, 0.99]})
        True
        >>> same_wall({"wall": [0.0, 1.0, 0.0, 1.0]}, {"wall": [0.5, 1.5, 0.0, 1.0]})
        False
    """
    if "wall" not in before:
        return False
    first, second = np.array(before["wall"]), np.array(now["wall"])
    size = max(first[1] - first[0], first[3] - first[2])
    return bool(np.abs(first - second).max() <= SAME * size)


@dataclass(frozen=True)
class _Asking:
    """A capture that is asked, with the fit that all names are tried beside."""

    base: SurfelFit
    split: Split
    scan: Scan
    options: CriticismSettings
    seed: int
    steps: Steps
    same: bool

    def settled(self, term: Accepted, name: str) -> tuple[Accepted, Further]:
        """The term that stays, and what the capture ``name`` added on its group."""
        names, select = list(term.weights), self.split.select
        known = [n for n in names if self.same and term.tried[n].values]
        none = self._gone_on("none", begun_with(self.base, []))
        before = log_likelihood(none, select)
        fits = {c.name: self._gone_on(c.name, begun_with(self.base, [c])) for c in self._asked(names)}
        after = {n: log_likelihood(fits[n], select) for n in names}
        best = max(after.values(), key=lambda value: float(value.sum()))
        seen = weights([before, best], self.split.block[select])[0] <= self.options.open_share
        here = {n: nats_by_block(before, value, self.split) for n, value in after.items()}
        kept = {}
        for n in known:
            effect = _effect(n, self.scan, term.tried[n].values)
            fixed = self._gone_on(f"{n} as it was", copy_effects(self.base.extension, [effect]))
            old = nats_by_block(before, log_likelihood(fixed, select), self.split)
            anew = sum(here[n])
            kept[n] = sum(old) / anew if anew > 0 else 1.0
            if kept[n] < HALF:
                fits[n], here[n] = fixed, old
        tried = {n: tried_with(n, fits[n], [*term.tried[n].nats, *here[n]]) for n in names}
        share = _weights(tried)
        left = {n: w for n, w in share.items() if w > self.options.open_share}
        first = term.name if term.name in left else max(left, key=lambda n: left[n])
        order = sorted(left, key=lambda n: (n != first, -left[n]))
        stays = replace(
            term,
            weights={n: left[n] / sum(left.values()) for n in order},
            split_by="; ".join(sorted({EFFECTS.splitting(first, n) for n in left} - {""})),
            tried={n: tried[n] for n in order},
            advised=term.advised if len(order) > 1 else {},
        )
        if first != term.name:
            stays = replace(stays, name=first, parameters=self._parameters(fits[first], first, term.misfit))
        gained = {n: float(sum(values)) for n, values in here.items()}
        return stays, Further(name, names, gained, kept, seen, share, order)

    def _asked(self, names: list[str]) -> list[Candidate]:
        """What is open, as the pool sees it here."""
        lit = lit_by(self.base, self.scan)
        asking = partial(ask, self.base, self.split, lit, self.options.spots, self.seed, only=names)
        return self.steps("screen", "asking for what is open", "pool", asking).candidates

    def _gone_on(self, name: str, extension: Extension) -> SurfelFit:
        fit = self.base.copy(extension, self.seed)
        return self.steps("fit", f"going on with {name}", name, partial(go_on, fit))

    def _parameters(self, fit: SurfelFit, name: str, misfit: float) -> dict[str, Estimate]:
        effect = next(e for e in fit.extension.effects if e.name == name)
        uncertainty = uncertainty_of(fit, self.split, self.options.spots, self.seed)
        return uncertainty.parameters(effect, None, misfit)


def _weights(tried: Mapping[str, Tried]) -> dict[str, float]:
    """How far the wall blocks of all captures leave each name open."""
    values = [torch.tensor(one.nats, dtype=torch.float64) for one in tried.values()]
    return dict(zip(tried, weights(values, np.arange(len(values[0]))), strict=True))


def _begun(term: Accepted, scan: Scan, same: bool) -> Effect:
    """An accepted term in another capture: with its values where these last, else at its null."""
    return _effect(term.name, scan, term.tried[term.name].values if same and term.name in term.tried else {})


def _effect(name: str, scan: Scan, values: Mapping[str, list[float]]) -> Effect:
    """An effect with values that stay as they are, or at its null where there are none.

    Raises:
        UserError: the other scan gives it other coefficients, or it has none of that name.
    """
    effect = next(cls for cls in [*EFFECTS, *FREE] if cls.name == name)(scan)
    for parameter, given in values.items():
        if parameter not in effect.declared or len(given) != effect.declared[parameter].size:
            raise UserError(f"the scans are too different: {name} has other coefficients in the second")
        effect.set(parameter, torch.tensor(given))
    return effect.requires_grad_(not values and not effect.per_spot)


def _with(diagnosis: Diagnosis, before: Accepted, after: Accepted, further: Further) -> Diagnosis:
    effects = [after if term.name == before.name else term for term in diagnosis.effects]
    notes = list(diagnosis.notes)
    if after.name != before.name:
        notes.append(
            f"{after.name} was first diagnosed as {before.name}, which leaves nearly the same trace in "
            f"{diagnosis.capture.get('name', 'the first capture')}: evidence and gain are those of "
            f"{before.name} there, sizes those of {after.name} in {further.name}."
        )
    return replace(
        diagnosis,
        effects=effects,
        groups=[[t.name, *t.confusable_with] for t in effects if t.confusable_with],
        notes=notes,
        further=[*diagnosis.further, further],
    )
