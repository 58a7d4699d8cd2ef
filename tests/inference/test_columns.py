"""Columns of the least-squares problem against central differences of the model's own render."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from inference_scenes import (
    FORWARD_MODE,
    capture_of,
    double_precision,
    effect_of,
    hide_some,
    scattered,
    surfels,
    uneven,
)
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE, FREE_NAMES
from nlos_lit.effects.nominal import nominal_scan
from nlos_lit.functional.irf import emg_cdf
from nlos_lit.inference.evidence import Projector
from nlos_lit.inference.problem import (
    _by_bin,
    acting_order,
    build_problem,
    columns_at,
    expected_and_columns,
    patches_of,
    towards_wall,
    weighted_columns,
)
from nlos_lit.inference.scenes import copy_effects
from nlos_lit.surfels.model import SurfelModel, inverse_softplus

pytestmark = FORWARD_MODE
# Step of differences. A slope of 8e-6 among counts of 8 is lost in their rounding where steps are finer.
STEP = 3e-4
DELAYS = ("free_scan_delay", "free_wall_delay", "time_drift", "line_delay", "scene_motion")
ACCEPTED = {
    "none": {},
    "gain and pile-up": {"vignetting": {"strength": 0.3}, "pile_up": {"detections": 0.5}},
    "falloff, tail and background": {
        "retroreflection": {"falloff": 3.2, "cosine": 0.7, "entrance": 0.5},
        "irf_tail": {"fraction": 0.2, "decay": 0.15, "quick": 0.3},
        "background_slope": {"slope": 0.5},
    },
}


@pytest.fixture(autouse=True)
def _sharp(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The kernel of the response, too, is not rounded to single precision."""
    monkeypatch.setattr("nlos_lit.model.laser_sensor.response", exact_response)
    yield from double_precision()


def exact_response(sigma: Tensor, kappa: Tensor, n_bins: int, lead: int) -> Tensor:
    return torch.diff(emg_cdf(torch.arange(n_bins + 1.0) - lead - 0.5, sigma, kappa))


def setting(
    kind: str, accepted: str = "none", number: int = 12, spots: int = 10
) -> tuple[SurfelModel, Extension, Scan, Tensor]:
    scene = capture_of(scattered(spots), kind)
    model, scan = surfels(scene, number).double(), Scan.of(scene)
    hide_some(model)
    extension = Extension(
        [effect_of(name, scan, **values) for name, values in ACCEPTED[accepted].items()]
    ).double()
    return model, extension, scan, torch.tensor([7, 0, 3, 8])


def slope(model: SurfelModel, extension: Extension, spots: Tensor, change: Callable) -> Tensor:
    """``[S·bins]`` derivative of the render; ``change(model, extension, step)`` acts in place on copies."""
    ends = []
    for step in (STEP, -STEP):
        both = copy.deepcopy(model), copy.deepcopy(extension)
        with torch.no_grad():
            change(*both, step)
        ends.append(both[0].expected(spots, both[1]))
    return ((ends[0] - ends[1]) / (2 * STEP)).reshape(-1)


def unit(n: int, k: int) -> Tensor:
    return torch.eye(n)[k]


@pytest.mark.parametrize("accepted", ACCEPTED)
@pytest.mark.parametrize("kind", ["confocal", "exhaustive"])
def test_nuisance_is_the_slope_of_the_render(kind, accepted):
    """Albedos in units of themselves, depths and places along x and y in bins, response, rims that roll off,
    effects accepted before; how bright each surfel (they are few) is from where on the wall.
    """
    model, extension, _, spots = setting(kind, accepted)
    m = len(model)
    model.outward.copy_(
        torch.linalg.cross(model.normal().detach(), torch.tensor([[0.3, 0.8, 0.1]]).expand(m, 3))
    )
    counts = torch.full((4, 58), 3.0)
    problem = build_problem(model, extension, spots, counts)
    albedo = model.albedo().detach()
    size = torch.maximum(albedo, 0.05 * albedo.mean())
    changes: list[Callable] = []
    for k in range(m):
        changes.append(
            lambda mo, ex, h, k=k: mo.raw_albedo.copy_(inverse_softplus(albedo + h * size * unit(m, k)))
        )
    for k in range(m):
        changes.append(lambda mo, ex, h, k=k: mo.raw_depth.add_(h * unit(m, k)))
    for axis in (0, 1):
        for k in range(m):
            changes.append(lambda mo, ex, h, k=k, a=axis: mo.anchor[k, a].add_(h * mo.bin_length / 2))
    for name in ("sigma_ls", "kappa_s", "background"):
        changes.append(lambda mo, ex, h, n=name: getattr(mo.laser_sensor, n).raw.add_(h))
    changes.append(lambda mo, ex, h: mo.roll.add_(h))
    changes.append(lambda mo, ex, h: mo.raw_opacity.add_(h))
    for k, effect in enumerate(extension.effects):
        for p in effect.declared:
            changes.append(lambda mo, ex, h, k=k, p=p: getattr(ex.effects[k], f"raw_{p}").add_(h))
    expected = model.expected(spots, extension)
    ours = problem.nuisance * expected.reshape(-1, 1).sqrt()
    # A surfel that is brighter by f at a spot changes that spot as much as one whose albedo is.
    towards = towards_wall(model)[spots]
    j = towards.shape[1]
    uneven = (problem.uneven * expected.reshape(-1, 1).sqrt()).reshape(4, 58, m, j)
    everywhere = (ours[:, :m] * albedo / size).view(4, 58, m, 1)
    assert torch.allclose(uneven, everywhere * towards[:, None, None, :], rtol=1e-9)
    assert ours.shape == (4 * 58, len(changes))
    for k, change in enumerate(changes):
        numeric = slope(model, extension, spots, change)
        assert float(numeric.abs().max()) > 0, f"column {k} is nothing"
        tolerance = 2e-5 * float(numeric.abs().max())
        assert float((ours[:, k] - numeric).abs().max()) < tolerance, f"column {k}"
    assert torch.allclose(problem.residual, ((counts - expected) / expected.sqrt()).reshape(-1))
    assert problem.lit.shape == (4 * 58,)
    assert 0 <= float(problem.lit.min()) < float(problem.lit.max()) <= 1
    free = build_problem(model, extension, spots, counts, with_effects=False)
    parameters = sum(e.declared[p].size for e in extension.effects for p in e.declared)
    assert free.nuisance.shape[1] == len(changes) - parameters
    assert torch.equal(free.nuisance, problem.nuisance[:, : free.nuisance.shape[1]])


def test_patches_look_uneven_from_the_wall():
    """56 surfels are 32 patches; each may be brighter along two functions of the wall point, of mean 0 and
    mean square 1 over the scan; along four where laser and sensor both move.
    """
    for kind, number in (("confocal", 2), ("exhaustive", 4)):
        model, extension, _, spots = setting(kind, number=56)
        towards, m = towards_wall(model), len(model)
        assert towards.shape[1] == number
        assert torch.allclose(towards.mean(0), torch.zeros(number, dtype=towards.dtype), atol=1e-9)
        assert torch.allclose(towards.square().mean(0), torch.ones(number, dtype=towards.dtype))
        problem = build_problem(model, extension, spots, torch.zeros(4, 58))
        assert problem.uneven.shape == (4 * 58, 32 * number)
        assert torch.equal(problem.prior, torch.zeros(2 * m + 32 * 2 + 4))


def test_batches_of_spots_change_nothing(monkeypatch):
    model, extension, _, spots = setting("confocal", "gain and pile-up")
    counts = torch.arange(4 * 58.0).reshape(4, 58)
    whole = build_problem(model, extension, spots, counts)
    monkeypatch.setattr("nlos_lit.inference.problem.CHUNK", 1)
    parts = build_problem(model, extension, spots, counts)
    assert torch.allclose(parts.nuisance, whole.nuisance, rtol=1e-10)
    assert torch.equal(parts.residual, whole.residual)


@pytest.mark.parametrize("name", [e.name for e in [*EFFECTS, *FREE]])
def test_columns_of_effects_are_the_slope_of_the_render(name):
    """At values away from the null, beside two effects that were accepted before; amplitudes first, then
    shapes.
    """
    model, extension, scan, spots = setting("exhaustive", "gain and pile-up")
    extension = Extension([e for e in extension.effects if e.name != name])
    effect = effect_of(name, scan).double()
    uneven(effect)
    whole = copy_effects(extension, [effect])
    place = [e.name for e in whole.effects].index(name)
    ours = expected_and_columns(model, extension, spots, effect, shapes=True)[1]
    wanted = [
        (p.name, k)
        for p in (*effect.amplitudes, *effect.shapes)
        for k in range(1 if effect.per_spot else p.size)
    ]
    assert ours.shape == (4 * 58, len(wanted))
    for column, (parameter, k) in list(enumerate(wanted))[:: 1 + len(wanted) // 24]:

        def change(mo, ex, h, parameter=parameter, k=k):
            raw = getattr(ex.effects[place], f"raw_{parameter}")
            raw.add_(h if effect.per_spot else h * unit(len(raw), k))

        numeric = slope(model, whole, spots, change)
        largest = float(numeric.abs().max())
        none = {*FREE_NAMES, "line_delay", "tcspc_nonlinearity"}
        assert largest > 0 or name in none, "bands may hold none of these spots, short periods no high waves"
        tolerance = 5e-5 * largest
        assert float((ours[:, column] - numeric).abs().max()) <= tolerance, parameter
    assert bool((ours != 0).any())
    amplitudes = expected_and_columns(model, extension, spots, effect)[1]
    assert torch.equal(amplitudes, ours[:, : amplitudes.shape[1]])
    assert amplitudes.shape[1] == sum(1 if effect.per_spot else p.size for p in effect.amplitudes)


@pytest.mark.parametrize(
    "name", [*DELAYS, "free_response_scan", "free_response_wall", "free_width_scan", "free_width_wall"]
)
@pytest.mark.parametrize("kind", ["confocal", "single", "exhaustive"])
def test_columns_of_what_acts_alike_at_all_spots_are_worked_out_once(name, kind, monkeypatch):
    """The same as by differentiating each coefficient: at its null and, of delays, away from it, beside
    effects that stand before it.
    """
    model, extension, scan, spots = setting(kind, "gain and pile-up")
    for effect in (effect_of(name, scan).double(), uneven(effect_of(name, scan)).double())[
        : 1 + (name in DELAYS)
    ]:
        ours = expected_and_columns(model, extension, spots, effect)[1]
        with monkeypatch.context() as patch:
            patch.setattr(type(effect), "factors", lambda self, spots: None)
            exact = expected_and_columns(model, extension, spots, effect)[1]
        assert float(exact.abs().max()) > 0
        assert float((ours - exact).abs().max()) < 1e-6 * float(exact.abs().max())


SCANNED = [e for e in EFFECTS if e.stage in ("spot", "counting") and len(e(nominal_scan()).shape_grid()) > 1]


@pytest.mark.parametrize("effect", SCANNED, ids=lambda e: e.name)
@pytest.mark.parametrize("elements", [1, 1 << 14, 1 << 25])
def test_shapes_side_by_side_are_those_one_by_one(effect, elements, monkeypatch):
    """However many of them at a time, beside effects that stand before it."""
    model, extension, scan, spots = setting("exhaustive", "gain and pile-up")
    effect = effect_of(effect.name, scan).double()
    shapes = effect.shape_grid()[:5]
    problem = build_problem(model, extension, spots, torch.full((4, 58), 3.0))
    one_by_one = []
    for shape in shapes:
        effect.set_all(shape)
        one_by_one.append(weighted_columns(problem, effect))
    monkeypatch.setattr("nlos_lit.inference.problem.CHUNK", elements)
    found = list(columns_at(problem, effect, shapes))
    assert len(shapes) > 1
    assert not torch.allclose(found[0], found[1])
    assert torch.allclose(torch.stack(found), torch.stack(one_by_one), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda e: e.name)
def test_only_delays_and_motions_have_factors(effect):
    """Of the registry: what turns the wall delays no spot as a whole."""
    _, _, scan, spots = setting("single")
    known = ("scene_motion", "time_drift", "line_delay")
    assert (effect(scan).factors(spots) is not None) is (effect.name in known)


@pytest.mark.parametrize(("most", "groups"), [(1, 1), (2, 2), (5, 4), (16, 16), (55, 32), (56, 56), (99, 56)])
def test_patches_are_halves_of_halves(most, groups):
    """No more than asked for, as large as each other, and each surfel its own where there may be enough."""
    model, *_ = setting("confocal", number=56)
    patch = patches_of(model, most)
    sizes = patch.bincount()
    assert len(sizes) == groups
    assert int(sizes.max() - sizes.min()) <= 1
    if groups == 56:
        assert torch.equal(patch, torch.arange(56))


def test_patches_lie_together():
    """Halved along the widest side: the left half is left of the right one, and so on within each."""
    model, *_ = setting("confocal", number=56)
    place = model.centre().detach()
    width = place.amax(0) - place.amin(0)
    two = patches_of(model, 2)
    side = int(width.argmax())
    assert float(place[two == 0, side].max()) < float(place[two == 1, side].min())
    four = patches_of(model, 4)
    for half in (0, 1):
        mine = place[two == half]
        assert sorted(set(four[two == half].tolist())) == [2 * half, 2 * half + 1]
        side = int((mine.amax(0) - mine.amin(0)).argmax())
        first, second = (place[four == 2 * half + k, side] for k in (0, 1))
        assert float(first.max()) < float(second.min())


@pytest.mark.parametrize("accepted", ["none", "falloff, tail and background"])
def test_columns_of_patches_are_the_sums_of_those_of_their_surfels(accepted):
    model, extension, _, spots = setting("exhaustive", accepted, number=24)
    counts = torch.full((4, 58), 3.0)
    exact = build_problem(model, extension, spots, counts)
    coarse = build_problem(model, extension, spots, counts, patches=5)
    patch, x = patches_of(model, 5), exact.nuisance
    sums = [torch.zeros(len(x), 4).index_add_(1, patch, x[:, start : start + 24]) for start in (0, 24)]
    by_hand = torch.cat([*sums, x[:, 48:]], 1)
    assert torch.allclose(coarse.nuisance, by_hand, rtol=1e-9, atol=1e-9 * float(x.abs().max()))
    assert torch.equal(coarse.prior, torch.cat([exact.prior[:8], exact.prior[48:]]))
    assert torch.equal(coarse.residual, exact.residual)


def test_patches_leave_little_more_to_a_term_than_surfels_do():
    """Sixteen patches of 96 surfels span less than these, so that terms keep no less of their information,
    and here at most a tenth of it more than they should.
    """
    torch.set_default_dtype(torch.float32)
    scene = capture_of(scattered(60))
    model, scan = surfels(scene, 96, level=10.0), Scan.of(scene)
    spots, nothing = torch.arange(60), Extension([])
    exact, coarse = (
        build_problem(model, nothing, spots, torch.ones(60, 58), patches=patches) for patches in (None, 16)
    )
    for name in ("irf_tail", "pile_up", "power_drift", "vignetting", "time_drift", "time_offset"):
        z = weighted_columns(exact, effect_of(name, scan))
        kept = [float(Projector(p).off(z).square().sum() / z.square().sum()) for p in (exact, coarse)]
        assert kept[0] - 1e-3 < kept[1] < kept[0] + 0.1, name


def test_columns_of_an_accepted_effect_count_it_once():
    model, extension, _, spots = setting("confocal", "gain and pile-up")
    vignetting = extension.effects[0]
    problem = build_problem(model, extension, spots, torch.zeros(4, 58))
    numeric = slope(model, extension, spots, lambda mo, ex, h: ex.effects[0].raw_strength.add_(h))
    ours = expected_and_columns(model, extension, spots, vignetting)[1][:, 0]
    assert float((ours - numeric).abs().max()) < 1e-6 * float(numeric.abs().max())
    weighted = weighted_columns(problem, vignetting)[:, 0]
    assert torch.allclose(weighted, ours / problem.expected.reshape(-1).sqrt())


@pytest.mark.parametrize("effect", [e for e in [*EFFECTS, *FREE] if not e.per_spot], ids=lambda e: e.name)
def test_columns_have_the_precision_of_the_counts(effect):
    """Numbers without a dimension made those of a vignetting's axis double, and no pool could be asked."""
    torch.set_default_dtype(torch.float32)
    scene = capture_of(scattered(10), "confocal")
    model, scan = surfels(scene, 12), Scan.of(scene)
    one = effect(scan)
    one.draw(one.typical(scan), np.random.default_rng(0))
    for column in expected_and_columns(model, Extension([one]), torch.tensor([7, 0, 3, 8]), one, shapes=True):
        assert column.dtype == torch.float32


def test_effects_act_in_the_order_of_the_registry_whenever_they_were_accepted():
    _, _, scan, _ = setting("confocal")
    late = copy_effects(
        Extension([effect_of("pile_up", scan)]),
        [effect_of("afterpulsing", scan), effect_of("time_offset", scan)],
    )
    assert [e.name for e in late.effects] == ["time_offset", "afterpulsing", "pile_up"]
    assert [acting_order(e(scan)) for e in EFFECTS] == list(range(len(EFFECTS)))
    stages = [e.stage for e in EFFECTS]
    assert sorted(stages, key=["path", "time", "response", "spot", "counting"].index) == stages


@pytest.mark.parametrize(("seen", "alone"), [(0.0, True), (1e-3, False)])
def test_bins_that_others_see_are_told(seen, alone):
    """A thousandth of the light of the bin before is enough; the square of a bin's own light is not."""
    signal = torch.rand(4, 30, generator=torch.Generator().manual_seed(2)) + 0.5

    def counted(light: Tensor) -> Tensor:
        return 3 * light**2 + seen * light.roll(1, 1)

    found = _by_bin(counted, signal)
    assert (found is not None) is alone
    if found is not None:
        torch.testing.assert_close(found, 6 * signal)
