"""Backward: effects that those accepted after them made needless."""

from __future__ import annotations

from functools import partial

from nlos_lit.effects.extension import Extension
from nlos_lit.inference.joint_step import copy_effects
from nlos_lit.inference.refit import compare, log_likelihood, refit_with
from nlos_lit.inference.split import Split
from nlos_lit.runtime.steps import Steps
from nlos_lit.surfels.fit import SurfelFit


def drop_needless(fit: SurfelFit, split: Split, batches: int, seed: int, steps: Steps) -> SurfelFit:
    """Backward: an effect accepted early may be explained by those that came later.

    Args:
        fit: with all accepted effects.
        split: of the spots.
        batches: of each refit.
        seed: of the batches.
        steps: says and keeps what is done.

    Returns:
        the fit without needless effects; at least one stays.
    """
    block = split.block[split.select]
    while len(fit.extension.effects) > 1:
        names = [e.name for e in fit.extension.effects]
        steps.plan(refit=len(names) + 1)
        key = f"drop{len(names)}"
        whole = steps("refit", "refitting with all effects", key, partial(refit_with, fit, [], batches, seed))
        reference, losses = log_likelihood(whole, split.select), []
        for name in names:
            fewer = steps(
                "refit",
                f"refitting without {name}",
                f"{key}_{name}",
                partial(_without, fit, name, batches, seed),
            )
            losses.append((compare(log_likelihood(fewer, split.select), reference, block), fewer))
        least, fewer = min(losses, key=lambda entry: entry[0].nats)
        if least.nats > 2 * least.error:
            break
        fit = fewer
    return fit


def _without(fit: SurfelFit, name: str, batches: int, seed: int) -> SurfelFit:
    """Refitted without one of its effects."""
    fewer = fit.copy(Extension([e for e in copy_effects(fit.extension, []).effects if e.name != name]), seed)
    fewer.run(1, steps=batches, settle=False)
    return fewer
