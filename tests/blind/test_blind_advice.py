"""The capture that is advised tells two names apart, by no less than was worked out beforehand."""

from __future__ import annotations

import pytest
import torch
from test_blind_further import DRIFT, MAP, OPTIONS, captured, quick, ramp_along

from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.advise import AGAIN, expected_nats
from nlos_lit.inference.heldout import log_likelihood
from nlos_lit.inference.pool import ask, lit_by
from nlos_lit.inference.scenes import begun_with, copy_effects, go_on
from nlos_lit.inference.split import split_spots
from nlos_lit.surfels.fit import SurfelFit

ORDER = "a second scan in another order"


def tried(capture: Capture, held: Effect | None = None) -> tuple[dict[str, SurfelFit], dict[str, float]]:
    """Fits with either term, a wall that is known as it was, and their nats on the select spots."""
    split, scan, pipeline = split_spots(capture), Scan.of(capture), quick(capture)
    base = pipeline.fit(capture, split, pipeline.image(capture), Extension([]), 0)
    begun = {
        c.name: begun_with(base, [c])
        for c in ask(base, split, lit_by(base, scan), OPTIONS.spots, 0, only=(DRIFT, MAP)).candidates
    }
    if held is not None:
        kept = type(held)(scan)
        kept.load_state_dict(held.state_dict())
        begun[MAP] = copy_effects(base.extension, [kept.requires_grad_(False)])
    fits = {name: go_on(base.copy(begun[name], 0)) for name in (DRIFT, MAP)}
    return fits, {name: float(log_likelihood(fit, split.select).sum()) for name, fit in fits.items()}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
def test_another_order_is_advised_and_tells_what_it_should(tmp_path):
    torch.manual_seed(0)
    first = captured(tmp_path, "raster", ramp_along("raster"), 1)
    fits, _ = tried(first)
    told = expected_nats(fits[DRIFT], fits[MAP], (DRIFT, MAP))
    assert max(told, key=lambda plan: told[plan]) == ORDER
    assert told[ORDER] > 10 * told[AGAIN]
    (wall,) = fits[MAP].extension.effects
    share = len(split_spots(first).select) / first.n_spots
    for order, right, wrong in (("columns", DRIFT, MAP), ("raster", MAP, DRIFT)):
        second = captured(tmp_path, "columns", ramp_along(order), 2)
        nats = tried(second, wall)[1]
        print(order, told, nats[right] - nats[wrong], "on a share of", share)
        assert nats[right] - nats[wrong] > share * told[ORDER]
