"""What a person who stands at the rig calls an effect, why it happens, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EffectWords:
    """An effect in plain words.

    Args:
        phrase: completes "Your simulation misses …".
        cause: the physics, one sentence.
        remedy: what to do on the rig, one sentence.
        headline: size of the effect, with ``{number}`` fields: parameters or quantities.
    """

    phrase: str
    cause: str = ""
    remedy: str = ""
    headline: str = ""
