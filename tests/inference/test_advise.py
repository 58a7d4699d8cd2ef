"""What another capture would tell of two terms that this one leaves open."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, surfels

from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.advise import AGAIN, across, expected_nats, plans
from nlos_lit.surfels.fit import SurfelFit

pytestmark = FORWARD_MODE
SIDE = 12


def scanned() -> Capture:
    """By columns of the wall, bright."""
    return capture_of(raster(SIDE), scan_order=np.arange(SIDE**2))


def both(true: str, other: str, **values: float) -> tuple[SurfelFit, SurfelFit]:
    """Fits of counts that hold one effect: with it as it is, and with the other in its place, fitted."""
    scene = scanned()
    scan = Scan.of(scene)
    right = effect_of(true, scan)
    right.draw(values or right.typical(scan), np.random.default_rng(2))
    measured = drawn(surfels(scene, level=20.0), Extension([right]), scene, seed=1)
    one = fit_of(surfels(measured, level=20.0), measured, Extension([right]))
    wrong = fit_of(surfels(measured, level=20.0), measured, Extension([effect_of(other, scan)]))
    wrong.go_on(160)
    return one, wrong


def test_another_order_tells_a_drift_from_a_map_of_the_wall():
    """The drift comes again along the new order, the wall keeps its map."""
    fits = both("power_drift", "wall_reflectance")
    told = expected_nats(*fits, ("power_drift", "wall_reflectance"))
    order = told["a second scan in another order"]
    assert max(told, key=lambda name: told[name]) == "a second scan in another order"
    assert order > 20
    assert order > 5 * told[AGAIN]
    assert told["a capture with the laser off"] < 1, "neither shows without light"


def test_without_the_laser_single_spots_are_told_from_a_map_of_the_background():
    """Either shows there as it does here, with nothing else beside it."""
    told = expected_nats(*both("hot_spots", "ambient_map"), ("hot_spots", "ambient_map"))
    assert max(told, key=lambda name: told[name]) == "a capture with the laser off"


def test_two_terms_that_are_one_tell_nothing():
    """Whatever is done, a term is like itself."""
    one, _ = both("power_drift", "power_drift")
    told = expected_nats(one, one, ("power_drift", "power_drift"))
    assert max(told.values()) < 1e-3


def test_plans_are_the_same_scan_but_for_one_thing():
    scene = scanned()
    again, order, tenth, dark = plans(scene)
    assert again.of is tenth.of is dark.of is scene
    assert (again.power, tenth.power) == (1.0, 0.1)
    assert dark.power < 1e-3
    assert np.array_equal(order.of.laser, scene.laser)
    assert np.corrcoef(order.of.scan_order, scene.scan_order)[0, 1] == pytest.approx(2 * SIDE / (SIDE**2 + 1))


def test_a_scan_without_an_order_of_its_own_goes_along_an_axis():
    scene = capture_of(raster(SIDE), scan_order=np.random.default_rng(1).permutation(SIDE**2))
    rank = across(scene)
    assert sorted(rank) == list(range(SIDE**2))
    steps = np.abs(np.diff(scene.sensor[np.argsort(rank)], axis=0)).max(axis=1)
    assert np.median(steps) == pytest.approx(0.8 / (SIDE - 1))
    assert torch.is_tensor(Scan.of(scene).rank)
