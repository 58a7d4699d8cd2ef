"""Surfels: hand-computed transients, energy, gradients, visibility."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from data_modules.simulate import Mesh, ScanPlan, simulate_transients
from data_modules.simulate.scenes import plate
from nlos_lit.capture import Capture
from nlos_lit.effects.hooks import NOTHING, Hooks
from nlos_lit.functional.compiled import tensor_by_tensor
from nlos_lit.functional.surfel_graph import (
    ALIKE,
    BEND,
    EDGE,
    FLATTEST,
    STIFFNESS,
    albedo_steps,
    bend_of,
    bending,
    misfits,
    neighbour_pairs,
)
from nlos_lit.functional.surfel_paths import (
    Runs,
    SplineSplat,
    quadrature,
    spline_weights,
    spread,
)
from nlos_lit.functional.surfel_visibility import who_hides
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.surfels.model import HIDING, Lateral, SurfelModel, spline_sensor, unknown_opacity

CELL = 0.05
FACING = [0.0, 0.0, -1.0]


def wall(laser, sensor=None, n_bins=300, bin_length=0.01, gate=None) -> Capture:
    laser = np.asarray(laser, dtype=float)
    up = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    sensor = laser if sensor is None else np.asarray(sensor, dtype=float)
    counts = np.ones((len(laser), n_bins), dtype=np.uint16)
    return Capture(counts, laser, sensor, up, up, bin_length=bin_length, gate=gate)


def build(
    capture, centre, normal=None, albedo=None, quadrature=1, sigma=1.0, kappa=0.6, background=0.2, cell=CELL
) -> SurfelModel:
    length, m = capture.bin_length, len(centre)
    sensor = spline_sensor(
        capture,
        {
            "sigma_ls": BoundedParameter(sigma * length, 0.59 * length, 10 * length, "m"),
            "kappa_s": BoundedParameter(kappa / length, 0.02 / length, 50 / length, "1/m"),
            "intensity": BoundedParameter(100.0, 1.0, 1e4, "counts m2"),
            "background": BoundedParameter(background, 1e-3, 10.0, "counts/bin"),
        },
    )
    normal = torch.tensor([FACING] * m if normal is None else normal)
    albedo = torch.ones(m) if albedo is None else torch.tensor(albedo)
    lateral = Lateral((-1.0, -1.0), (cell, cell), (41, 41))
    return SurfelModel(
        capture,
        centre=torch.tensor(centre),
        normal=normal,
        albedo=albedo,
        lateral=lateral,
        laser_sensor=sensor,
        quadrature=quadrature,
    )


def random_model(quadrature=2) -> tuple[SurfelModel, torch.Tensor]:
    rng = np.random.default_rng(3)
    capture = wall(
        rng.uniform(-0.4, 0.4, (5, 3)) * [1, 1, 0], rng.uniform(-0.4, 0.4, (5, 3)) * [1, 1, 0], gate=(40, 300)
    )
    centre = (rng.uniform(-0.3, 0.3, (7, 3)) + np.array([0, 0, 0.8])).tolist()
    normal = (rng.normal(0, 0.3, (7, 3)) + FACING).tolist()
    return build(capture, centre, normal, rng.uniform(0.2, 1.5, 7).tolist(), quadrature), torch.tensor(
        [4, 0, 2]
    )


def test_one_surfel_by_hand():
    # Laser (0.3, 0, 0), sensor (0, 0.4, 0), surfel at (0, 0, 0.4): d1 = 0.5, d2 = √0.32, all cosines are
    # 0.4/d.
    model = build(wall([[0.3, 0.0, 0.0]], [[0.0, 0.4, 0.0]]), [[0.0, 0.0, 0.4]])
    paths = model.paths(torch.tensor([0]))
    d1, d2 = 0.5, math.sqrt(0.32)
    expected = CELL**2 * (0.4 / d1) ** 2 * (0.4 / d2) ** 2 / (d1**2 * d2**2)
    assert paths.contribution.item() == pytest.approx(expected, rel=1e-5)
    assert paths.length.item() == pytest.approx(d1 + d2, rel=1e-6)
    transient = model.transients(paths, torch.tensor([0]), NOTHING)[0]
    assert transient.sum().item() == pytest.approx(expected, rel=1e-5)
    mean = ((torch.arange(300) + 0.5) * transient).sum() / transient.sum()
    assert mean.item() == pytest.approx((d1 + d2) / 0.01, abs=1e-3)


def test_tilted_surfel_covers_its_cell_and_steep_one_keeps_its_length():
    normal = torch.tensor([[0.6, 0.0, -0.8], [1.0, 0.0, 0.0]])
    shift, area = spread(normal, torch.tensor([0.2, 0.1]), torch.tensor([[0.5, 0.5], [-0.5, 0.5]]))
    # Slope 0.75: the footprint stays ±0.1 × 0.05, the height is ±0.075, the area 0.02/0.8.
    assert shift[0, 0].tolist() == pytest.approx([0.1, 0.05, 0.075], abs=1e-6)
    assert area.tolist() == pytest.approx([0.02 / 0.8, 0.02 / 0.4], rel=1e-6)
    # Upright: no extent along x, 2.5 times the cell along z.
    assert shift[1, 0].tolist() == pytest.approx([0.0, 0.05, 0.25], abs=1e-6)


def test_spline_has_exact_energy_mean_and_variance_at_every_phase():
    time = torch.linspace(20, 22, 41, dtype=torch.float64)[:, None]
    first, weights = spline_weights(time)
    bins = first[..., None] + torch.arange(4) + 0.5
    exact = {"rtol": 0, "atol": 1e-12}
    assert torch.allclose(weights.sum(-1), torch.ones_like(time), **exact)
    assert torch.allclose((weights * bins).sum(-1), time, **exact)
    assert torch.allclose(
        (weights * (bins - time[..., None]) ** 2).sum(-1), torch.full_like(time, 1 / 3), **exact
    )


def test_splat_drops_what_leaves_the_window():
    image = SplineSplat.apply(torch.tensor([[1.0, 1.0, 1.0]]), torch.tensor([[-7.0, 5.5, 99.0]]), 10)
    assert image[0].tolist() == pytest.approx([0, 0, 0, 0, 1 / 6, 4 / 6, 1 / 6, 0, 0, 0], abs=1e-6)


def test_the_splat_as_a_matrix_is_the_splat():
    gen = torch.Generator().manual_seed(0)
    energy, time = torch.rand(2, 3, 4, generator=gen), 30 * torch.rand(2, 3, 4, generator=gen) - 5
    albedo = torch.tensor([0.5, 0.0, 2.0], requires_grad=True)
    expected = SplineSplat.apply((energy * albedo[:, None]).flatten(1), time.flatten(1), 20)
    runs = Runs.of(energy, time, 20)
    assert runs.send(albedo) == pytest.approx(expected.detach(), abs=1e-6)
    grad = torch.rand(2, 20, generator=gen)
    (by_paths,) = torch.autograd.grad((expected * grad).sum(), albedo)
    assert torch.from_numpy(runs.pull(grad)) == pytest.approx(by_paths, rel=1e-5)


def test_legs_keep_their_digits_far_from_the_origin():
    """Products of matrices lose what squares have in common; from the scene's middle that is little."""
    model, spots = random_model()
    with torch.no_grad():
        near = model.paths(spots)
    for points in (model.laser, model.sensor, model.anchor):
        points += torch.tensor([64.0, -32.0, 8.0])
    with torch.no_grad():
        away = model.paths(spots)
    assert away.length == pytest.approx(near.length, abs=3e-5)  # m; coordinates themselves have 4e-6
    assert away.contribution == pytest.approx(near.contribution, rel=1e-3)


def test_plate_has_the_simulators_transients():
    """The independent simulator carries ρ_w²ρ_p/π³ and bins without a splat: compare energies, means and
    variances per spot.
    """
    scan = ScanPlan(
        kind="single", nx=4, ny=3, width=1.0, height=0.6, fixed_point=(0.2, -0.1), bin_length=0.01, n_bins=300
    )
    laser, sensor = scan.points()
    up = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    mesh = plate((0.1, 0.05, 0.7), 0.4, 0.2, turn_y=0.3)
    truth = (
        torch.from_numpy(simulate_transients(mesh, laser, sensor, up, up, bin_length=0.01, n_bins=300))
        * math.pi**3
    )
    normal = np.array([math.sin(0.3), 0.0, math.cos(0.3)]) * -1
    step = 0.4 * math.cos(0.3) / 8
    xy = [((i - 3.5) * step, (j - 1.5) * 0.05) for i in range(8) for j in range(4)]
    centre = [[0.1 + x, 0.05 + y, 0.7 - normal[0] / normal[2] * x] for x, y in xy]
    model = build(wall(laser, sensor), centre, [normal.tolist()] * 32, quadrature=3, cell=0.05)
    model.cell = torch.tensor([step, 0.05])
    spots = torch.arange(12)
    ours = model.transients(model.paths(spots), spots, NOTHING).double().detach()
    bins = torch.arange(300) + 0.5
    assert ours.sum(1) == pytest.approx(truth.sum(1), rel=2e-3)
    mean, mean_truth = (ours @ bins.double()) / ours.sum(1), (truth @ bins.double()) / truth.sum(1)
    assert mean == pytest.approx(mean_truth, abs=0.05)  # bins


def test_curved_patches_have_the_light_of_a_cylinder():
    """An upright one, in cells a fifth of its radius wide, by the independent simulator: flat patches lie
    before it on average, and face all light alike.
    """
    radius, step, fine = 0.2, 0.04, 12
    scan = ScanPlan(kind="confocal", nx=5, ny=2, width=1.4, height=0.4, bin_length=0.01, n_bins=300)
    laser, sensor = scan.points()
    up = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    x = np.linspace(-0.14, 0.14, 7 * fine + 1)
    rim = np.stack([x, 0.8 - np.sqrt(radius**2 - x**2)], 1)
    vertices = np.array([[a, y, z] for y in (-0.04, 0.04) for a, z in rim])
    first = np.arange(len(x) - 1)
    low, high = np.stack([first, first + 1], 1), np.stack([first, first + 1], 1) + len(x)
    faces = np.concatenate([np.c_[low, high[:, 1]], np.c_[low[:, 0], high[:, ::-1]]])[:, ::-1]
    mesh = Mesh(vertices, faces, 1.0)
    given = {"bin_length": 0.01, "n_bins": 300, "occlusion": False}
    truth = torch.from_numpy(simulate_transients(mesh, laser, sensor, up, up, **given) * math.pi**3)
    middle = torch.arange(-3, 4) * step
    normal = torch.stack([middle / radius, 0 * middle, -(1 - (middle / radius) ** 2).sqrt()], 1)
    centre = torch.stack([middle, 0 * middle, 0.8 + radius * normal[:, 2]], 1)
    both = torch.cat([centre - torch.tensor([0, 0.02, 0]), centre + torch.tensor([0, 0.02, 0])])
    turned = torch.cat([normal, normal])
    model = build(wall(laser, sensor), both.tolist(), turned.tolist(), quadrature=4, cell=step)
    # The true curvature: 1/radius around the axis, in the tangent plane.
    around = torch.stack([-turned[:, 2], 0 * turned[:, 2], turned[:, 0]], 1)
    spots, errors = torch.arange(10), []
    for curvature in (torch.zeros(14, 3, 3), around[:, :, None] * around[:, None] / radius):
        model.curvature = curvature
        ours = model.transients(model.paths(spots), spots, NOTHING).double().detach()
        bins = torch.arange(300) + 0.5
        late = (ours @ bins.double()) / ours.sum(1) - (truth @ bins.double()) / truth.sum(1)
        errors.append(torch.stack([(ours.sum(1) / truth.sum(1) - 1).abs(), late.abs()]).numpy())
    (flat, flat_late), (curved, curved_late) = errors
    assert flat.min() > 0.002
    assert flat_late.min() > 0.03  # bins
    assert (curved < 0.5 * flat).all()
    assert (curved_late < 0.4 * flat_late).all()


def test_curvature_follows_from_the_normals_of_neighbours():
    """Of a sphere; a rigid turn of all normals is none."""
    radius, step = 0.3, 0.03
    lateral = torch.cartesian_prod(torch.arange(-4, 5), torch.arange(-4, 5)) * step
    normal = torch.cat([lateral, -(radius**2 - lateral.square().sum(1, keepdim=True)).sqrt()], 1) / radius
    centre = torch.tensor([0.0, 0.0, 0.9]) + radius * normal
    model = build(wall([[0.0, 0.0, 0.0]]), centre.tolist(), normal.tolist(), cell=step)
    model.lay()
    true = (torch.eye(3) - normal[:, :, None] * normal[:, None]) / radius
    inner = lateral.abs().amax(1) < 3.5 * step
    assert model.curvature[inner] == pytest.approx(true[inner], abs=0.3 / radius)
    trace = model.curvature.diagonal(dim1=1, dim2=2).sum(1)
    assert trace[inner].mean() == pytest.approx(2 / radius, rel=0.2)  # the ridge keeps a seventh
    model.lift()
    before, (at, facing) = model.curvature.clone(), model.placed()
    model.divide(2)
    away = (model.centre() - torch.tensor([0.0, 0.0, 0.9])).norm(dim=1)
    flat_away = (
        at[:, None] + spread(facing, model.cell * 2, quadrature(2))[0] - torch.tensor([0, 0, 0.9])
    ).norm(dim=2)
    assert torch.equal(model.curvature, before.repeat_interleave(4, 0))
    assert (away - radius).abs().mean() < 0.6 * (flat_away - radius).abs().mean()
    flat = build(wall([[0.0, 0.0, 0.0]]), [[0.0, 0.0, 0.5], [0.5, 0.0, 0.5]])
    flat.lay()
    assert not flat.curvature.any()  # none has a neighbour


def test_render_adds_response_and_background_inside_the_gate():
    model = build(wall([[0.0, 0.0, 0.0]], gate=(20, 300)), [[0.0, 0.0, 0.5]])
    expected = model.render(torch.tensor([0]))[0]
    assert expected.shape == (280,)
    assert expected[:30].detach() == pytest.approx(torch.full((30,), 0.2), abs=1e-4)
    energy = 100 * CELL**2 / 0.5**4
    assert (expected - 0.2).sum().item() == pytest.approx(energy, rel=1e-3)
    # Arrival at bin 100 plus the tail's mean delay 1/0.6.
    bins = torch.arange(20, 300) + 0.5
    assert (((expected - 0.2) * bins).sum() / energy).item() == pytest.approx(100 + 1 / 0.6, abs=0.05)


@pytest.mark.parametrize("name", ["raw_depth", "raw_albedo", "raw_normal"])
def test_gradient_of_render_agrees_with_finite_differences(name):
    model, spots = random_model()
    model.double()
    probe = torch.randn(3, 260, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def value() -> torch.Tensor:
        return (model.render(spots) * probe).sum()

    parameter = getattr(model, name)
    (gradient,) = torch.autograd.grad(value(), parameter)
    for index in [(0,), (3,)] if parameter.ndim == 1 else [(0, 0), (3, 1)]:
        step = 1e-3
        sides = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter[index] += sign * step
                sides.append(value().item())
                parameter[index] -= sign * step
        assert gradient[index].item() == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=2e-3, abs=1e-6)


def _with(model, depth, albedo, spots):
    return torch.func.functional_call(model, {"raw_depth": depth, "raw_albedo": albedo}, (spots,))


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
def test_forward_mode_through_render_equals_reverse_mode():
    model, spots = random_model()
    shift = torch.randn(7, generator=torch.Generator().manual_seed(2))
    probe = torch.randn(3, 260, generator=torch.Generator().manual_seed(3))
    with tensor_by_tensor():
        _, forward = torch.func.jvp(
            lambda z: _with(model, z, model.raw_albedo, spots), (model.raw_depth.detach(),), (shift,)
        )
    (gradient,) = torch.autograd.grad((model.render(spots) * probe).sum(), model.raw_depth)
    assert (forward * probe).sum().item() == pytest.approx((gradient @ shift).item(), rel=1e-3)


def test_hooks_act_at_their_stages():
    class Double(Hooks):
        def path(self, contribution, paths, spots):
            return 2 * contribution

        def time(self, length, paths, spots):
            return length + 0.03  # three bins

        def gain(self, signal, spots):
            return 3 * signal

        def background(self, background, spots):
            return 5 * background

    model, spots = random_model()
    plain, changed = model.render(spots) - 0.2, model.render(spots, Double()) - 1.0
    assert torch.allclose(changed[:, 3:], 6 * plain[:, :-3], atol=1e-3 * changed.abs().max().item())
    assert torch.equal(model.render(spots, Hooks()), model.render(spots))


def test_a_batch_is_its_spots_one_by_one():
    model, spots = random_model()
    single = torch.cat([model.render(s[None]) for s in spots])
    assert torch.allclose(model.expected(spots), single, rtol=1e-5, atol=1e-6)


def test_bending_vanishes_on_a_sphere_and_punishes_turned_normals():
    angle = torch.tensor([[-0.1, 0.0], [0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
    normal = torch.stack(
        [angle[:, 0].sin(), angle[:, 1].sin(), -torch.sqrt(1 - angle.sin().square().sum(1))], 1
    )
    centre = normal * 0.5 + torch.tensor([0.0, 0.0, 1.5])
    pairs = neighbour_pairs(centre, normal, 0.09)
    assert len(pairs[0]) == 10  # every pair but the two farthest ends
    weight = torch.ones(4)
    i, j = pairs
    half = (normal[i] - normal[j]) / 2  # what is left on an arc is the turn itself
    assert torch.allclose(misfits(centre, normal, pairs), STIFFNESS * (half**2).sum(1), atol=1e-9)
    turned = torch.nn.functional.normalize(normal + torch.tensor([0.2, 0.0, 0.0]), dim=1)
    assert bending(centre, turned, weight, pairs, BEND) > 4 * bending(centre, normal, weight, pairs, BEND)
    # By hand: a pair whose misfit is `bend` costs ln 2 in the two directions together.
    flat = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])
    rise = 0.03 / (1 - 0.03**2) ** 0.5
    flat[1, 2] += 0.1 * rise
    facing = torch.tensor([0.0, 0.0, -1.0]).expand(2, 3)
    both = torch.tensor([0, 1]), torch.tensor([1, 0])
    assert bending(flat, facing, torch.ones(2), both, 0.03).item() == pytest.approx(np.log(2), rel=1e-4)


def test_how_much_neighbours_misfit():
    """Steps of 0.003, 0.02 and 0.02 in a row: 0.02 by most; dark surfels do not count; held at both ends."""
    facing = torch.tensor([0.0, 0.0, -1.0]).expand(4, 3)
    pairs = torch.tensor([0, 1, 2, 1, 2, 3]), torch.tensor([1, 2, 3, 0, 1, 2])

    def bend(steps: list[float], weight: list[float]) -> float:
        height = 0.1 * torch.tensor([0.0, *steps]).cumsum(0)
        centre = torch.stack([0.1 * torch.arange(4.0), torch.zeros(4), 1 + height], 1)
        return bend_of(centre, facing, torch.tensor(weight), pairs)

    assert bend([0.003, 0.02, 0.02], [1.0, 1.0, 1.0, 1.0]) == pytest.approx(0.02, rel=1e-3)
    assert bend([0.003, 0.02, 0.02], [1.0, 1.0, 0.1, 0.1]) == pytest.approx(0.003, rel=1e-3)
    assert bend([0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]) == FLATTEST
    assert bend([0.2, 0.3, 0.2], [1.0, 1.0, 1.0, 1.0]) == BEND
    none = torch.zeros(0, dtype=torch.long)
    assert bend_of(torch.ones(1, 3), facing[:1], torch.ones(1), (none, none)) == BEND


def test_an_edge_of_albedo_costs_little_more_the_higher_it_is():
    both, level = (torch.tensor([0, 1]), torch.tensor([1, 0])), torch.tensor(2.0)
    steps = [0.0, 0.02, 0.04, EDGE, 1.0]  # of the level
    cost = [albedo_steps(torch.tensor([0.5, 0.5 + 2.0 * x]), both, level).item() for x in steps]
    assert cost[0] == 0
    assert 3 < cost[2] / cost[1] < 4.1  # a square below ALIKE …
    size = np.sqrt(np.square(steps[3:]) + ALIKE**2) - ALIKE
    assert cost[3:] == pytest.approx(EDGE * np.log1p(size / EDGE), rel=1e-4)  # … and a logarithm above EDGE


@pytest.mark.parametrize(("share", "hides"), [(0.95, False), (1.05, True)])
def test_surfels_that_are_next_to_clear_hide_nothing(share, hides):
    """They would stand before what does hide: here the one in the middle, behind the first."""
    capture = wall([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    model = build(capture, [[0.0, 0.0, 0.4], [0.0, 0.0, 0.7], [0.0, 0.0, 1.0]])
    model.set_opacity(torch.tensor([share * HIDING, 0.8, 0.5]))
    model.update_hiders()
    assert model.hiders.tolist() == [[[[0] * 4, [int(hides)] * 4, [1 if hides else 2] * 4]]]
    seen = 1 - share * HIDING if hides else 1 - 0.8
    assert model.arriving(model.hiders)[0, 2].item() == pytest.approx(seen)


def test_a_surfel_is_hidden_in_part_past_an_edge():
    capture = wall([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    model = build(capture, [[0.0, 0.0, 0.5], [0.0, 0.0, 1.0], [0.5, 0.0, 0.5]])
    cell, facing = float(model.cell[0]), model.normal().detach()
    # The one in front ends at half a cell, so that a cell's width is hidden twice as far away.
    for aside, part in ((0.0, 1.0), (1.0, 0.5), (2.0, 0.0)):
        centre = torch.tensor([[0.0, 0.0, 0.5], [aside * cell, 0.0, 1.0], [0.5, 0.0, 0.5]])
        model.place(centre, facing, torch.ones(3), torch.full((3,), 0.8))
        model.update_hiders()
        assert model.arriving(model.hiders).tolist() == [pytest.approx([1.0, 1 - 0.8 * part, 1.0])]


@pytest.mark.parametrize(("bins", "points"), [(1.5, 1), (2.0, 1), (2.1, 4), (4.0, 4)])
def test_fine_surfels_are_looked_at_in_the_middle_alone(bins, points):
    capture = wall([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    model = build(capture, [[0.0, 0.0, 0.5], [0.0, 0.0, 1.0]], cell=bins * capture.bin_length)
    model.update_hiders()
    assert model.hiders.shape == (1, 1, 2, points)
    assert (model.hiders[0, 0, 1] == 1).all()


@pytest.mark.parametrize(("bins", "drawn"), [(0.5, 1), (0.52, 2), (1.0, 2), (1.02, 3), (2.5, 5), (9.0, 5)])
def test_surfels_are_drawn_by_points_half_a_bin_apart(monkeypatch, bins, drawn):
    """At most five along each side: the widest surfels have the coarsest outlines."""
    capture = wall([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    model, given = build(capture, [[0.0, 0.0, 0.5]], cell=bins * capture.bin_length), []

    def watched(*args, **options) -> torch.Tensor:
        given.append(args[-1])
        return who_hides(*args, **options)

    monkeypatch.setattr("nlos_lit.surfels.model.who_hides", watched)
    model.update_hiders()
    assert given == [drawn]


def test_light_is_hidden_from_laser_and_from_sensor():
    capture = wall([[-0.5, 0.0, 0.0]], [[0.5, 0.0, 0.0]])
    front = [[-0.25, 0.0, 0.5], [0.25, 0.0, 0.5], [-0.35, 0.0, 0.7]]
    model = build(capture, [*front, [0.0, 0.0, 1.0]])
    model.set_opacity(torch.tensor([0.8, 0.5, 0.9, 0.5]))
    model.update_hiders()
    # The third is on its way from the laser to none; of the last both legs are crossed.
    assert model.hiders[:, 0, 3].tolist() == [[1] * 4, [2] * 4]
    assert model.arriving(model.hiders)[0, 3].item() == pytest.approx(0.2 * 0.5)
    opacity = model.raw_opacity
    (slope,) = torch.autograd.grad(model.render(torch.tensor([0])).sum(), opacity)
    assert (slope[:2] < 0).all()
    assert slope[3] == 0


def test_surfels_keep_their_opacity_and_new_ones_have_an_unknown_one():
    model, _ = random_model()
    own = torch.linspace(0.2, 0.8, 7)
    model.set_opacity(own)
    model.keep(torch.tensor([True, False, True, True, False, True, True]))
    assert torch.allclose(model.opacity(), own[[0, 2, 3, 5, 6]])
    model.divide(2)
    assert torch.allclose(model.opacity(), own[[0, 2, 3, 5, 6]].repeat_interleave(4))
    model.place(*(v.detach() for v in (*model.placed(), model.albedo())))
    assert torch.allclose(model.opacity(), unknown_opacity(model.albedo().detach()))


def test_state_restores_the_model():
    model, spots = random_model()
    model.update_hiders()
    again = SurfelModel.from_state(_capture_of(model), model.state_dict())
    assert torch.equal(again.render(spots), model.render(spots))
    assert len(again) == 7


def _capture_of(model: SurfelModel) -> Capture:
    capture = wall(model.laser.double().numpy(), model.sensor.double().numpy(), gate=(40, 300))
    assert capture.n_bins == 300
    return capture


def test_quadrature_is_centred():
    assert quadrature(2).tolist() == [[-0.25, -0.25], [-0.25, 0.25], [0.25, -0.25], [0.25, 0.25]]
