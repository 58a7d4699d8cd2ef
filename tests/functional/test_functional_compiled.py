"""Compiled loops say what is said tensor by tensor: values, gradients, and derivatives in forward mode."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nlos_lit.functional import irf, surfel_graph, surfel_paths, surfel_visibility
from nlos_lit.functional.surfel_graph import (
    albedo_cost,
    bending,
    carry_along,
    lay_sheet,
    level_of,
    neighbour_pairs,
    sheet_normals,
)
from nlos_lit.functional.surfel_paths import SplineSplat, Walls, patches, quadrature, spline_at, trace
from nlos_lit.functional.surfel_visibility import who_hides
from nlos_lit.inference.problem import pushed

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
GEN = torch.Generator().manual_seed(3)
CELL = torch.tensor([0.04, 0.05])


def randn(*shape: int, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*shape, generator=GEN)


@pytest.fixture
def plainly(monkeypatch):
    """Runs a function with nothing compiled."""

    def run(function, *args):
        with monkeypatch.context() as patch:
            for module in (surfel_paths, surfel_graph, surfel_visibility):
                for name in ("compiled", "for_loops"):
                    patch.setattr(module, name, lambda values: False, raising=False)
            return function(*args)

    return run


def scene(number: int = 40) -> tuple[Tensor, Tensor, Tensor]:
    """Centres and normals of surfels, some of them upright, and how they curve."""
    centre = torch.stack(
        [randn(number, scale=0.2), randn(number, scale=0.2), 1 + randn(number, scale=0.1)], 1
    )
    normal = normalize(randn(number, 3, scale=0.6) + torch.tensor([0.0, 0.0, -1.0]), dim=1)
    bow = randn(number, 3, 3, scale=3.0)
    return centre, normal, bow + bow.mT


def with_gradients(function, *given: Tensor) -> list[Tensor]:
    """What comes out, and the gradients of a random sum of it."""
    given = [x.clone().requires_grad_() for x in given]
    found = function(*given)
    found = [found] if isinstance(found, Tensor) else list(found)
    gen = torch.Generator().manual_seed(8)
    total = sum((torch.randn(x.shape, generator=gen) * x).sum() for x in found)
    return [x.detach() for x in found] + list(torch.autograd.grad(total, given))


def alike(compiled: list[Tensor], plain: list[Tensor], rel: float = 1e-4) -> bool:
    """Each to a share of its largest value; not all are nothing."""

    def same(one: Tensor, other: Tensor) -> bool:
        return one.shape == other.shape and bool((one - other).abs().max() <= rel * other.abs().max())

    return all(map(same, compiled, plain)) and len(compiled) == len(plain) and any(x.any() for x in plain)


@pytest.mark.parametrize("curved", [True, False])
@pytest.mark.parametrize("points", [1, 2])
def test_patches(plainly, curved, points):
    _, normal, curvature = scene()

    def found(normal: Tensor):
        return patches(normal, CELL, quadrature(points), curvature if curved else None)

    assert alike(with_gradients(found, normal), plainly(with_gradients, found, normal))


@pytest.mark.parametrize("confocal", [True, False])
def test_paths(plainly, confocal):
    """Also of points whose light does not reach the wall: behind it, or turned away."""
    centre, normal, curvature = scene()
    centre[0, 2], normal[1] = -0.5, torch.tensor([0.0, 0.0, 1.0])
    laser, sensor = (torch.cat([randn(5, 2, scale=0.4), torch.zeros(5, 1)], 1) for _ in range(2))
    up, seen = torch.tensor([[0.0, 0.0, 1.0]] * 5), torch.rand(5, 40, generator=GEN)

    def found(centre: Tensor, normal: Tensor, seen: Tensor) -> list[Tensor]:
        walls = Walls(laser, up, sensor, up, confocal)
        return list(trace(centre, normal, CELL, quadrature(2), walls, curvature, seen)[:6])

    given = (centre, normal, seen)
    assert alike(with_gradients(found, *given), plainly(with_gradients, found, *given))


def test_splines(plainly):
    """Also of what arrives before and after the record, and at its ends."""
    time = torch.cat(
        [60 * torch.rand(3, 200, generator=GEN) - 5, torch.tensor([[-2.0, 0.0, 50.0, 52.0]] * 3)], 1
    )
    light, image = torch.rand(3, 204, generator=GEN), randn(3, 50)

    def splatted(light: Tensor, time: Tensor) -> Tensor:
        return SplineSplat.apply(light, time, 50)

    assert alike(with_gradients(splatted, light, time), plainly(with_gradients, splatted, light, time))
    assert alike(list(spline_at(image, time)), list(plainly(spline_at, image, time)))


def test_derivatives_of_splines_are_exact():
    """In both directions, and where nothing is asked of what comes out."""
    time, light = 8 * torch.rand(2, 5, generator=GEN).double(), torch.rand(2, 5, generator=GEN).double()
    given = (light.requires_grad_(), time.requires_grad_())

    def splatted(light: Tensor, time: Tensor) -> Tensor:
        return SplineSplat.apply(light, time, 9)

    assert torch.autograd.gradcheck(splatted, given, check_forward_ad=True)


def test_splines_in_forward_mode(plainly):
    """By light, by times, or by both."""
    time, light = 60 * torch.rand(3, 200, generator=GEN) - 5, torch.rand(3, 200, generator=GEN)
    more, later = randn(3, 200), randn(3, 200)

    def moved(by_light: Tensor | None, by_time: Tensor | None) -> list[Tensor]:
        changes = {"light": by_light, "time": by_time}
        at, given = {"light": light, "time": time}, [name for name, d in changes.items() if d is not None]

        def splatted(*some: Tensor) -> Tensor:
            now = at | dict(zip(given, some, strict=True))
            return SplineSplat.apply(now["light"], now["time"], 50)

        return list(pushed(splatted, tuple(at[n] for n in given), tuple(changes[n] for n in given)))

    for change in ((more, None), (None, later), (more, later)):
        found = moved(*change)
        assert alike(found, plainly(moved, *change))
        nudged = [x if d is None else x + 1e-3 * d for x, d in zip((light, time), change, strict=True)]
        off = SplineSplat.apply(*nudged, 50) - found[0]
        assert float((off / 1e-3 - found[1]).abs().max()) < 0.01 * float(found[1].abs().max())


def test_what_is_no_number_is_lost():
    """It must not be written beside the record."""
    time = torch.tensor([[float("nan"), float("inf"), -float("inf"), 3e38, 4.5]])
    found = SplineSplat.apply(torch.tensor([[5.0, 5.0, 5.0, 5.0, 6.0]]), time, 8)
    assert found[0].tolist() == pytest.approx([0, 0, 0, 1, 4, 1, 0, 0])


def test_sheets(plainly):
    centre, normal, _ = scene(200)
    pairs = neighbour_pairs(centre, normal, 0.1)
    weight = torch.rand(200, generator=GEN)
    assert len(pairs[0]) > 400
    for as_it_is in (False, True):
        sheet = lay_sheet(centre, normal, weight, pairs, 0.05, as_it_is)

        def normals(moved: Tensor, sheet=sheet) -> Tensor:
            return sheet_normals(sheet, moved)

        moved = centre + randn(200, 3, scale=0.01)
        assert alike(with_gradients(normals, moved), plainly(with_gradients, normals, moved))
        shift = randn(200)
        assert alike(
            with_gradients(lambda x, sheet=sheet: carry_along(sheet, x), shift),
            plainly(with_gradients, lambda x, sheet=sheet: carry_along(sheet, x), shift),
        )


def test_costs(plainly):
    centre, normal, _ = scene(200)
    pairs, weight = neighbour_pairs(centre, normal, 0.1), torch.rand(200, generator=GEN)

    def bends(centre: Tensor, normal: Tensor) -> Tensor:
        return bending(centre, normal, weight, pairs, 0.03)

    assert alike(with_gradients(bends, centre, normal), plainly(with_gradients, bends, centre, normal))
    albedo = torch.rand(200, generator=GEN) ** 3
    albedo[3] = 0.0
    level = level_of(albedo)
    for weights in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.7, 1.3, 3.0)):

        def costs(albedo: Tensor, weights=weights) -> Tensor:
            return albedo_cost(albedo, pairs, level, *weights)

        assert alike(with_gradients(costs, albedo), plainly(with_gradients, costs, albedo))


def test_views(plainly):
    """Of walls that are not flat, too; a pixel's edge may fall to either side."""
    centre, normal, _ = scene(300)
    wall = torch.cat([randn(30, 2, scale=0.4), torch.tensor([0.0, 0.02]).repeat(15)[:, None]], 1)
    target = centre[:, None] + randn(300, 4, 3, scale=0.01)
    given = (centre, normal, CELL, wall, target, 3)
    found, plain = who_hides(*given), plainly(who_hides, *given)
    assert (plain > 0).float().mean() > 0.1
    assert (found != plain).float().mean() < 1e-3
    names = torch.randperm(300, generator=GEN).to(torch.int32) + 7
    named = who_hides(*given, names=names)
    assert torch.equal(named, torch.where(found > 0, names[(found - 1).clamp_min(0).long()], 0))


@pytest.mark.parametrize(("sigma", "kappa"), [(0.6, 2.0), (3.0, 0.2), (1e-2, 1.0), (8.0, 5.0), (0.3, 50.0)])
def test_response_and_its_slopes(sigma, kappa):
    """By differences of the distribution function, and by its derivatives tensor by tensor."""

    def plain(sigma: Tensor, kappa: Tensor) -> Tensor:
        edges = torch.arange(91, dtype=torch.float64) - 20.5
        return torch.diff(irf.emg_cdf(edges, sigma.double(), kappa.double())).float()

    def found(sigma: Tensor, kappa: Tensor) -> Tensor:
        return irf.response(sigma, kappa, 90, 20)

    given = (torch.tensor(sigma), torch.tensor(kappa))
    assert alike(with_gradients(found, *given)[:1], with_gradients(plain, *given)[:1], rel=1e-6)
    towards = (torch.tensor(0.7), torch.tensor(-0.2))
    slopes = [torch.func.jvp(f, given, towards)[1] for f in (found, plain)]
    assert slopes[0] == pytest.approx(slopes[1], abs=1e-6)
    gen = torch.Generator().manual_seed(1)
    weight = torch.rand(90, generator=gen)
    pulls = []
    for function in (found, plain):
        leaves = [x.clone().requires_grad_() for x in given]
        pulls.append(torch.stack(torch.autograd.grad((weight * function(*leaves)).sum(), leaves)))
    assert pulls[0] == pytest.approx(pulls[1], abs=1e-6)
