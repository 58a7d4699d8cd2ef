"""Terms that hide one another: each is refused by itself, and asked for once all are in the model.

Beside each of several strong faults the others leave so much unexplained that it does not stand out, and fine
scenes have bent themselves to all of them. So a term that was refused stays for the time being, and the pool
is asked beside it for the next (docs/criticism.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from nlos_lit.inference.criticise import Loop, Turn, weighed
from nlos_lit.inference.heldout import log_likelihood, weights
from nlos_lit.surfels.fit import SurfelFit


@dataclass(frozen=True)
class Company:
    """Terms that are accepted together.

    Args:
        turns: of each, accepted.
        coarse: the parsimonious scene with them.
        fine: the scene with them that predicts best.
    """

    turns: list[Turn]
    coarse: SurfelFit
    fine: SurfelFit


def in_company(loop: Loop, turn: Turn, coarse: SurfelFit, fine: SurfelFit) -> Company | None:
    """What is asked for beside others of a turn's term and those that come after it.

    Terms with a number for each spot are none of these: with them nothing is predicted for other spots.

    Args:
        loop: of the capture.
        turn: whose term was refused.
        coarse: the parsimonious scene that was asked.
        fine: the fine scene without the turn's term.

    Returns:
        What holds; None where nothing does, or where no other term came to the first.
    """
    members: list[Turn] = []
    turn = replace(turn, confirmed=None, refused={})
    while True:
        laws = [t for t in turn.trials if t.candidate is None or not t.candidate.effect.per_spot]
        if len(laws) < 2:  # going on with none alone
            break
        turn = loop.among(replace(turn, best=None, group={}), weighed(laws, loop.block))
        if turn.best is None:
            break
        members.append(turn)
        coarse = loop.again(turn.best)
        if len(coarse.extension.effects) >= loop.settings.most:
            break
        turn = loop.turn(coarse, None)  # the misfit holds what hides it
    if len(members) < 2:
        return None
    select = loop.split.select
    grown = loop.fine(coarse, f"with_company_{loop.number}")
    scene = max((grown, coarse), key=lambda fit: float(log_likelihood(fit, select).sum()))
    while members:
        held = loop.held(members, scene)
        members = [member for member, _ in held]
        failing = [(member, without) for member, without in held if not member.accepted]
        if not failing:
            without, with_them = (log_likelihood(fit, select) for fit in (fine, scene))
            better = weights([without, with_them], loop.block)[1] > 1 - loop.settings.open_share
            return Company(members, coarse, scene) if better else None
        worst, fewer = min(failing, key=lambda each: _gain(each[0]))
        members = [member for member in members if member is not worst]
        assert worst.best is not None
        coarse = fewer if coarse is scene else loop.without(coarse, worst.best.name)
        scene = fewer
    return None


def _gain(member: Turn) -> float:
    assert member.confirmed is not None
    return member.confirmed.gain.nats
