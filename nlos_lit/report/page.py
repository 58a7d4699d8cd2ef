"""The diagnosis as one page that opens anywhere, as JSON, and as figures."""

from __future__ import annotations

import base64
import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter

from nlos_lit.effects.formulas import FORMULAS, written
from nlos_lit.inference.result import Accepted, Diagnosis, Followed, Further
from nlos_lit.io.files import whole_file, write_json
from nlos_lit.report.advice import advised, confidence, next_step
from nlos_lit.report.diagnosis_figures import by_evidence, diagnosis_figures
from nlos_lit.report.glossary import glossary_list, glossed
from nlos_lit.report.page_style import CSS
from nlos_lit.report.quantities import NONE, amount, amount_of, headline, number, percent, quantity
from nlos_lit.report.style import save_figure
from nlos_lit.report.together import rows, told_apart
from nlos_lit.report.verdict import (
    at_noise,
    barely,
    follows,
    invisible,
    misfit,
    missing,
    rivals,
    sureness,
    tone,
    verdict,
    weight_of,
)
from nlos_lit.report.words import AXES, capital, describe

CAPTIONS = {
    "residual_time": "Residual along time, all spots together: how many standard deviations the counts lie"
    " above the simulation.",
    "residual_depth": "Residual along depth.",
    "residual_wall": "Residual over the wall, as seen from the wall. Grey spots were kept back to score the"
    " last model only.",
    "residual_scan": "Residual in the order in which the spots were recorded.",
    "residual_rate": "Residual against how bright a spot is.",
    "deviance": "Misfit without any, without each and with all of what was accepted, and on spots that"
    " nothing was chosen with. Grey: only counting noise is left.",
    "effects": "Parameters of the accepted effects and free terms.",
    "screening": "How much the counts ask for every known effect and free term by itself, before any was"
    " accepted.",
    "detection_limits": "How strong each would have to be to be named in nine of ten cases.",
    "witness_maps": "The direct pulse, which lies outside the gate, against the wall gain that was fitted"
    " inside it.",
    "witness_tail": "The direct pulse's own decay against the tail that was fitted inside the gate.",
    "witness_delays": "When each spot's direct pulse comes against the delay that was fitted inside the gate,"
    " both over the mean of the spot's neighbours.",
}
SCATTERED = 1.5  # scatter from which on it is said
FACTS = {
    "bin_width_ps": "bin width (ps)",
    "bin_length": "bin length (m of path)",
    "gate": "gate (bins)",
    "counts_per_spot": "counts a spot",
}


class Markup(str):
    """Text that is HTML already; anything else is escaped."""


def write_report(
    diagnosis: Diagnosis,
    folder: Path | str,
    extra_figures: Mapping[str, Figure] | None = None,
    scene: Sequence[str] = (),
) -> Path:
    """Write ``report.html`` (all in one file), ``diagnosis.json``, ``figures/*.png`` and offered effects.

    Args:
        diagnosis: that is shown.
        folder: for the files.
        extra_figures: further figures by name, shown at the end.
        scene: settings of the command line that name the scene, for the command that the page proposes.

    Returns:
        The page's path.

    Raises:
        ValueError: an extra figure has the name of one of the diagnosis's own.
    """
    folder = Path(folder)
    own, extra = diagnosis_figures(diagnosis), dict(extra_figures or {})
    stems = [re.sub(r"[^\w-]+", "_", name) for name in [*own, *extra]]
    if len(set(stems)) < len(stems):
        raise ValueError(f"figures must have different names; found {sorted(stems)}")
    images: dict[str, Markup] = {}
    for stem, (name, figure) in zip(stems, [*own.items(), *extra.items()], strict=True):
        path = folder / "figures" / f"{stem}.png"
        save_figure(figure, path)
        images[name] = _image(name, path.read_bytes())
    write_json(folder / "diagnosis.json", diagnosis.to_dict())
    for term in diagnosis.unknown:
        if term.formula is not None and term.formula.offered:
            _write_effect(term.formula, diagnosis, folder / "effects")
    page = folder / "report.html"
    with whole_file(page) as partial:
        explorable = (folder / "explore.html").is_file()
        text = report_html(diagnosis, images, list(extra), scene, explorable, folder.parent)
        partial.write_text(text, encoding="utf-8")
    return page


def _write_effect(formula: Followed, diagnosis: Diagnosis, folder: Path) -> None:
    """The file of a formula that a free term follows, as an effect of its own."""
    share, size = percent(formula.share), headline(formula.name, formula.parameters)
    found = f"a diagnosis of {diagnosis.capture['name']}: {size}; {share} of the gain of a free term."
    kind = next(each for each in FORMULAS if each.name == formula.name)
    with whole_file(folder / f"{formula.name}.py") as partial:
        partial.write_text(written(kind, found), encoding="utf-8")


def log_figures(folder: Path | str, figures: Mapping[str, Figure]) -> None:
    """The figures in TensorBoard.

    Args:
        folder: gets an event file in its ``tensorboard``.
        figures: by name.
    """
    with SummaryWriter(Path(folder) / "tensorboard") as writer:
        for name, figure in figures.items():
            writer.add_figure(f"diagnosis/{name}", figure)


def report_html(
    diagnosis: Diagnosis,
    images: Mapping[str, Markup],
    extra: Iterable[str] = (),
    scene: Sequence[str] = (),
    explorable: bool = False,
    folder: Path | None = None,
) -> str:
    """The page.

    Args:
        diagnosis: that is shown.
        images: HTML of the figures, by name.
        extra: names of those that go to the end.
        scene: settings of the command line that name the scene.
        explorable: ``explore.html`` is beside it.
        folder: of the run, for the command that takes another capture; None names none.

    Returns:
        HTML that needs nothing but itself.
    """

    def shown(*starts: str) -> str:
        return "".join(
            image for name, image in images.items() if name.startswith(starts) and name not in set(extra)
        )

    name = str(diagnosis.capture.get("name", "capture"))
    found = missing(diagnosis)
    each = "<ol>" + "".join(f"<li>{_text(one)}</li>" for one in found) + "</ol>" if len(found) > 1 else ""
    known: set[str] = set()
    advice = next_step(diagnosis, scene, folder)
    command = f"<pre tabindex=0><code>{_text(advice.command)}</code></pre>" if advice.command else ""
    link = '<p><a href="explore.html">Explore scene, wall and transients</a></p>' if explorable else ""
    parts = [
        f'<header><p class="over">Diagnosis of {_text(name)}</p>'
        f'<h1 class="{tone(diagnosis)}">{_text(verdict(diagnosis, listed=False))}</h1>{each}'
        f"<h2>How sure is that?</h2><p>{glossed(confidence(diagnosis), known)}</p>"
        f'<div class="next"><h2>Do this next</h2><p>{glossed(advice.text, known)}</p>{command}</div>'
        f"{link}</header>",
        _misfit_bar(diagnosis),
        _section("How sure, in numbers", f"<p>{glossed(sureness(diagnosis), known)}</p>"),
        _section("What is likely, and not certain", _likely(diagnosis)) if diagnosis.likely else "",
        _section("What the simulation was extended with", _accepted(diagnosis, diagnosis.effects))
        if diagnosis.effects
        else "",
        _section("What no known effect explains", _unexplained(diagnosis) + shown("unknown_")),
        _section("Why, and what to do on the rig", _remedies(diagnosis))
        if diagnosis.effects or diagnosis.unknown
        else "",
        _section("What cannot be told apart here", _groups(diagnosis)) if diagnosis.groups else "",
        *(_section(f"What {_text(one.name)} says of it", _further(one)) for one in diagnosis.further),
        _section("Where simulation and measurement differ", _calm(diagnosis) + shown("residual_")),
        _section("The gain", _scores(diagnosis) + shown("deviance", "effects")),
        _section("Every known effect and free term, tested", shown("screening") + _screened(diagnosis))
        if diagnosis.screened
        else "",
        _section("What could not have been seen", _limits(diagnosis) + shown("detection_limits"))
        if diagnosis.screened
        else "",
        _section("The direct pulse as witness", _witness(diagnosis) + shown("witness_"))
        if diagnosis.witness
        else "",
        _section("Notes", "<ul>" + "".join(f"<li>{_text(n)}</li>" for n in diagnosis.notes) + "</ul>")
        if diagnosis.notes
        else "",
        _section("More figures", "".join(images[n] for n in extra)) if extra else "",
        _section("Capture and run", _facts(diagnosis)),
        _section("Words", glossary_list()),
    ]
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    title = f"<title>Diagnosis of {_text(name)}</title><style>{CSS}</style>"
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}{title}</head>\n<body><main>\n'
        + "\n".join(filter(None, parts))
        + "\n</main></body></html>\n"
    )


def _misfit_bar(diagnosis: Diagnosis) -> str:
    m = misfit(diagnosis)
    parts = {
        "noise": ("counting noise", m.noise),
        "explained": ("explained, by free terms too" if diagnosis.unknown else "explained", m.explained),
        "unexplained": ("unexplained", m.unexplained),
    }
    if at_noise(diagnosis):
        parts = {"noise": parts["noise"], "within": ("left, within what is called noise", m.unexplained)}
    total = sum(value for _, value in parts.values())
    if not (math.isfinite(total) and total > 0):
        return ""
    shares = {name: 100 * value / total for name, (_, value) in parts.items()}
    strip = "".join(
        f'<span class="{name}" style="width:{share:.2f}%"></span>'
        for name, share in shares.items()
        if share > 0
    )
    keys = "".join(
        f'<span><i class="{name}"></i>{label} {percent(value / total)} ({number(value)})</span>'
        for name, (label, value) in parts.items()
    )
    where = "spots that nothing was fitted to or chosen with" if m.untouched else "held-out spots"
    caption = f"<figcaption>Misfit of the simulation as it was (deviance per bin), on {where}.</figcaption>"
    return f'<figure><div class="bar">{strip}</div><div class="keys">{keys}</div>{caption}</figure>'


def _calm(diagnosis: Diagnosis) -> str:
    """Why bands that stand out are no finding, where there is none."""
    if diagnosis.effects or diagnosis.unknown:
        return ""
    largest = max(
        (float(np.nanmax(np.abs(p.before))) for p in diagnosis.profiles if np.isfinite(p.before).any()),
        default=math.nan,
    )
    if not largest > 3:
        return ""
    text = (
        f"Single bands reach {number(largest, 2)} σ: sums over many counts show errors that are far too small"
        " to matter in any one bin. No term that would take them away has the evidence it needs, so none of"
        " them is a finding, and nothing is marked."
    )
    return f"<p>{_text(text)}</p>"


def _accepted(diagnosis: Diagnosis, terms: Iterable[Accepted]) -> str:
    heads = [
        "Effect",
        "Size (± standard error)",
        "Evidence (nats)",
        "Gain on other spots",
        "May be instead",
    ]
    return _table(heads, [_accepted_row(diagnosis, term) for term in terms], "cards")


def _accepted_row(diagnosis: Diagnosis, effect: Accepted) -> list[Any]:
    bin_length = diagnosis.capture.get("bin_length")
    sizes = []
    for name, estimate in effect.parameters.items():
        first, *more = quantity(effect.name, name, estimate, bin_length)
        also = f"<small>{_text(' = '.join(['', *more]).strip())}</small>" if more else ""
        sizes.append(f"<div>{_text(name.replace('_', ' '))} <b>{_text(first)}</b> {also}</div>")
    gain = effect.heldout_gain
    low, high = gain.ci95
    held = (
        f"<b>{number(gain.nats_per_photon)}</b> nats a photon"
        f" <small>95 %: {number(low)} … {number(high)}</small>"
        f"<div>deviance per bin {number(gain.deviance_per_bin_before, 4)} →"
        f" {number(gain.deviance_per_bin_after, 4)}</div>"
    )
    others = [f"{name}{weight_of(weight)}" for name, weight in rivals(diagnosis, effect).items()]
    confused = f"{_text(', '.join(others) or 'nothing else')}" + (
        f"<div><small>split by: {_text(effect.split_by)}</small></div>" if effect.split_by else ""
    )
    title = f"<b>{_text(describe(effect.name).phrase)}</b> <small>{_text(effect.name)}</small>"
    size = Markup("".join(sizes) or NONE)
    return [Markup(title), size, number(effect.evidence), Markup(held), Markup(confused)]


def _remedies(diagnosis: Diagnosis) -> str:
    names = dict.fromkeys(
        [
            name
            for term in [*diagnosis.effects, *diagnosis.unknown]
            for name in [term.name, *rivals(diagnosis, term)]
        ]
    )
    words = [(describe(n).words, n) for n in names]
    return (
        "<dl>"
        + "".join(
            f"<dt>{_text(capital(w.phrase))} <small>{_text(n)}</small></dt>"
            f"<dd>{_text(w.cause)} <b>{_text(w.remedy)}</b></dd>"
            for w, n in words
        )
        + "</dl>"
    )


def _groups(diagnosis: Diagnosis) -> str:
    items = []
    for group in diagnosis.groups:
        terms = [t for t in [*diagnosis.effects, *diagnosis.unknown] if t.name in group]
        splits = [t.split_by for t in terms if t.split_by]
        how = f" – split by: {'; '.join(dict.fromkeys(splits))}" if splits else ""
        names = " or ".join(f"{describe(name).phrase} ({name})" for name in group)
        worked_out = "".join(advised(t) for t in terms)
        items.append(f"<li>{_text(names + how)}{_text(f'.{worked_out}' if worked_out else '')}</li>")
    return f"<p>These leave nearly the same trace in this capture.</p><ul>{''.join(items)}</ul>"


def _further(further: Further) -> str:
    heads = ["Was open", "Gain there over none of them (nats)", "Values", "Weight, all captures", "Verdict"]
    text = (
        f"{told_apart(further)} Only what was open was asked, each beside a scene of that capture's own, and"
        " judged by parts of the wall that were not fitted. What belongs to the wall or to how the rig stands"
        " must have the values that it had: where these keep less than half of what values fitted anew gain,"
        " it is judged by them."
    )
    return f"<p>{_text(text)}</p>" + _table(heads, rows(further), "cards")


def _likely(diagnosis: Diagnosis) -> str:
    """Terms that were tried and are not named, a paragraph each."""
    kept = (
        "it was fitted along with those that are"
        if diagnosis.effects or diagnosis.unknown
        else "the simulation was not extended with it"
    )
    return "".join(
        f"<p><b>{_text(capital(describe(one.name).phrase))}</b> was tried. With it spots that were not fitted"
        f" are predicted better by {number(one.nats)} ± {number(one.error, 2)} nats: it explains"
        f" {_text(percent(one.explained))} of what they leave unexplained without it. Its own evidence is"
        f" {number(one.evidence)} nats; {number(one.needed)} are needed, since what the scene leaves"
        f" unexplained may look like it by as much. So it is not named, and {kept}.</p>"
        for one in diagnosis.likely
    )


def _unexplained(diagnosis: Diagnosis) -> str:
    left = diagnosis.unexplained
    held = (
        f"{AXES.get(left.axis, left.axis)}: {number(left.evidence)} nats, {number(diagnosis.needed)} needed"
    )
    if not diagnosis.unknown:
        return f"<p>{_text(f'No free term is needed. The most evidence of one is {held}.')}</p>"
    what = (
        "A free term is a correction without a name, of any form along its axis."
        f" The most evidence is {held}."
    )
    told = "".join(f"<p>{_text(follows(term) + _offer(term))}</p>" for term in diagnosis.unknown)
    return f"<p>{_text(what)}</p>" + _accepted(diagnosis, diagnosis.unknown) + told


def _offer(term: Accepted) -> str:
    """Where the formula lies that a free term follows."""
    if term.formula is None or not term.formula.offered:
        return ""
    return (
        f" The file effects/{term.formula.name}.py beside this page holds it as an effect; copied to"
        " nlos_lit/effects and named in its __init__.py it is one of the registry."
    )


def _scores(diagnosis: Diagnosis) -> str:
    rows = {"held-out, base": diagnosis.base, "held-out, extended": diagnosis.extended}
    rows |= {f"untouched test, {name}": scores for name, scores in diagnosis.untouched_test.items()}
    heads = ["Spots", "Deviance per bin", "of which noise", "Transient NMSE", "of which noise"]
    return _table(
        heads,
        [
            [n, *(number(v, 4) for v in (s.deviance_per_bin, s.deviance_noise, s.nmse, s.nmse_noise_floor))]
            for n, s in rows.items()
        ],
    )


def _screened(diagnosis: Diagnosis) -> str:
    bin_length, rows = diagnosis.capture.get("bin_length"), []
    accepted = {term.name for term in [*diagnosis.effects, *diagnosis.unknown]}
    for one in by_evidence(diagnosis.screened):
        step = {**one.one_step, **one.shape}
        sizes = ", ".join(
            f"{n.replace('_', ' ')} {amount(one.name, n, v, bin_length)}" for n, v in step.items()
        )
        kept = percent(one.retained_information) + (" (barely identifiable)" if barely(one) else "")
        title = Markup(
            f"{_text(one.name)}{' <b>✔</b>' if one.name in accepted else ''}<br>"
            f"<small>{_text(describe(one.name).phrase)}</small>"
        )
        rows.append(
            [
                title,
                number(one.evidence),
                kept,
                number(one.scatter, 2) if one.scatter > SCATTERED else "",
                one.degrees,
                sizes or NONE,
            ]
        )
    heads = ["Effect", "Evidence (nats)", "Retained", "Scatter", "Coefficients", "First estimate"]
    text = (
        f"Ranked by evidence, of which {number(diagnosis.needed)} nats are needed (fewer by what acts where"
        " the scene sends no light, and by delays and gains of single spots: no misfit of the scene looks"
        " like these); ✔ accepted. Evidence alone"
        " is not enough: what is accepted also gains on other spots, and beats its rivals. Evidence:"
        " logarithm of the odds that the counts give to the term against none. Retained: what is left of its"
        " trace once scene, albedo and response have adapted. Scatter: how much more its trace varies over"
        f" the wall than counts do, where that is more than {SCATTERED}."
    )
    if any(s.name in accepted and s.evidence <= diagnosis.needed for s in diagnosis.screened):
        text += (
            " Accepted with less here: asked for when the model had other terms already. A scene without"
            " a strong effect imitates it, and asks for it no more."
        )
    return f"<p>{_text(text)}</p>" + _table(heads, rows)


def _limits(diagnosis: Diagnosis) -> str:
    bin_length, rows = diagnosis.capture.get("bin_length"), []
    for one in sorted(diagnosis.screened, key=lambda s: (not invisible(s), not barely(s))):
        limits = ", ".join(
            f"{n.replace('_', ' ')} {amount(one.name, n, v, bin_length)}" for n, v in one.detectable.items()
        )
        remark = (
            "barely identifiable: scene, albedo and response can imitate nearly all of it"
            if barely(one)
            else ""
        )
        rows.append([one.name, "at no possible strength" if invisible(one) else limits or NONE, remark])
    return _table(["Effect", "Would be named in nine of ten cases from", "Remark"], rows)


def _witness(diagnosis: Diagnosis) -> str:
    w, rows = diagnosis.witness or {}, []
    if w.get("direct_pulse_counts") is not None:
        rows.append(["Counts of the direct pulse", f"{w['direct_pulse_counts']:,.0f}"])
    r, fitted, direct = (
        w.get("wall_gain_correlation"),
        w.get("tail_decay_fitted_m"),
        w.get("tail_decay_direct_m"),
    )
    if r is not None:
        rows.append(["Correlation of the fitted wall gain with it (1: the same, 0: unrelated)", number(r)])
    if w.get("wall_gain_by_chance") is not None:
        chance = "Its largest with the pulse's map turned or mirrored: what smooth maps share by chance"
        rows.append([chance, number(w["wall_gain_by_chance"])])
    if fitted is not None:
        rows.append(["Decay of the fitted tail", amount_of("time", fitted)])
    if direct:
        rows.append(
            [
                "Decay of the direct pulse, early to late",
                " … ".join(amount_of("time", v) for v in direct),
            ]
        )
    if w.get("delay_correlation") is not None:
        apart = "Correlation of the spots' fitted delays with its own, each over its neighbours'"
        rows.append([apart, number(w["delay_correlation"])])
    return "<p>It lies outside the gate; no fit has used it.</p>" + _table(["Witness", "Value"], rows)


def _facts(diagnosis: Diagnosis) -> str:
    facts = {FACTS.get(k, k.replace("_", " ")): v for k, v in diagnosis.capture.items()}
    facts |= {"seed": diagnosis.seed, "toys": diagnosis.toys, "time taken (s)": diagnosis.seconds}
    return _table(
        ["Fact", "Value"], [[k, f"{v:.6g}" if isinstance(v, float) else str(v)] for k, v in facts.items()]
    )


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>" if body else ""


def _table(heads: list[str], rows: Iterable[list[Any]], style: str = "") -> str:
    top = "".join(f"<th>{_text(h)}</th>" for h in heads)
    lines = (
        "".join(f'<td data-label="{_text(h)}">{_text(cell)}</td>' for h, cell in zip(heads, row, strict=True))
        for row in rows
    )
    return (
        f'<div class="wide" tabindex="0"><table class="{style}"><thead><tr>{top}</tr></thead><tbody><tr>'
        + "</tr><tr>".join(lines)
        + "</tr></tbody></table></div>"
    )


def _image(name: str, png: bytes) -> Markup:
    term = name.removeprefix("unknown_")
    base = (
        f"The free term {term}: {describe(term).phrase}; 0 is no change."
        if term != name
        else CAPTIONS.get(name) or CAPTIONS.get(re.sub(r"_\d+$", "", name)) or name.replace("_", " ")
    )
    data = base64.b64encode(png).decode("ascii")
    return Markup(
        f'<figure><img alt="{_text(base)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{_text(base)}</figcaption></figure>"
    )


def _text(value: Any) -> str:
    return value if isinstance(value, Markup) else html.escape(str(value))
