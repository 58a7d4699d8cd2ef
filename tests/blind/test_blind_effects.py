"""Hidden effects of time, response, gain, background and counting, and those outside the registry.

Each is checked by hand.
"""

import numpy as np
import pytest
from blind_helpers import LEVEL, WINDOW, bin_path, mean_path, one_dot, points, scene_of, shift_of, work_on
from blind_inject import EFFECTS, UNKNOWN
from blind_scenes import Scene, Window
from blind_work import BACKGROUND, Work, moved_in_time


@pytest.fixture(scope="module")
def dot() -> Scene:
    return one_dot()


def test_delays_below_a_bin_keep_energy_and_move_the_mean(dot):
    delay = np.linspace(-0.02, 0.03, 1024)
    light = moved_in_time(dot.clean, dot, delay, 0.0)
    np.testing.assert_allclose(light.sum(axis=1), dot.clean.sum(axis=1))
    np.testing.assert_allclose(
        mean_path(light, WINDOW.fine) - mean_path(dot.clean, WINDOW.fine), delay, atol=1e-12
    )


def test_offset_drift_jitter_and_clock(dot):
    work = work_on(dot)
    offset = EFFECTS["time_offset"].inject(work, 3.0)["offset"]
    assert abs(offset) == pytest.approx(0.024)
    np.testing.assert_allclose(shift_of(work), offset, atol=1e-6)

    work = work_on(dot)
    values = EFFECTS["time_drift"].inject(work, 2.0)
    shift = shift_of(work)
    assert np.ptp(shift) == pytest.approx(0.016, rel=1e-3) == values["peak_to_peak"]
    assert shift.mean() == pytest.approx(0, abs=1e-6)
    assert np.abs(np.diff(shift)).max() < 3e-4
    assert np.polyfit(work.rank, shift, 1, full=True)[1][0] > 0.05 * (shift**2).sum()  # more than a slope

    work = work_on(dot)
    EFFECTS["timing_jitter"].inject(work, 1.0)
    shift = shift_of(work)
    assert shift.std() == pytest.approx(0.008, rel=0.08)
    assert abs(np.corrcoef(shift[1:], shift[:-1])[0, 1]) < 0.12

    work = work_on(dot)
    scale = EFFECTS["clock_scale"].inject(work, 0.03)["scale"]
    path = mean_path(dot.clean, WINDOW.fine)
    np.testing.assert_allclose(
        shift_of(work), scale * (path - (1.1 + 112 * 0.008)), atol=0.02 * WINDOW.fine.step
    )


def test_tail_delays_the_mean_by_its_share(dot):
    late = scene_of(points((0.0, 0.0, 0.62)))  # early light, so that the tail stays inside the window
    work = work_on(late)
    values = EFFECTS["irf_tail"].inject(work, 0.2)
    seen = work.signal()[528]
    base = work_on(late).signal()[528]
    tail = (seen - 0.8 * base) / 0.2
    decay = -WINDOW.bin_length / np.polyfit(np.arange(60), np.log(tail[40:100]), 1)[0]
    assert decay == pytest.approx(values["decay"], rel=0.01)
    rest = np.exp(-(WINDOW.t_start + 224 * 0.008 - mean_path(late.clean, WINDOW.fine)[528]) / values["decay"])
    assert tail.sum() == pytest.approx(base.sum() * (1 - rest), rel=0.02)


def test_ghost_comes_again_with_its_share(dot):
    work = work_on(scene_of(points((0.0, 0.0, 0.62))))
    values = EFFECTS["ghost_pulse"].inject(work, 0.15)
    extra = work.signal() - work_on(work.scene).signal()
    near = np.linalg.norm(work.scene.laser, axis=1) < 0.3
    np.testing.assert_allclose(
        extra.sum(axis=1)[near] / work_on(work.scene).signal().sum(axis=1)[near], 0.15, rtol=1e-3
    )
    np.testing.assert_allclose(
        (bin_path(np.maximum(extra, 0)) - bin_path(work_on(work.scene).signal()))[near],
        values["delay"],
        atol=1e-4,
    )


# Gain and background


def log_gain(work: Work) -> np.ndarray:
    """What the counts tell of it, up to a constant."""
    signal, base = work.expected() - work.background, work_on(work.scene).signal()
    assert signal.sum() == pytest.approx(LEVEL * 1024, rel=1e-3)
    return np.log(signal.sum(axis=1) / base.sum(axis=1))


def test_gains(dot):
    work = work_on(dot)
    EFFECTS["power_drift"].inject(work, 0.4)
    gain = log_gain(work)
    assert np.ptp(gain) == pytest.approx(0.4)
    assert np.abs(np.diff(gain)).max() < 0.004

    work = work_on(dot)
    EFFECTS["wall_reflectance"].inject(work, 0.2)
    gain = log_gain(work)
    assert gain.std() == pytest.approx(0.2)
    assert (
        max(np.abs(np.diff(gain.reshape(32, 32), axis=k)).max() for k in (0, 1)) < 0.12
    )  # smooth along both axes

    work = work_on(dot)
    strength = EFFECTS["vignetting"].inject(work, 0.5)["strength"]
    gain = log_gain(work)
    assert gain[0] - gain[32 * 16 + 16] == pytest.approx(-strength * (2 - 2 / 31**2))


def test_backgrounds(dot):
    dark = BACKGROUND * LEVEL
    assert dark == pytest.approx(0.15)
    kinds = {name: work_on(dot) for name in ("ambient_map", "hot_spots", "background_slope", "direct_leak")}
    values = {name: EFFECTS[name].inject(work, 0.5) for name, work in kinds.items()}
    assert np.log(kinds["ambient_map"].background[:, 7] / dark).std() == pytest.approx(0.5)
    extra = kinds["hot_spots"].background - dark
    assert (extra[:, 0] > 1e-9).sum() == 10 == values["hot_spots"]["number"]
    assert extra.sum() / 224 / 10 == pytest.approx(values["hot_spots"]["level"])
    assert values["hot_spots"]["level"] == pytest.approx(0.5 * dark, rel=0.3)
    ends = kinds["background_slope"].background[3, [0, -1]]
    slope = values["background_slope"]["slope"]
    assert ends / dark == pytest.approx([1 - slope * 223 / 224, 1 + slope * 223 / 224])
    leak = kinds["direct_leak"].background - dark
    assert leak[5].sum() * 0.008 == pytest.approx(
        values["direct_leak"]["amplitude"] * values["direct_leak"]["decay"], rel=0.01
    )
    np.testing.assert_array_equal(leak[0], leak[1000])
    assert all(np.array_equal(work.signal(), work_on(dot).signal()) for work in kinds.values())


# Counting


def counted(name: str, strength: float, counts: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
    work = work_on(
        Scene("none", Window(0.008, counts.shape[1], 0.0), np.zeros((len(counts), 3)), np.zeros(0), counts)
    )
    values = (EFFECTS | UNKNOWN)[name].inject(work, strength)
    return work.counting[0](counts), values


def test_pile_up_records_only_the_first_photon_of_a_cycle():
    per_cycle = np.array([0.05, 0.6, 0.1, 0.3, 0.02, 0.5])
    cycles = 100_000
    photons = np.random.default_rng(1).poisson(per_cycle, (cycles, 6)) > 0
    first = np.where(photons.any(axis=1), photons.argmax(axis=1), 6)
    histogram = np.bincount(first, minlength=7)[:6]
    detections = -np.expm1(-per_cycle.sum())
    recorded, _ = counted("pile_up", detections, (cycles * per_cycle)[None])
    np.testing.assert_allclose(recorded[0], histogram, atol=4 * np.sqrt(cycles) / 2)
    assert recorded.sum() / cycles == pytest.approx(detections)


def test_pile_ups_parameter_is_the_mean_over_spots():
    counts = np.random.default_rng(2).exponential(3.0, (5, 40)) * np.array([1, 2, 3, 4, 5])[:, None]
    recorded, _ = counted("pile_up", 0.3, counts)
    cycles = recorded.sum(axis=1).mean() / 0.3
    np.testing.assert_allclose(
        recorded.sum(axis=1), cycles * -np.expm1(-counts.sum(axis=1) / cycles), rtol=1e-9
    )


def test_afterpulses_follow_every_count():
    counts = np.zeros((1, 300))
    counts[0, [10, 40]] = 100, 10
    recorded, values = counted("afterpulsing", 0.3, counts)
    assert recorded[0, :10].max() < 1e-9
    assert recorded[0, 10] == pytest.approx(100)
    q = np.exp(-0.008 / values["decay"])
    assert recorded[0, 11] == pytest.approx(100 * 0.3 * (1 - q), rel=1e-6)
    assert recorded[0, 41] == pytest.approx(0.3 * (1 - q) * (100 * q**30 + 10), rel=1e-6)


def test_codes_gate_and_unknowns():
    flat = np.full((2, 200), 10.0)
    ripple, values = counted("tcspc_nonlinearity", 0.1, flat)
    wave = ripple[0] / 10 - 1
    t = np.arange(200)
    basis = np.stack(
        [np.sin(2 * np.pi * t / values["period"]), np.cos(2 * np.pi * t / values["period"])], axis=1
    )
    found, rest, *_ = np.linalg.lstsq(basis, wave, rcond=None)
    assert np.hypot(*found) == pytest.approx(0.1)
    assert rest < 1e-20
    edge, values = counted("gate_edges", 0.5, flat)
    assert edge[0, [0, -1]] == pytest.approx([5, 10 * (1 - values["end"])], rel=1e-4)
    assert edge[0, 3] == pytest.approx(10 * (1 - 0.5 * np.exp(-3 / values["width"])), rel=1e-4)
    less, _ = counted("saturation", 0.5, np.array([[1.0, 3.0], [2.0, 6.0]]))
    np.testing.assert_allclose(
        less, [[1 / (1 + 0.5 * 4 / 6), 3 / (1 + 0.5 * 4 / 6)], [2 / (1 + 0.5 * 8 / 6), 6 / (1 + 0.5 * 8 / 6)]]
    )


def test_missing_codes_lie_in_the_light(dot):
    work = work_on(dot)
    first = int(UNKNOWN["missing_codes"].inject(work, 0.6)["first"])
    ratio = work.expected() / work_on(dot).expected()
    np.testing.assert_allclose(
        ratio,
        np.broadcast_to(np.where(np.isin(np.arange(224), range(first, first + 5)), 0.4, 1), ratio.shape),
    )
    arrived = np.cumsum(work.signal().sum(axis=0)) / work.signal().sum()
    assert 0.2 < arrived[first] < 0.9


def test_unknowns_of_the_scan_and_the_wall(dot):
    work = work_on(dot)
    cycles = UNKNOWN["mains_ripple"].inject(work, 0.2)["cycles"]
    spectrum = np.abs(np.fft.rfft(work.gain - work.gain.mean(), 16 * 1024))
    assert 12 <= cycles <= 20
    assert spectrum.argmax() / 16 == pytest.approx(cycles, abs=0.15)

    work = work_on(dot)
    UNKNOWN["dead_stripe"].inject(work, 0.5)
    halved = (work.gain == 0.5).reshape(32, 32)
    assert set(np.unique(work.gain)) == {0.5, 1.0}
    assert not halved.all(axis=0).any()
    assert not halved.all(axis=1).any()

    work = work_on(dot)
    UNKNOWN["moving_object"].inject(work, 0.01)
    shift = mean_path(work.light, WINDOW.fine) - mean_path(dot.clean, WINDOW.fine)
    cosine = 0.7 / np.linalg.norm(dot.laser - dot.elements.centre[0], axis=1)
    np.testing.assert_allclose(shift, np.where(np.arange(1024) < 512, 0, -0.02 * cosine), atol=1.3e-3)
