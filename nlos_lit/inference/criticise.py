"""Show, name, extend, measure: the loop that finds out which physical effects a capture asks for
(docs/criticism.md).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.discrepancy import Discrepancy, counted, discrepancies, smooth
from nlos_lit.inference.form import Form, forms_of
from nlos_lit.inference.joint_step import copy_effects, null_of
from nlos_lit.inference.needless import drop_needless
from nlos_lit.inference.problem import Problem, build_problem
from nlos_lit.inference.refit import compare, log_likelihood, refit_with, score
from nlos_lit.inference.screen import FOLDS, Candidate, Projector, screen
from nlos_lit.inference.split import Split
from nlos_lit.inference.trials import Trial, best_of_each, choose, group_of
from nlos_lit.runtime.steps import Steps
from nlos_lit.surfels.fit import SurfelFit

log = logging.getLogger(__name__)
WORK = 1e12  # multiplications of the nuisance columns with each other, some 40 s of one core
WELL = 0.01  # retained information from which on an effect counts as well identifiable
Rebuild = Callable[[Extension, int], SurfelFit]


@dataclass(frozen=True)
class CriticismSettings:
    """How hard an effect must be asked for before it is named.

    Args:
        spots: fitted spots that score tests look at at most (fewer where there are very many surfels).
        level: largest p-value, Holm-adjusted over all effects.
        least_gain: nats that the score test must predict …
        least_shape: … for effects that neither move nor scale the light: of these the base's own errors feign
            fewer …
        least_share: … and share of the misfit beyond noise (fitted spots) that this must be: what is smaller
            may be the base's own.
        rivals: effects that are refitted before one is chosen. finalists: of them, with which the scene is
            rebuilt from new seeds; the one that was screened best is always among them.
        hopeless: share of the best predicted gain below which an effect is no rival.
        far_off: misfit over noise from which on single-path effects are finalists whatever their score.
        similar: correlation of projected sensitivities from which on two effects are one group.
        steps: batches of a refit (and as many again at falling rate).
        most: effects that are accepted at most.
        explained: share of the structured misfit that named effects must explain; below it, the misfit is
            called unexplained.
        numerics: vary seed and quadrature of the base, too.
        toys: simulated captures for the null distribution. processes: that work on them; rebuilds that go on
            side by side.
    """

    spots: int = 1024
    level: float = 1e-3
    least_gain: float = 25.0
    least_shape: float = 15.0
    least_share: float = 0.02
    rivals: int = 5
    hopeless: float = 0.2
    finalists: int = 3
    far_off: float = 0.15
    similar: float = 0.9
    steps: int = 120
    most: int = 5
    explained: float = 0.67
    numerics: bool = True
    toys: int = 0
    processes: int = 2


@dataclass(frozen=True)
class Turn:
    """One turn of the loop.

    Args:
        candidates: the screening, largest predicted gain first.
        discrepancies: flexible ones, largest gain first.
        trials: the rivals after their refits, most evidence first.
        accepted: one of them; None ends the loop.
        group: names that the capture cannot tell from the accepted one.
        controls: fits without another effect.
        form: of the effect that was accepted before, where it is wrong.
    """

    candidates: list[Candidate]
    discrepancies: list[Discrepancy]
    trials: list[Trial]
    accepted: Trial | None
    group: list[str]
    controls: list[SurfelFit | None] = field(default_factory=list)
    form: Form | None = None


def tested_spots(fit: SurfelFit, split: Split, most: int) -> int:
    """How many fitted spots score tests look at; gains are nats over these.

    Args:
        fit: whose surfels make the columns.
        split: whose ``fit`` spots there are.
        most: spots; fewer where their products would exceed ``WORK``.

    Returns:
        a number of spots.
    """
    columns = 2 * len(fit.model) + 64
    return min(most, len(split.fit), max(64, int(WORK / (fit.counts.shape[1] * columns**2))))


def tested_rows(fit: SurfelFit, split: Split, most: int, seed: int) -> np.ndarray:
    """Which fitted spots score tests look at.

    Args:
        fit: that is tested.
        split: of its spots.
        most: see :func:`tested_spots`.
        seed: of the choice.

    Returns:
        sorted rows of ``split.fit`` (and of the fit's counts).
    """
    return np.sort(np.random.default_rng(seed).permutation(len(split.fit))[: tested_spots(fit, split, most)])


def tested_problem(fit: SurfelFit, split: Split, most: int, seed: int) -> tuple[Problem, torch.Tensor]:
    """The weighted least-squares problem of tested spots.

    Args:
        fit: that is tested.
        split: of its spots.
        most: see :func:`tested_spots`.
        seed: of the choice.

    Returns:
        the problem of S spots, and ``[S]`` their folds.
    """
    rows = tested_rows(fit, split, most, seed)
    spots = torch.from_numpy(split.fit[rows])
    return build_problem(fit.model, fit.extension, spots, fit.counts[rows]), split.folds(spots, FOLDS)


@dataclass(frozen=True)
class Look:
    """Effects and flexible discrepancies as the score tests see them.

    Args:
        candidates: effects, largest predicted gain first.
        discrepancies: flexible ones, largest gain first.
        own: ``[P]`` the step that the base alone would take.
        form: of the effect asked about, where it is wrong.
    """

    candidates: list[Candidate]
    discrepancies: list[Discrepancy]
    own: torch.Tensor
    form: Form | None = None


def look(fit: SurfelFit, split: Split, scan: Scan, s: CriticismSettings, seed: int, latest: str = "") -> Look:
    """Screen all effects that the fit does not have yet, and the flexible discrepancies.

    Args:
        fit: that is criticised.
        split: of its spots.
        scan: of the capture.
        s: settings.
        seed: of the spots that are looked at.
        latest: name of the effect whose form is looked at, too.

    Returns:
        what the tests say; nothing but the form where that is wrong.
    """
    problem, folds = tested_problem(fit, split, s.spots, seed)
    have = {e.name for e in fit.extension.effects}
    projector = Projector(problem)
    wrong = [
        form
        for e in fit.extension.effects
        if e.name == latest
        for form in forms_of(problem, projector, e)
        if form.wrong
    ]
    if wrong:  # the effect goes, and with it all that a screening beside it would say
        return Look([], [], projector.own, wrong[0])
    candidates = screen(problem, projector, [e(scan) for e in EFFECTS if e.name not in have], folds)
    asked = [
        c.effect
        for c in candidates
        if c.effect.per_spot and c.p_value < s.level and c.gain > needed(c, s, 0.0)
    ]
    rest = discrepancies(problem, projector, scan, asked)
    return Look(candidates, rest, projector.own)


def turn(
    fit: SurfelFit,
    rebuild: Rebuild,
    split: Split,
    scan: Scan,
    s: CriticismSettings,
    seed: int,
    steps: Steps,
    latest: str = "",
) -> Turn:
    """Screen, refit the rivals, rebuild the scene with the finalists, choose.

    The control goes through the same without another effect (as it is, refitted, or rebuilt with another
    random seed).

    Where the base is far off, linear tests around it say little about effects that bend single paths: these
    are rebuilt with, too. Else, where a function of the count rate says more than any effect, the counting is
    none that the registry knows: no rivals.

    Args:
        fit: with the effects accepted so far.
        rebuild: a fit from new seeds with given effects and random seed.
        split: of the spots.
        scan: of the capture.
        s: settings.
        seed: of everything random.
        steps: says and keeps what is done.
        latest: name of the effect that was accepted last.

    Returns:
        the turn; its ``accepted`` is None where no effect is asked for.
    """
    number = len(fit.extension.effects) + 1
    steps.plan(screen=1, refit=s.rivals + 1, fit=s.finalists)
    screening = partial(look, fit, split, scan, s, seed, latest)
    seen = steps("screen", f"screening effects, turn {number}", f"turn{number}_screen", screening)
    candidates, rest = seen.candidates, seen.discrepancies
    if seen.form is not None:
        return Turn(candidates, rest, [], None, [], form=seen.form)
    (misfit, noise), tested = misfit_and_noise(fit, split), tested_spots(fit, split, s.spots)
    over = misfit * tested / len(split.fit)
    possible = [c for c in candidates if not smooth(rest, c.effect.name, c.gain)]
    wanted = significant(possible, s, over)
    far_off = misfit > s.far_off * noise
    if not far_off and (not wanted or counted(rest) > wanted[0].gain + s.least_gain):
        return Turn(candidates, rest, [], None, [])
    rivals = [c for c in wanted[: s.rivals] if c.gain > s.hopeless * wanted[0].gain]
    steps.plan(refit=1 + len(rivals), fit=1 + min(s.finalists, len(rivals)))
    own = partial(refit_with, fit, [], s.steps, seed, seen.own)
    controls: list[SurfelFit | None] = [
        fit,
        steps("refit", "refitting the control", f"turn{number}_control", own),
    ]
    tries = []
    for c in rivals:
        refit = partial(refit_with, fit, [c], s.steps, seed)
        again = steps(
            "refit", f"refitting with {c.effect.name}", f"turn{number}_refit_{c.effect.name}", refit
        )
        tries.append((c, again, log_likelihood(again, split.select)))
    weight = len(split.fit) / tested  # of a prediction for the tested spots
    tries.sort(key=lambda t: -float(t[2].sum()) - weight * t[0].gain)
    finalists = [
        (c, again.extension) for k, (c, again, _) in enumerate(tries) if k < s.finalists or c is wanted[0]
    ]
    if far_off:
        tried = {c.effect.name for c, _ in finalists}
        bending = [c for c in candidates if c.effect.stage == "path" and c.effect.name not in tried]
        finalists += [(c, copy_effects(fit.extension, [null_of(c.effect)])) for c in bending]
    steps.plan(fit=1 + len(finalists))
    jobs = [
        (
            "rebuilding the control",
            f"turn{number}_rebuild",
            partial(_rebuilt, rebuild, fit.extension, seed + 1),
        )
    ]
    for c, extension in finalists:
        text, name = f"rebuilding the scene with {c.effect.name}", f"turn{number}_rebuild_{c.effect.name}"
        jobs.append((text, name, partial(_rebuilt, rebuild, extension, seed)))
    control, *rebuilt = steps.several("fit", jobs, s.processes)
    controls.append(control)
    pairs = zip(finalists, rebuilt, strict=True)
    tries += [(c, again, log_likelihood(again, split.select)) for (c, _), again in pairs if again is not None]
    reference, block = best_likelihood(controls, split), split.block[split.select]
    trials = best_of_each(
        [
            Trial(c, again, compare(reference, value, block), value, weight * c.gain)
            for c, again, value in tries
        ]
    )
    share = len(split.select) / tested
    held = [
        t
        for t in trials
        if t.gain.nats > max(t.gain.error, share * needed(t.candidate, s, over, rebuilt=True))
    ]
    if not held:
        return Turn(candidates, rest, trials, None, [], controls)
    best = choose(held, block)
    return Turn(candidates, rest, trials, best, group_of(best, trials, block, s.similar), controls)


def _rebuilt(rebuild: Rebuild, extension: Extension, seed: int) -> SurfelFit | None:
    """None: with these effects no surfel survives, so that they are not the ones."""
    try:
        return rebuild(copy_effects(extension, []), seed)
    except UserError as error:
        log.info("a rebuild leaves nothing: %s", error)
        return None


def best_likelihood(fits: list[SurfelFit | None], split: Split) -> torch.Tensor:
    """Log-likelihoods of the select spots of the best of several fits.

    Args:
        fits: that are compared; None are skipped.
        split: of the spots.

    Returns:
        ``[S]`` nats.
    """
    found = [log_likelihood(f, split.select) for f in fits if f is not None]
    return max(found, key=lambda values: float(values.sum()))


def needed(candidate: Candidate, s: CriticismSettings, over: float, rebuilt: bool = False) -> float:
    """Nats over the tested spots that an effect must promise, or gain once the scene is rebuilt.

    A base that has not quite converged is off along what it could imitate, and what is left of an effect
    takes that for its own: nats in inverse proportion to the retained information. Below ``WELL`` the rebuilt
    scene must gain as much more.

    Args:
        candidate: the effect.
        s: settings.
        over: misfit of the tested spots, nats.
        rebuilt: of a rebuilt scene, not of the screening.

    Returns:
        nats.
    """
    least = s.least_gain if candidate.effect.moves_light else s.least_shape
    scarce = max(1.0, WELL / max(candidate.retained, 1e-6)) if rebuilt else 1.0
    return max(least * scarce, s.least_share * over)


def misfit_and_noise(fit: SurfelFit, split: Split) -> tuple[float, float]:
    """Misfit beyond noise, and noise, measured on the select spots.

    Args:
        fit: that is judged.
        split: of the spots.

    Returns:
        both in nats over as many spots as were fitted.
    """
    scores = score(fit, split.select)
    nats = fit.counts.shape[1] * len(split.fit) / 2
    return (scores.deviance_per_bin - scores.deviance_noise) * nats, scores.deviance_noise * nats


def significant(candidates: list[Candidate], s: CriticismSettings, over: float) -> list[Candidate]:
    """Candidates whose Holm-adjusted p-value and predicted gain pass.

    Args:
        candidates: largest predicted gain first.
        s: settings.
        over: misfit of the tested spots, nats.

    Returns:
        those that pass, in the same order.
    """
    order = sorted(candidates, key=lambda c: c.p_value)
    passed, worst = set(), 0.0
    for rank, candidate in enumerate(order):
        worst = max(worst, candidate.p_value * (len(order) - rank))
        if worst > s.level:
            break
        passed.add(candidate.effect.name)
    return [c for c in candidates if c.effect.name in passed and c.gain > needed(c, s, over)]


@dataclass
class Findings:
    """What the loop leaves behind.

    Args:
        base: the fit without effects.
        final: the fit with all effects that were kept.
        turns: of the loop.
        again: the final fit from new seeds; None without effects, or where no surfel survived.
    """

    base: SurfelFit
    final: SurfelFit
    turns: list[Turn]
    again: SurfelFit | None = None

    @property
    def accepted(self) -> list[Turn]:
        kept = {e.name for e in self.final.extension.effects}
        return [t for t in self.turns if t.accepted is not None and t.accepted.name in kept]

    @property
    def left(self) -> list[Discrepancy]:
        """Flexible discrepancies of the final fit."""
        return self.turns[-1 if self.wrong is None else -2].discrepancies

    @property
    def wrong(self) -> Form | None:
        """Form of the effect that was accepted last, and not kept because of it."""
        return self.turns[-1].form


def criticise(
    base: SurfelFit,
    rebuild: Rebuild,
    split: Split,
    scan: Scan,
    s: CriticismSettings,
    seed: int,
    steps: Steps | None = None,
) -> Findings:
    """Find out, one after the other, which effects the capture asks for.

    Args:
        base: fitted to ``split.fit`` without effects.
        rebuild: a fit from new seeds with the given effects, begun at their present values, and the given
            random seed: surfels that imitated an effect do not come back.
        split: of the spots.
        scan: of the capture.
        s: settings.
        seed: of everything random.
        steps: says and keeps what is done.

    Returns:
        base, turns and final fit.
    """
    fit = before = base
    turns, latest, steps = [], "", steps or Steps()
    while True:
        turns.append(turn(fit, rebuild, split, scan, s, seed, steps, latest))
        best = turns[-1].accepted
        if best is None:
            break
        before, fit, latest = fit, best.fit, best.name
        if len(fit.extension.effects) == s.most:
            last = steps(
                "screen",
                "screening what is left",
                "last_screen",
                partial(look, fit, split, scan, s, seed, latest),
            )
            turns.append(Turn(last.candidates, last.discrepancies, [], None, [], form=last.form))
            break
    if turns[-1].form is not None:
        fit = before
    fit = drop_needless(fit, split, s.steps, seed, steps)
    again = None
    if len(fit.extension.effects):
        steps.plan(fit=1)
        once_more = partial(_rebuilt, rebuild, fit.extension, seed + 2)
        again = steps(
            "fit", "rebuilding the scene once more: do the parameters come back?", "again", once_more
        )
    return Findings(base, fit, turns, again)
