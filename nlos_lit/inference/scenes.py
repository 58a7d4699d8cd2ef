"""Scenes of a capture, with terms and without: gone on with, built anew, made fine."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from nlos_lit.capture.errors import UserError
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.candidates import Candidate
from nlos_lit.inference.heldout import log_likelihood, weights
from nlos_lit.inference.members import EVEN
from nlos_lit.inference.per_spot import solve
from nlos_lit.inference.problem import acting_order
from nlos_lit.inference.split import Split
from nlos_lit.runtime.steps import Steps
from nlos_lit.surfels.fit import SurfelFit

log = logging.getLogger(__name__)
Rebuild = Callable[[Extension, int], SurfelFit]
Grow = Callable[[SurfelFit, int], SurfelFit]
Job = tuple[str, str, Callable[[], SurfelFit]]  # what a step says, is kept as, and does
LENGTHS = (1.0, 0.3, 0.1)  # of the pool's step, that a term may begin with
WARM = 240  # batches, at falling rates


def begun_with(fit: SurfelFit, extra: list[Candidate]) -> Extension:
    """A copy of the fit's extension with more terms, begun where the pool saw them.

    A step of the linear problem may be far too long where a term bends the light, and is shortened until the
    counts are likelier; numbers of single spots are solved for and not moved by an optimiser.

    Args:
        fit: whose extension it is.
        extra: the terms.

    Returns:
        a new extension.
    """

    def begun(length: float) -> Extension:
        added = []
        for candidate in extra:
            effect = copy.deepcopy(candidate.effect)
            effect.shift(length * candidate.step)
            effect.clamp()
            added.append(effect.requires_grad_(not effect.per_spot))
        return copy_effects(fit.extension, added)

    def likelihood(extension: Extension) -> float:
        counts = fit.counts[fit.tested]
        expected = fit.model.expected(fit.train[fit.tested], extension).clamp_min(1e-9)
        return float((torch.xlogy(counts, expected) - expected).double().sum())

    return max((begun(length) for length in LENGTHS), key=likelihood) if extra else begun(0.0)


def copy_effects(extension: Extension, extra: list[Effect]) -> Extension:
    """A copy of the extension with more effects at their present values, in order of application.

    Args:
        extension: that is copied.
        extra: effects, copied too.

    Returns:
        a new extension.
    """
    return Extension(sorted((copy.deepcopy(e) for e in [*extension.effects, *extra]), key=acting_order))


def solve_spots(fit: SurfelFit) -> SurfelFit:
    """The fit, with numbers of single spots solved for: random batches would visit each a few times only."""
    for effect in fit.extension.effects:
        if effect.per_spot:
            solve(fit.model, fit.extension, effect, fit.train, fit.counts)
    return fit


def go_on(fit: SurfelFit) -> SurfelFit:
    """Some more batches, at falling rates.

    Numbers of single spots stay until the scene has got used to the terms that came or left: they would take
    up whatever it lacks at first, and the scene could not get it back.

    Args:
        fit: that goes on, in place.

    Returns:
        the same fit.
    """
    fit.go_on(WARM)
    return solve_spots(fit)


class Scenes:
    """All scenes that are made of one capture, each as a step.

    Args:
        rebuild: a parsimonious fit from new seeds with given effects, begun at their present values, and
            random seed.
        grow: the same scene gone on with until surfels are as many and as fine as the counts ask for.
        split: of the spots.
        seed: of everything random.
        steps: says and keeps what is done.
        processes: fits that go on side by side.
    """

    def __init__(
        self, rebuild: Rebuild, grow: Grow, split: Split, seed: int, steps: Steps, processes: int
    ) -> None:
        self.rebuild, self.grow, self.split, self.seed = rebuild, grow, split, seed
        self.steps, self.processes = steps, processes
        self.turn = 0  # pools that were asked so far: names of steps have it
        self.block = split.block[split.select]

    def value(self, fit: SurfelFit) -> Tensor:
        """``[S]`` nats of the select spots."""
        return log_likelihood(fit, self.split.select)

    def better(self, *fits: SurfelFit) -> SurfelFit:
        """The one that predicts the select spots best."""
        return max(fits, key=lambda fit: float(self.value(fit).sum()))

    def predicts(self, scene: SurfelFit, other: SurfelFit, least: float = EVEN) -> bool:
        """Which of two scenes predicts the select spots better.

        Args:
            scene: one.
            other: another.
            least: weight from which on it counts.

        Returns:
            Whether it is the first.
        """
        return weights([self.value(other), self.value(scene)], self.block)[1] > least

    def several(self, jobs: Sequence[Job], screen: int = 0) -> list[SurfelFit]:
        """Fits that do not depend on one another, side by side.

        Args:
            jobs: steps that make them.
            screen: questions that come after them, for the time that is left.

        Returns:
            one a job.
        """
        self.steps.plan(fit=len(jobs), screen=screen)
        return self.steps.several("fit", jobs, self.processes)

    def warm(self, fit: SurfelFit, extra: list[Candidate]) -> SurfelFit:
        """The same scene, gone on with more terms.

        Args:
            fit: that is copied.
            extra: the terms.

        Returns:
            another fit.
        """
        return go_on(fit.copy(begun_with(fit, extra), self.seed))

    def gone_on(self, fit: SurfelFit, new: list[Candidate]) -> SurfelFit:
        """:meth:`warm` as a step of its own.

        Args:
            fit: that is copied.
            new: the terms.

        Returns:
            another fit.
        """
        names = [c.name for c in new]
        kept = f"on{self.turn}_{'_'.join(names)}"
        return self.steps("fit", f"going on with {', '.join(names)}", kept, partial(self.warm, fit, new))

    def without(self, fit: SurfelFit, names: Sequence[str]) -> SurfelFit:
        """The same scene, gone on without some terms.

        Args:
            fit: that is copied.
            names: of the terms.

        Returns:
            another fit.
        """
        fewer = [e for e in copy_effects(fit.extension, []).effects if e.name not in names]
        return go_on(fit.copy(Extension(fewer), self.seed))

    def parted(self, fit: SurfelFit, names: Sequence[str], kept: str) -> SurfelFit:
        """:meth:`without` as a step of its own.

        Args:
            fit: that is copied.
            names: of the terms that leave.
            kept: name of the step.

        Returns:
            another fit.
        """
        text = f"going on without {', '.join(names)}"
        return self.steps("fit", text, kept, partial(self.without, fit, names))

    def only(self, fit: SurfelFit, names: Sequence[str]) -> SurfelFit:
        """The same scene, gone on without all other terms.

        Args:
            fit: that is copied.
            names: of the terms that stay.

        Returns:
            another fit, or the same where it has no others.
        """
        others = [e.name for e in fit.extension.effects if e.name not in names]
        return self.parted(fit, others, f"only{self.turn}_{'_'.join(names)}") if others else fit

    def solved(self, fit: SurfelFit, new: Candidate) -> SurfelFit:
        """The same scene with a term of single spots, and nothing moved: batches may make it worse.

        Args:
            fit: that is copied.
            new: the term.

        Returns:
            another fit.
        """
        text, kept = f"solving for {new.name}", f"solved{self.turn}_{new.name}"
        return self.steps("fit", text, kept, lambda: solve_spots(fit.copy(begun_with(fit, [new]), self.seed)))

    def refining(self, fit: SurfelFit, name: str) -> Job:
        """The step that makes a scene as fine as the counts ask for, with the fit's terms.

        Args:
            fit: parsimonious.
            name: of the step.

        Returns:
            the step, not done yet.
        """
        text, kept = f"refining the scene {name.replace('_', ' ')}", f"fine{self.turn}_{name}"
        return text, kept, lambda: solve_spots(self.grow(fit, self.seed))

    def fine(self, fit: SurfelFit, name: str) -> SurfelFit:
        """A scene as fine as the counts ask for, with the fit's terms.

        Args:
            fit: parsimonious.
            name: of the step.

        Returns:
            another fit.
        """
        return self.steps("fit", *self.refining(fit, name))

    def grown(self, coarse: SurfelFit, name: str) -> SurfelFit:
        """The scene as fine as the counts ask for, or the parsimonious one, whichever predicts better.

        Args:
            coarse: the parsimonious one.
            name: of the step.

        Returns:
            one of them.
        """
        return self.better(self.fine(coarse, name), coarse)

    def anew(self, extension: Extension) -> SurfelFit | None:
        """A parsimonious scene from new seeds with these effects.

        None where no surfel survives with them, so that they are not the ones.
        """
        try:
            fit = self.rebuild(copy_effects(extension, []), self.seed)
        except UserError as error:
            log.info("a rebuild leaves nothing: %s", error)
            return None
        return solve_spots(fit)

    def or_anew(self, fit: SurfelFit) -> SurfelFit:
        """A parsimonious scene, or one built anew with its terms, whichever predicts better."""
        other = self.anew(fit.extension)
        return fit if other is None else self.better(other, fit)

    def built_or(self, other: SurfelFit, extension: Extension) -> SurfelFit:
        """A scene built with effects.

        Args:
            other: a scene.
            extension: the effects.

        Returns:
            A new fit, or the other, where no surfel survives with the effects.
        """
        fit = self.anew(extension)
        return other if fit is None else fit

    def joined(self, fit: SurfelFit, new: list[Candidate]) -> SurfelFit:
        """A parsimonious scene with more terms.

        The present one goes on with them, and is built anew, where that predicts better: surfels that
        imitated the terms do not come back.

        Args:
            fit: parsimonious.
            new: terms that come to it.

        Returns:
            another fit.
        """
        self.steps.plan(fit=3)
        warm = self.gone_on(fit, new)
        text = f"rebuilding the scene with {', '.join(e.name for e in warm.extension.effects)}"
        kept = f"new{self.turn}_{'_'.join(c.name for c in new)}"
        return self.steps("fit", text, kept, partial(self.or_anew, warm))

    def built_with(self, coarse: SurfelFit, names: Sequence[str]) -> SurfelFit:
        """A parsimonious scene with some of its terms: gone on with, or built anew.

        Args:
            coarse: with these terms, and others.
            names: of those that stay.

        Returns:
            The one that predicts the select spots better.
        """
        text, kept = f"rebuilding the scene with {', '.join(names)}", f"built{self.turn}_{'_'.join(names)}"
        return self.steps("fit", text, kept, partial(self.or_anew, self.only(coarse, names)))

    def built_without(self, coarse: SurfelFit, name: str) -> SurfelFit:
        """A parsimonious scene without a term: gone on with, or built anew, whichever predicts better.

        Args:
            coarse: with the term.
            name: of the term.

        Returns:
            another fit.
        """
        return self.or_anew(self.without(coarse, [name]))

    def whole(self, coarse: SurfelFit) -> SurfelFit:
        """A parsimonious scene whose terms do all that they stand for.

        A scene that has taken up the first of some echoes leaves every second one to be found, and no step
        leads from there to the first.

        Args:
            coarse: the scene.

        Returns:
            It, or one built anew from what its terms may be a part of, for as long as that predicts better.
        """
        tried = 0
        while parts := {e.name: more for e in coarse.extension.effects if (more := e.part_of())}:
            extension = copy_effects(coarse.extension, [])
            for effect in extension.effects:
                effect.set_all(parts.get(effect.name, {}))
            text, kept = f"building a scene with more of {', '.join(parts)}", f"whole{self.turn}_{tried}"
            self.steps.plan(fit=1)
            fit = self.steps("fit", text, kept, partial(self.built_or, coarse, extension))
            if self.better(coarse, fit) is coarse:
                break
            coarse, tried = fit, tried + 1
        return coarse
