"""The fourth bounce against a sum over all pairs of surfels, written out."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from effect_contract import scene, surfels
from inference_scenes import FORWARD_MODE

from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.higher_order_bounces import CLUSTERS, HigherOrderBounces, clusters
from nlos_lit.inference.evidence import Projector
from nlos_lit.inference.problem import build_problem, weighted_columns
from nlos_lit.surfels.model import SurfelModel

BIN, T_START, N_BINS = 0.01, 0.5, 400


def valley(confocal: bool, per_side: int = 8, opening: float = 1.0) -> tuple[Capture, SurfelModel]:
    """Two plates that meet in a valley (a ridge for a negative opening), one of them darker, over a 5 × 3
    scan.
    """
    xy = np.stack(
        np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.2, 0.3, 3), indexing="ij"), -1
    ).reshape(-1, 2)
    laser = np.column_stack([xy, np.zeros(15)])
    sensor = laser if confocal else laser[::-1] * [0.5, 0.7, 0] + [0.05, 0.0, 0.0]
    up = np.broadcast_to([0.0, 0.0, 1.0], (15, 3))
    scene = Capture(
        np.ones((15, N_BINS), dtype=np.uint16), laser, sensor, up, up, bin_length=BIN, t_start=T_START
    )
    line = (np.arange(2 * per_side) + 0.5) / per_side - 1
    x, y = (g.ravel() * 0.3 for g in np.meshgrid(line, line, indexing="ij"))
    centre = np.column_stack([x, y, 0.8 - opening * np.abs(x)])
    normal = np.column_stack([-opening * np.sign(x), 0 * x, -np.ones_like(x)]) / math.hypot(1, opening)
    base = surfels(dataclasses.replace(scene, gate=(0, N_BINS)))
    base.cell = torch.tensor([0.3 / per_side] * 2)
    base.place(*(torch.tensor(a, dtype=torch.float32) for a in (centre, normal, np.where(x > 0, 0.4, 1.0))))
    return scene, base


def all_pairs(capture: Capture, model: SurfelModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Energy, mean arrival (m) and its standard deviation for each spot, from ρ_a ρ_b/π · form factors, in
    numpy.
    """
    centre, normal, albedo = (
        t.detach().double().numpy() for t in (model.centre(), model.normal(), model.albedo())
    )
    area = float(model.cell.prod()) / -normal[:, 2]
    gap = centre[None] - centre[:, None]
    d = np.linalg.norm(gap, axis=2) + np.eye(len(centre))
    leaving = np.maximum(np.einsum("abk,ak->ab", gap, normal), 0) / d
    arriving = np.maximum(-np.einsum("abk,bk->ab", gap, normal), 0) / d
    exchange = leaving * arriving / (d**2 + area.mean() / math.pi)
    sums = []
    for l, s in zip(capture.laser, capture.sensor, strict=True):
        legs = []
        for wall in (l, s):
            away = centre - wall
            distance = np.linalg.norm(away, axis=1)
            facing = np.maximum(-(away * normal).sum(1), 0) / distance
            legs.append((distance, away[:, 2] / distance * facing / distance**2))
        (dl, fl), (ds, fs) = legs
        energy = np.outer(albedo * area * fl, albedo * area * fs) * exchange / math.pi
        length = dl[:, None] + d + ds[None]
        mean = (energy * length).sum() / energy.sum()
        sums.append((energy.sum(), mean, math.sqrt((energy * (length - mean) ** 2).sum() / energy.sum())))
    return tuple(np.array(sums).T)


def fourth(capture: Capture, model: SurfelModel) -> np.ndarray:
    effect, spots = HigherOrderBounces(Scan.of(capture)), torch.arange(capture.n_spots)
    with torch.no_grad():
        paths, albedo = model.paths(spots), model.albedo()
        energy = paths.contribution * albedo[:, None]
        return effect.fourth_bounce(energy, albedo, paths, spots, N_BINS).double().numpy()


@pytest.mark.parametrize("confocal", [True, False])
@pytest.mark.parametrize("per_side", [4, 8, 14])
def test_energy_and_arrival_are_those_of_all_pairs(confocal, per_side):
    capture, model = valley(confocal, per_side)
    energy, mean, width = all_pairs(capture, model)
    ours = fourth(capture, model)
    time = T_START + (np.arange(N_BINS) + 0.5) * BIN
    total = ours.sum(1)
    our_mean = ours @ time / total
    our_width = np.sqrt(((time - our_mean[:, None]) ** 2 * ours).sum(1) / total)
    assert total == pytest.approx(energy, rel=0.04)
    assert our_mean == pytest.approx(mean, abs=1.5 * BIN)
    assert our_width == pytest.approx(width, rel=0.1)


def test_two_surfels_by_hand():
    """Surfels at (±0.4, 0, 0.8), turned by 45° towards each other: both cosines there are √½, d = 0.8."""
    model = valley(True)[1]
    wall, up = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    capture = Capture(
        np.ones((1, N_BINS), dtype=np.uint16), wall, wall, up, up, bin_length=BIN, t_start=T_START
    )
    model.laser, model.sensor = torch.zeros(1, 3), torch.zeros(1, 3)
    half = math.sqrt(0.5)
    model.quadrature = 1
    model.cell = torch.tensor([0.01, 0.01])
    model.place(
        torch.tensor([[-0.4, 0, 0.8], [0.4, 0, 0.8]]),
        torch.tensor([[half, 0, -half], [-half, 0, -half]]),
        torch.tensor([0.5, 0.8]),
    )
    ours = fourth(capture, model)[0]
    # Legs √0.8; cosθ_wall = 0.8/√0.8, cosθ_surfel = (0.4 + 0.8) √½/√0.8; area 10⁻⁴ √2.
    area, leg = 1e-4 * math.sqrt(2), math.sqrt(0.8)
    into = area * (0.8 / leg) * (1.2 * half / leg) / 0.8
    expected = 2 * 0.5 * 0.8 * into**2 * 0.5 / (0.64 + area / math.pi) / math.pi
    assert ours.sum() == pytest.approx(expected, rel=1e-3)
    arrival = ((np.arange(N_BINS) + 0.5) * ours).sum() / ours.sum()
    assert arrival == pytest.approx((2 * leg + 0.8 - T_START) / BIN, abs=0.02)


def test_flat_and_convex_surfaces_have_no_fourth_bounce():
    for opening in (0.0, -0.8):
        capture, model = valley(True, opening=opening)
        assert np.abs(fourth(capture, model)).max() < 1e-12


def test_clusters_are_few_and_whole():
    generator = torch.Generator().manual_seed(2)
    for m in (1, 12, 3000):
        centre = torch.rand(m, 3, generator=generator) * torch.tensor([2.0, 1.0, 0.3])
        member, cell = clusters(centre)
        assert member.sum(1).tolist() == [1] * m
        assert (member.sum(0) > 0).all()
        assert member.shape[1] <= CLUSTERS
        # No cluster is wider than its cube, and cubes are no larger than needed.
        for k in range(member.shape[1]):
            inside = centre[member[:, k] > 0]
            assert (inside.amax(0) - inside.amin(0)).max() <= cell + 1e-5
    assert member.shape[1] > CLUSTERS / 3


def test_a_grazing_surfel_sends_no_more_than_its_area():
    """A spot sees the last one, which is curved, edge-on at its centre, and one half of it from above."""
    capture, model = valley(True)
    centre, normal, albedo = (v.detach() for v in (model.centre(), model.normal(), model.albedo()))
    away = torch.nn.functional.normalize(centre[-1] - torch.as_tensor(capture.laser[0]).float(), dim=0)
    normal[-1] = torch.nn.functional.normalize(away[2] * away - torch.tensor([0.0, 0.0, 1.0]), dim=0)
    model.place(centre, normal, albedo)
    model.curvature[-1] = 2.0 * (torch.eye(3) - torch.outer(normal[-1], normal[-1]))
    assert fourth(capture, model).sum(1) == pytest.approx(all_pairs(capture, model)[0], rel=0.04)


def test_strength_is_the_mean_albedo():
    """Two equal faces: the fourth bounce is strength times that of albedo 1, whatever surfels call theirs."""
    capture, model = valley(True)
    effect, spots = HigherOrderBounces(Scan.of(capture)), torch.arange(capture.n_spots)
    effect.set("strength", 0.4)
    for relative in (1.0, 30.0):
        with torch.no_grad():
            paths, albedo = model.paths(spots), torch.ones(len(model))
            dark, light = torch.zeros(capture.n_spots, N_BINS), paths.contribution
            more = effect.transients(dark, relative * light, relative * albedo, paths, spots)
            white = effect.fourth_bounce(light, albedo, paths, spots, N_BINS)
        assert more.sum(1).numpy() == pytest.approx(0.4 * relative * white.sum(1).numpy(), rel=1e-4)


def test_share_is_known_after_a_rendering():
    model, scan = scene("confocal")
    bounces, spots = HigherOrderBounces(scan), torch.arange(10)
    bounces.set("strength", 2.0)
    assert set(bounces.quantities()) == {"strength"}
    plain, more = (model.expected(spots, Extension(e)) - 0.4 for e in ([], [bounces]))
    share = bounces.quantities()["share"].value.item()
    # All light of this scene falls into the record, but for the tail of the response.
    assert (more.sum() / plain.sum() - 1).item() == pytest.approx(share, rel=0.1)
    assert share > 1e-4


@FORWARD_MODE
def test_a_scene_cannot_do_it_by_a_change_of_its_brightness():
    """Beside a model that has it, it is not what all albedos and the intensity do against each other."""
    capture, model = valley(True)
    effect, spots = HigherOrderBounces(Scan.of(capture)), torch.arange(capture.n_spots)
    effect.set("strength", 0.9)
    model.laser_sensor.set_intensity(1e4)
    extension = Extension([effect])
    counts = model.expected(spots, extension).detach()
    problem = build_problem(model, extension, spots, counts, with_effects=False, patches=8)
    column = weighted_columns(problem, effect)
    assert Projector(problem).free(column).norm() > 0.05 * column.norm()


def test_surfels_in_the_same_place_keep_it_finite():
    capture, model = valley(True, 4)
    centre, normal, albedo = (v.detach() for v in (model.centre(), model.normal(), model.albedo()))
    model.place(
        centre[[0, 0, *range(1, len(centre))]],
        normal[[0, 5, *range(1, len(normal))]],
        albedo[[0, *range(len(albedo))]],
    )
    spots = torch.arange(capture.n_spots)
    paths = model.paths(spots)
    effect = HigherOrderBounces(Scan.of(capture))
    albedo = model.albedo()
    effect.fourth_bounce(paths.contribution * albedo[:, None], albedo, paths, spots, N_BINS).sum().backward()
    for parameter in (model.raw_depth, model.raw_normal, model.raw_albedo):
        assert parameter.grad.isfinite().all()
