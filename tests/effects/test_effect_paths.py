"""Effects on single paths and on time, against numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from effect_contract import SPOTS, scene
from effect_hand import ONE, SPOT, effect, hand_paths, hand_scan

from nlos_lit.effects.effect import Asked


def test_retroreflection_turns_the_fourth_power_into_the_second():
    retro = effect("retroreflection", falloff=2.0, cosine=1.0)
    near, far = (retro.path(ONE, hand_paths(d, d), SPOT).item() for d in (0.5, 1.0))
    # The base carries d⁻⁴; twice as far, a retroreflector is 4 times and not 16 times darker, so the factor
    # is 4.
    assert far / near == pytest.approx(4.0, rel=1e-5)
    # At d0, half the path at the middle of the gate 0.62 m + 35 bins of 2 cm = 1.32 m, nothing changes.
    assert retro.path(ONE, hand_paths(0.66, 0.66), SPOT).item() == pytest.approx(1.0, rel=1e-5)
    grazing = effect("retroreflection", falloff=4.0, cosine=0.5)
    # (0.25 · 0.64)^(-1/2) = 1/0.4
    assert grazing.path(ONE, hand_paths(1, 2, 0.25, 0.64), SPOT).item() == pytest.approx(2.5, rel=1e-5)


def test_retroreflecting_sheeting_sends_back_less_of_what_enters_at_an_angle():
    sheeting = effect("retroreflection", falloff=4.0, cosine=1.0, entrance=5.0)

    def kept(degrees: float) -> float:
        cosine = math.cos(math.radians(degrees))
        return sheeting.path(ONE, hand_paths(1, 1, cosine, cosine), SPOT).item()

    # tan⁴ 30° = 1/9: beside the cos² of the base 0.75 · e^(-5/9) = 0.43, as type I sheeting keeps at least.
    assert kept(30) == pytest.approx(math.exp(-5 / 9), rel=1e-5)
    assert 0.75 * kept(30) == pytest.approx(30 / 70, abs=0.002)
    assert kept(0) == 1.0
    assert kept(45) == pytest.approx(math.exp(-5), rel=1e-4)
    # From 60° on, tan² = 3, nothing is lost any more.
    assert kept(60) == pytest.approx(math.exp(-45), rel=1e-3)
    assert kept(80) == pytest.approx(math.exp(-45), rel=1e-3)


def test_specular_lobe_peaks_along_the_mirror_direction():
    # Wall points at x = ±0.75, surfel at depth 1 facing the wall: the half vector is the normal.
    scan = hand_scan([[-0.75, 0, 0]], [[0.75, 0, 0]])
    lobe = effect("specular_lobe", scan=scan, strength=0.5, exponent=4.0)
    assert lobe.path(ONE, hand_paths(1.25, 1.25, 0.8, 0.8), SPOT).item() == pytest.approx(
        1 + 0.5 * 3, rel=1e-5
    )
    # Confocal at 60° from the normal: cos θh = 0.5, 1 + 0.5 · 3 · 0.5⁴.
    lobe = effect("specular_lobe", scan=hand_scan([[0.0, 0, 0]]), strength=0.5, exponent=4.0)
    assert lobe.path(ONE, hand_paths(1, 1, 0.5, 0.5), SPOT).item() == pytest.approx(1 + 1.5 / 16, rel=1e-5)


def test_occlusion_blocks_legs_that_cross_the_disc():
    # Disc of radius 0.1 at (0.25, 0, 0.5). The leg from (0.5, 0, 0) to (0, 0, 1) crosses its centre, that
    # from (0, 0, 0) passes.
    scan = hand_scan([[0.5, 0, 0], [0.0, 0, 0]], [[0.0, 0, 0], [0.0, 0, 0]])
    disc = effect("occlusion", scan=scan, opacity=0.6, x=0.25, y=0.0, z=0.5, radius=0.1)
    factor = [disc.path(ONE, hand_paths(), torch.tensor([s])).item() for s in (0, 1)]
    assert factor == pytest.approx([0.4, 1.0], abs=1e-3)
    # A surfel before the disc is not hidden; confocal spots lose light both ways; half of it gets through at
    # the disc's rim.
    assert disc.path(ONE, hand_paths(centre=(0.375, 0, 0.25)), SPOT).item() == pytest.approx(1.0, abs=1e-3)
    both = effect("occlusion", scan=hand_scan([[0.5, 0, 0]]), opacity=0.6, x=0.25, y=0.0, z=0.5, radius=0.1)
    assert both.path(ONE, hand_paths(), SPOT).item() == pytest.approx(0.16, abs=1e-3)
    both.set("y", 0.1)
    assert both.path(ONE, hand_paths(), SPOT).item() == pytest.approx(0.7**2, abs=1e-3)


@pytest.mark.parametrize("confocal", [True, False])
@pytest.mark.parametrize(("x", "y"), [(0.22, -0.13), (-0.47, 0.0)])
def test_the_disc_is_looked_for_where_legs_lose_light(confocal, x, y):
    """Of each depth and radius the best place; at the true depth and radius within a cell of the true one."""
    line = torch.linspace(-0.5, 0.5, 14)
    wall = torch.nn.functional.pad(torch.cartesian_prod(line, line), (0, 1))
    other = wall if confocal else wall[:1].expand(len(wall), 3)
    scan = hand_scan(wall.tolist(), None if confocal else other.tolist())
    disc = effect("occlusion", scan=scan, opacity=0.3)
    z, radius = (disc.declared[name].grid[2] for name in ("z", "radius"))
    disc.set_all({"x": x, "y": y, "z": z, "radius": radius})
    line = torch.linspace(-0.6, 0.6, 11)
    centre = torch.nn.functional.pad(torch.cartesian_prod(line, line), (0, 1), value=1.3)
    lost = 2 - sum(disc.transmission(points, centre) for points in (wall, other)).detach()
    asked = Asked(torch.arange(len(wall)), centre, lost, torch.ones_like(lost))
    found = disc.likely_shapes(asked)
    assert len(found) == 20
    (best,) = (s for s in found if (s["z"], s["radius"]) == (z, radius))
    cell = disc.declared["radius"].grid[0] / 2
    assert (best["x"], best["y"]) == pytest.approx((x, y), abs=cell)
    # Behind everything no disc hides anything: what is asked for there does not matter.
    nothing = disc.likely_shapes(asked._replace(centre=centre * torch.tensor([1.0, 1.0, 0.01])))
    assert len(nothing) == 20


def test_wall_tilt_shortens_legs():
    # Spot at X = 0.4 of a scan centred on 0.1: X from its centre is 0.3, z = 0.02 · 0.3 = 6 mm. Leg (-0.3, 0,
    # 0.4): cos = 0.8.
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


def test_a_larger_scan_is_the_model_of_the_moved_points():
    """Both in length and in light, against surfels traced from the points where they really are."""
    model, scan = scene("exhaustive")
    wall, spots = effect("wall_scale", "exhaustive", scale=0.04), torch.arange(SPOTS)
    stated = model.laser.clone(), model.sensor.clone()
    paths = model.paths(spots)
    centre = torch.cat([scan.centre, torch.zeros(1)])
    model.laser, model.sensor = (centre + 1.04 * (points - centre) for points in stated)
    real = model.paths(spots)
    model.laser, model.sensor = stated
    assert wall.time(paths.length, paths, spots).detach() == pytest.approx(real.length.detach(), abs=2e-3)
    changed = wall.path(paths.contribution, paths, spots).sum(2).detach()
    truth = real.contribution.sum(2).detach()
    lit = truth > 0.05 * truth.max()
    assert changed[lit] == pytest.approx(truth[lit], rel=0.02)


def test_wall_scale_by_hand():
    # Spots at X = -0.3 and 0.3 about 0. In a scan half as large again the second is at 0.45: the leg to
    # (0.45, 0, 0.6) shrinks from √(0.15² + 0.6²) to 0.6, what it carries grows by their ratio's fourth power.
    scan = dataclasses.replace(
        hand_scan([[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0]]),
        places=(torch.tensor([[-1.0, 0], [1.0, 0]]),),
        half=0.3,
    )
    wall = effect("wall_scale", scan=scan)
    wall.declared["scale"] = dataclasses.replace(wall.declared["scale"], upper=1.0)
    wall.set("scale", 0.5)
    paths, spot = hand_paths(centre=(0.45, 0.0, 0.6)), torch.tensor([1])
    leg = math.hypot(0.15, 0.6)
    assert wall.time(ONE, paths, spot).item() == pytest.approx(1 - 2 * (leg - 0.6), abs=1e-6)
    assert wall.path(ONE, paths, spot).item() == pytest.approx((leg / 0.6) ** 8, rel=1e-5)


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
    baseline, spots = (
        effect("laser_sensor_baseline", "exhaustive", baseline_x=0.02, baseline_y=-0.015),
        torch.arange(SPOTS),
    )
    stated = model.sensor.clone()
    paths = model.paths(spots)
    model.sensor = stated + torch.tensor([0.02, -0.015, 0.0])
    real = model.paths(spots)
    model.sensor = stated
    assert baseline.time(paths.length, paths, spots).detach() == pytest.approx(real.length.detach(), abs=2e-3)
    changed, truth = (
        baseline.path(paths.contribution, paths, spots).sum(2).detach(),
        real.contribution.sum(2).detach(),
    )
    lit = truth > 0.05 * truth.max()
    assert changed[lit] == pytest.approx(truth[lit], rel=0.01)


def test_offsets_of_time():
    paths, lengths = hand_paths(), torch.full((1, 1, 1), 1.52)
    assert effect("time_offset", offset=0.05).time(lengths, paths, SPOT).item() == pytest.approx(
        1.57, abs=1e-6
    )
    # The gate's middle is at 0.62 + 0.02 · 35 = 1.32 m: 0.2 m from it becomes 0.21 m.
    assert effect("clock_scale", scale=0.05).time(lengths, paths, SPOT).item() == pytest.approx(
        1.53, abs=1e-6
    )
    jitter = effect("timing_jitter", offset=torch.tensor([0.03, -0.04] + [0.0] * (SPOTS - 2)))
    assert jitter.time(lengths, paths, torch.tensor([1])).item() == pytest.approx(1.48, abs=1e-6)
    sigma = jitter.quantities()["sigma"].value.item()
    assert sigma == pytest.approx(0.05 / math.sqrt(2), abs=1e-5)  # spots at exactly 0 were not solved for
    jitter.width = 3.0  # in bins
    assert jitter.quantities()["sigma"].value.item() == pytest.approx(3.0 * jitter.scan.bin_length)


def test_time_drift_follows_the_order_of_acquisition():
    drift = effect("time_drift")
    size = drift.declared["drift"].size
    assert size == 9  # ten spots have no more; a scan of hundreds has 23
    drift.set("drift", torch.linspace(-0.01, 0.03, size))
    spots = torch.arange(SPOTS)
    shift = drift.time(torch.zeros(SPOTS, 1, 1), hand_paths(), spots)[:, 0, 0].detach()
    assert shift.mean().item() == pytest.approx(0, abs=1e-7)
    # rms: orthonormal functions; peak to peak: the extremes.
    quantities = drift.quantities()
    assert quantities["rms"].value.item() == pytest.approx(math.sqrt(shift.square().mean().item()), abs=1e-5)
    assert quantities["peak_to_peak"].value.item() == pytest.approx(
        (shift.max() - shift.min()).item(), abs=1e-6
    )
    # A straight line over the scan order is among its functions.
    rank = drift.scan.rank
    line = drift.functions @ (drift.functions.T @ rank) / SPOTS
    assert line == pytest.approx(rank, abs=1e-4)
