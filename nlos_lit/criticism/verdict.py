"""The diagnosis in one sentence, and how much of the misfit it explains."""

from __future__ import annotations

import math
from dataclasses import dataclass

from nlos_lit.criticism.quantities import headline, number, percent, probability
from nlos_lit.criticism.result import Accepted, Diagnosis, Scores, Screened
from nlos_lit.criticism.words import AXES, describe

AT_NOISE = 0.03  # excess over counting noise that is called "at the noise"
BARELY = 0.05  # retained information below which an effect cannot be told from the scene


@dataclass(frozen=True)
class Misfit:
    """Deviance per bin of the base, taken apart: what counting noise makes, what the extension explains, what is left.

    ``share`` is the explained part of the excess over noise, negative where the extension is worse; None without an excess.
    """

    noise: float
    explained: float
    unexplained: float
    share: float | None
    untouched: bool


def misfit(diagnosis: Diagnosis) -> Misfit:
    """On the untouched spots where they were scored, else on the held-out ones; each fit against its own noise level."""
    test = diagnosis.untouched_test
    untouched = {"base", "extended"} <= set(test)
    base, extended = (test["base"], test["extended"]) if untouched else (diagnosis.base, diagnosis.extended)
    before, after = _excess(base), _excess(extended)
    if not (math.isfinite(before) and math.isfinite(after)) or before <= 0:
        return Misfit(base.deviance_per_bin, 0.0, 0.0, None, untouched)
    left = min(max(after, 0.0), before)
    return Misfit(base.deviance_noise, before - left, left, 1 - after / before, untouched)


def rivals(diagnosis: Diagnosis, name: str) -> list[str]:
    """Effects that share a group with ``name``: this capture cannot tell them apart."""
    return list(dict.fromkeys(other for group in diagnosis.groups if name in group for other in group if other != name))


def could_not_be_seen(screened: Screened) -> bool:
    """The effect looks like scene, albedo or response in this capture, at any strength."""
    return not screened.retained_information >= BARELY  # NaN included


def tone(diagnosis: Diagnosis) -> str:
    """``fine``, ``found`` or ``unexplained``."""
    if diagnosis.unexplained.significant:
        return "unexplained"
    return "found" if diagnosis.effects or diagnosis.groups else "fine"


def verdict(diagnosis: Diagnosis) -> str:
    """What is wrong, in plain words and one or two sentences."""
    names = {effect.name for effect in diagnosis.effects}
    found = [_one(diagnosis, effect) for effect in diagnosis.effects]
    for group in diagnosis.groups:
        if not names & set(group):
            found.append(f"one of these, which this capture cannot tell apart: {_either(group)}")
    axis = AXES.get(diagnosis.unexplained.axis, "on some axis")
    if not found:
        return (
            f"Something is wrong {axis} that no known effect explains."
            if diagnosis.unexplained.significant
            else _nothing(diagnosis)
        )
    if len(found) == 1:
        text = f"Your simulation misses {found[0]}"
    else:
        text = f"Your simulation misses {len(found)} things: " + "; ".join(f"({k}) {one}" for k, one in enumerate(found, 1))
    share = misfit(diagnosis).share
    if diagnosis.effects and share is not None:
        what = "it" if len(diagnosis.effects) == 1 else "them"
        text += f"; modelling {what} explains {percent(min(share, 1.0))} of the excess misfit"
    more = f" Something is still wrong {axis} that no known effect explains." if diagnosis.unexplained.significant else ""
    return text + "." + more


def sureness(diagnosis: Diagnosis) -> str:
    """How far the verdict can be trusted, in one or two sentences."""
    parts = []
    if diagnosis.effects:
        worst = max((e.p_value for e in diagnosis.effects), key=lambda p: math.inf if math.isnan(p) else p)
        sure = [e for e in diagnosis.effects if e.heldout_gain.ci95[0] > 0]
        every = "every accepted effect" if len(diagnosis.effects) > 1 else "the accepted effect"
        parts.append(f"Chance that noise alone looks like {every}: p = {probability(worst)} or less.".replace("= <", "<"))
        whole = len(sure) == len(diagnosis.effects)
        confirmed = "The gain holds" if whole else f"The gain of {len(sure)} of {len(diagnosis.effects)} effects holds"
        parts.append(f"{confirmed} on wall blocks that were not fitted (95 % interval above 0).")
    if diagnosis.unexplained.significant:
        parts.append(
            f"What stays unexplained is not chance: p = {probability(diagnosis.unexplained.p_value)} "
            f"(statistic {number(diagnosis.unexplained.statistic)}).".replace("= <", "<")
        )
    blind = [s for s in diagnosis.screened if could_not_be_seen(s)]
    if diagnosis.screened:
        seen = len(diagnosis.screened) - len(blind)
        parts.append(
            f"{len(diagnosis.screened)} effects were tested; {seen} could have been seen in this capture, {len(blind)} could not."
        )
    toys = (
        f"calibrated with {diagnosis.toys} simulated captures"
        if diagnosis.toys
        else "from theory alone: no simulated captures were run"
    )
    parts.append(f"p-values are {toys}.")
    return " ".join(parts)


def _one(diagnosis: Diagnosis, effect: Accepted) -> str:
    size = headline(effect.name, effect.parameters)
    text = f"{describe(effect.name).phrase}: {size}" if size else describe(effect.name).phrase
    others = rivals(diagnosis, effect.name)
    return f"{text} – or {_either(others)}, which this capture cannot tell apart" if others else text


def _either(names: list[str]) -> str:
    phrases = [describe(name).phrase for name in names]
    return " or ".join([", ".join(phrases[:-1]), phrases[-1]] if len(phrases) > 1 else phrases)


def _nothing(diagnosis: Diagnosis) -> str:
    excess = _excess(diagnosis.base) / diagnosis.base.deviance_noise
    if not excess > AT_NOISE:
        return "Nothing in the registry is needed: the fit is at the noise."
    return f"Nothing in the registry is needed: what is left, {percent(excess)} above counting noise, is not significant."


def _excess(scores: Scores) -> float:
    return scores.deviance_per_bin - scores.deviance_noise
