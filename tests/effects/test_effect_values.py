"""Every effect against numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from effect_contract import BIN, GATE, SPOTS, capture, registered, scene
from torch import Tensor

from nlos_lit.effects import EFFECTS, Effect, Extension, Scan
from nlos_lit.effects.basis import smooth_basis, smooth_map_basis, spline_basis
from nlos_lit.functional.surfel_paths import Paths

FIRST, LAST = GATE


def effect(name: str, kind: str = "confocal", scan: Scan | None = None, **values: float | Tensor) -> Effect:
    built = registered(name)(scene(kind)[1] if scan is None else scan)
    for parameter, value in values.items():
        built.set(parameter, value)
    return built


def hand_scan(laser: list[list[float]], sensor: list[list[float]] | None = None) -> Scan:
    """A scan of given wall points, everything else as in the contract's scenes."""
    points = torch.tensor(laser)
    other = points if sensor is None else torch.tensor(sensor)
    base = scene("confocal")[1]
    moving = (points,) if sensor is None else (points, other)
    return dataclasses.replace(
        base,
        places=tuple(p[:, :2] / 0.5 for p in moving),
        half=0.5,
        rank=torch.linspace(-1, 1, len(points)),
        laser=points,
        sensor=other,
        confocal=sensor is None,
    )


def hand_paths(
    laser_leg=1.0, sensor_leg=1.0, laser_cosine=1.0, sensor_cosine=1.0, centre=(0.0, 0.0, 1.0), normal=(0.0, 0.0, -1.0)
) -> Paths:
    """One spot, one surfel, one point; throughput and length are not looked at by any hook."""
    numbers = [torch.full((1, 1, 1), float(v)) for v in (1, 0, laser_leg, sensor_leg, laser_cosine, sensor_cosine)]
    return Paths(*numbers, torch.tensor([centre]), torch.tensor([normal]), torch.tensor([0.01]))


ONE, SPOT = torch.ones(1, 1, 1), torch.tensor([0])


def test_retroreflection_turns_the_fourth_power_into_the_second():
    retro = effect("retroreflection", falloff=2.0, cosine=1.0)
    near, far = (retro.path(ONE, hand_paths(d, d), SPOT).item() for d in (0.5, 1.0))
    # The base carries d⁻⁴; twice as far, a retroreflector is 4 times and not 16 times darker, so the factor is 4.
    assert far / near == pytest.approx(4.0, rel=1e-5)
    # At d0, half the path at the middle of the gate 0.62 m + 35 bins of 2 cm = 1.32 m, nothing changes.
    assert retro.path(ONE, hand_paths(0.66, 0.66), SPOT).item() == pytest.approx(1.0, rel=1e-5)
    grazing = effect("retroreflection", falloff=4.0, cosine=0.5)
    # (0.25 · 0.64)^(-1/2) = 1/0.4
    assert grazing.path(ONE, hand_paths(1, 2, 0.25, 0.64), SPOT).item() == pytest.approx(2.5, rel=1e-5)


def test_specular_lobe_peaks_along_the_mirror_direction():
    # Wall points at x = ±0.75, surfel at depth 1 facing the wall: the half vector is the normal.
    scan = hand_scan([[-0.75, 0, 0]], [[0.75, 0, 0]])
    lobe = effect("specular_lobe", scan=scan, strength=0.5, exponent=4.0)
    assert lobe.path(ONE, hand_paths(1.25, 1.25, 0.8, 0.8), SPOT).item() == pytest.approx(1 + 0.5 * 3, rel=1e-5)
    # Confocal at 60° from the normal: cos θh = 0.5, 1 + 0.5 · 3 · 0.5⁴.
    lobe = effect("specular_lobe", scan=hand_scan([[0.0, 0, 0]]), strength=0.5, exponent=4.0)
    assert lobe.path(ONE, hand_paths(1, 1, 0.5, 0.5), SPOT).item() == pytest.approx(1 + 1.5 / 16, rel=1e-5)


def test_occlusion_blocks_legs_that_cross_the_disc():
    # Disc of radius 0.1 at (0.25, 0, 0.5). The leg from (0.5, 0, 0) to (0, 0, 1) crosses its centre, that from (0, 0, 0) passes.
    scan = hand_scan([[0.5, 0, 0], [0.0, 0, 0]], [[0.0, 0, 0], [0.0, 0, 0]])
    disc = effect("occlusion", scan=scan, opacity=0.6, x=0.25, y=0.0, z=0.5, radius=0.1)
    factor = [disc.path(ONE, hand_paths(), torch.tensor([s])).item() for s in (0, 1)]
    assert factor == pytest.approx([0.4, 1.0], abs=1e-3)
    # A surfel before the disc is not hidden; confocal spots lose light both ways; half of it gets through at the disc's rim.
    assert disc.path(ONE, hand_paths(centre=(0.375, 0, 0.25)), SPOT).item() == pytest.approx(1.0, abs=1e-3)
    both = effect("occlusion", scan=hand_scan([[0.5, 0, 0]]), opacity=0.6, x=0.25, y=0.0, z=0.5, radius=0.1)
    assert both.path(ONE, hand_paths(), SPOT).item() == pytest.approx(0.16, abs=1e-3)
    both.set("y", 0.1)
    assert both.path(ONE, hand_paths(), SPOT).item() == pytest.approx(0.7**2, abs=1e-3)


def test_wall_tilt_shortens_legs():
    # Spot at X = 0.4 of a scan centred on 0.1: X from its centre is 0.3, z = 0.02 · 0.3 = 6 mm. Leg (-0.3, 0, 0.4): cos = 0.8.
    scan = hand_scan([[0.4, 0.0, 0.0], [-0.2, 0.0, 0.0]])
    scan = dataclasses.replace(scan, places=(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]),), half=0.3)
    tilt = effect("wall_tilt", scan=scan, tilt_x=0.02)
    length = tilt.time(ONE, hand_paths(centre=(0.1, 0.0, 0.4)), SPOT).item()
    assert length == pytest.approx(1 - 2 * 0.8 * 0.006, abs=1e-6)
    assert effect("wall_tilt", scan=scan, tilt_y=0.02).time(ONE, hand_paths(), SPOT).item() == 1.0


def test_wall_tilt_is_the_real_change_of_length():
    tilt = effect("wall_tilt", "exhaustive", tilt_x=0.01, tilt_y=-0.005)
    model, scan = scene("exhaustive")
    spots = torch.arange(SPOTS)
    paths = model.paths(spots)
    moved = []
    for wall in (scan.laser, scan.sensor):
        low, high = (torch.cat([scan.laser, scan.sensor])[:, :2].aminmax(dim=0)[k] for k in (0, 1))
        x, y = (wall[:, :2] - (low + high) / 2).T
        real = wall + torch.stack([0 * x, 0 * x, 0.01 * x - 0.005 * y], 1)
        moved.append(torch.cdist(real, paths.centre) - torch.cdist(wall, paths.centre))
    ours = (tilt.time(paths.length, paths, spots) - paths.length)[..., 0]
    assert ours.detach() == pytest.approx((moved[0] + moved[1]).detach(), abs=2e-5)


def test_baseline_moves_the_sensor_alone():
    # Sensor (0, 0, 0) looks at (0.3, 0, 0): the leg to (0.3, 0, 0.4) shrinks from 0.5 to 0.4.
    scan = hand_scan([[0.0, 0.0, 0.0]])
    scan = dataclasses.replace(scan, half=2.0)
    baseline = effect("laser_sensor_baseline", scan=scan, baseline_x=0.3)
    paths = hand_paths(centre=(0.3, 0.0, 0.4))
    assert baseline.time(ONE, paths, SPOT).item() == pytest.approx(1 - 0.1, abs=1e-6)
    # cosθ cosθ/d²: from 0.8²/0.25 to 1/0.16.
    assert baseline.path(ONE, paths, SPOT).item() == pytest.approx((1 / 0.16) / (0.64 / 0.25), rel=1e-5)


def test_baseline_is_the_model_of_the_moved_sensor():
    model, _ = scene("exhaustive")
    baseline, spots = effect("laser_sensor_baseline", "exhaustive", baseline_x=0.02, baseline_y=-0.015), torch.arange(SPOTS)
    stated = model.sensor.clone()
    paths = model.paths(spots)
    model.sensor = stated + torch.tensor([0.02, -0.015, 0.0])
    real = model.paths(spots)
    model.sensor = stated
    assert baseline.time(paths.length, paths, spots).detach() == pytest.approx(real.length.detach(), abs=2e-3)
    changed, truth = baseline.path(paths.contribution, paths, spots).sum(2).detach(), real.contribution.sum(2).detach()
    lit = truth > 0.05 * truth.max()
    assert changed[lit] == pytest.approx(truth[lit], rel=0.01)


def test_offsets_of_time():
    paths, lengths = hand_paths(), torch.full((1, 1, 1), 1.52)
    assert effect("time_offset", offset=0.05).time(lengths, paths, SPOT).item() == pytest.approx(1.57, abs=1e-6)
    # The gate's middle is at 0.62 + 0.02 · 35 = 1.32 m: 0.2 m from it becomes 0.21 m.
    assert effect("clock_scale", scale=0.05).time(lengths, paths, SPOT).item() == pytest.approx(1.53, abs=1e-6)
    jitter = effect("timing_jitter", offset=torch.tensor([0.03, -0.04] + [0.0] * (SPOTS - 2)))
    assert jitter.time(lengths, paths, torch.tensor([1])).item() == pytest.approx(1.48, abs=1e-6)
    sigma = jitter.quantities()["sigma"].value.item()
    assert sigma == pytest.approx(0.05 / math.sqrt(SPOTS), abs=1e-5)


def test_time_drift_follows_the_order_of_acquisition():
    drift = effect("time_drift")
    size = drift.declared["drift"].size
    assert size == 5
    drift.set("drift", torch.linspace(-0.01, 0.03, size))
    spots = torch.arange(SPOTS)
    shift = drift.time(torch.zeros(SPOTS, 1, 1), hand_paths(), spots)[:, 0, 0].detach()
    assert shift.mean().item() == pytest.approx(0, abs=1e-7)
    # rms: orthonormal functions; peak to peak: the extremes.
    quantities = drift.quantities()
    assert quantities["rms"].value.item() == pytest.approx(math.sqrt(shift.square().mean().item()), abs=1e-5)
    assert quantities["peak_to_peak"].value.item() == pytest.approx((shift.max() - shift.min()).item(), abs=1e-6)
    # A straight line over the scan order is among its functions.
    rank = drift.scan.rank
    line = drift.functions @ (drift.functions.T @ rank) / SPOTS
    assert line == pytest.approx(rank, abs=1e-4)


def test_irf_tail_keeps_the_energy_and_delays_it():
    scan = dataclasses.replace(scene("confocal")[1], n_bins=4000)
    tail = effect("irf_tail", scan=scan, fraction=0.3, decay=10 * BIN)
    kernel = torch.zeros(30)
    kernel[5] = 1.0
    late = tail.response(kernel, 5).detach()
    assert late.sum().item() == pytest.approx(1, abs=1e-5)
    # Bin k behind the peak holds e^{-k/10} - e^{-(k+1)/10} of the tail.
    assert late[5].item() == pytest.approx(0.7 + 0.3 * (1 - math.exp(-0.1)), abs=1e-6)
    assert late[25].item() == pytest.approx(0.3 * (math.exp(-2) - math.exp(-2.1)), abs=1e-6)
    assert late[:5].abs().max().item() < 1e-6


def test_ghost_pulse_stands_at_its_delay():
    ghost = effect("ghost_pulse", fraction=0.2, delay=7.25 * BIN)
    kernel = torch.zeros(6)
    kernel[2] = 1.0
    doubled = ghost.response(kernel, 2).detach()
    assert len(doubled) == 2 + LAST
    expected = torch.zeros(2 + LAST)
    expected[2], expected[9], expected[10] = 1.0, 0.2 * 0.75, 0.2 * 0.25
    assert doubled == pytest.approx(expected, abs=1e-5)


def test_gains_of_spots():
    signal, spots = torch.full((2, LAST), 3.0), torch.tensor([4, 1])
    scan = scene("confocal")[1]
    place = scan.places[0]
    vignetting = effect("vignetting", strength=0.3).gain(signal, spots).detach()
    assert vignetting[:, 7] == pytest.approx(3 * torch.exp(-0.3 * (place[spots] ** 2).sum(1)), rel=1e-5)
    drift = effect("power_drift")
    drift.set("drift", torch.tensor([0.1, -0.2, 0.0, 0.3, 0.05]))
    assert drift.gain(signal, spots)[:, 3].detach() == pytest.approx(3 * torch.exp(drift.field()[spots]).detach(), rel=1e-5)
    assert drift.field().mean().item() == pytest.approx(0, abs=1e-6)
    assert drift.quantities()["rms"].value.item() == pytest.approx(math.sqrt(0.01 + 0.04 + 0.09 + 0.0025), abs=1e-4)


def grid_scan(n: int) -> Scan:
    line = torch.linspace(-1, 1, n)
    places = torch.cartesian_prod(line, line)
    return dataclasses.replace(scene("confocal")[1], places=(places,), rank=torch.linspace(-1, 1, n * n))


@pytest.mark.parametrize(("name", "pieces"), [("wall_reflectance", 6), ("ambient_map", 5)])
def test_maps_hold_every_smooth_function_of_the_wall_but_the_constant(name, pieces):
    built = effect(name, scan=grid_scan(12))
    assert built.functions.shape == (144, pieces**2 - 1)
    x, y = built.scan.places[0].T
    smooth = x + 0.5 * y**2 - 0.7 * x * y**3
    smooth = smooth - smooth.mean()
    fitted = built.functions @ (built.functions.T @ smooth) / 144
    assert fitted == pytest.approx(smooth, abs=1e-4)
    built.set(built.coefficients, 0.1)
    # Orthonormal: rms 0.1 · √(number of functions).
    assert built.quantities()["rms"].value.item() == pytest.approx(0.1 * math.sqrt(pieces**2 - 1), rel=1e-3)


def test_reflectance_is_one_map_of_both_wall_points():
    """A spot with laser at a, sensor at b has the gain of the spot with laser at b, sensor at a: f(a) + f(b)."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, 40, 2, generator=generator) * 2 - 1
    points = [torch.cat([p / 2, torch.zeros(40, 1)], 1) for p in (a, b)]
    scan = hand_scan(torch.cat(points).tolist(), torch.cat(points[::-1]).tolist())
    wall = effect("wall_reflectance", scan=scan)
    wall.set("gain_map", torch.linspace(-0.1, 0.2, wall.declared["gain_map"].size))
    field = wall.field().detach()
    assert field[:40] == pytest.approx(field[40:], abs=1e-5)
    assert field.abs().max() > 0.05
    # Both points at one place: the gain of that place twice, e^{2f}, so functions of mean square 4.
    twice = effect("wall_reflectance", scan=hand_scan(points[0].tolist(), points[0].tolist()))
    assert twice.functions.square().mean(0) == pytest.approx(torch.full((twice.functions.shape[1],), 4.0), rel=1e-4)


def test_backgrounds():
    level, spots = torch.tensor(2.0), torch.tensor([3, 0])
    sloped = effect("background_slope", slope=0.4).background(level, spots).detach()
    # The gate's bins 6 … 63 have middles at τ = ∓(1 - 1/58); before the gate τ = -1.
    assert sloped[6].item() == pytest.approx(2 * (1 - 0.4 * (1 - 1 / 58)), rel=1e-5)
    assert sloped[63].item() == pytest.approx(2 * (1 + 0.4 * (1 - 1 / 58)), rel=1e-5)
    assert sloped[0].item() == pytest.approx(1.2, rel=1e-5)
    extra = torch.zeros(SPOTS)
    extra[3], extra[5], extra[6] = 4.0, 2.0, 0.01
    hot = effect("hot_spots", extra=extra)
    assert hot.background(level, spots)[:, 0].tolist() == pytest.approx([6.0, 2.0])
    assert {n: q.value.item() for n, q in hot.quantities().items()} == pytest.approx({"level": 3.0, "number": 2.0})
    assert effect("hot_spots").quantities()["number"].value.item() == 0
    leak = effect("direct_leak", amplitude=5.0, decay=4 * BIN).background(level, spots).detach()
    assert leak[[0, 6, 10]].tolist() == pytest.approx([7.0, 7.0, 2 + 5 / math.e], rel=1e-5)
    ambient = effect("ambient_map", level_map=0.1)
    assert ambient.background(level, spots)[:, 0].detach() == pytest.approx(
        2 * torch.exp(ambient.field()[spots]).detach(), rel=1e-5
    )


def test_afterpulsing_by_hand():
    scan = dataclasses.replace(scene("confocal")[1], n_bins=400)
    after = effect("afterpulsing", scan=scan, probability=0.25, decay=5 * BIN)
    counts = torch.zeros(1, 400)
    counts[0, 3], counts[0, 4] = 100.0, 40.0
    seen = after.counting(counts, SPOT)[0].detach()
    # p_k = (e^{0.2} - 1) e^{-0.2 k}: bin 4 gets p_1 of bin 3 and nothing of itself.
    p1, p2 = ((math.exp(0.2) - 1) * math.exp(-0.2 * k) for k in (1, 2))
    assert seen[3:6].tolist() == pytest.approx([100.0, 40 + 25 * p1, 25 * p2 + 10 * p1], rel=1e-5)
    assert seen.sum().item() == pytest.approx(140 * 1.25, rel=1e-5)


def test_pile_up_is_coates_formula():
    scan = dataclasses.replace(scene("confocal")[1], mean_counts=300.0)
    pile = effect("pile_up", scan=scan, detections=0.3)  # 1000 cycles
    seen = pile.counting(torch.tensor([[200.0, 700.0, 0.05]]), SPOT)[0].tolist()
    free = math.exp(-0.2)
    by_hand = [1000 * (1 - free), 1000 * (1 - math.exp(-0.7)) * free, 0.05 * math.exp(-0.9)]
    assert seen == pytest.approx(by_hand, rel=1e-4)
    # Drawn cycle by cycle: the first photon is kept.
    rng = np.random.default_rng(0)
    photons = rng.poisson([0.2, 0.7], (200_000, 2)) > 0
    assert photons[:, 0].mean() == pytest.approx(seen[0] / 1000, abs=4e-3)
    assert (photons[:, 1] & ~photons[:, 0]).mean() == pytest.approx(seen[1] / 1000, abs=4e-3)


def test_ripple_and_edges_of_the_gate():
    counts = torch.full((1, LAST), 10.0)
    ripple = effect("tcspc_nonlinearity", sine=0.3, cosine=0.4, period=8.0)
    seen = ripple.counting(counts, SPOT)[0].detach()
    assert seen[[0, 2, 4, 6, 8]].tolist() == pytest.approx([14, 13, 6, 7, 14], rel=1e-5)
    assert ripple.quantities()["amplitude"].value.item() == pytest.approx(0.5, abs=1e-5)
    edges = effect("gate_edges", start=0.5, end=0.2, width=2.0)
    seen = edges.counting(counts, SPOT)[0].detach()
    by_hand = [10, 5, 10 * (1 - 0.5 / math.e), 10 * (1 - 0.2 / math.e), 8]
    assert seen[[FIRST - 1, FIRST, FIRST + 2, LAST - 3, LAST - 1]].tolist() == pytest.approx(by_hand, rel=1e-5)


def test_no_frequency_of_a_ripple_is_missed():
    for width in (58, 300):
        scan = dataclasses.replace(scene("confocal")[1], gate=(10, 10 + width), n_bins=10 + width)
        f = 1 / np.array(effect("tcspc_nonlinearity", scan=scan).declared["period"].grid)
        assert f[0] == pytest.approx(max(1 / 64, 2 / width))
        assert f[-1] == pytest.approx(1 / 2.2)
        assert np.diff(f).max() <= 1 / (1.5 * width) * 1.05
        assert len(f) <= 200


def test_delays_of_ghosts_are_scanned_densely():
    scan = dataclasses.replace(scene("confocal")[1], n_bins=512)
    bins = np.array(effect("ghost_pulse", scan=scan).declared["delay"].grid) / BIN
    assert bins[0] == pytest.approx(4)
    assert np.diff(bins)[bins[:-1] < 37] == pytest.approx(3.0)
    assert 0.56 * 512 < bins[-1] <= 0.6 * 512
    assert (bins[1:] / bins[:-1])[bins[:-1] > 42] == pytest.approx(1.06)


def test_splines_sum_to_one_and_are_smooth():
    u = torch.linspace(-1, 1, 201, dtype=torch.float64)
    basis = spline_basis(u, 6)
    assert basis.sum(1) == pytest.approx(torch.ones(201), abs=1e-12)
    functions = smooth_basis(u, 6)
    assert functions.shape == (201, 5)
    assert functions.T @ functions / 201 == pytest.approx(torch.eye(5, dtype=torch.float64), abs=1e-9)
    assert functions.mean(0).abs().max() < 1e-9
    # Few points: as many functions as they can tell apart.
    assert smooth_map_basis(torch.rand(4, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1, 6).shape == (4, 3)
    assert smooth_basis(torch.zeros(1), 6).shape == (1, 0)


@pytest.mark.parametrize("kind", ["single", "exhaustive"])
def test_scan_knows_its_centre(kind):
    scan = scene(kind)[1]
    moving = scan.sensor if kind == "single" else torch.cat([scan.laser, scan.sensor])
    low, high = moving[:, :2].aminmax(dim=0)
    assert scan.centre == pytest.approx((low + high) / 2, abs=1e-6)
    assert scan.middle == pytest.approx(0.62 + 0.02 * 35)


@pytest.mark.parametrize("built", EFFECTS, ids=lambda e: e.name)
def test_a_fixed_laser_works(built):
    """Single-laser scans, all effects at their nulls: nothing changes."""
    model, scan = scene("single")
    spots = torch.arange(SPOTS)
    assert model.expected(spots, Extension([built(scan)])) == pytest.approx(model.expected(spots), rel=1e-5, abs=1e-4)


def test_one_spot_is_enough():
    whole = capture("confocal")
    points = {name: getattr(whole, name)[:1] for name in ("laser", "sensor", "laser_normal", "sensor_normal")}
    alone = dataclasses.replace(whole, counts=whole.counts[:1], scan_order=None, **points)
    scan = Scan.of(alone)
    for built in EFFECTS:
        assert built(scan).quantities() is not None
