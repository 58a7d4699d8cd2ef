"""What a free term follows: a formula with few numbers, where one predicts as well."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, surfels

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference import scenes as module
from nlos_lit.inference.distil import Follower, distil, laid_through
from nlos_lit.inference.heldout import Comparison, compare
from nlos_lit.inference.scenes import Scenes
from nlos_lit.inference.split import split_spots
from nlos_lit.runtime.steps import Steps

pytestmark = FORWARD_MODE
SIDE = 16
ORDER = np.random.default_rng(5).permutation(SIDE**2)  # of acquisition


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve surfels need few batches."""
    monkeypatch.setattr(module, "WARM", 40)


def followed(factor: np.ndarray) -> dict[str, Follower]:
    """Counts times ``factor`` ``[S]`` in order of acquisition; the free term of the scan is fitted, and
    distilled.
    """
    scene = capture_of(raster(SIDE), scan_order=ORDER)
    model = surfels(scene, level=4.0)
    by_spot = torch.from_numpy(factor[ORDER]).float()[:, None]
    measured = drawn(model, Extension([]), scene, seed=1, factor=by_spot)
    scan, split = Scan.of(measured), split_spots(measured)
    fit = fit_of(model, measured, Extension([effect_of("free_scan", scan)]), split.fit)
    fit.go_on(200)
    scenes = Scenes(None, None, split, 0, Steps(), 1)
    value, less = (scenes.value(f) for f in (fit, scenes.without(fit, ["free_scan"])))
    return distil(scenes, scan, accepting(fit, "free_scan", compare(less, value, scenes.block)))


def accepting(fit: object, term: str, gain: Comparison) -> SimpleNamespace:
    """Findings of a loop that accepted one term."""
    member = SimpleNamespace(name=term, trial=SimpleNamespace(gain=gain))
    return SimpleNamespace(final=fit, accepted=[member])


def test_a_jump_is_told_by_its_place_and_height():
    passed = (np.arange(SIDE**2) + 0.5) / SIDE**2
    (found,) = followed(np.where(passed < 0.6, 1.0, 1.3)).values()
    assert found.name == "counts_over_scan_step"
    assert found.offered
    assert found.share > 1, "two numbers are known better than 63"
    (step,) = found.fit.extension.effects
    assert float(step.value("place").detach()) == pytest.approx(0.6, abs=0.02)
    assert float(step.value("height").detach()) == pytest.approx(np.log(1.3), rel=0.1)
    free = effect_of("free_scan", step.scan, field=torch.eye(63)[0])
    line = laid_through(step, free, found.fit, torch.tensor([0.0, SIDE**2]))
    assert line[1] - line[0] == pytest.approx(np.log(1.3), rel=0.1)
    assert line.mean() == pytest.approx(0.0, abs=0.1), "as high as the term, which is zero on average"


def test_what_follows_no_formula_is_not_offered():
    """Every stretch of the scan has a gain of its own."""
    gains = np.exp(0.2 * np.random.default_rng(3).standard_normal(64))
    for found in followed(np.repeat(gains, SIDE**2 // 64)).values():
        assert found.share < 0.6
        assert not found.offered


def test_a_map_of_the_wall_follows_no_formula_of_one_axis():
    assert distil(None, None, accepting(None, "free_wall", Comparison(50.0, 1.0, (48.0, 52.0)))) == {}


@pytest.mark.parametrize(("share", "offered"), [(0.899, False), (0.9, True)])
def test_nine_tenths_of_the_gain_are_asked_for(share, offered):
    assert Follower("counts_over_scan_wave", None, share).offered == offered
