"""Effects on single paths and on time, against numbers worked out by hand."""

from __future__ import annotations

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch
from effect_contract import SPOTS, capture, scene, surfels
from effect_hand import ONE, SPOT, effect, hand_paths, hand_scan

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Asked
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.scene_motion import SceneMotion
from nlos_lit.functional.surfel_paths import Walls


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


def walls_at(*points: tuple[float, float]) -> Walls:
    """Of a confocal scan, facing the scene."""
    place = torch.tensor([[x, y, 0.0] for x, y in points])
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand_as(place)
    return Walls(place, up, place, up, confocal=True)


def small_scan() -> Scan:
    """Spots at x = -0.2 and 0.4, so that its centre is at 0.1."""
    scan = hand_scan([[0.4, 0.0, 0.0], [-0.2, 0.0, 0.0]])
    return dataclasses.replace(scan, places=(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]),), half=0.3)


def test_a_tilted_wall_stands_nearer_and_faces_aside():
    # X from the scan's centre is 0.3: z = 0.75 · 0.3. The plane z = 0.75 x has the normal (-0.6, 0, 0.8).
    tilt = effect("wall_tilt", scan=small_scan())
    tilt.declared["tilt_x"] = dataclasses.replace(tilt.declared["tilt_x"], upper=1.0)
    tilt.set("tilt_x", 0.75)
    real = tilt.walls(walls_at((0.4, 0.0), (-0.2, 0.3)), SPOT)
    assert real.confocal
    assert real.laser.detach().numpy() == pytest.approx(np.array([[0.4, 0, 0.225], [-0.2, 0.3, -0.225]]))
    for normal in (real.laser_normal, real.sensor_normal):
        assert normal.detach().numpy() == pytest.approx(np.array([[-0.6, 0.0, 0.8]] * 2))
    assert torch.equal(real.sensor, real.laser)
    y = effect("wall_tilt", scan=small_scan(), tilt_y=-0.02).walls(walls_at((0.4, 0.5)), SPOT)
    assert y.laser.detach().numpy() == pytest.approx(np.array([[0.4, 0.5, -0.01]]))


def test_each_side_of_a_scan_has_a_scale_of_its_own():
    wall = effect("wall_scale", scan=small_scan(), scale_x=0.1, scale_y=-0.2)
    real = wall.walls(walls_at((0.4, 0.5), (0.1, 0.0)), SPOT)
    for place in (real.laser, real.sensor):
        assert place.detach().numpy() == pytest.approx(np.array([[0.43, 0.4, 0], [0.1, 0.0, 0]]))
    assert real.confocal


def test_baseline_moves_the_sensor_alone():
    baseline = effect("laser_sensor_baseline", scan=small_scan(), baseline_x=0.05, baseline_y=-0.03)
    stated = walls_at((0.4, 0.5))
    real = baseline.walls(stated, SPOT)
    assert torch.equal(real.laser, stated.laser)
    assert real.sensor.detach().numpy() == pytest.approx(np.array([[0.45, 0.47, 0.0]]))
    assert not real.confocal


@pytest.mark.parametrize("kind", ["confocal", "exhaustive"])
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("wall_tilt", {"tilt_x": 0.03, "tilt_y": -0.02}),
        ("wall_scale", {"scale_x": 0.1, "scale_y": -0.05}),
        ("laser_sensor_baseline", {"baseline_x": 0.05, "baseline_y": -0.04}),
    ],
)
def test_a_moved_wall_is_the_model_of_the_moved_points(kind, name, values):
    """As if the file told of the real points; also where surfels stand edge on."""
    model, _ = scene(kind)
    moved = effect(name, kind, **values)
    spots = torch.arange(SPOTS)
    real = moved.walls(model.walls(spots), spots)
    measured = capture(kind)
    points = {
        place: getattr(real, place).detach().double().numpy()
        for place in ("laser", "laser_normal", "sensor", "sensor_normal")
    }
    other = surfels(dataclasses.replace(measured, **points))
    other.load_state_dict(model.state_dict())
    assert other.confocal == real.confocal
    expected = model.expected(spots, Extension([moved]))
    assert expected.numpy() == pytest.approx(other.expected(spots).numpy(), rel=1e-4, abs=1e-4)
    assert float((expected - model.expected(spots)).abs().max()) > 0.02 * float(expected.max())


def drawn_motion(kind: str, rms: float) -> SceneMotion:
    motion = effect("scene_motion", kind)
    motion.draw({"rms": rms}, np.random.default_rng(3))
    return motion


@pytest.mark.parametrize("kind", ["confocal", "single", "exhaustive"])
def test_a_scene_that_moves_is_at_each_spot_the_scene_that_lies_elsewhere(kind):
    model, _ = scene(kind)
    motion, spots = drawn_motion(kind, 0.03), torch.arange(SPOTS)
    expected, along = model.expected(spots, Extension([motion])), motion.field().detach()
    for k in spots[::3].tolist():
        elsewhere = copy.deepcopy(model)
        elsewhere.anchor += along[k]
        assert expected[k].numpy() == pytest.approx(
            elsewhere.expected(spots[k : k + 1])[0].numpy(), rel=1e-4, abs=1e-4
        )
    assert float((expected - model.expected(spots)).abs().max()) > 0.02 * float(expected.max())


def test_quantities_of_a_motion_are_those_of_its_ways():
    motion = drawn_motion("confocal", 0.03)
    way, said = motion.field().detach(), motion.quantities()
    assert way.shape == (SPOTS, 3)
    assert way.mean(0).numpy() == pytest.approx(np.zeros(3), abs=1e-7)
    assert said["rms"].value.item() == pytest.approx(0.03, rel=1e-4)
    assert way.square().sum(1).mean().sqrt().item() == pytest.approx(0.03, rel=1e-4)
    for axis, values in zip("xyz", way.T, strict=True):
        assert said[f"range_{axis}"].value.item() == pytest.approx((values.max() - values.min()).item())
    # The first three numbers are the smoothest function's: along x, y and z.
    motion.set("motion", torch.tensor([0.0, 0.01, 0.0] + [0.0] * (motion.declared["motion"].size - 3)))
    assert motion.field().detach().numpy() == pytest.approx(
        0.01 * motion.functions[:, :1].numpy() * np.array([0, 1, 0])
    )


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
