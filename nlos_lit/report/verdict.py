"""The diagnosis in one sentence, and how much of the misfit it explains."""

from __future__ import annotations

import math
from dataclasses import dataclass

from nlos_lit.inference.result import Accepted, Diagnosis, Scores, Screened
from nlos_lit.report.quantities import headline, percent, probability
from nlos_lit.report.words import AXES, describe

AT_NOISE = 0.03  # excess over counting noise that is called "at the noise"
BARELY = 0.05  # retained information below which the scene can imitate nearly all of an effect


@dataclass(frozen=True)
class Misfit:
    """Deviance per bin of the base, taken apart.

    Args:
        noise: what counting noise makes.
        explained: what the extension explains.
        unexplained: what is left.
        share: the explained part of the excess over noise, negative where the extension is worse; None
            without an excess.
        untouched: scored on spots that nothing was fitted to or chosen with.
    """

    noise: float
    explained: float
    unexplained: float
    share: float | None
    untouched: bool


def misfit(diagnosis: Diagnosis) -> Misfit:
    """The misfit on the untouched spots where they were scored, else on the held-out ones.

    Each fit stands against its own noise level.
    """
    base, extended, untouched = _scored(diagnosis)
    before, after = _excess(base), _excess(extended)
    if not (math.isfinite(before) and math.isfinite(after)) or before <= 0:
        return Misfit(base.deviance_per_bin, 0.0, 0.0, None, untouched)
    left = min(max(after, 0.0), before)
    return Misfit(base.deviance_noise, before - left, left, 1 - after / before, untouched)


def indistinguishable(diagnosis: Diagnosis, name: str) -> list[str]:
    """Effects that this capture cannot tell apart from one.

    Args:
        diagnosis: with groups of such effects.
        name: of the one.

    Returns:
        Names, each once, in the order of the groups.
    """
    return list(
        dict.fromkeys(
            other for group in diagnosis.groups if name in group for other in group if other != name
        )
    )


def barely(screened: Screened) -> bool:
    """Scene, albedo and response can imitate nearly all of the effect in this capture."""
    return not screened.retained_information >= BARELY  # NaN included


def invisible(screened: Screened) -> bool:
    """No physically possible strength would have shown."""
    limits, known = screened.detectable.items(), describe(screened.name)
    return bool(limits) and all(not math.isfinite(v) or (known.number(n).share and v > 1) for n, v in limits)


def tone(diagnosis: Diagnosis) -> str:
    """``fine``, ``found`` or ``unexplained``."""
    if diagnosis.unexplained.significant:
        return "unexplained"
    return "found" if diagnosis.effects or diagnosis.groups else "fine"


def missing(diagnosis: Diagnosis) -> list[str]:
    """What the simulation misses, in plain words: each effect, and each group without an accepted one."""
    names = {effect.name for effect in diagnosis.effects}
    found = [_one(diagnosis, effect) for effect in diagnosis.effects]
    for group in diagnosis.groups:
        if not names & set(group):
            found.append(f"one of these, and this capture cannot tell which: {_either(group)}")
    return found


def verdict(diagnosis: Diagnosis, listed: bool = True) -> str:
    """What is wrong, in plain words and one or two sentences.

    Args:
        diagnosis: the whole.
        listed: say each of several things; else they are only counted.

    Returns:
        What is missing, how much of the misfit it explains, and whether something else is wrong.
    """
    found = missing(diagnosis)
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
        every = ": " + "; ".join(f"({k}) {one}" for k, one in enumerate(found, 1))
        text = f"Your simulation misses {len(found)} things{every if listed else ''}"
    share = misfit(diagnosis).share
    if diagnosis.effects and share is not None:
        what = "it" if len(diagnosis.effects) == 1 else "them"
        text += f"; modelling {what} explains {percent(min(share, 1.0))} of the excess misfit"
    more = (
        f" Something is still wrong {axis} that no known effect explains."
        if diagnosis.unexplained.significant
        else ""
    )
    return text + "." + more


def sureness(diagnosis: Diagnosis) -> str:
    """How far the verdict can be trusted, in one or two sentences."""
    parts = []
    if diagnosis.effects:
        several = len(diagnosis.effects) > 1
        known = [e.p_value for e in diagnosis.effects if math.isfinite(e.p_value)]
        if known:
            what = "any one of these effects" if several else "this effect"
            parts.append(f"The chance that noise alone would look like {what} is {probability(max(known))}.")
        sure = sum(e.heldout_gain.ci95[0] > 0 for e in diagnosis.effects)
        gain = (
            "The gain"
            if sure == len(diagnosis.effects)
            else f"The gain of {sure} of {len(diagnosis.effects)} effects"
        )
        parts.append(f"{gain} holds on wall blocks that were not fitted (95 % interval above 0).")
    if diagnosis.unexplained.significant:
        left = diagnosis.unexplained
        parts.append(
            f"The chance that noise alone leaves what stays unexplained is {probability(left.p_value)}."
        )
    if diagnosis.screened:
        hidden = sum(invisible(s) for s in diagnosis.screened)
        hard = sum(barely(s) and not invisible(s) for s in diagnosis.screened)
        parts.append(
            f"Effects tested: {len(diagnosis.screened)}, of which {hard} barely identifiable in this capture,"
            f" {hidden} not at all."
        )
    if diagnosis.toys:
        parts.append(f"What noise alone does was checked on {diagnosis.toys} simulated captures.")
    else:
        parts.append("These probabilities are from theory alone: no simulated captures were run.")
    return " ".join(parts)


def _one(diagnosis: Diagnosis, effect: Accepted) -> str:
    size = headline(effect.name, effect.parameters)
    text = f"{describe(effect.name).phrase}: {size}" if size else describe(effect.name).phrase
    others = indistinguishable(diagnosis, effect.name)
    return f"{text} (or {_either(others)}: this capture cannot tell which)" if others else text


def _either(names: list[str]) -> str:
    phrases = [describe(name).phrase for name in names]
    return " or ".join([", ".join(phrases[:-1]), phrases[-1]] if len(phrases) > 1 else phrases)


def _nothing(diagnosis: Diagnosis) -> str:
    base, *_ = _scored(diagnosis)
    excess = _excess(base) / base.deviance_noise
    if not excess > AT_NOISE:
        return "Nothing in the registry is needed: the fit is at the noise."
    return (
        f"Nothing in the registry is needed: what is left, {percent(excess)} above counting noise, has no"
        " clear shape along time, wall, scan or count rate; the fitted surface itself may be incomplete."
    )


def _scored(diagnosis: Diagnosis) -> tuple[Scores, Scores, bool]:
    """Base and extension on the untouched spots (True) where both were scored there, else held-out ones."""
    test = diagnosis.untouched_test
    if {"base", "extended"} <= set(test):
        return test["base"], test["extended"], True
    return diagnosis.base, diagnosis.extended, False


def _excess(scores: Scores) -> float:
    return scores.deviance_per_bin - scores.deviance_noise
