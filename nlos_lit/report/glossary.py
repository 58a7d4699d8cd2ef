"""What the report's words mean, where someone points at one, and in a list at its end."""

from __future__ import annotations

import html
import re
from types import MappingProxyType

GLOSSARY = MappingProxyType(
    {
        "counting noise": "Photons come by chance: n expected ones scatter by √n. No simulation can be nearer"
        " to a measurement than that.",
        "deviance per bin": "How unlikely the counts of a bin are under the simulation, twice the logarithm;"
        " about 1 where only chance is left and counts are many.",
        "direct pulse": "Light that goes from the laser's spot on the wall straight to the detector. It lies"
        " outside the gate, no fit sees it, and so it can bear witness.",
        "evidence": "The logarithm of the odds that the counts give to a term against none, in nats: 3 nats"
        " are odds of 20 to 1, 7 are 1000 to 1.",
        "excess misfit": "What the simulation leaves above counting noise.",
        "free term": "A correction without a physical name, of any form along one axis: it says that"
        " something is wrong and where, not what.",
        "gate": "The time bins that are fitted, after the direct pulse.",
        "held-out spots": "Wall points whose counts nothing was fitted to; they were used to choose between"
        " terms.",
        "nats": "Units of the natural logarithm of a probability.",
        "NMSE": "Σ(measured − simulated)² / Σ measured², over the gate.",
        "retained": "The share of an effect's trace that is left once scene, albedo and response have adapted"
        " to it. What retains little can hardly be told from another scene.",
        "simulated captures": "Counts drawn from the fitted simulation, diagnosed like the real ones: how"
        " often chance alone finds as much.",
        "spot": "A point of the wall that was lit or looked at, with its own histogram.",
        "untouched spots": "Wall points that took part in nothing, neither in fitting nor in choosing.",
    }
)


def glossed(text: str, known: set[str]) -> str:
    """Escaped text in which the first appearance of each word of the glossary can be pointed at.

    Args:
        text: plain.
        known: words that need no more explaining; those that are explained here are added.

    Returns:
        HTML.

    Examples:
        >>> known = {"nats"}
        >>> print(glossed("9 nats beside the gate < 3", known)[:54], sorted(known))
        9 nats beside the <dfn class="term" tabindex="0" data- ['gate', 'nats']
    """
    pattern = "|".join(sorted(map(re.escape, GLOSSARY), key=len, reverse=True))

    def explained(match: re.Match[str]) -> str:
        word = match[0]
        if word in known:
            return word
        known.add(word)
        says = html.escape(GLOSSARY[word])
        return f'<dfn class="term" tabindex="0" data-says="{says}">{word}</dfn>'

    return re.sub(rf"\b(?:{pattern})\b", explained, html.escape(text))


def glossary_list() -> str:
    """All words, as an HTML list."""
    entries = (f"<dt>{html.escape(w)}</dt><dd>{html.escape(says)}</dd>" for w, says in GLOSSARY.items())
    return f"<dl>{''.join(entries)}</dl>"
