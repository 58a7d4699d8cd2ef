"""From the loop's findings to a :class:`~nlos_lit.inference.result.Diagnosis`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.inference.criticise import CriticismSettings, Findings, Trial, Turn, tested_rows, tested_spots
from nlos_lit.inference.discrepancy import Discrepancy
from nlos_lit.inference.form import Form
from nlos_lit.inference.refit import log_likelihood, score
from nlos_lit.inference.residuals import profiles
from nlos_lit.inference.result import Accepted, Diagnosis, Gain, Screened, Unexplained
from nlos_lit.inference.screen import Candidate
from nlos_lit.inference.split import Split
from nlos_lit.inference.toys import Null
from nlos_lit.inference.uncertainty import Uncertainty
from nlos_lit.inference.witness import witness
from nlos_lit.surfels.fit import SurfelFit

SEEN = 25.0  # statistic from which on an effect counts as detectable


@dataclass(frozen=True)
class Verdicts:
    """What the final fit leaves unexplained, and whether that casts doubt on the names."""

    unexplained: Unexplained
    dominates: bool


def assemble(
    capture: Capture,
    found: Findings,
    split: Split,
    scan: Scan,
    settings: CriticismSettings,
    null: Null | None,
    numerics: dict[str, float],
    name: str,
    seconds: float,
    seed: int,
) -> Diagnosis:
    """Everything the report says.

    Args:
        capture: that was diagnosed.
        found: by the loop.
        split: of its spots.
        scan: of the capture.
        settings: of the criticism.
        null: what toys of the base show; None where there are none.
        numerics: changes of the deviance when only the computation is varied.
        name: of the capture.
        seconds: the diagnosis took.
        seed: of it.

    Returns:
        The result, as it is written and shown.
    """
    base, final = found.base, found.final
    rows = tested_rows(final, split, settings.spots, seed)
    spots = split.fit[rows]
    counts, block = final.counts[rows], torch.from_numpy(split.block[spots])
    uncertainty = Uncertainty(final, torch.from_numpy(spots), counts, block, len(rows) / len(split.fit))
    verdicts = judge(found, split, settings)
    fresh = (
        found.again.extension.effects
        if found.again is not None and sensible(found.again, base, split)
        else []
    )
    effects, groups, notes = [], [], []
    for turn in [] if verdicts.dominates else found.accepted:
        trial = _taken(turn)
        p, feigned = weighed(trial.candidate, null, settings.level)
        if feigned:
            notes.append(
                f"{trial.name} improved the fit,"
                f" but captures simulated without it score as much (p = {p:.2g})"
            )
            continue
        effect = next(e for e in final.extension.effects if e.name == trial.name)
        again = next((e for e in fresh if e.name == effect.name), None)
        group = alternatives(turn, found.accepted)
        effects.append(_accepted(turn, effect, again, group, uncertainty, split, p))
        if group:
            groups.append([trial.name, *group])
    if verdicts.dominates:
        names = ", ".join(_taken(t).name for t in found.accepted)
        notes.append(f"{names}: improved the fit but left too much of what shows, and therefore not named")
        final = base
    if found.wrong is not None:
        notes.append(_of_another_form(found.wrong))
    fitted, test = torch.from_numpy(np.concatenate([split.fit, split.select])), split.test
    return Diagnosis(
        effects=effects,
        groups=groups,
        unexplained=verdicts.unexplained,
        screened=[_screened(c, null) for c in found.turns[0].candidates],
        base=score(base, split.select),
        extended=score(final, split.select),
        untouched_test={"base": score(base, test), "extended": score(final, test)},
        witness=witness(capture, final),
        profiles=profiles(base, final, scan, fitted),
        numerics=numerics,
        notes=notes,
        capture=_facts(capture, name),
        toys=0 if null is None else null.toys,
        seconds=seconds,
        seed=seed,
    )


def weighed(candidate: Candidate, null: Null | None, level: float) -> tuple[float, bool]:
    """How sure an effect is.

    Args:
        candidate: that was screened.
        null: what toys of the base show; None where there are none.
        level: p-value up to which an effect is significant.

    Returns:
        p-value, by toys where there are any, and whether it was only they who spoke against the effect.
    """
    p = candidate.p_value if null is None else null.p_value(candidate)
    return p, candidate.p_value <= level < p


def alternatives(turn: Turn, accepted: list[Turn]) -> list[str]:
    """A turn's group without what is needed beside its effect: that is no other name for it.

    Args:
        turn: of the loop.
        accepted: all turns that accepted an effect.

    Returns:
        Names of effects.
    """
    names = {_taken(t).name for t in accepted}
    return [name for name in turn.group if name not in names]


def _of_another_form(form: Form) -> str:
    share = f"({form.gain:.0f} nats, of {form.own:.0f} that it changes itself)"
    why = (
        f"would need another strength in every stretch of the {form.axis} axis {share}"
        if form.axis == "time"
        else f"is a falling function of the scene's own count rate {share}, of which it should know nothing"
    )
    return f"{form.name} improved the fit, but {why}, and is therefore not named"


def judge(found: Findings, split: Split, settings: CriticismSettings) -> Verdicts:
    """The largest flexible discrepancy that is left, and whether it outweighs what the named effects explain.

    A map that was taken back because it follows the count rate says so itself; another effect of the wrong
    form only where nothing else does.

    Args:
        found: by the loop.
        split: of the spots.
        settings: of the criticism.

    Returns:
        What is left, and whether it casts doubt on the names.
    """
    rest = [
        d for d in found.left if d.p_value * len(found.left) < settings.level and d.gain > settings.least_gain
    ]
    worst = max(rest, key=lambda d: d.gain, default=None)
    if found.wrong is not None:
        dominates = worst is not None and _outweighs(worst, found, split, settings)
        cause = found.wrong if worst is None or found.wrong.axis == "rate" else worst
        return Verdicts(Unexplained(True, cause.axis, cause.statistic, cause.p_value), dominates)
    if worst is None:
        calm = max(found.left, key=lambda d: d.gain)
        return Verdicts(Unexplained(False, calm.axis, calm.statistic, calm.p_value), False)
    return Verdicts(
        Unexplained(True, worst.axis, worst.statistic, worst.p_value),
        _outweighs(worst, found, split, settings),
    )


def _outweighs(left: Discrepancy, found: Findings, split: Split, settings: CriticismSettings) -> bool:
    """Whether names hold less than the share ``explained`` of the misfit.

    That is of all that they gain and is left, nats a spot; or, where most of what they were predicted to gain
    was of this very kind, of what the base had of it.
    """
    if not found.accepted:
        return False
    tested = tested_spots(found.final, split, settings.spots)
    spared = 1 - settings.explained
    named = sum(_taken(t).gain.nats for t in found.accepted) / len(split.select)
    if spared * named < settings.explained * left.gain / tested:
        return True
    had = next((d.gain for d in found.turns[0].discrepancies if (d.axis, d.of) == (left.axis, left.of)), 0.0)
    had *= tested / tested_spots(found.base, split, settings.spots)
    predicted = sum(_taken(t).candidate.gain for t in found.accepted)
    return had - left.gain > 0.5 * predicted and left.gain > spared * had


def sensible(again: SurfelFit, base: SurfelFit, split: Split) -> bool:
    """Whether a rebuild got somewhere: it is likelier than the base. Else it says nothing of the effects.

    Args:
        again: the rebuild, with effects.
        base: without them.
        split: of the spots; those selected with decide.

    Returns:
        True where its effects may be looked at.
    """
    with_, without = (float(log_likelihood(fit, split.select).sum()) for fit in (again, base))
    return with_ > without


def _taken(turn: Turn) -> Trial:
    """What a turn accepted, where it did."""
    assert turn.accepted is not None
    return turn.accepted


def _accepted(
    turn: Turn,
    effect: Effect,
    again: Effect | None,
    group: list[str],
    uncertainty: Uncertainty,
    split: Split,
    p: float,
) -> Accepted:
    trial = _taken(turn)
    return Accepted(
        name=effect.name,
        parameters=uncertainty.parameters(effect, again),
        statistic=trial.candidate.statistic,
        p_value=p,
        heldout_gain=_gain(trial, split),
        confusable_with=group,
        split_by="; ".join(sorted({EFFECTS.splitting(effect.name, other) for other in group} - {""})),
    )


def _gain(trial: Trial, split: Split) -> Gain:
    fit, spots = trial.fit, split.select
    first, last = fit.capture.gate
    photons = float(fit.capture.counts[spots, first:last].sum())
    after = score(fit, spots).deviance_per_bin
    bins = len(spots) * (last - first)
    low, high = trial.gain.interval
    return Gain(
        after + 2 * trial.gain.nats / bins, after, trial.gain.nats / photons, (low / photons, high / photons)
    )


def _screened(candidate: Candidate, null: Null | None) -> Screened:
    effect, start = candidate.effect, 0
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
        detectable[p.name] = float(SEEN**0.5 * p.scale * error.square().mean().sqrt())
        start += p.size
    return Screened(
        name=effect.name,
        statistic=candidate.statistic,
        p_value=candidate.p_value if null is None else null.p_value(candidate),
        retained_information=candidate.retained,
        degrees=candidate.degrees,
        predicted_gain=candidate.gain,
        one_step=step,
        shape=candidate.shape,
        detectable=detectable,
        expected=float(candidate.degrees) if null is None else null.expected(candidate),
    )


def _facts(capture: Capture, name: str) -> dict[str, Any]:
    first, last = capture.gate
    order = capture.scan_order
    return {
        "name": name,
        "kind": capture.kind,
        "spots": capture.n_spots,
        "bins": capture.n_bins,
        "bin_length": capture.bin_length,
        "bin_width_ps": capture.bin_width_ps,
        "counts_per_spot": float(capture.counts[:, first:last].sum() / capture.n_spots),
        "gate": list(capture.gate),
        "scan_order": "raster" if np.array_equal(order, np.arange(len(order))) else "as given",
    }
