"""Transients against hand-computed cases and independent quadrature."""

from __future__ import annotations

import math

import numpy as np
import psutil
import pytest

from data_modules.simulate.mesh import Mesh, join
from data_modules.simulate.scenes import plate, sphere
from data_modules.simulate.transients import simulate_transients, spread_triangles, work
from nlos_lit.capture.errors import CaptureError, MemoryBudgetError, UserError

WALL = (0.0, 0.0, 1.0)


def transients(mesh: Mesh, laser, sensor, *, bin_length=0.01, n_bins=400, **options) -> np.ndarray:
    laser, sensor = np.broadcast_arrays(
        np.atleast_2d(laser).astype(float), np.atleast_2d(sensor).astype(float)
    )
    normals = np.broadcast_to(WALL, laser.shape)
    return simulate_transients(
        mesh, laser, sensor, normals, normals, bin_length=bin_length, n_bins=n_bins, **options
    )


def test_one_small_patch_has_the_value_and_bin_of_the_formula():
    size, place = 0.002, (0.1, -0.05, 0.6)
    laser, sensor = (0.3, 0.2, 0.0), (-0.2, 0.1, 0.0)
    h = transients(plate(place, size, size, albedo=0.5), laser, sensor, wall_albedo=0.8, t_start=0.2)[0]
    d1 = math.sqrt(0.2**2 + 0.25**2 + 0.6**2)
    d2 = math.sqrt(0.3**2 + 0.15**2 + 0.6**2)
    cosines = (0.6 / d1) ** 2 * (0.6 / d2) ** 2  # wall and patch are parallel: each cosine counts twice
    expected = size**2 * 0.8**2 * 0.5 / math.pi**3 * cosines / (d1**2 * d2**2)
    assert h.sum() == pytest.approx(expected, rel=1e-4)
    assert h.argmax() == math.floor((d1 + d2 - 0.2) / 0.01) == 116
    assert h[116] == pytest.approx(expected, rel=1e-4)


def test_tilted_patch_uses_its_own_normal():
    """A patch straight ahead, turned by 30° about y, on a confocal path.

    It keeps cos 30° on both legs, and its area.
    """
    angle = math.pi / 6
    flat = transients(plate((0, 0, 0.7), 0.004, 0.004), (0, 0, 0), (0, 0, 0)).sum()
    turned = transients(plate((0, 0, 0.7), 0.004, 0.004, turn_y=angle), (0, 0, 0), (0, 0, 0)).sum()
    assert turned / flat == pytest.approx(math.cos(angle) ** 2, rel=1e-4)


def test_tilted_wall_uses_the_wall_normal():
    tilted = np.array([[math.sin(0.4), 0, math.cos(0.4)]])
    zero = np.zeros((1, 3))
    mesh = plate((0, 0, 0.7), 0.004, 0.004)
    flat = transients(mesh, zero, zero).sum()
    turned = simulate_transients(
        mesh, zero, zero, tilted, np.array([WALL]), bin_length=0.01, n_bins=400
    ).sum()
    assert turned / flat == pytest.approx(math.cos(0.4), rel=1e-4)


@pytest.mark.parametrize("factor", [2.0, 3.0])
def test_confocal_energy_falls_with_the_fourth_power_of_distance(factor):
    near = transients(plate((0, 0, 0.4), 0.002, 0.002), (0, 0, 0), (0, 0, 0)).sum()
    far = transients(plate((0, 0, 0.4 * factor), 0.002, 0.002), (0, 0, 0), (0, 0, 0)).sum()
    assert near / far == pytest.approx(factor**4, rel=1e-4)


def test_each_leg_falls_with_the_square_of_its_own_distance():
    """The laser point recedes along the axis (a wall point at z = -0.4 facing the scene): only d1 doubles."""
    mesh = plate((0, 0, 0.4), 0.002, 0.002)
    near = transients(mesh, (0, 0, 0), (0.1, 0, 0)).sum()
    far = transients(mesh, (0, 0, -0.4), (0.1, 0, 0)).sum()
    assert near / far == pytest.approx(4, rel=1e-4)


def dense_quadrature(laser, sensor, low, high, z, edges, n=1500) -> np.ndarray:
    """Histogram of a plane z = const, by midpoint samples of the literal integrand."""
    x = low[0] + (high[0] - low[0]) * (np.arange(n) + 0.5) / n
    y = low[1] + (high[1] - low[1]) * (np.arange(n) + 0.5) / n
    cell = (high[0] - low[0]) * (high[1] - low[1]) / n**2
    d1 = np.sqrt((x[:, None] - laser[0]) ** 2 + (y - laser[1]) ** 2 + z**2)
    d2 = np.sqrt((x[:, None] - sensor[0]) ** 2 + (y - sensor[1]) ** 2 + z**2)
    value = z**4 / np.pi**3 / (d1**4 * d2**4) * cell
    return np.histogram(d1 + d2, bins=edges, weights=value)[0]


def test_plane_agrees_with_direct_quadrature_bin_by_bin():
    laser, sensor = (0.25, 0.1, 0.0), (-0.1, -0.2, 0.0)
    h = transients(plate((0.1, 0.05, 0.5), 0.5, 0.3), laser, sensor, bin_length=0.006, n_bins=400)[0]
    reference = dense_quadrature(laser, sensor, (-0.15, -0.1), (0.35, 0.2), 0.5, 0.006 * np.arange(401))
    assert h.sum() == pytest.approx(reference.sum(), rel=1e-4)
    assert np.linalg.norm(h - reference) < 0.004 * np.linalg.norm(reference)


def test_sphere_agrees_with_its_one_dimensional_integral():
    """Confocal, the sphere straight ahead: rings of polar angle θ up to the horizon.

    This also shows that no patch shades itself.
    """
    distance, radius = 0.6, 0.25
    theta = np.arccos(radius / distance) * (np.arange(20_000) + 0.5) / 20_000
    rho = np.sqrt(distance**2 + radius**2 - 2 * distance * radius * np.cos(theta))
    at_patch, at_wall = (distance * np.cos(theta) - radius) / rho, (distance - radius * np.cos(theta)) / rho
    ring = 2 * np.pi * radius**2 * np.sin(theta) * np.arccos(radius / distance) / 20_000
    value = ring * (at_patch * at_wall) ** 2 / rho**4 / np.pi**3
    reference = np.histogram(2 * rho, bins=0.01 * np.arange(401), weights=value)[0]
    h = transients(sphere((0, 0, distance), radius, rings=80), (0, 0, 0), (0, 0, 0))[0]
    assert h.sum() == pytest.approx(value.sum(), rel=2e-3)
    assert np.linalg.norm(h - reference) < 0.01 * np.linalg.norm(reference)


def test_finer_patches_change_little():
    spots = np.array([[0.3, 0.1, 0], [-0.2, -0.4, 0]])
    mesh = join(
        plate((0.2, 0.1, 0.7), 0.4, 0.3, turn_x=0.5, albedo=0.4), sphere((-0.1, 0, 0.5), 0.15, rings=12)
    )
    coarse, fine = (transients(mesh, spots, spots, detail=detail) for detail in (1, 3))
    assert np.linalg.norm(coarse - fine) < 0.01 * np.linalg.norm(fine)
    assert coarse.sum(axis=1) == pytest.approx(fine.sum(axis=1), rel=0.01)


def test_albedo_is_linear_across_a_face():
    shade = plate((0, 0, 0.8), 0.02, 0.02)
    ramp = Mesh(shade.vertices, shade.faces, [0.2, 0.2, 0.8, 0.8])
    point = (0, 0, 0)
    assert transients(ramp, point, point).sum() == pytest.approx(
        0.5 * transients(shade, point, point).sum(), rel=1e-3
    )


def test_a_plate_fully_behind_another_gives_nothing():
    front, back = plate((0, 0, 0.5), 0.6, 0.6), plate((0, 0, 0.9), 0.2, 0.2)
    spots = np.array([[0.1, 0.0, 0.0], [-0.1, 0.05, 0.0]])
    both, alone = transients(join(front, back), spots, spots), transients(front, spots, spots)
    assert np.array_equal(both, alone)
    assert transients(join(front, back), spots, spots, occlusion=False).sum() > 1.01 * alone.sum()


def test_a_straight_edge_hides_exactly_the_half_behind_it():
    """A screen edge at x = 0 halfway to the plate: from x = 0, the plate's half x < 0 is hidden."""
    screen = plate((-0.3, 0, 0.4), 0.6, 2.0, albedo=0.0)
    hidden = transients(join(screen, plate((0, 0, 0.8), 0.4, 0.4)), (0, 0, 0), (0, 0, 0)).sum()
    half = transients(plate((0.1, 0, 0.8), 0.2, 0.4), (0, 0, 0), (0, 0, 0)).sum()
    assert hidden == pytest.approx(half, rel=1e-3)


def test_a_screen_on_either_leg_blocks_the_path():
    screen, target = plate((-0.3, 0, 0.3), 0.3, 0.6, albedo=0.0), plate((0, 0, 0.6), 0.02, 0.02)
    free, behind = (0.4, 0.0, 0.0), (-0.5, 0.0, 0.0)
    scene = join(screen, target)
    both = np.array([free, free, behind]), np.array([free, behind, free])
    energy = transients(scene, *both).sum(axis=1)
    assert energy[0] > 0
    assert energy[1] == energy[2] == 0


def test_back_faces_are_black_unless_two_sided():
    away = plate((0, 0, 0.5), 0.1, 0.1).flipped()
    with pytest.raises(UserError, match="two_sided"):
        transients(away, (0, 0, 0), (0.1, 0, 0))
    seen = transients(away, (0, 0, 0), (0.1, 0, 0), two_sided=True)
    assert seen == pytest.approx(transients(away.flipped(), (0, 0, 0), (0.1, 0, 0)), rel=1e-9)


def test_a_two_sided_sheet_does_not_shine_through():
    """Laser and sensor on opposite sides of an upright sheet see different faces."""
    sheet = plate((0, 0, 0.5), 0.2, 0.2, turn_y=math.pi / 2)
    scene = join(sheet, plate((0, 0.5, 0.5), 0.01, 0.01))
    opposite = transients(scene, (-0.4, 0, 0), (0.4, 0, 0), two_sided=True)
    without = transients(plate((0, 0.5, 0.5), 0.01, 0.01), (-0.4, 0, 0), (0.4, 0, 0))
    assert opposite.sum() == pytest.approx(without.sum(), rel=1e-9)


@pytest.mark.parametrize("fraction", [0.1, 0.25, 0.5, 0.9])
def test_sub_bin_shifts_keep_energy_and_centroid(fraction):
    mesh, spot, b = plate((0.05, 0.1, 0.6), 0.4, 0.3, turn_x=0.3), (0.1, -0.1, 0), 0.01

    def centroid(t_start):
        h = transients(mesh, spot, spot, bin_length=b, t_start=t_start)[0]
        return h.sum(), (h * (t_start + b * (np.arange(400) + 0.5))).sum() / h.sum()

    (energy, here), (moved_energy, there) = centroid(0.0), centroid(fraction * b)
    assert moved_energy == pytest.approx(energy, rel=1e-12)
    assert there == pytest.approx(here, abs=2e-3 * b)


def test_moving_the_scene_moves_the_centroid_by_twice_as_much():
    """On axis, far away, a plate moved by a quarter bin arrives half a bin later.

    The 1/d⁴ weighting adds up to 1e-3.
    """
    b = 0.01
    plates = [plate((0, 0, 3.0 + move), 0.5, 0.4, turn_y=0.4) for move in (0, 0.25 * b)]
    rows = [transients(mesh, (0, 0, 0), (0, 0, 0), bin_length=b, n_bins=800)[0] for mesh in plates]
    centroids = [(row * np.arange(800)).sum() / row.sum() for row in rows]
    assert centroids[1] - centroids[0] == pytest.approx(0.5, abs=2e-3)


def test_exhaustive_pairs_equal_pairs_one_by_one():
    mesh = join(plate((0.1, 0, 0.5), 0.3, 0.2), sphere((-0.2, 0.1, 0.6), 0.1, rings=6))
    points = np.array([[0.2, 0.1, 0], [-0.3, 0.2, 0], [0.0, -0.4, 0]])
    laser, sensor = np.repeat(points, 3, axis=0), np.tile(points, (3, 1))
    together = transients(mesh, laser, sensor)
    assert work(mesh, laser, sensor, bin_length=0.01, n_bins=400).keep_legs
    assert not work(mesh, points, points, bin_length=0.01, n_bins=400).keep_legs
    assert together[[0, 4, 8]] == pytest.approx(transients(mesh, points, points), rel=1e-9, abs=1e-18)
    assert together[1] == pytest.approx(together[3], rel=1e-9, abs=1e-18)  # reciprocity


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        (
            (0.25, 1.5, 2.75),
            [0, 0.18, 0.64, 0.18, 0],
        ),  # survival at 1: 1 - 0.75²/(2.5·1.25) = 0.82, at 2: 0.18
        ((2.0, 0.0, 0.5), [0, 2 / 3, 1 / 3, 0, 0]),  # survival at 1: 1²/(2·1.5) = 1/3
        ((0.2, 0.2, 0.2), [0, 1, 0, 0, 0]),
        ((-1.0, -1.0, 1.0), [0.75, 0.25, 0, 0, 0]),  # survival at 0: 1²/(2·2) = 1/4
        ((2.0, 4.0, 4.0), [0, 0, 0, 0.25, 0.75]),
        ((-3.0, -2.5, -2.0), [1, 0, 0, 0, 0]),
        ((7.0, 8.0, 9.0), [0, 0, 0, 0, 1]),
    ],
)
def test_a_triangle_spreads_over_bins_as_worked_out_by_hand(times, expected):
    histogram = spread_triangles(np.array([[2.0]]), np.array([times]), np.array([[0, 1, 2]]), 3)
    assert histogram[0] == pytest.approx(2 * np.array(expected), abs=1e-15)


def test_unreasonable_requests_are_refused_in_one_sentence(monkeypatch):
    mesh = plate((0, 0, 0.5), 0.1, 0.1)
    with pytest.raises(CaptureError, match=r"\[S, 3\]"):
        simulate_transients(
            mesh,
            np.zeros((2, 3)),
            np.zeros((3, 3)),
            np.ones((2, 3)),
            np.ones((2, 3)),
            bin_length=0.01,
            n_bins=9,
        )
    with pytest.raises(UserError, match="positive"):
        transients(mesh, (0, 0, 0), (0, 0, 0), bin_length=0.0)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 1 << 20}))
    with pytest.raises(MemoryBudgetError, match="GiB"):
        transients(mesh, (0, 0, 0), (0, 0, 0))
