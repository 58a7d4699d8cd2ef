"""What to make of a diagnosis: how sure it is in plain words, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nlos_lit.inference.advise import AGAIN
from nlos_lit.inference.members import Member
from nlos_lit.inference.result import Accepted, Diagnosis
from nlos_lit.report.quantities import number, percent
from nlos_lit.report.verdict import at_noise, excess_share, follows, invisible, rivals
from nlos_lit.report.words import capital, describe

# What tells where something without a name comes from, by the axis that it lies along.
TELLS = {
    "time": "Record the direct pulse alone and lay its shape beside the one below: what they share is the"
    " instrument's. Then begin the gate later and diagnose again: what stays is none of the early light.",
    "depth": "See whether the volume ends where the residual stands out (scene.volume.depth), and diagnose"
    " again with a deeper one.",
    "wall": "Lay the map below beside a photograph of the wall and the direct pulse of each spot. Then scan"
    " again with the hidden scene moved: what keeps its place belongs to the wall or the optics.",
    "scan": "Scan the same wall again in another order, for example backwards: what keeps its place on the"
    " wall is not the scan's, what keeps its time is the rig's.",
    "rate": "Record again at half the laser power: what becomes smaller comes from how photons are counted.",
    "time×scan": "Record the direct pulse again and again for as long as a scan takes: a response that"
    " changes shows there without any scene.",
    "time×wall": "Record the direct pulse at the corners and the middle of the wall: a response that changes"
    " over it shows there without any scene.",
    "spot": "Record the same capture again: what comes back at the same spots belongs to them.",
}
MORE = 2.0  # times what the same scan again tells, from which on another capture is advised
FINDER = "See whether the shape below follows anything you know of the rig, and record the capture again."


@dataclass(frozen=True)
class Advice:
    """What to do next.

    Args:
        text: a few sentences.
        command: to be typed; empty where there is none.
    """

    text: str
    command: str = ""


def confidence(diagnosis: Diagnosis) -> str:
    """How far the verdict can be trusted, without a number that needs explaining.

    Args:
        diagnosis: the whole.

    Returns:
        one word and what it means, in a few sentences.
    """
    terms = [*diagnosis.effects, *diagnosis.unknown]
    if not terms:
        return _of_nothing(diagnosis)
    several = len(terms) > 1
    it = "each of them" if several else "it"
    held = all(term.heldout_gain.ci95[0] > 0 for term in terms)
    asked = f"the counts ask for {it} by more than is needed"
    if any(rivals(diagnosis, term) for term in terms):
        first = "Open: that something is there is " + ("well supported" if held else "likely")
        text = f"{first}, but what it is this capture cannot tell: more than one cause would look like this."
    elif any(term.needed is not None and term.evidence <= term.needed for term in terms):
        text = (
            f"Fair: parts of the wall that nothing was fitted to are predicted much better with {it}, but a "
            "scene that the fitted surface cannot follow might look so, too."
        )
    elif held:
        text = f"Good: {asked}, and {it} also predicts parts of the wall that nothing was fitted to."
    else:
        text = f"Fair: {asked}; that {it} predicts other parts of the wall better may still be chance."
    if not diagnosis.toys:
        text += " How often as much comes up by itself was not counted here: criticism.toys=20 counts it."
    return text


def next_step(diagnosis: Diagnosis, scene: Sequence[str] = (), folder: Path | None = None) -> Advice:
    """The one thing to do first.

    Args:
        diagnosis: the whole.
        scene: settings of the command line that name the scene.
        folder: of the run that was diagnosed; None where it is not known.

    Returns:
        on the rig, or at the keyboard.
    """
    base = ["nlos", "train", *scene]
    found = sorted(diagnosis.effects, key=_gain, reverse=True)
    if found:
        first = found[0]
        names = [*(e.name for e in diagnosis.effects), *diagnosis.along]
        known = shlex.join([*base, f"effects=[{','.join(names)}]"])
        others = rivals(diagnosis, first)
        if others and first.split_by:
            asked = "" if folder is None else f"nlos diagnose {shlex.quote(str(folder))} --split-with FILE\n"
            return Advice(
                f"Tell the candidates apart: take {first.split_by}.{advised(first)}"
                + (" Where that is a capture of the scene, the first command asks it." if asked else "")
                + " Until then the reconstruction can be made with the first of them in the model:",
                asked + known,
            )
        remedy = describe(first.name).words.remedy
        more = " Then the next one." if len(found) > 1 else ""
        return Advice(f"{remedy}{more} Or leave the rig as it is and put it into the model:", known)
    if diagnosis.unknown:
        worst = max(diagnosis.unknown, key=_gain)
        known = f" {follows(worst)}" if worst.formula is not None and worst.formula.offered else ""
        return Advice(
            f"{TELLS.get(worst.axis, FINDER)} Until it has a name, read the picture with care where the"
            f" residual below stands out.{known}"
        )
    likely = [one.name for one in diagnosis.likely if not describe(one.name).free]
    if likely and not at_noise(diagnosis):
        name = likely[0]
        return Advice(
            f"To be certain: {describe(name).words.remedy} Or put it into the model, and see whether the"
            " picture becomes clearer:",
            shlex.join([*base, f"effects=[{name}]"]),
        )
    refined = shlex.join([*base, "refine=true"])
    if at_noise(diagnosis):
        return Advice(
            "Nothing needs repair. Reconstruct with the simulation as it is; to see finer, count longer:",
            refined,
        )
    return Advice(
        "Look first at the scene, not at the rig: see whether the volume ends where the residual map below"
        " stands out (scene.volume.depth), and let a finer surface try:",
        refined,
    )


def advised(term: Accepted) -> str:
    """Which capture would tell a term from its rivals, as worked out beforehand.

    Args:
        term: that was accepted.

    Returns:
        A sentence that begins with a space; empty where nothing was worked out.
    """
    if not term.advised:
        return ""
    again, best = term.advised[AGAIN], max(term.advised, key=lambda plan: term.advised[plan])
    if term.advised[best] < MORE * again:
        return f" By calculation the same scan again would tell as much as others: {number(again, 2)} nats."
    most = number(term.advised[best], 2)
    return f" By calculation {best} would tell {most} nats, the same scan again {number(again, 2)}."


def told_member(member: Member) -> str:
    """What is known of a term that was tried, while the diagnosis goes on.

    Args:
        member: the term.

    Returns:
        a sentence.
    """
    phrase, found = describe(member.name).phrase, member.confirmed
    if found is None:
        return f"{capital(phrase)}: tried."
    nats = f"{number(found.evidence)} nats beside all else, {number(found.needed)} needed"
    share = f"{percent(found.explained)} of what other spots leave unexplained without it"
    return f"{capital(phrase)}: {'holds' if member.accepted else 'does not hold'} ({nats}; {share})."


def _of_nothing(diagnosis: Diagnosis) -> str:
    known = [s for s in diagnosis.screened if not describe(s.name).free]
    hidden = sum(invisible(s) for s in known)
    blind = (
        f" {hidden} of {len(known)} could not have shown in this capture at any strength." if hidden else ""
    )
    if at_noise(diagnosis):
        return (
            "Good, within limits: the simulation predicts spots that it was not fitted to as well as counting"
            f" allows. Effects weaker than those listed below may still be there.{blind}"
        )
    share = excess_share(diagnosis)
    if diagnosis.likely:
        return (
            "Open: what is likely predicts parts of the wall that nothing was fitted to, but its own evidence"
            f" is less than what a misfit of the scene could look like.{blind}"
        )
    return (
        f"Limited: the simulation is {percent(share)} above counting noise, for no reason that could be told,"
        f" and weak effects may hide in that.{blind}"
    )


def _gain(term: Accepted) -> float:
    gain = term.heldout_gain
    return gain.deviance_per_bin_before - gain.deviance_per_bin_after
