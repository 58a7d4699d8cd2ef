"""All turns of one capture: what is asked for alone, or in company."""

from __future__ import annotations

from collections.abc import Callable

from nlos_lit.capture.scan import Scan
from nlos_lit.inference.company import in_company
from nlos_lit.inference.criticise import CriticismSettings, Findings, Grow, Loop, Rebuild, Turn, per_spot
from nlos_lit.inference.split import Split
from nlos_lit.runtime.steps import Steps
from nlos_lit.surfels.fit import SurfelFit

# Fine fit without effects, present one, turns so far.
Told = Callable[[SurfelFit, SurfelFit, list[Turn]], None]


def criticise(
    base: SurfelFit,
    rebuild: Rebuild,
    grow: Grow,
    split: Split,
    scan: Scan,
    s: CriticismSettings,
    seed: int,
    steps: Steps | None = None,
    told: Told = lambda base, present, turns: None,
) -> Findings:
    """Find out, one after the other, what the capture asks for.

    Args:
        base: fitted to ``split.fit`` without effects, coarse.
        rebuild, grow: see :class:`Loop`.
        split: of the spots.
        scan: of the capture.
        s: settings.
        seed: of everything random.
        steps: says and keeps what is done.
        told: called before the first turn and after each, see :data:`Told`.

    Returns:
        base, turns and final fit.
    """
    loop = Loop(rebuild, grow, split, scan, s, seed, steps or Steps())
    first = fine = loop.fine(base, "without_effects")
    coarse = base
    turns: list[Turn] = []
    told(first, fine, turns)
    while len(coarse.extension.effects) < s.most:
        new, coarse, fine = _settled(loop, loop.turn(coarse, fine), coarse, fine)
        turns += new
        told(first, fine, turns)
        if not turns[-1].accepted:
            break
    return Findings(first, fine, turns, loop.losses(fine), coarse if fine is not first else None)


def _settled(
    loop: Loop, turn: Turn, coarse: SurfelFit, fine: SurfelFit
) -> tuple[list[Turn], SurfelFit, SurfelFit]:
    """What comes of a turn: turns, the parsimonious and the fine scene after them.

    Its terms are asked for beside a fine scene, one after the other, then in company, and those with a number
    for each spot last.
    """
    asked_company = False
    while turn.best is not None:
        turn, again, refined = loop.asked_again(turn, fine)
        if turn.accepted:
            return [turn], again, refined
        other = loop.next_best(turn)
        if not asked_company and (other is None or per_spot(other)):
            asked_company, company = True, in_company(loop, turn, coarse, fine)
            if company is not None:
                return company.turns, company.coarse, company.fine
        if other is None:
            break
        turn = other
    return [turn], coarse, fine
