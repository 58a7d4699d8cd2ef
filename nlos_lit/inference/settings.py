"""How hard a term must be asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CriticismSettings:
    """How hard a term must be asked for before the model is extended with it.

    Args:
        spots: fitted spots that the pool is asked on at most.
        level: chance of a false name that is borne where the base is right: a term needs ln(terms in the
            pool/level) nats of evidence.
        share: of the misfit that a fine scene leaves, nats; a term needs so much on top, as far as it acts
            where the scene's light falls. What is wrong for unknown reasons may look a little like anything.
        form: of what other terms take from a term, nats; it needs so much on top. No cause follows an
            equation to the last digit, and what a strong one leaves looks like its look-alikes.
        most: terms that are tried together at most.
        rivals: look-alikes that are tried in the place of each term that holds, at most.
        open_share: weight above which the capture leaves open that a rival is meant.
        odds: share of the best one's weight from which on a simpler rival goes before it, a scene begun with
            fewer effects, and effects before something unknown by itself.
        toys: simulated captures for the null distribution.
        processes: that work on them; fits that go on side by side.
    """

    spots: int = 1024
    level: float = 0.01
    share: float = 0.1
    form: float = 0.25
    most: int = 8
    rivals: int = 2
    open_share: float = 0.05
    odds: float = 0.25
    toys: int = 0
    processes: int = 2
