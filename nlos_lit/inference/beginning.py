"""What the search begins with: scenes built with effects from the first surfel on, where these are better."""

from __future__ import annotations

import copy
from functools import partial

from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.candidates import Candidate, Pool
from nlos_lit.inference.heldout import weights
from nlos_lit.inference.members import SURE, Held, Member
from nlos_lit.inference.scenes import Scenes, copy_effects
from nlos_lit.surfels.fit import SurfelFit

IMITATED = [
    frozenset(cls.name for cls in EFFECTS if kind in cls.imitated)
    for kind in ("light", "geometry", "echoes", "late")
]


def begun(scenes: Scenes, base: SurfelFit, fine: SurfelFit, pool: Pool, least: float, odds: float) -> Held:
    """What the search begins with.

    Beside a scene that has imitated a strong effect the counts do not ask for that any more. So scenes are
    also built with all effects of each kind that scenes imitate, from the first surfel on. One is taken where
    it surely predicts better than the base, and, when it has become as fine, than the fine scene without any:
    of those that predict nearly as well as the best the one with the fewest effects, since late light may be
    that of a tail, of echoes or of both. Where there are no such effects they are a burden, or the scene is a
    luckier one: where it is as good without them, it is the base. They may also do a little of what is there;
    so, where they are taken, a scene with what the counts ask for together is built in the same way.

    Args:
        scenes: of the capture.
        base: without effects, parsimonious.
        fine: the same scene as fine as the counts ask for.
        pool: what the counts ask for beside the base.
        least: nats from which on a term begins with the shapes that the pool found.
        odds: share of the best one's weight from which on one with fewer effects goes before it.

    Returns:
        The effects that are there, if any, and the scenes with them; nobody was asked whether they hold.
    """
    found = [Held([], fine, base)]
    asked = [Member(t.candidate, t.rivals) for t in pool.together if not t.candidate.free]
    known = any({m.name for m in asked} <= kind for kind in IMITATED)  # or nothing is asked for
    kinds = [[Member(c) for c in pool.candidates if c.name in kind] for kind in IMITATED]
    built = _built(scenes, base, {k: members for k, members in enumerate(kinds) if members}, least)
    for kind, members in enumerate([*kinds, asked]):
        if members is asked and not known and len(found) > 1:
            built |= _built(scenes, base, {kind: asked}, least)
        fit = built.get(kind, base)
        if not fit.extension.effects or not scenes.predicts(fit, base, SURE):
            continue
        names = [m.name for m in members]
        bare = scenes.parted(fit, names, f"begun_{'_'.join(names)}_bare")
        if not scenes.predicts(fit, bare, SURE):
            members, fit = [], bare
        grown = scenes.grown(fit, f"begun_with_{'_'.join(names)}")
        if scenes.predicts(grown, fine, SURE):
            found.append(Held(members, grown, fit))
    shares = weights([scenes.value(one.coarse) for one in found], scenes.block)
    near = [k for k, share in enumerate(shares) if share == max(shares) or share >= odds * max(shares)]
    return found[min(near, key=lambda k: (len(found[k].members), -shares[k]))]


def _built(
    scenes: Scenes, base: SurfelFit, kinds: dict[int, list[Member]], least: float
) -> dict[int, SurfelFit]:
    """Scenes built with the terms of each kind, or the base where no surfel survives with them."""
    jobs = []
    for members in kinds.values():
        extension = copy_effects(Extension([]), [_at_first(m.candidate, base, least) for m in members])
        text = f"building a scene with {', '.join(e.name for e in extension.effects)}"
        kept = f"begun_{'_'.join(m.name for m in members)}"
        jobs.append((text, kept, partial(scenes.built_or, base, extension)))
    return dict(zip(kinds, scenes.several(jobs), strict=True))


def _at_first(candidate: Candidate, base: SurfelFit, least: float) -> Effect:
    """What a scene is built with: the effect as it begins, with the shapes that the pool asks for."""
    effect = copy.deepcopy(candidate.effect)
    effect.begin(base.counts)
    if candidate.evidence > least:
        effect.set_all({p.name: candidate.effect.value(p.name) for p in effect.shapes})
    return effect.requires_grad_(True)
