"""From the search's findings to a :class:`~nlos_lit.inference.result.Diagnosis`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.wall_blocks import by_block
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.formulas import Formula
from nlos_lit.effects.free_terms import RATES, Free
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.smooth import fast
from nlos_lit.effects.strengths import bound_notes
from nlos_lit.inference.advise import expected_nats
from nlos_lit.inference.candidates import Candidate
from nlos_lit.inference.distil import Follower, laid_through
from nlos_lit.inference.heldout import Comparison, score
from nlos_lit.inference.members import Findings, Member, Trial
from nlos_lit.inference.own import null_of
from nlos_lit.inference.residuals import SIDE, profiles
from nlos_lit.inference.result import (
    Accepted,
    Diagnosis,
    Followed,
    Gain,
    Likely,
    Screened,
    Shape,
    Tried,
    Unexplained,
)
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.inference.split import Split
from nlos_lit.inference.toys import Null
from nlos_lit.inference.uncertainty import Uncertainty, uncertainty_of
from nlos_lit.inference.witness import witness
from nlos_lit.surfels.fit import SurfelFit

DRAWS = 16  # of fields, of which a mean size is taken
NINE_OF_TEN = 1.2816  # standard deviations of a score that nine of ten exceed from below


def assemble(
    capture: Capture,
    found: Findings,
    split: Split,
    scan: Scan,
    settings: CriticismSettings,
    null: Null | None,
    name: str,
    seconds: float,
    seed: int,
    followers: Mapping[str, Follower] = MappingProxyType({}),
) -> Diagnosis:
    """Everything the report says.

    Args:
        capture: that was diagnosed.
        found: by the search.
        split: of its spots.
        scan: of the capture.
        settings: of the criticism.
        null: what toys of the base show; None where there are none.
        name: of the capture.
        seconds: the diagnosis took.
        seed: of it.
        followers: formulas of the free terms, by these terms' names.

    Returns:
        The result, as it is written and shown.
    """
    base, final = found.base, found.final

    def uncertain(fit: SurfelFit) -> Uncertainty:
        return uncertainty_of(fit, split, settings.spots, seed)

    uncertainty = uncertain(final)
    terms = {e.name: e for e in final.extension.effects if isinstance(e, Free)}
    misfit = {m.name: m.confirmed.misfit for m in found.accepted if m.confirmed is not None}
    followed = {n: _followed(f, terms[n], uncertain(f.fit), misfit[n], scan) for n, f in followers.items()}
    accepted = [_accepted(member, found, uncertainty, split, scan, followed) for member in found.accepted]
    named = [a for a in accepted if not a.axis]
    unknown = [a for a in accepted if a.axis]
    first = found.pools[0].candidates
    worst = max(unknown, key=lambda a: a.evidence, default=None)
    left = [(c.effect.axis, c.evidence) for c in found.pools[-1].candidates if isinstance(c.effect, Free)]
    most = left[0] if worst is None else (worst.axis, worst.evidence)
    fitted, test = torch.from_numpy(np.concatenate([split.fit, split.select])), split.test
    largest = first[0].evidence
    over = max([largest - found.needed, *(a.evidence - a.needed for a in accepted if a.needed is not None)])
    along = [m.candidate.effect for m in found.present if not m.accepted] if found.accepted else []
    return Diagnosis(
        effects=named,
        unknown=unknown,
        groups=[[a.name, *a.confusable_with] for a in named if a.confusable_with],
        unexplained=Unexplained(worst is not None, *most),
        screened=[_screened(c, found.needed) for c in first],
        base=score(base, split.select),
        extended=score(final, split.select),
        untouched_test={"base": score(base, test), "extended": score(final, test)},
        witness=witness(capture, final),
        profiles=profiles(base, final, scan, fitted),
        needed=found.needed,
        chance=math.exp(min(0.0, math.log(settings.level) - over)) if null is None else null.chance(largest),
        notes=[*bound_notes(final.extension.effects), *_unnamed(along)],
        capture=facts_of(capture, name),
        toys=0 if null is None else null.toys,
        seconds=seconds,
        seed=seed,
        likely=_likely(found.members),
        along=[e.name for e in along],
    )


def _unnamed(effects: list[Effect]) -> list[str]:
    """What is in the last model and not named."""
    if not effects:
        return []
    phrases = "; ".join(e.name if e.words is None else e.words.phrase for e in effects)
    they = "it" if len(effects) == 1 else "each of them"
    return [
        f"Fitted along and not named, since other spots are predicted better with {they} and the counts ask"
        f" for {they} less than they would have to: {phrases}."
    ]


def _followed(
    follower: Follower, free: Free, uncertainty: Uncertainty, misfit: float, scan: Scan
) -> Followed:
    formula = next(e for e in follower.fit.extension.effects if e.name == follower.name)
    assert isinstance(formula, Formula)
    parameters, shape = uncertainty.parameters(formula, None, misfit), shape_of(free, scan)
    curve = laid_through(formula, free, follower.fit, torch.from_numpy(shape.edges).float())
    equation = f"{formula.equation}, x {formula.is_x}"
    told = (follower.name, equation, parameters, follower.share, follower.offered)
    return Followed(*told, curve)


def _accepted(
    member: Member,
    found: Findings,
    uncertainty: Uncertainty,
    split: Split,
    scan: Scan,
    followed: Mapping[str, Followed],
) -> Accepted:
    confirmed, trial = member.confirmed, member.trial
    assert confirmed is not None  # what makes a member accepted
    effect = next(e for e in found.final.extension.effects if e.name == member.name)
    others = () if found.again is None else found.again.extension.effects
    again = next((e for e in others if e.name == effect.name), None)
    kept = {e.name for e in found.final.extension.effects}
    weights = {name: w for name, w in member.group.items() if name == member.name or name not in kept}
    total = sum(weights.values())
    free = effect if isinstance(effect, Free) else None
    return Accepted(
        name=effect.name,
        parameters=uncertainty.parameters(effect, again, confirmed.misfit),
        evidence=confirmed.evidence,
        heldout_gain=_gain(found.final, trial.gain, split),
        weights={name: weight / total for name, weight in weights.items()},
        split_by="; ".join(sorted({EFFECTS.splitting(effect.name, other) for other in weights} - {""})),
        advised=_advised(effect.name, list(weights), member.trials),
        axis=free.axis if free else "",
        shape=shape_of(free, scan) if free else None,
        formula=followed.get(effect.name),
        needed=confirmed.needed,
        explained=confirmed.explained,
        misfit=confirmed.misfit,
        tried={name: _tried(name, member.trials, split) for name in weights},
    )


def _likely(members: list[Member]) -> list[Likely]:
    """Terms that are not named although other spots are predicted much better with them."""
    found = [(m.name, m.confirmed) for m in members if m.likely]
    told = [
        Likely(name, c.gain.nats, c.gain.error, c.explained, c.evidence, c.needed)
        for name, c in found
        if c is not None
    ]
    return sorted(told, key=lambda one: -one.nats)


def _advised(name: str, names: list[str], trials: list[Trial]) -> dict[str, float]:
    """What captures would tell of a term and the hardest of its rivals; those of single spots aside."""
    tried = {t.name: t.fit for t in trials if t.candidate is not None and not t.candidate.effect.per_spot}
    rivals = [rival for rival in names if rival != name and rival in tried]
    if name not in tried or not rivals:
        return {}
    told = [expected_nats(tried[name], tried[rival], (name, rival)) for rival in rivals]
    return {plan: min(each[plan] for each in told) for plan in told[0]}


def _tried(name: str, trials: list[Trial], split: Split) -> Tried:
    trial = next(t for t in trials if t.name == name)
    none = next(t for t in trials if t.candidate is None)
    return tried_with(name, trial.fit, nats_by_block(none.likelihood, trial.likelihood, split))


def tried_with(name: str, fit: SurfelFit, nats: list[float]) -> Tried:
    """What is kept of a term that was tried.

    Args:
        name: of the term.
        fit: that went on with it.
        nats: of each wall block.

    Returns:
        The record; with values where another capture of the same wall has them alike.
    """
    effect = next(e for e in fit.extension.effects if e.name == name)
    if not effect.lasting:
        return Tried(nats)
    return Tried(
        nats, {p.name: effect.value(p.name).detach().reshape(-1).tolist() for p in effect.amplitudes}
    )


def nats_by_block(before: Tensor, after: Tensor, split: Split) -> list[float]:
    """What one fit gains over another on each block of select spots.

    Args:
        before: ``[S]`` nats of the select spots.
        after: ``[S]`` of the same.
        split: of the spots.

    Returns:
        One number a block.
    """
    gain: list[float] = by_block(after - before, split.block[split.select]).tolist()
    return gain


def _gain(fit: SurfelFit, loss: Comparison, split: Split) -> Gain:
    """What the term's absence costs, a bin and a photon of the select spots."""
    first, last = fit.capture.gate
    photons = float(fit.capture.counts[split.select, first:last].sum())
    after = score(fit, split.select).deviance_per_bin
    low, high = loss.interval
    bins = len(split.select) * (last - first)
    return Gain(after + 2 * loss.nats / bins, after, loss.nats / photons, (low / photons, high / photons))


def _screened(candidate: Candidate, least: float) -> Screened:
    effect, start = candidate.effect, 0
    least += math.log(len(effect.shape_grid()))  # that one of its shapes alone is asked for
    step, detectable = {}, {}
    for p in effect.amplitudes:
        part = slice(start, start + p.size)
        error = candidate.error[part][torch.isfinite(candidate.error[part])]
        if not effect.per_spot:
            step[p.name] = (
                float(p.scale * candidate.step[part].square().mean().sqrt())
                if p.size > 1
                else float((p.null or 0.0) + p.scale * candidate.step[part])
            )
        visible = _visible(error, least, alone=effect.per_spot)
        if p.size > 1 and "rms" in effect.quantities() and not effect.per_spot:
            detectable["rms"] = visible * _rms_of(effect, p)
        else:
            detectable[p.name] = p.scale * visible
        start += p.size
    return Screened(
        name=effect.name,
        evidence=candidate.evidence,
        retained_information=candidate.retained,
        scatter=candidate.scatter,
        degrees=2 if effect.per_spot else len(candidate.step),
        one_step=step,
        shape=candidate.shape,
        detectable=detectable,
    )


def _rms_of(effect: Effect, p: Parameter) -> float:
    """Root mean square, in its unit, of a field whose stored coefficients are all 1, up or down."""
    null, rng, squares = null_of(effect), np.random.default_rng(0), []
    for _ in range(DRAWS):
        null.set(p.name, torch.from_numpy(p.scale * rng.choice([-1.0, 1.0], p.size)))
        squares.append(float(null.quantities()["rms"].value.detach()) ** 2)
    return float(np.mean(squares)) ** 0.5


def _visible(error: Tensor, least: float, alone: bool) -> float:
    """How large k coefficients must be, all alike, to have so much evidence in nine of ten captures.

    ``error`` ``[k]`` is that of each: together they have the sum of what each has. Numbers of single spots
    stand ``alone``. Not a number where no error is known.
    """
    k = len(error)
    if alone or not k:
        return float((visible_score(least) + NINE_OF_TEN) * error.square().mean().sqrt())
    return float((visible_score(least / k) + NINE_OF_TEN / k**0.5) * error.pow(-2).mean().rsqrt())


def visible_score(least: float) -> float:
    """Score, in standard deviations, at which one coefficient has so much evidence: ½(u² - 1 - ln u²) nats.

    Examples:
        >>> round(visible_score(8.3), 2)
        4.54
    """
    low, high = 1.0, 2.0 + 2.0 * max(least, 1.0)
    for _ in range(60):
        u = (low + high) / 2
        low, high = (u, high) if 0.5 * (u**2 - 1 - math.log(u**2)) < least else (low, u)
    return low


@torch.no_grad()
def shape_of(effect: Free, scan: Scan) -> Shape:
    """What a free term looks like.

    Over the wall and time it is the leading pair of the table of spots and bins: the map over the wall, times
    the root mean square of what it does along time.

    Args:
        effect: a free term.
        scan: of the capture.

    Returns:
        its values along its axis.
    """
    (p,) = effect.amplitudes
    first, last = scan.gate
    values = effect.values()
    if effect.axis == "time":
        return Shape("time", p.unit, np.arange(first, last + 1.0), values[first:last].numpy())
    if effect.axis == "rate":
        edges = scan.mean_counts * np.exp(np.linspace(*RATES, len(values) + 1))
        return Shape("rate", p.unit, edges, values.numpy())
    if effect.axis == "scan":
        edges, mean = _along_scan(values[:, None], scan, fast(scan))
        return Shape("scan", p.unit, edges, mean[:, 0])
    if effect.axis == "time×scan":
        edges, mean = _along_scan(values[:, first:last], scan)
        return Shape(effect.axis, p.unit, edges, mean, np.arange(first, last + 1.0))
    if effect.axis == "time×wall":
        left, size, _ = torch.linalg.svd(values[:, first:last], full_matrices=False)
        values = left[:, 0] * size[0] / math.sqrt(last - first)
    place = torch.clamp(((scan.places[-1] + 1) / 2 * SIDE).long(), 0, SIDE - 1)
    mean = _means(values[:, None], place[:, 0] * SIDE + place[:, 1], SIDE**2).reshape(SIDE, SIDE)
    edges_x, edges_y = (c + np.linspace(-scan.half, scan.half, SIDE + 1) for c in scan.centre.tolist())
    return Shape(effect.axis, p.unit, edges_x, mean, edges_y)


def _along_scan(values: Tensor, scan: Scan, number: int = 64) -> tuple[np.ndarray, np.ndarray]:
    number = min(number, scan.n_spots)
    band = ((scan.rank + 1) / 2 * number).long().clamp(0, number - 1)
    return np.linspace(0, scan.n_spots, number + 1), _means(values, band, number)


def _means(values: Tensor, band: Tensor, number: int) -> np.ndarray:
    total = torch.zeros(number, values.shape[1]).index_add_(0, band, values)
    spots = torch.zeros(number).index_add_(0, band, torch.ones(len(band)))
    return (total / spots[:, None]).numpy()


def facts_of(capture: Capture, name: str) -> dict[str, Any]:
    """What a diagnosis says of its capture.

    Args:
        capture: that was diagnosed.
        name: of it.

    Returns:
        JSON-serialisable; ``wall`` is the scanned part, ``[x0, x1, y0, y1]``, m.
    """
    first, last = capture.gate
    order = capture.scan_order
    points = capture.sensor if np.ptp(capture.sensor, axis=0).max() > 0 else capture.laser
    low, high = points.min(axis=0), points.max(axis=0)
    return {
        "name": name,
        "kind": capture.kind,
        "spots": capture.n_spots,
        "bins": capture.n_bins,
        "bin_length": capture.bin_length,
        "bin_width_ps": capture.bin_width_ps,
        "wall": [round(float(v), 4) for v in (low[0], high[0], low[1], high[1])],
        "counts_per_spot": float(capture.counts[:, first:last].sum() / capture.n_spots),
        "gate": list(capture.gate),
        "scan_order": "raster" if np.array_equal(order, np.arange(len(order))) else "as given",
    }
