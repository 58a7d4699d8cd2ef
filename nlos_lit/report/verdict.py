"""The diagnosis in a few sentences, and how much of the misfit it explains."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from nlos_lit.inference.result import Accepted, Diagnosis, Scores, Screened
from nlos_lit.report.quantities import headline, number, percent, probability
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


def rivals(diagnosis: Diagnosis, term: Accepted) -> dict[str, float | None]:
    """What this capture leaves open instead of a term.

    Args:
        diagnosis: with groups of names that cannot be told apart.
        term: that was accepted.

    Returns:
        Weights by name, the largest first, None where a name has none; without the term itself.
    """
    weighed = sorted(term.confusable_with, key=lambda name: -term.weights[name])
    grouped = [name for group in diagnosis.groups if term.name in group for name in group]
    return {name: term.weights.get(name) for name in [*weighed, *grouped] if name != term.name}


def barely(screened: Screened) -> bool:
    """Scene, albedo and response can imitate nearly all of the effect in this capture."""
    return not screened.retained_information >= BARELY  # NaN included


def invisible(screened: Screened) -> bool:
    """No physically possible strength would have shown."""
    limits, known = screened.detectable.items(), describe(screened.name)
    return bool(limits) and all(not math.isfinite(v) or (known.number(n).share and v > 1) for n, v in limits)


def tone(diagnosis: Diagnosis) -> str:
    """``fine``, ``found`` or ``unexplained``."""
    open_ = diagnosis.likely and not diagnosis.effects and excess_share(diagnosis) > AT_NOISE
    if diagnosis.unknown or open_:
        return "unexplained"
    return "found" if diagnosis.effects else "fine"


def excess_share(diagnosis: Diagnosis) -> float:
    """How far the base is above counting noise, as a share of that, where it was scored last."""
    base, *_ = _scored(diagnosis)
    return _excess(base) / base.deviance_noise


def at_noise(diagnosis: Diagnosis) -> bool:
    """No term was needed, and hardly anything is left that one could be needed for."""
    return tone(diagnosis) == "fine" and not excess_share(diagnosis) > AT_NOISE


def missing(diagnosis: Diagnosis) -> list[str]:
    """What the simulation misses, in plain words: each effect, with what it may be instead."""
    return [_one(diagnosis, effect) for effect in diagnosis.effects]


def verdict(diagnosis: Diagnosis, listed: bool = True) -> str:
    """What is wrong, in plain words and a few sentences.

    Args:
        diagnosis: the whole.
        listed: say each of several things; else they are only counted.

    Returns:
        What is missing, whether something else is wrong, how much of the misfit all that explains, and what
        is likely besides.
    """
    said = _found(diagnosis, listed)
    if diagnosis.likely and (diagnosis.effects or diagnosis.unknown):
        first = diagnosis.likely[0]
        return (
            f"{said} Likely besides, and not certain: {describe(first.name).phrase},"
            f" {percent(first.explained)} of what is left elsewhere on the wall."
        )
    return said


def _found(diagnosis: Diagnosis, listed: bool) -> str:
    found, share = missing(diagnosis), misfit(diagnosis).share
    said = ""
    if share is not None:
        said = f"{percent(min(share, 1.0)) if share > 0 else 'none'} of the excess misfit"
    if not found:
        if not diagnosis.unknown:
            return _nothing(diagnosis)
        holds = f" {_free_terms(diagnosis, said)}." if said else ""
        return f"{_wrong(diagnosis, 'Something')}.{holds}"
    if len(found) == 1:
        text = f"Your simulation misses {found[0]}"
    else:
        every = ": " + "; ".join(f"({k}) {one}" for k, one in enumerate(found, 1))
        text = f"Your simulation misses {len(found)} things{every if listed else ''}"
    beside = " with what is likely besides" if diagnosis.likely else ""
    if not diagnosis.unknown:
        what = "it" if len(found) == 1 else "them"
        return f"{text}; modelling {what}{beside} explains {said}." if said else f"{text}."
    text += f". {_wrong(diagnosis, 'Something else')}"
    held = _held(diagnosis)
    if held is not None:
        sentence = _free_terms(diagnosis, f"{percent(held)} of the excess misfit")
        text += f"; {sentence[0].lower()}{sentence[1:]}"
    return f"{text}. Modelling all of them{beside} explains {said}." if said else f"{text}."


def sureness(diagnosis: Diagnosis) -> str:
    """How far the verdict can be trusted, in a few sentences."""
    terms = [*diagnosis.effects, *diagnosis.unknown]
    parts = [_evidence(diagnosis, terms)]
    if terms:
        sure = sum(term.heldout_gain.ci95[0] > 0 for term in terms)
        gain = "The gain" if sure == len(terms) else f"The gain of {sure} of {len(terms)} terms"
        parts.append(f"{gain} holds on wall blocks that were not fitted (95 % interval above 0).")
    parts.append(_chance(diagnosis))
    known = [s for s in diagnosis.screened if not describe(s.name).free]
    if known:
        hidden = sum(invisible(s) for s in known)
        hard = sum(barely(s) and not invisible(s) for s in known)
        parts.append(
            f"Effects tested: {len(known)}, of which {hard} barely identifiable in this capture,"
            f" {hidden} not at all."
        )
    if len(known) < len(diagnosis.screened):
        parts.append(f"Free terms tested: {len(diagnosis.screened) - len(known)}.")
    return " ".join(filter(None, parts))


def either(weights: Mapping[str, float | None]) -> str:
    """Several names as alternatives.

    Args:
        weights: of each, where there are any.

    Returns:
        Their phrases.

    Examples:
        >>> either({"irf_tail": 0.81, "wall_tilt": 0.19})
        "a slow detector tail (81 %) or a relay wall that is tilted against the scan's plane (19 %)"
    """
    return _joined([_with_weight(describe(name).phrase, weight) for name, weight in weights.items()], "or")


def weight_of(weight: float | None) -> str:
    """A weight behind a name; empty where there is none."""
    return "" if weight is None else f" ({percent(weight, 1)})"


def _with_weight(phrase: str, weight: float | None) -> str:
    """One bracket, where the phrase ends with one."""
    if weight is None or not phrase.endswith(")"):
        return phrase + weight_of(weight)
    return f"{phrase[:-1]}; {percent(weight, 1)})"


def _one(diagnosis: Diagnosis, effect: Accepted) -> str:
    size, others = headline(effect.name, effect.parameters), rivals(diagnosis, effect)
    if not others:
        return f"{describe(effect.name).phrase}: {size}" if size else describe(effect.name).phrase
    open_ = either({effect.name: effect.weights.get(effect.name), **others})
    first = "former" if len(others) == 1 else "first"
    return f"{open_}: this capture cannot tell which" + (f"; the {first} would be {size}" if size else "")


def _wrong(diagnosis: Diagnosis, what: str) -> str:
    """Where free terms were needed, and what each may be instead."""
    axes = dict.fromkeys(AXES.get(term.axis, f"along {term.axis}") for term in diagnosis.unknown)
    text = f"{what} is wrong {_joined(list(axes), 'and')} that no known effect explains"
    others = {name: w for term in diagnosis.unknown for name, w in rivals(diagnosis, term).items()}
    return text + (f", unless it is {either(others)}: this capture cannot tell" if others else "")


def _free_terms(diagnosis: Diagnosis, what: str) -> str:
    several = len(diagnosis.unknown) > 1
    return f"{len(diagnosis.unknown)} free terms hold {what}" if several else f"A free term holds {what}"


def follows(term: Accepted) -> str:
    """Which formula a free term follows, in a few sentences.

    Args:
        term: that was accepted.

    Returns:
        Empty where none was asked for.
    """
    formula = term.formula
    if formula is None:
        return ""
    size, kept = headline(formula.name, formula.parameters), percent(max(formula.share, 0.0))
    told = f"{describe(formula.name).phrase} (f = {formula.equation}; {size})"
    if not formula.offered:
        return f"No formula that was tried follows it; the nearest is {told}, which keeps {kept} of its gain."
    return f"It follows {told}: this keeps {kept} of its gain on spots that were not fitted."


def _held(diagnosis: Diagnosis) -> float | None:
    """Share of the excess misfit that the free terms hold by themselves; None where that is not known."""
    excess = _excess(diagnosis.base)
    gains = [term.heldout_gain for term in diagnosis.unknown]
    held = sum(gain.deviance_per_bin_before - gain.deviance_per_bin_after for gain in gains)
    return min(held / excess, 1.0) if excess > 0 and math.isfinite(held) else None


def _evidence(diagnosis: Diagnosis, terms: list[Accepted]) -> str:
    """How much the counts ask for what was found, or for what comes nearest to being found."""
    needed = f"{number(diagnosis.needed)} are needed"
    found = [term.evidence for term in terms if math.isfinite(term.evidence)]
    if found:
        least = "each of them is at least" if len(terms) > 1 else "it is"
        bars = [diagnosis.needed if term.needed is None else term.needed for term in terms]
        low, high = number(min(bars)), number(max(bars))
        asked = low if low == high else f"{low} – {high}"
        return f"The evidence for {least} {number(min(found))} nats; {asked} are needed."
    pool = [s for s in diagnosis.screened if math.isfinite(s.evidence)]
    if terms or not pool:
        return ""
    most = max(pool, key=lambda s: s.evidence)
    text = f"The most evidence, {number(most.evidence)} nats, is for {describe(most.name).phrase}; {needed}"
    return f"{text}, but other spots did not confirm it." if most.evidence > diagnosis.needed else f"{text}."


def _chance(diagnosis: Diagnosis) -> str:
    """How often as much comes up without any effect; counting allows no less than one in toys + 1."""
    if not math.isfinite(diagnosis.chance):
        return ""
    if not diagnosis.toys:
        level = probability(diagnosis.chance)
        return f"As much without any effect: by theory, level {level}; no simulated captures were run."
    share = probability(max(diagnosis.chance, 1 / (diagnosis.toys + 1)))
    return (
        f"Of {diagnosis.toys} simulated captures without any effect, at most a share of {share} gave as much."
    )


def _joined(parts: list[str], word: str) -> str:
    return f" {word} ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def _nothing(diagnosis: Diagnosis) -> str:
    if at_noise(diagnosis):
        return "Nothing in the registry is needed: the fit is at the noise."
    if diagnosis.likely:
        first, above = diagnosis.likely[0], percent(excess_share(diagnosis))
        return (
            f"No cause is certain for what is left, {above} above counting noise. The likeliest is"
            f" {describe(first.name).phrase}, which explains {percent(first.explained)} of it elsewhere on"
            " the wall; a scene that the fitted surface cannot follow might look so, too."
        )
    return (
        f"Nothing in the registry is needed: what is left, {percent(excess_share(diagnosis))} above counting"
        " noise, has no clear shape along time, wall, scan or count rate; the fitted surface itself may be"
        " incomplete."
    )


def _scored(diagnosis: Diagnosis) -> tuple[Scores, Scores, bool]:
    """Base and extension on the untouched spots (True) where both were scored there, else held-out ones."""
    test = diagnosis.untouched_test
    if {"base", "extended"} <= set(test):
        return test["base"], test["extended"], True
    return diagnosis.base, diagnosis.extended, False


def _excess(scores: Scores) -> float:
    return scores.deviance_per_bin - scores.deviance_noise
