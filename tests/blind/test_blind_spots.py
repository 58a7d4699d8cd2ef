"""Hidden effects of single spots, of the order of acquisition and of the scan's size, checked by hand."""

import dataclasses

import numpy as np
import pytest
from blind_helpers import LEVEL, WINDOW, mean_path, one_dot, work_on
from blind_inject import EFFECTS
from blind_scenes import Scene
from blind_work import BACKGROUND


@pytest.fixture(scope="module")
def dot() -> Scene:
    return one_dot()


def test_a_larger_scan_is_seen_from_farther_out(dot):
    work = work_on(dot)
    scale = EFFECTS["wall_scale"].inject(work, 0.1)["scale"]
    assert abs(scale) == pytest.approx(0.1)
    # The scan's centre is the wall's, (0, 0, 0): confocal, so that light comes after twice the distance.
    real = dot.laser * [1 + scale, 1 + scale, 1]
    legs = np.linalg.norm(real - dot.elements.centre[0], axis=1)
    np.testing.assert_allclose(mean_path(work.light, WINDOW.fine), 2 * legs, atol=0.6 * WINDOW.fine.step)


def test_hum_changes_the_background_in_the_order_of_the_scan(dot):
    work = work_on(dot)
    values = EFFECTS["hum"].inject(work, 0.5)
    level = work.background / (BACKGROUND * LEVEL)
    assert np.ptp(level, axis=1).max() == 0
    assert 0.5 < level.min() + 1e-3 < level.max() < 1.5 + 1e-9
    assert np.ptp(level) == pytest.approx(1.0, rel=0.01)
    spectrum = np.abs(np.fft.rfft(level[:, 0] - level.mean(), 16 * 1024))
    assert spectrum.argmax() / 16 == pytest.approx(values["frequency"], abs=0.2)
    np.testing.assert_array_equal(work.signal(), work_on(dot).signal())


def test_a_direct_tail_is_the_same_everywhere_only_in_a_confocal_scan(dot):
    dark = BACKGROUND * LEVEL
    work = work_on(dot)
    values = EFFECTS["direct_tail"].inject(work, 5.0)
    glow = work.background - dark
    np.testing.assert_array_equal(glow[0], glow[1000])
    assert glow[0, 0] == pytest.approx(5 * dark) == values["strongest"]
    assert glow[0, 50] / glow[0, 0] == pytest.approx(np.exp(-50 * 0.008 / values["decay"]))
    # With one laser point in a corner: the farther, the later it came and the less of it there is.
    single = dataclasses.replace(dot, laser=np.broadcast_to(dot.sensor[0], dot.sensor.shape))
    work = work_on(single)
    values = EFFECTS["direct_tail"].inject(work, 5.0)
    glow = work.background - dark
    apart = np.linalg.norm(single.laser - single.sensor, axis=1)
    shape = np.exp(apart / values["decay"]) / (1 + apart / values["reach"]) ** 2
    np.testing.assert_allclose(glow[:, 0] / glow[0, 0], shape, rtol=1e-9)
    assert glow[:, 0].max() == pytest.approx(5 * dark)


def test_late_gates_lose_the_early_bins_of_a_few_spots(dot):
    work = work_on(dot)
    values = EFFECTS["spot_gate"].inject(work, 0.8)
    ratio = work.expected() / work_on(dot).expected()
    late = np.flatnonzero(ratio[:, 0] < 0.9)
    assert len(late) == 25 == values["number"]
    start = int(values["start"])
    np.testing.assert_allclose(ratio[late, :start], 0.2)
    np.testing.assert_array_equal(ratio[late, start:], 1)
    np.testing.assert_array_equal(np.delete(ratio, late, axis=0), 1)


def test_crosstalk_comes_from_the_spot_before_in_the_order_of_the_scan(dot):
    work = work_on(dot)
    order = np.random.default_rng(0).permutation(1024)
    work.rank = 2 * order / 1023 - 1
    values = EFFECTS["crosstalk"].inject(work, 0.15)
    plain, lag = work_on(dot).expected(), int(values["lag"])
    more = work.expected() - plain
    for spot in range(0, 1024, 37):
        before = np.flatnonzero(order == order[spot] - lag)
        by_hand = 0.15 * plain[before[0]] if len(before) else np.zeros(224)
        np.testing.assert_allclose(more[spot], by_hand, atol=1e-9)
