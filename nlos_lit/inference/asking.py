"""What the counts ask for beside a scene, and how much of it a term needs to hold."""

from __future__ import annotations

import copy
import math
from functools import partial

import numpy as np
import torch

from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.free_terms import FREE
from nlos_lit.inference.candidates import Pool
from nlos_lit.inference.heldout import score
from nlos_lit.inference.own import own_evidence
from nlos_lit.inference.pool import ask
from nlos_lit.inference.scenes import Scenes, copy_effects, solve_spots
from nlos_lit.inference.settings import CriticismSettings
from nlos_lit.surfels.fit import SurfelFit

OF_SPOTS = frozenset(cls.name for cls in [*EFFECTS, *FREE] if cls.per_spot)


def misfit_of(fit: SurfelFit, spots: np.ndarray, number: int) -> float:
    """How much likelier than by the fit some counts would be if all but counting noise were explained.

    Numbers of single spots are solved for: no fit can know those of spots that it has not seen.

    Args:
        fit: that is judged.
        spots: ``[S]`` rows of the capture.
        number: of spots that it is said for.

    Returns:
        nats, half the deviance above the noise's; below 0 where surfels have taken up noise.
    """
    if any(e.per_spot for e in fit.extension.effects):
        fit = copy.copy(fit)
        fit.extension, fit.train = copy_effects(fit.extension, []), torch.from_numpy(spots)
        fit.counts = torch.from_numpy(fit.capture.gated_counts()[spots])
        solve_spots(fit)
    found = score(fit, spots)
    return 0.5 * (found.deviance_per_bin - found.deviance_noise) * number * fit.counts.shape[1]


class Asking:
    """Asks the counts of one capture.

    Args:
        scenes: of the capture.
        scan: of it.
        settings: of the criticism.
    """

    def __init__(self, scenes: Scenes, scan: Scan, settings: CriticismSettings) -> None:
        self.scenes, self.scan, self.settings = scenes, scan, settings
        self.split, self.seed, self.steps = scenes.split, scenes.seed, scenes.steps
        self.least = math.log((len(EFFECTS) + len(FREE)) / settings.level)

    def ask(self, fit: SurfelFit, room: int, effects: bool = True, of_spots: bool = False) -> Pool:
        """What the counts ask for beside a fit.

        Args:
            fit: that is criticised.
            room: for so many terms that are taken together.
            effects: such may be taken; free terms may where none is.
            of_spots: only terms with a number for each spot are asked.

        Returns:
            the pool.
        """
        self.scenes.turn += 1
        turn, only = self.scenes.turn, OF_SPOTS if of_spots else None
        text = "asking single spots" if of_spots else "asking the pool"
        asking = partial(self._ask, fit, room, effects, only)
        return self.steps("screen", f"{text}, {turn}", f"pool{turn}", asking)

    def beside(self, fine: SurfelFit, name: str, kept: str) -> float:
        """Nats of a term beside a fine scene: cells that are too wide ask for terms that it does not need.

        Args:
            fine: the scene, without the term.
            name: of the term.
            kept: name of the step.

        Returns:
            its evidence.
        """
        asking = partial(self._ask, fine, 0, True, {name})
        (found,) = self.steps("screen", f"asking for {name}", kept, asking).candidates
        return found.evidence

    def _ask(self, fit: SurfelFit, room: int, effects: bool, only: frozenset[str] | set[str] | None) -> Pool:
        return ask(
            fit, self.split, self.scan, self.settings.spots, self.seed, self.least, room, effects, only
        )

    def own(
        self, scene: SurfelFit, names: list[str], kept: str
    ) -> tuple[dict[str, tuple[float, float, float]], list[str]]:
        """Own evidence of some terms of a scene.

        Args:
            scene: with the terms.
            names: of them.
            kept: name of the step.

        Returns:
            By name nats, those needed, and those of these for what other terms take; and who is left when all
            who have less than they need are gone.
        """
        bar = partial(self._bar, self.misfit(scene))
        asking = partial(own_evidence, scene, self.split, self.settings.spots, self.seed, names, bar)
        return self.steps("screen", f"asking for {', '.join(names)} again", kept, asking)

    def needed(self, fit: SurfelFit) -> float:
        """Nats of own evidence that a term needs beside a fine scene, if it acts where its light falls."""
        return self._bar(self.misfit(fit), 1.0)

    def _bar(self, misfit: float, lit: float, lost: float = 0.0) -> float:
        """Nats that a term needs, of whose information ``lit`` lies where the scene's light falls.

        Without the others it would have ``lost`` more. What these do follows their equations as nearly as a
        real cause does, and what is left of it looks like the term.
        """
        s = self.settings
        return self.least + s.share * lit * misfit + s.form * lost

    def misfit(self, fit: SurfelFit) -> float:
        """In the mean of fitted and select spots, for as many as the pool is asked on.

        What surfels take up of the noise of fitted spots they add to that of the others: the mean of both
        holds neither.
        """
        number = min(len(self.split.fit), self.settings.spots)
        parts = (self.split.fit, self.split.select)
        return max(0.0, sum(misfit_of(fit, spots, number) for spots in parts) / len(parts))

    def left(self, fit: SurfelFit) -> float:
        """Nats that a fit leaves of all that the select spots would gain; below 0 where it took up noise."""
        return misfit_of(fit, self.split.select, len(self.split.select))
