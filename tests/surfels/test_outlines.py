"""How far sheets reach: the albedos of all surfels solved for together, sheets extended and cut back."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from inference_scenes import FORWARD_MODE, capture_of, drawn, effect_of, fit_of, raster, surfels
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.capture.wall_blocks import wall_blocks
from nlos_lit.effects.extension import Extension
from nlos_lit.functional.surfel_graph import level_of
from nlos_lit.functional.surfel_lattice import side
from nlos_lit.functional.surfel_paths import STEEP
from nlos_lit.surfels.fit import FINEST, Round, SurfelFit, SurfelSettings, score_spots
from nlos_lit.surfels.model import SurfelModel
from nlos_lit.surfels.outlines import DIM, OPAQUE, RINGS, SEARCH, cut_back, extend, solve_albedos

pytestmark = FORWARD_MODE
CELL = 0.08
DEEP = VolumeGrid((-1.0, -1.0, 0.2), (0.1, 0.1, 0.1), (20, 20, 20))
WALL = capture_of(raster(10))
SPOTS = torch.arange(100)


def board(albedo: Tensor, z: float = 0.7, scene=WALL) -> SurfelModel:
    """Surfels ``albedo`` ``[n, n]`` on a lattice, facing the wall; some hundred counts a spot."""
    model, n = surfels(scene), len(albedo)
    x = CELL * (torch.arange(n) - n // 2)
    centre = torch.cat([torch.cartesian_prod(x, x), torch.full((n * n, 1), z)], 1)
    model.lateral = model.lateral._replace(origin=(0.0, 0.0), pitch=(CELL, CELL))
    model.cell = torch.tensor([CELL, CELL])
    model.place(centre, torch.tensor([0.0, 0.0, -1.0]).expand(n * n, 3), albedo.flatten())
    return model


def test_albedos_are_found_together_and_there_are_none_where_nothing_is():
    true = torch.ones(5, 5)
    true[:, :2], true[0, 4] = 0.0, 0.0
    counts = board(true).expected(SPOTS)
    model = board(torch.full((5, 5), 0.5))
    solve_albedos(model, SPOTS, counts, (0.0, 0.0, 0.0), SEARCH)
    found = model.albedo().detach().view(5, 5)
    assert (found - true)[true == 1].abs().max() < 0.1
    assert found[true == 0].max() < 0.1
    noisy, errors = torch.poisson(counts, generator=torch.Generator().manual_seed(2)), []
    for evenness in (0.0, 0.7):
        solve_albedos(model, SPOTS, noisy, (evenness, 0.0, 0.0), SEARCH)
        errors.append((model.albedo().view(5, 5) - true).abs().mean().item())
    assert errors[1] < 0.7 * errors[0]


def test_the_solution_is_that_of_the_cost_it_names():
    """No change of one albedo lowers the likelihood with its prior."""
    true = 0.3 + 0.7 * torch.rand(5, 5, generator=torch.Generator().manual_seed(1))
    counts = torch.poisson(board(true).expected(SPOTS), generator=torch.Generator().manual_seed(2))
    model = board(torch.full((5, 5), 0.6))
    for _ in range(4):  # as often as it stops, since the level may change
        solve_albedos(model, SPOTS, counts, (0.7, 0.0, 0.0), SEARCH)
    level = model.albedo().detach()

    def cost(albedo: Tensor) -> float:
        paths = model.paths(SPOTS)
        expected = model.record(model.transients(paths, SPOTS, Extension([]), albedo), SPOTS, Extension([]))
        expected = expected[:, model.gate[0] :].double()
        nats = (expected - torch.xlogy(counts.double(), expected)).sum()
        return float(nats + model.albedo_cost(0.7, 0.0, 0.0, albedo))

    with torch.no_grad():
        least = cost(level)
        for k in range(25):
            for change in (0.95, 1.05):
                moved = level.clone()
                moved[k] *= change
                assert cost(moved) > least


@pytest.mark.parametrize(("cost", "stays"), [(0.5, True), (4.0, False)])
def test_a_faint_surfel_must_be_worth_what_it_costs(cost, stays):
    """``cost`` of what the counts lose without it; the sheet, each of whose surfels is worth more, stays."""
    model = board(torch.ones(3, 3))
    centre = torch.cat([model.centre().detach(), torch.tensor([[0.5, 0.5, 0.8]])])
    normal = torch.tensor([0.0, 0.0, -1.0]).expand(10, 3)
    model.place(centre, normal, torch.cat([torch.ones(9), torch.tensor([0.3])]))
    with torch.no_grad():
        counts = model.expected(SPOTS).double()
        model.set_albedo(torch.cat([torch.ones(9), torch.zeros(1)]))
        without = model.expected(SPOTS).double()
        model.set_albedo(torch.cat([torch.ones(9), torch.tensor([0.3])]))
    worth = float((without - counts - torch.xlogy(counts, without / counts)).sum())
    assert worth > 3
    solve_albedos(model, SPOTS, counts.float(), (0.7, 1.0, cost * worth), SEARCH)
    albedo = model.albedo().detach()
    assert albedo[:9].min() > 0.5
    assert (albedo[9] > DIM) == stays


def test_a_spot_counts_once():
    """Of few spots the prior says more: their noise must not say what they leave open."""
    counts = torch.poisson(
        board(torch.ones(5, 5)).expected(SPOTS), generator=torch.Generator().manual_seed(2)
    )
    rough = {}
    for few in (10, 100):
        model = board(torch.ones(5, 5))
        solve_albedos(model, SPOTS[:few], counts[:few], (30.0, 0.0, 0.0), SEARCH)
        rough[few] = model.albedo().std().item()
    assert rough[10] < rough[100]


def test_effects_stand_still_and_are_seen_through():
    scan = Scan.of(WALL)
    extension = Extension([effect_of("irf_tail", scan, fraction=0.3, decay=0.1)])
    counts = board(torch.ones(5, 5)).expected(SPOTS, extension)
    seen, blind = board(torch.full((5, 5), 0.5)), board(torch.full((5, 5), 0.5))
    before = {name: value.clone() for name, value in extension.state_dict().items()}
    solve_albedos(seen, SPOTS, counts, (0.7, 1.0, 0.0), SEARCH, extension)
    solve_albedos(blind, SPOTS, counts, (0.7, 1.0, 0.0), SEARCH)
    assert all(torch.equal(value, before[name]) for name, value in extension.state_dict().items())
    assert all(p.grad is None for p in [*extension.parameters(), *seen.parameters()])
    errors = [(m.albedo() - 1).abs().mean().item() for m in (seen, blind)]
    assert errors[0] < 0.5 * errors[1]


def test_fourth_bounces_stay_what_they_are():
    """They are no linear function of the albedos."""
    fourth = Extension([effect_of("higher_order_bounces", Scan.of(WALL), strength=4.0)])

    def corner(albedo: float) -> SurfelModel:
        model = board(torch.full((5, 5), albedo))
        centre, side = model.centre(), model.centre()[:, :1].sign()
        centre = centre + torch.cat([torch.zeros(25, 2), -centre[:, :1].abs()], 1)
        model.place(centre, torch.cat([-side, 0 * side, -torch.ones(25, 1)], 1), model.albedo())
        return model

    true = corner(1.0)
    counts, without = true.expected(SPOTS, fourth), true.expected(SPOTS)
    assert (counts - without).sum() > 0.02 * without.sum()
    seen, blind = corner(0.9), corner(0.9)
    for model, extension in ((seen, fourth), (blind, Extension([]))):
        for _ in range(3):  # each with those of the albedos before
            solve_albedos(model, SPOTS, counts, (0.7, 1.0, 0.0), SEARCH, extension)
    errors = [(m.albedo() - 1).abs().mean().item() for m in (seen, blind)]
    assert errors[0] < 0.5 * errors[1]


def test_rings_lie_within_the_grid_hide_nothing_and_are_hidden():
    model = board(torch.ones(3, 3))
    front = torch.tensor([[0.0, 0.0, 0.4]])
    both = torch.cat([model.centre(), front]), torch.tensor([0.0, 0.0, -1.0]).expand(10, 3)
    model.place(*both, torch.cat([torch.ones(9), torch.tensor([0.9])]), torch.full((10,), 0.8))
    model.update_hiders()
    before = model.hiders.clone()
    extend(model, DEEP, SPOTS)
    assert torch.equal(model.hiders[:, :, :10], before)
    assert torch.allclose(model.opacity(), torch.tensor([0.8] * 10 + [0.0] * (len(model) - 10)))
    back = model.centre()[:, 2] > 0.6
    assert int(back.sum()) == (3 + 2 * RINGS) ** 2
    new = model.hiders[:, :, 10:][:, :, back[10:]]
    assert set(new.unique().tolist()) == {0, 10}  # the one in front, counted from 1, hides some
    assert not model.hiders[:, :, ~back].any()  # and nothing hides what lies beside it
    shallow = VolumeGrid((-1.0, -1.0, 0.55), (0.1, 0.1, 0.02), (20, 20, 20))
    model = board(torch.ones(3, 3), z=0.45)
    extend(model, shallow, SPOTS)
    assert len(model) == 9


def test_round_sheets_go_on_down_their_flanks():
    """From surfels that are there, not from those that are only tried; they curve on and hide nothing."""
    model, radius = board(torch.ones(1, 3)), 0.5
    angle = torch.deg2rad(torch.tensor([20.0, 40.0, 60.0]))
    normal = torch.stack([angle.sin(), 0 * angle, -angle.cos()], 1)
    along = torch.stack([angle.cos(), 0 * angle, angle.sin()], 1)
    axis = torch.tensor([-0.4, 0.0, 1.0])
    bend = along[:, :, None] * along[:, None] / radius
    for curvature, more in ((bend, 1), (0 * bend, 0)):
        model.place(axis + radius * normal, normal, torch.ones(3), torch.full((3,), 0.8), curvature)
        extend(model, DEEP, SPOTS)
        steep = -model.normal().detach()[3:, 2] < STEEP
        assert int(steep.sum()) == more
        assert model.opacity()[3:].max() < 1e-6
        if more:
            assert torch.equal(model.curvature[3:][steep], bend[2:])
            away = (model.centre().detach()[3:][steep] - axis)[0, [0, 2]].norm()
            assert abs(float(away) - radius) < 0.02


def laid_board(n: int) -> SurfelModel:
    """A board of ``n`` × ``n`` bright cells at 0.5 m, of which it is known where it ends."""
    model = board(torch.ones(n, n), z=0.5)
    model.lay()
    model.lift()
    return model


def test_behind_rims_stand_sides_where_it_is_known_where_sheets_end():
    """Behind all but the middle one of nine surfels, faced outwards, flat and hiding nothing; none where
    surfels have just come, as halves of wider ones have.
    """
    for known in (True, False):
        model = laid_board(3) if known else board(torch.ones(3, 3), z=0.5)
        extend(model, DEEP, SPOTS)
        centre, normal = (part.detach() for part in model.placed())
        stands = -normal[:, 2] < STEEP
        assert int(stands.sum()) == (8 if known else 0)
        out, at = normal[stands], centre[stands]
        assert ((out * at).sum(1) > 0.9 * CELL).all()
        assert torch.allclose(at[:, 2], torch.tensor(0.5 + CELL / STEEP / 2), atol=1e-4)
        assert not model.curvature[stands].any()
        assert not model.opacity()[stands].gt(1e-6).any()


def test_sides_stay_where_something_is_thick():
    """Counts of a board with sides are explained by sides; where it has none they are cut back."""
    for sides in (True, False):
        true = laid_board(5)
        place, out, _ = side(*true.placed(), true.outward, torch.ones(25, dtype=torch.bool), true.cell)
        centre, normal = true.placed()
        if sides:
            centre, normal = torch.cat([centre, place]), torch.cat([normal, out])
        true.place(centre, normal, torch.ones(len(centre)))
        true.update_hiders()
        counts = torch.poisson(true.expected(SPOTS), generator=torch.Generator().manual_seed(1))
        model = laid_board(5)
        model.update_hiders()
        before = model.albedo().detach()
        extend(model, DEEP, SPOTS)
        solve_albedos(model, SPOTS, counts, (0.7, 1.0, 3.0), 4 * SEARCH)
        cut_back(model, before)
        stands = -model.normal().detach()[:, 2] < STEEP
        light = float(model.albedo().detach()[stands].sum()) / len(place)
        assert light > 0.6 if sides else light == 0.0


def test_faint_surfels_are_not_extended():
    albedo = torch.ones(3, 3)
    albedo[0] = 0.01
    model = board(albedo)
    extend(model, DEEP, SPOTS)
    assert model.centre()[:, 0].min() > -0.1 - RINGS * CELL
    assert model.centre()[:, 0].max() > 0.05 + RINGS * CELL


@pytest.mark.parametrize(
    ("before", "share", "hides", "stays"),
    [
        (0.95, 0.95, 0.95, False),
        (0.95, 1.05, 0.95, True),
        (1.05, 0.95, 0.95, True),
        (0.95, 0.95, 1.05, True),
        (None, 0.95, 1.05, False),
        (None, 1.05, 0.95, True),
    ],
)
def test_surfels_go_that_are_dim_and_were_dim_or_new_and_hide_nothing(before, share, hides, stays):
    albedo = torch.ones(3, 3)
    albedo[2, 2] = share * DIM
    model = board(albedo)
    assert level_of(model.albedo()).item() == pytest.approx(1.0, rel=1e-5)
    known = torch.ones(8) if before is None else torch.tensor([1.0] * 8 + [before * DIM])
    model.set_opacity(torch.tensor([0.8] * 8 + [hides * OPAQUE]))
    cut_back(model, known)
    assert len(model) == (9 if stays else 8)
    # Those that were there keep their opacity, of a new one nothing is known.
    new = 9 if before is None and stays else 8
    assert torch.allclose(model.opacity()[:8], torch.tensor(0.8))
    assert len(model) == 8 or (model.opacity()[8] < 0.1) == (new == 9)


def outlined(number: int) -> SurfelFit:
    """A board of 5 × 5 cells of which only some rows in the middle are known, one round of outlines on."""
    true = board(torch.ones(5, 5))
    scene = drawn(true, Extension([]), WALL, seed=3)
    known = torch.zeros(5, 5)
    known[1:-1, 2] = 1.0
    start = board(known.clamp_min(1e-6))
    keep = known.flatten() > 0
    start.place(start.centre()[keep], start.normal()[keep], torch.full((int(keep.sum()),), 3.0))
    fit = fit_of(start, scene)
    fit.settings = SurfelSettings(steps=20, quadrature=2, subdivide=1)
    fit.grid = DEEP
    fit.schedule([Round(20, left=1, outline=True) for _ in range(number)])
    fit.finish()
    return fit


def test_a_sheet_that_is_known_in_part_comes_out_whole_and_no_larger():
    model = outlined(1).model
    x, y, _ = (model.centre().detach() / CELL).round().T
    inside = (x.abs() <= 2) & (y.abs() <= 2)
    assert int(inside.sum()) == 25
    albedo = model.albedo().detach()
    assert float(albedo[~inside].sum() / albedo.sum()) < 0.1
    assert float(albedo[inside].std() / albedo[inside].mean()) < 0.25


def test_outlines_reach_the_noise_from_a_part_and_go_on_to_the_digit():
    fit, again = outlined(2), outlined(2)
    scores = score_spots(fit.model, fit.capture, fit.train, fit.extension)
    assert scores.deviance_per_bin < 1.03 * scores.deviance_noise
    assert all(
        torch.equal(v, w) for v, w in zip(fit.model.parameters(), again.model.parameters(), strict=True)
    )


def waiting(change: dict | None = None) -> SurfelFit:
    """A board of 25 surfels, about to be asked whether more rounds follow."""
    fit = fit_of(board(torch.ones(5, 5)), WALL)
    fit.settings = dataclasses.replace(
        SurfelSettings(steps=1, quadrature=1, visibility=False), **(change or {})
    )
    fit.grid, fit.judged = DEEP, torch.arange(4)
    return fit


@pytest.mark.parametrize(
    ("change", "parts"), [({}, 2), ({"subdivide": 1}, 1), ({"most": 4 * 25}, 2), ({"most": 4 * 25 - 1}, 1)]
)
def test_surfels_are_divided_where_they_may_be(monkeypatch, change, parts):
    fit = waiting(change)
    monkeypatch.setattr(fit, "_predicted", lambda: (torch.zeros(4), True))
    fit.schedule([], 1)
    assert [each.parts for each in fit.plan] == [parts]


@pytest.mark.parametrize(("wide", "parts"), [(0.98, 1), (1.02, 2)])
def test_surfels_that_are_narrow_enough_are_not_divided(monkeypatch, wide, parts):
    fit = waiting()
    fit.model.cell = torch.full((2,), wide * FINEST * WALL.bin_length)
    monkeypatch.setattr(fit, "_predicted", lambda: (torch.zeros(4), True))
    fit.schedule([], 1)
    assert [each.parts for each in fit.plan] == [parts]


@pytest.mark.parametrize(
    ("found", "gains", "seen"),
    [
        ([3, 2, 1], [1, 1, 1], [True, True, False]),  # as many as are asked for, then finer
        ([3, 0, 1], [1, 1, 1], [True, False, False]),  # none is missing
        ([3, 2, 1], [-1, 1, 1], [True, False, False]),  # it does not help
    ],
)
def test_missing_bodies_come_first_while_there_are_any_and_they_help(monkeypatch, found, gains, seen):
    fit, found = waiting({"subdivide": 1}), iter(found)
    nats, began = torch.zeros(4), []

    def begin(model, *_):
        if number := next(found):
            model.place(
                torch.cat([model.centre(), torch.tensor([[0.0, 0.0, 0.9]]).expand(number, 3)]),
                torch.cat([model.normal(), torch.tensor([[0.0, 0.0, -1.0]]).expand(number, 3)]),
                torch.cat([model.albedo(), torch.ones(number)]),
            )
        return number

    monkeypatch.setattr("nlos_lit.surfels.fit.begin_bodies", begin)
    monkeypatch.setattr(fit, "_predicted", lambda: (nats.clone(), True))
    before = len(fit.model)
    fit.schedule([], 3, bodies=2)
    for gain in gains:
        began.append(bool((fit.model.centre()[:, 2] > 0.85).any()) and fit.bodies > 0)
        fit.begin_round()
        fit.step(), fit.step()
        nats += gain
        fit.end_round()
        if gain < 0:
            assert len(fit.model) == before
            nats -= gain
    assert began == seen


def test_surfels_cost_something_from_outlines_until_rounds_are_judged(monkeypatch):
    """A copy, and a fit that is restored, know whether they still do."""

    def costs(fit: SurfelFit) -> bool:
        found = []
        for lean in (0.0, 5.0):
            fit.settings = dataclasses.replace(fit.settings, lean=lean)
            found.append(fit.loss(torch.arange(8))["albedos"].item())
        return found[1] > found[0]

    fit = waiting()
    for plan, told in (([Round(1, grow=True)], False), ([Round(1, outline=True)], True)):
        fit.schedule(plan)
        assert costs(fit) == told
    fit.schedule([Round(1, onward=True)])
    assert costs(fit)
    monkeypatch.setattr(fit, "_predicted", lambda: (torch.zeros(4), True))
    fit.schedule([], 1)
    assert not costs(fit)
    other, again = fit.copy(fit.extension, 0), waiting()
    again.restore(fit.state())
    for each in (other, again):
        each.schedule([Round(1, onward=True)])
        assert not costs(each)


def test_what_a_round_adds_must_be_worth_its_area(monkeypatch):
    """However finely it is divided; a copy, and a fit that is restored, know how wide surfels were."""

    def cost(fit: SurfelFit) -> float:
        """Nats, over all fitted spots: of a surfel as bright as the scene's level ``lean`` / 1.1."""
        found = []
        for lean in (0.0, 5.0):
            fit.settings = dataclasses.replace(fit.settings, lean=lean)
            found.append(fit._predicted()[0])
        assert len(found[0]) == len(fit.judged)
        return float((found[0] - found[1]).mean()) * len(fit.train)

    fit = waiting()
    assert cost(fit) == pytest.approx(5 * 25 / 1.1)
    fit.model.divide(2)
    other, again = fit.copy(fit.extension, 0), waiting()
    again.restore(fit.state())
    for each in (fit, other, again):
        assert len(each.model) == 100
        assert cost(each) == pytest.approx(5 * 25 / 1.1)
    half = torch.cat([torch.ones(50), torch.zeros(50)])
    fit.model.set_albedo(half)
    assert cost(fit) == pytest.approx(5 * 12.5 / 1.1, rel=1e-3)


@pytest.mark.parametrize("divided", [True, False])
@pytest.mark.parametrize(("gain", "stays"), [(0.49, False), (0.51, True)])
def test_a_round_that_predicts_nothing_better_is_undone(monkeypatch, divided, gain, stays):
    fit = waiting({} if divided else {"subdivide": 1})
    monkeypatch.setattr(fit, "_predicted", lambda: (torch.zeros(4), True))
    fit.schedule([], 3)
    before = {name: v.clone() for name, v in fit.model.state_dict().items() if torch.is_tensor(v)}

    def after() -> tuple[torch.Tensor, bool]:
        """Four spots whose gains scatter by 1: their mean's standard error is a half."""
        return gain + torch.tensor([-1.0, -1.0, 1.0, 1.0]), True

    fit.begin_round()
    assert float(fit.model.cell.max()) == pytest.approx(CELL / 2 if divided else CELL)
    fit.step(), fit.step()
    monkeypatch.setattr(fit, "_predicted", after)
    fit.end_round()
    now = fit.model.state_dict()
    kept = all(now[n].shape == v.shape and torch.equal(now[n], v) for n, v in before.items())
    assert kept != stays
    # Where finer surfels did not pay those that were go on; where these did not, nothing does.
    assert [each.parts for each in fit.plan] == ([2 if divided else 1] if stays else [1] if divided else [])


@pytest.mark.parametrize(("gain", "stays"), [(0.70, False), (0.71, True)])
def test_spots_of_one_patch_that_gain_together_count_as_one(monkeypatch, gain, stays):
    """Two patches of two spots, whose gains are 1 above and 1 below the mean: their sum errs by √8."""
    fit = waiting()
    monkeypatch.setattr("nlos_lit.surfels.fit.PATCHES", 5)
    assert [*wall_blocks(WALL, 5)[fit.judged]] == [0, 0, 1, 1]
    before = torch.zeros(4, dtype=torch.double)
    assert fit._better(before + gain + torch.tensor([1.0, 1.0, -1.0, -1.0]), before) == stays


def test_the_level_does_not_ask_how_many_dark_surfels_lie_around():
    bright = torch.cat([torch.full((30,), 0.8), torch.full((10,), 1.6)])
    with_dark = torch.cat([bright, torch.zeros(400)])
    assert level_of(with_dark) == level_of(bright)
    assert level_of(bright).item() in np.float32([0.8, 1.6])
