"""The surface fit of a small scene: at the noise, better than its image, repeatable, blind to held-out
counts, silent on noise.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from data_modules.simulate import ScanPlan, SensorModel, join, simulate_capture
from data_modules.simulate.bodies import Torus
from data_modules.simulate.scenes import plate
from data_modules.spots import heldout_mask
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.volume_grid import VolumeGrid, volume_grid
from nlos_lit.capture.wall_blocks import wall_blocks
from nlos_lit.effects import EFFECTS, build_effects
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.hooks import Hooks
from nlos_lit.functional.surfel_graph import (
    CURVED,
    brightness,
    curvature_of,
    lay_sheet,
    level_of,
    neighbour_pairs,
    sheet_normals,
)
from nlos_lit.functional.surfel_paths import STEEP
from nlos_lit.model.build import PipelineSettings, build_pipeline
from nlos_lit.surfels import growth, start
from nlos_lit.surfels.effect_start import asked_of, choose_shapes
from nlos_lit.surfels.fit import PATCHES, Round, SurfelFit, SurfelSettings, score_spots
from nlos_lit.surfels.fitted import FittedSurfels, fit_surfels
from nlos_lit.surfels.growth import (
    PlaceTest,
    Score,
    Seeds,
    begin_bodies,
    best_apart,
    continuations,
    continuing_gain,
    dispersion,
    occupied,
    prune_and_grow,
    support,
)
from nlos_lit.surfels.model import SurfelModel, unknown_opacity
from nlos_lit.surfels.outlines import SEARCH, solve_albedos

QUICK = SurfelSettings(contest=40, rounds=2, outlines=1, more=0, test_spots=200, floor=0.15, per_cell=2)
BIN = 0.0096


def scene() -> tuple[Capture, np.ndarray]:
    """A tilted plate and, behind its edge, a darker one; 20 × 20 spots, 1500 counts each.

    Cells of 5 cm are coarse: half of them hold an edge, so the noise is missed by some per cent.
    """
    front = plate((0.12, 0.08, 0.5), 0.3, 0.25, turn_y=0.25, albedo=0.9)
    back = plate((-0.15, -0.12, 0.75), 0.35, 0.3, albedo=0.5)
    scan = ScanPlan(kind="confocal", nx=20, ny=20, width=1.0, n_bins=190, bin_length=BIN, t_start=0.6)
    sensor = SensorModel(sigma=1.0 * BIN, kappa=0.6 / BIN, background=0.15, mean_counts=1500)
    capture, _ = simulate_capture(join(front, back), scan, sensor, seed=2)
    return capture, heldout_mask(capture, 3, 4)


def image(capture: Capture) -> tuple[torch.Tensor, VolumeGrid]:
    grid = volume_grid(capture, depth=(0.35, 0.95))
    phasor = build_pipeline(capture, grid, PipelineSettings(0.1)).phasor
    phasor.prepare(capture, phasor.plan(capture, 2**30))
    with torch.no_grad():
        return phasor(), grid


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Tensors here are small: a second thread costs more than it brings, much more on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def fitted():
    capture, held = scene()
    intensity, grid = image(capture)
    train = np.flatnonzero(~held)
    return (
        capture,
        held,
        intensity,
        grid,
        fit_surfels(capture, intensity, grid, QUICK, train, seed=0, heldout_spots=np.flatnonzero(held)),
    )


def test_reaches_the_noise_on_held_out_spots(fitted):
    result = fitted[-1]
    assert result.heldout.deviance_per_bin < 1.08 * result.heldout.deviance_noise
    assert result.heldout.nmse < 1.3 * result.heldout.nmse_noise_floor
    assert result.history[-1]["surfels"] == len(result.model)


def test_recovers_response_and_background(fitted):
    parameters = {name: value for name, (value, _) in fitted[-1].parameters.items()}
    assert parameters["sigma_ls"] == pytest.approx(BIN, rel=0.1)
    assert parameters["kappa_s"] == pytest.approx(0.6 / BIN, rel=0.25)
    assert parameters["background"] == pytest.approx(0.15, rel=0.05)


def test_places_and_normals_lie_on_the_plates(fitted):
    points = fitted[-1].points()
    strong = points.albedo > 0.3
    near = strong & (points.positions[:, 2] > 0.65)
    assert np.median(np.abs(points.positions[near, 2] - 0.75)) < BIN / 8
    tilted = strong & (points.positions[:, 2] < 0.6)
    # The plate turned by 0.25 about y: z = 0.5 - tan(0.25) (x - 0.12).
    plane = 0.5 - np.tan(0.25) * (points.positions[tilted, 0] - 0.12)
    assert np.median(np.abs(points.positions[tilted, 2] - plane)) < BIN / 8
    cosine = points.normals[tilted] @ np.array([-np.sin(0.25), 0, -np.cos(0.25)])
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 6
    ratio = np.median(points.albedo[near]) / np.median(points.albedo[tilted])
    assert ratio == pytest.approx(0.5 / 0.9, rel=0.15)


def test_same_seed_same_result_and_held_out_counts_do_not_matter(fitted):
    capture, held, intensity, grid, _ = fitted
    train, short = np.flatnonzero(~held), dataclasses.replace(QUICK, rounds=1, steps=8)
    counts = capture.counts.copy()
    counts[held] = 7 * counts[held][:, ::-1] + 1
    changed = dataclasses.replace(capture, counts=counts)
    scored = np.flatnonzero(held)
    first, again = (
        fit_surfels(capture, intensity, grid, short, train, seed=4, heldout_spots=scored) for _ in range(2)
    )
    blind = fit_surfels(changed, intensity, grid, short, train, seed=4, heldout_spots=scored)
    other = fit_surfels(capture, intensity, grid, short, train, seed=5)
    for name, value in first.model.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, again.model.state_dict()[name])
            assert torch.equal(value, blind.model.state_dict()[name])
    assert blind.heldout.deviance_per_bin > 2 * first.heldout.deviance_per_bin
    assert first.parameters != other.parameters


def test_more_rounds_follow_while_they_gain_and_the_fit_is_above_the_noise(fitted):
    capture, held, intensity, grid, _ = fitted
    train = np.flatnonzero(~held)
    short = dataclasses.replace(QUICK, contest=0, rounds=1, outlines=0, steps=2)
    seen, deviances, results = [], [], []
    for more in (0, 1, 3):
        settings = dataclasses.replace(short, more=more)
        progress = (lambda *count: seen.append(count)) if more == 1 else None
        result = fit_surfels(capture, intensity, grid, settings, train, progress=progress)
        deviances.append(score_spots(result.model, capture, torch.from_numpy(train)).deviance_per_bin)
        results.append(result)
    assert [len(result.history) for result in results] == [1, 3, 5], "one looked for bodies"
    assert deviances[0] > deviances[1] > deviances[2]
    of = dict(seen)
    assert [k for k, _ in seen] == list(range(1, 25))
    assert [of[k] for k in (8, 9, 16, 17, 24)] == [8, 16, 16, 24, 24]
    given = results[-1].fit
    judged, train_of_it = set(given.judged.tolist()), set(given.train.tolist())
    assert len(judged) == len(train) // 10
    assert judged | train_of_it == set(train)
    assert not judged & train_of_it
    patch = wall_blocks(capture, PATCHES)
    cut = {int(patch[spot]) for spot in judged} & {int(patch[spot]) for spot in train_of_it}
    assert len(cut) <= 1, "whole patches are set aside: neighbours would tell of them"
    assert len(results[0].fit.judged) == 0, "no round may follow, and no spot is set aside"


def test_nothing_follows_where_judged_spots_are_at_the_noise_or_there_are_none(fitted, monkeypatch):
    fit = fitted[-1].fit.copy(Extension([]), 0)
    fit.judged = torch.arange(3)
    for above_noise in (False, True):
        monkeypatch.setattr(fit, "_predicted", lambda now=above_noise: (torch.zeros(3), now))
        fit.schedule([], 4)
        assert len(fit.plan) == above_noise
    fit.judged = torch.arange(0)
    fit.schedule([], 4)
    assert fit.finished


def test_only_the_given_spots_are_scored(fitted):
    capture, held, intensity, grid, _ = fitted
    short, train = dataclasses.replace(QUICK, rounds=1, steps=2), np.flatnonzero(~held)
    assert fit_surfels(capture, intensity, grid, short, train).heldout is None
    some = np.flatnonzero(held)[5:25]
    result = fit_surfels(capture, intensity, grid, short, train, heldout_spots=some)
    counts, expected = (
        capture.gated_counts()[some].astype(float),
        result.expected(torch.from_numpy(some)).double().numpy(),
    )
    assert result.heldout.nmse == pytest.approx(
        ((counts - expected) ** 2).sum() / (counts**2).sum(), rel=1e-4
    )


def rippled(capture: Capture, period: float, height: float) -> Capture:
    """Bins that ripple: counts drawn anew from scaled ones keep Poisson statistics where they get thinner."""
    ripple = (1 + height * np.sin(2 * np.pi * np.arange(capture.n_bins) / period)) / (1 + height)
    return dataclasses.replace(
        capture, counts=np.random.default_rng(3).binomial(capture.counts, ripple).astype(np.uint16)
    )


def test_effects_are_fitted_along_and_their_shapes_found(fitted):
    """The grid's middle, a period of 4 bins, is nowhere near the true one."""
    capture, held, intensity, grid, _ = fitted
    rough, train = rippled(capture, 11.3, 0.2), np.flatnonzero(~held)
    seen, scores = [], {}
    for scan_shapes in (False, True):
        extension = Extension(build_effects(["tcspc_nonlinearity"], Scan.of(rough)))
        result = fit_surfels(
            rough, intensity, grid, QUICK, train, extension=extension, heldout_spots=np.flatnonzero(held),
            scan_shapes=scan_shapes, progress=lambda done, total: seen.append((done, total)),
        )  # fmt: skip
        scores[scan_shapes] = result.heldout.deviance_per_bin / result.heldout.deviance_noise
        ripple = {name: q.value.item() for name, q in result.extension.effects[0].quantities().items()}
        assert (abs(ripple["period"] - 11.3) < 0.3) == scan_shapes
    assert ripple["rms"] == pytest.approx(0.2 / 2**0.5, abs=0.03 / 2**0.5)
    assert scores[True] < scores[False] - 0.02
    assert seen[640:] == [(k, 640) for k in range(1, 641)]


def test_a_decay_is_found_and_an_absent_effect_stays_at_its_null(fitted):
    """Everything but the effects is true here: the fitted model, its counts drawn with a tail."""
    capture, _, _, _, result = fitted
    model, spots = result.model, torch.arange(capture.n_spots)
    scan = Scan.of(capture)
    (tail,) = build_effects(["irf_tail"], scan)
    tail.set("fraction", 0.25)
    decay = tail.declared["decay"].grid[3]  # 24 bins
    tail.set("decay", decay)
    expected = model.expected(spots, Extension([tail]))
    leaks = []
    for seed in range(8):
        counts = torch.poisson(expected, generator=torch.Generator().manual_seed(seed))
        found = Extension(build_effects(["irf_tail", "direct_leak", "wall_reflectance"], scan))
        choose_shapes(model, found, spots, counts)
        fitted_tail, wall, leak = found.effects
        assert fitted_tail.value("decay").item() == pytest.approx(decay)
        assert fitted_tail.value("fraction").item() == pytest.approx(0.25, abs=0.02)
        assert wall.value("gain_map").abs().max() == 0
        leaks.append(leak.value("amplitude").item())
    assert np.mean(leaks) < 0.02  # noise alone gives one 0.01


def test_what_is_asked_of_a_path_is_what_leaving_it_out_gains(fitted):
    """Beside finite differences: half of one surfel's light at one spot is left out."""
    result = fitted[-1]
    model, spots = result.model, torch.tensor([3, 11, 40])
    expected = model.expected(spots, Extension([]))
    counts = torch.poisson(1.1 * expected, generator=torch.Generator().manual_seed(0))
    noise = expected.sqrt()
    asked = asked_of(model, Extension([]), spots, (counts - expected) / noise, expected)

    class Less(Hooks):
        def path(self, contribution, paths, which):
            lost = torch.zeros_like(contribution)
            lost[1, surfel] = 0.5
            return contribution * (1 - lost)

    for surfel in asked.light[1].topk(3).indices.tolist():
        less = model.expected(spots, Less())
        gain = ((counts / expected - 1) * (less - expected)).sum() / 0.5
        assert asked.excess[1, surfel].item() == pytest.approx(gain.item(), rel=2e-3, abs=1e-3)
        light = ((expected - less) / noise).sum() / 0.5
        assert asked.light[1, surfel].item() == pytest.approx(light.item(), rel=2e-3)


def test_a_disc_that_hides_is_found(fitted):
    """Everything but the effect is true here: the fitted model, its counts drawn behind a disc."""
    capture, _, _, _, result = fitted
    model, spots = result.model, torch.arange(capture.n_spots)
    (disc,) = build_effects(["occlusion"], Scan.of(capture))
    middle = model.centre().detach().mean(0)
    true = {"x": 0.5 * float(middle[0]) + 0.03, "y": 0.5 * float(middle[1]), "z": 0.5 * float(middle[2])}
    disc.set_all({**true, "radius": 0.3 * disc.scan.half, "opacity": 0.5})
    counts = torch.poisson(
        model.expected(spots, Extension([disc])), generator=torch.Generator().manual_seed(0)
    )
    found = Extension(build_effects(["occlusion"], disc.scan))
    choose_shapes(model, found, spots, counts)
    (seen,) = found.effects
    for name in ("x", "y"):
        assert seen.value(name).item() == pytest.approx(true[name], abs=0.1 * disc.scan.half)
    assert seen.value("z").item() == pytest.approx(true["z"], rel=0.5)
    assert seen.value("opacity").item() == pytest.approx(0.5, abs=0.2)


def test_progress_counts_every_step(fitted):
    capture, held, intensity, grid, _ = fitted
    seen = []
    settings = dataclasses.replace(QUICK, contest=3, rounds=2, steps=3)
    fit_surfels(
        capture,
        intensity,
        grid,
        settings,
        np.flatnonzero(~held),
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(k, 21) for k in range(1, 22)]


@pytest.mark.parametrize("ambient", [0.3, 40.0])
def test_noise_alone_seeds_nothing(fitted, ambient):
    capture, held, _, _, _ = fitted
    noise = np.random.default_rng(1).poisson(ambient, capture.counts.shape).astype(np.uint16)
    empty = dataclasses.replace(capture, counts=noise)
    intensity, grid = image(empty)
    with pytest.raises(UserError, match="significant"):
        fit_surfels(empty, intensity, grid, QUICK, np.flatnonzero(~held))


def test_high_ambient_light_seeds_few_and_finds_the_scene(fitted):
    capture, held, _, _, clean = fitted
    bright = capture.counts + np.random.default_rng(1).poisson(12.0, capture.counts.shape).astype(np.uint16)
    capture = dataclasses.replace(capture, counts=bright)
    intensity, grid = image(capture)
    result = fit_surfels(
        capture, intensity, grid, QUICK, np.flatnonzero(~held), heldout_spots=np.flatnonzero(held)
    )
    assert len(result.model) < 2 * len(clean.model)
    assert result.parameters["background"][0] == pytest.approx(12.15, rel=0.02)
    assert result.heldout.deviance_per_bin < 1.05 * result.heldout.deviance_noise


def test_surfels_in_empty_space_die_and_missing_ones_grow(fitted):
    capture, held, _, grid, result = fitted
    model = SurfelModel.from_state(capture, result.model.state_dict())
    centre, normal, albedo = (t.detach() for t in (model.centre(), model.normal(), model.albedo()))
    gone = (centre[:, :2] - torch.tensor([0.12, 0.08])).norm(dim=1) < 0.06
    assert gone.sum() >= 3
    ghosts = torch.tensor([[0.4, -0.4, 0.4], [-0.4, 0.4, 0.4], [0.42, 0.42, 0.9]])
    model.place(
        torch.cat([centre[~gone], ghosts]),
        torch.cat([normal[~gone], torch.tensor([[0.0, 0.0, -1.0]]).expand(3, 3)]),
        torch.cat([albedo[~gone], torch.full((3,), 1e-5)]),
    )
    train = torch.from_numpy(np.flatnonzero(~held))
    counts = torch.from_numpy(capture.gated_counts())[train]
    test = PlaceTest(model, capture, train, counts, model.expected(train))
    prune_and_grow(model, grid, test, share=1.0, cost=3.0)
    now = model.centre().detach()
    assert torch.cdist(ghosts, now).min() > 0.02
    assert ((now[:, :2] - torch.tensor([0.12, 0.08])).norm(dim=1) < 0.06).sum() >= 2


def test_who_hides_whom_is_remembered_when_surfels_come_and_go(fitted):
    model = SurfelModel.from_state(fitted[0], fitted[-1].model.state_dict())
    model.update_hiders()
    before, centre, opacity = model.hiders, model.centre().detach(), model.opacity().detach()
    kept = torch.rand(len(model), generator=torch.Generator().manual_seed(0)) > 0.3
    place = Seeds(torch.tensor([[0.5, 0.5, 0.9]]), torch.tensor([[0.0, 0.0, -1.0]]))
    growth._add(model, kept, place, torch.ones(1), torch.ones(1), 0.1)
    number = int(kept.sum())
    assert len(model) == number + 1
    assert torch.allclose(model.opacity()[:number], opacity[kept])
    assert torch.allclose(model.opacity()[number:], unknown_opacity(model.albedo().detach())[number:])
    assert not model.hiders[:, :, number].any()  # of the new one nothing is known
    who, was = model.hiders[:, :, :number].long(), before[:, :, kept].long()
    stays = torch.cat([torch.tensor([False]), kept])[was]
    assert stays.any()
    assert (was > 0).sum() > stays.sum()
    assert torch.equal(who > 0, stays)
    assert torch.equal(model.centre()[who[stays] - 1], centre[was[stays] - 1])


def without_the_back(fitted) -> tuple[SurfelModel, torch.Tensor, torch.Tensor]:
    """The fitted scene with its front plate alone, the fitted spots and what was counted there."""
    capture, held, _, _, result = fitted
    model = SurfelModel.from_state(capture, result.model.state_dict())
    model.keep(model.centre()[:, 2] < 0.62)
    train = torch.from_numpy(np.flatnonzero(~held))
    return model, train, torch.from_numpy(capture.gated_counts())[train]


def test_a_body_that_is_missing_is_found(fitted):
    capture, _, _, grid, result = fitted
    model, train, counts = without_the_back(fitted)
    front, reserve = model.centre().clone(), result.fit.reserve
    test = PlaceTest(model, capture, train, counts, model.expected(train))
    number = begin_bodies(model, grid, test, reserve)
    assert torch.equal(model.centre()[: len(front)], front)
    assert len(model) == len(front) + number
    solve_albedos(model, train, counts, (0.7, 1.0, 0.0), SEARCH)
    away = model.centre().detach()[len(front) :] - torch.tensor([-0.15, -0.12, 0.75])
    reach = torch.tensor([0.175, 0.15, 0.0]) + float(model.cell.max())
    inside, albedo = (away.abs() < reach).all(1), model.albedo().detach()[len(front) :]
    assert float(albedo[inside].sum() / albedo.sum()) > 0.8
    model.update_hiders()
    before = model.hiders.clone()
    nothing = PlaceTest(model, capture, train, counts, counts.clamp_min(0.1))
    assert begin_bodies(model, grid, nothing, reserve) == 0
    assert torch.equal(model.hiders, before), "it stays as it was"


@pytest.mark.parametrize(("lit", "found"), [("everywhere", True), ("in a corner", False)])
def test_light_that_is_missing_in_a_corner_alone_is_no_body(fitted, monkeypatch, lit, found):
    """The same light twice, sixty times as bright where a ninth of the wall sees it alone."""
    capture, grid = fitted[0], fitted[3]
    model, train, _ = without_the_back(fitted)
    expected = model.expected(train)
    body = SurfelModel.from_state(capture, model.state_dict())
    here = Seeds(torch.tensor([[-0.15, -0.12, 0.75]]), torch.tensor([[0.0, 0.0, -1.0]]))
    body.place(*here, torch.ones(1))
    light = body.light(train)
    corner = torch.from_numpy((capture.laser[train.numpy(), :2] > 1 / 6).all(1))
    share = torch.ones(len(train)) if lit == "everywhere" else 60.0 * corner
    # Ten standard deviations of what this light can be seen by.
    light = 10 * light * share[:, None] / (light.square() / expected).sum().sqrt()
    test = PlaceTest(model, capture, train, expected + light, expected)
    assert float(test.places(here).significance) > 5
    assert (begin_bodies(model, grid, test, here) == 1) == found
    monkeypatch.setattr(growth, "dispersion", lambda scores: 25.0)
    assert begin_bodies(model, grid, test, here) == 0, "places that ask for less light do so as strongly"


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("time_offset", {"offset": 0.05}),
        ("wall_scale", {"scale_x": 0.1, "scale_y": -0.1}),
        ("retroreflection", {"falloff": 3.0}),
        ("vignetting", {"strength": 0.8}),
        ("gate_edges", {"start": 0.5}),
        ("pile_up", {"detections": 0.5}),
    ],
)
def test_places_are_asked_through_all_effects(fitted, name, values):
    """The score of a place is the derivative of the likelihood by the albedo of a surfel there."""
    capture, held, _, _, result = fitted
    train = torch.from_numpy(np.flatnonzero(~held))
    counts = torch.from_numpy(capture.gated_counts())[train]
    built = EFFECTS.named(name)(Scan.of(capture))
    built.set_all(values)
    model, hooks = SurfelModel.from_state(capture, result.model.state_dict()), Extension([built])
    test = PlaceTest(model, capture, train, counts, model.expected(train, hooks), hooks)
    here = torch.tensor([5, len(model) // 2])
    albedo = model.albedo().detach().requires_grad_()
    arriving = model.transients(model.paths(train, hooks), train, hooks, albedo)
    by = model.record(arriving, train, hooks)[:, model.gate[0] :]
    likelihood = (torch.xlogy(counts, by) - by).sum()
    true = torch.autograd.grad(likelihood, albedo)[0][here]
    found = test.surfels().score[here]
    assert found.numpy() == pytest.approx(true.numpy(), rel=0.02, abs=0.02 * float(true.abs().max()))


def test_candidates_keep_apart():
    centre = torch.tensor([[0.0, 0.0, 1.0], [0.01, 0.0, 1.0], [0.1, 0.0, 1.0]])
    assert best_apart(centre, torch.tensor([1.0, 3.0, 2.0]), 0.05).tolist() == [1, 2]
    assert len(best_apart(centre[:0], torch.zeros(0), 0.05)) == 0
    assert occupied(centre, centre[:1], 0.05).tolist() == [True, True, False]
    around, source = continuations(
        torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[0.6, 0.0, -0.8]]), torch.tensor([0.1, 0.2])
    )
    # Slope 0.75 along x: a step of 0.1 in x rises by 0.075.
    assert torch.allclose(around.centre[7], torch.tensor([0.1, 0.2, 1.075]), atol=1e-6)
    assert torch.allclose(around.normal[7], torch.tensor([0.6, 0.0, -0.8]))
    assert source.tolist() == [0] * 24


def test_a_bent_continuation_lies_on_the_circle_through_both_places():
    """Chord and tangents: the line between the centres makes half the turn with either plane."""
    centre, normal = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    places, _ = continuations(centre, normal, torch.tensor([0.1, 0.1]))
    step = places.centre - centre
    for turn, part in ((0.25, slice(8, 16)), (-0.25, slice(16, 24))):
        rise = torch.asin(step[part, 2] / step[part].norm(dim=1))
        assert torch.allclose(rise, torch.full((8,), turn / 2), atol=1e-6)
        assert torch.allclose(-places.normal[part, 2], torch.full((8,), float(np.cos(turn))), atol=1e-6)


def test_gains_of_a_continued_sheet_by_hand():
    """Score 40, information 100: the best albedo is 0.4, and gains 40·0.4 - 50·0.16 = 8 nats."""
    result = Score(torch.tensor([40.0]), torch.tensor([100.0]), torch.ones(1))
    gain, albedo = continuing_gain(result, torch.tensor([0.4]), 1.0)
    assert (gain.item(), albedo.item()) == (pytest.approx(8.0), pytest.approx(0.4))
    # A neighbour twice as bright: 0.4 is half of it, which the prior (deviation 0.7) holds against it.
    gain, albedo = continuing_gain(result, torch.tensor([0.8]), 1.0)
    assert (gain.item(), albedo.item()) == (
        pytest.approx(8 - (np.log(2) / 0.7) ** 2 / 2, abs=1e-5),
        pytest.approx(0.4),
    )
    assert continuing_gain(result, torch.tensor([0.4]), 4.0)[0].item() == pytest.approx(2.0)


def test_dispersion_looks_at_places_with_too_much_light_alone():
    noise = torch.randn(20_000, generator=torch.Generator().manual_seed(0))
    assert dispersion(noise) == pytest.approx(1.0, abs=0.05)
    assert dispersion(torch.cat([noise, torch.full((30_000,), 80.0)])) == pytest.approx(1.0, abs=0.05)
    assert dispersion(7 * noise) == pytest.approx(49, rel=0.05)
    assert dispersion(torch.zeros(0)) == 1.0


def flat_sheet(capture: Capture, result, tilt: float = 0.0) -> SurfelModel:
    """3 × 3 surfels of one plane, the middle one turned by ``tilt`` about y; rims do not roll off."""
    model = SurfelModel.from_state(capture, result.model.state_dict())
    model.roll.data.zero_()
    x, y = torch.meshgrid(*(torch.arange(-1.0, 2.0) * float(model.cell[0]),) * 2, indexing="ij")
    centre = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((9,), 0.6)], 1)
    normal = torch.tensor([[0.0, 0.0, -1.0]]).repeat(9, 1)
    normal[4] = torch.tensor([np.sin(tilt), 0.0, -np.cos(tilt)])
    model.place(centre, normal, torch.ones(9))
    return model


def test_neighbours_in_a_plane_share_their_worth(fitted):
    capture, result = fitted[0], fitted[-1]
    worth = torch.arange(9.0)
    flat = support(flat_sheet(capture, result), worth)
    assert flat[4] == pytest.approx(36 - 4)  # all the others
    assert flat[0] == pytest.approx(1 + 3 + 4)  # a corner has three neighbours
    leaning = support(flat_sheet(capture, result, tilt=1.0), worth)
    assert leaning[4] < 0.6 * flat[4]


def test_what_outshines_the_scene_costs():
    even, level = torch.full((8,), 0.3), torch.tensor(0.3)
    assert brightness(even, level) == 0
    assert brightness(torch.cat([even, torch.zeros(4)]), level) == 0
    outshone = torch.cat([even, torch.tensor([0.6, 0.0])]).requires_grad_()
    assert level_of(outshone) == level
    assert brightness(outshone, level).item() == pytest.approx(0.5 * (np.log(2) / 0.2) ** 2, rel=1e-5)
    (slope,) = torch.autograd.grad(brightness(outshone, level), outshone)
    assert slope[8] > 0
    assert not slope[:8].any()
    assert not slope[9:].any()


def test_a_shift_takes_the_sheet_along(fitted):
    capture, result = fitted[0], fitted[-1]
    model = flat_sheet(capture, result)
    model.lay()
    with torch.no_grad():
        model.raw_shift[4] = 1.0
    moved = (model.centre() - model.anchor)[:, 2] / (model.bin_length / 2)
    assert moved.min() > 0.05
    assert moved.max() < 0.25
    with torch.no_grad():
        model.raw_shift.fill_(1.0)
    assert torch.allclose((model.centre() - model.anchor)[:, 2], torch.tensor(model.bin_length / 2))
    kept = model.centre().detach()
    model.lift()
    assert torch.equal(model.centre(), kept)
    assert not model.raw_shift.any()


def outside(result: FittedSurfels) -> float:
    """How far the front plate's light lies outside its outline on average, m."""
    points = result.points()
    x, y, z = points.positions.T
    front = z < 0.62
    beyond = np.hypot((np.abs(x - 0.12) - 0.15 * np.cos(0.25)).clip(0), (np.abs(y - 0.08) - 0.125).clip(0))
    return np.average(beyond[front], weights=points.albedo[front])


def test_outlines_are_where_the_plates_end(fitted):
    """All together, and finer where that predicts more, against as many rounds one by one."""
    capture, held, intensity, grid, result = fitted
    train, scored = np.flatnonzero(~held), np.flatnonzero(held)
    together, one_by_one = (
        fit_surfels(capture, intensity, grid, settings, train, seed=0, heldout_spots=scored)
        for settings in (
            dataclasses.replace(QUICK, rounds=2, outlines=2, more=2),
            dataclasses.replace(QUICK, rounds=6, outlines=0),
        )
    )
    assert outside(result) < outside(one_by_one)
    assert outside(together) < outside(one_by_one)


def test_normals_follow_places_while_a_sheet_is_laid(fitted):
    capture, result = fitted[0], fitted[-1]
    model = flat_sheet(capture, result)
    model.lay()
    assert torch.allclose(model.normal(), torch.tensor([0.0, 0.0, -1.0]).expand(9, 3), atol=1e-6)
    with torch.no_grad():  # z rises by a fifth of x
        model.raw_depth.copy_(0.2 * model.anchor[:, 0] / (model.bin_length / 2))
    lean = -(model.normal()[4, 0] / model.normal()[4, 2]).item()
    assert 0.16 < lean < 0.2  # the ridge keeps some of what was
    gradient = torch.autograd.grad(model.normal()[4, 0], model.raw_depth)[0]
    assert gradient[1] != 0
    assert gradient[4].abs() < 1e-6
    kept = model.normal().detach()
    model.lift()
    assert torch.allclose(model.normal(), kept)
    with torch.no_grad():
        model.raw_depth.zero_()
    assert torch.allclose(model.normal(), kept)


def test_normals_at_a_rim_are_those_of_a_round_body():
    """Half of a tube, cut where it stands upright. Planes through neighbours on one side face inwards by half
    of what the surface bends to the next ones, 7.4°.
    """
    angle = torch.linspace(-1.3, 1.3, 11)
    along = torch.arange(7) * 0.26
    x, y = (v.reshape(-1) for v in torch.meshgrid(angle, along, indexing="ij"))
    true = torch.stack([x.sin(), torch.zeros_like(x), -x.cos()], 1)
    centre = torch.stack([true[:, 0], y, true[:, 2]], 1)
    pairs = neighbour_pairs(centre, true, 0.42)
    sheet = lay_sheet(centre, true, torch.ones(len(centre)), pairs, 0.26)
    cosine = (sheet_normals(sheet, centre) * true).sum(1).clamp(-1, 1)
    off = torch.rad2deg(torch.arccos(cosine)).view(11, 7)[:, 3]
    assert off.max() < 7.4 / 2
    assert off[1:-1].max() < 0.1, "neighbours are all around"


def test_rims_lean_outwards(fitted):
    """A row of three rolls off at its ends, by as much however often it is laid."""
    capture, result = fitted[0], fitted[-1]
    model = flat_sheet(capture, result)
    model.roll.data.fill_(0.5)
    for as_it_is in (False, False, True):
        model.lay(as_it_is)
        x, y, z = model.normal().detach().T
        assert torch.allclose(x[[1, 4, 7]], torch.tensor([-1.0, 0.0, 1.0]) * x[7], atol=1e-6)
        assert torch.allclose(y[[3, 4, 5]], torch.tensor([-1.0, 0.0, 1.0]) * x[7], atol=1e-6)
        # π/2 · (w + 2v)/(3w + 2√2 v), neighbours in a cell's distance of weight w, diagonal ones of v
        assert -x[7] / z[7] == pytest.approx(0.5 * 0.758, abs=0.001)
        model.lift()
        assert torch.allclose(model.normal(), torch.stack([x, y, z], 1), atol=1e-6)
    assert torch.autograd.grad(model.normal()[7, 0], model.roll)[0] > 0.4


def test_how_far_rims_roll_off_is_found(fitted):
    """Plates end; a torus turns away from the wall within a cell, and spots that no fit has seen are
    predicted better by that.
    """
    assert abs(fitted[-1].model.roll) < 0.05
    scan = ScanPlan(kind="confocal", nx=20, ny=20, width=1.0, n_bins=190, bin_length=BIN, t_start=0.6)
    sensor = SensorModel(sigma=1.0 * BIN, kappa=0.6 / BIN, background=0.15, mean_counts=1500)
    torus = Torus(radius=0.14, tube=0.06, at=(0.05, 0.0, 0.6)).mesh()
    capture, _ = simulate_capture(torus, scan, sensor, seed=2)
    held = heldout_mask(capture, 3, 4)
    train, scored = np.flatnonzero(~held), np.flatnonzero(held)
    free, kept = (
        fit_surfels(capture, *image(capture), settings, train, seed=0, heldout_spots=scored)
        for settings in (QUICK, dataclasses.replace(QUICK, roll_rate=1e-9))
    )
    assert free.model.roll > 0.15
    assert abs(kept.model.roll) < 1e-6
    assert free.heldout.deviance_per_bin < kept.heldout.deviance_per_bin


def test_a_sheet_that_is_laid_as_it_is_begins_with_its_own_normals(fitted):
    capture, result = fitted[0], fitted[-1]
    model = flat_sheet(capture, result, tilt=0.5)
    own = model.normal().detach()
    model.lay()
    assert not torch.allclose(model.normal(), own, atol=0.05)  # its neighbours know better
    model = flat_sheet(capture, result, tilt=0.5)
    model.lay(as_it_is=True)
    assert torch.allclose(model.normal(), own, atol=1e-6)
    with torch.no_grad():  # z rises by a fifth of x
        model.raw_depth.copy_(0.2 * model.anchor[:, 0] / (model.bin_length / 2))
    lean = -(model.normal()[:, 0] / model.normal()[:, 2])
    assert 0.1 < lean[1] < 0.2  # beside the middle one; the ridge keeps some of what was
    assert torch.atan(lean[4]) > 0.5 + 0.05


def test_what_goes_on_begins_where_it_ended(fitted):
    """At rates of nothing it stays; a round that arranges anew moves normals."""
    capture, held, grid, result = fitted[0], fitted[1], fitted[3], fitted[-1]
    train = torch.from_numpy(np.flatnonzero(~held))
    counts = torch.from_numpy(capture.gated_counts())[train]
    rates = dict.fromkeys(("depth_rate", "albedo_rate", "opacity_rate", "roll_rate", "response_rate"), 1e-9)
    settings, nothing = dataclasses.replace(QUICK, **rates), Seeds(torch.zeros(0, 3), torch.zeros(0, 3))
    model = SurfelModel.from_state(capture, result.model.state_dict())
    model.update_hiders()
    generator = torch.Generator().manual_seed(0)
    given = (model, capture, grid, counts, train, settings, nothing, Extension([]), generator)
    fit = SurfelFit(*given, torch.arange(len(train)), torch.arange(0))
    before = fit.model.expected(train, fit.extension).detach()

    def moved(plan: Round) -> float:
        again = fit.copy(Extension([]), 0)
        again.schedule([plan])
        again.finish()
        return float((again.model.expected(train, again.extension) - before).abs().max() / before.max())

    assert moved(Round(2, onward=True)) < 1e-4
    assert moved(Round(2)) > 1e-3


def test_division_keeps_plane_area_and_albedo(fitted):
    capture, result = fitted[0], fitted[-1]
    model = SurfelModel.from_state(capture, result.model.state_dict())
    before, spots = model.expected(torch.arange(20)), torch.arange(20)
    number, quadrature = len(model), model.quadrature
    hiders, model.quadrature = model.hiders, 2 * quadrature
    fine = model.expected(spots)
    model.divide(2)
    first_part = torch.where(hiders > 0, 4 * (hiders - 1) + 1, 0)  # of the four that a surfel becomes
    model.quadrature, model.hiders = quadrature, first_part.repeat_interleave(4, 2)
    assert len(model) == 4 * number
    flat = -result.model.normal()[:, 2] > 0.9
    assert flat.all() or flat.float().mean() > 0.5
    assert (model.expected(spots) - fine).norm() < 2e-3 * before.norm()


def test_bins_that_were_not_recorded_take_part_in_nothing(fitted):
    """Nothing is expected there, so that no likelihood and no gradient knows of them."""
    capture, held, intensity, grid, _ = fitted
    train, short = np.flatnonzero(~held), dataclasses.replace(QUICK, rounds=2, steps=10)
    observed = np.ones(capture.counts.shape, bool)
    observed[::3, :60] = False
    cut = dataclasses.replace(capture, observed=observed, counts=capture.counts * observed)
    result = fit_surfels(cut, intensity, grid, short, train, heldout_spots=np.flatnonzero(held))
    blind = dataclasses.replace(cut, observed=None)
    wrong = fit_surfels(blind, intensity, grid, short, train, heldout_spots=np.flatnonzero(held))
    assert result.heldout.deviance_per_bin < wrong.heldout.deviance_per_bin
    expected = result.expected(torch.arange(capture.n_spots)).numpy()
    assert (expected[~observed] == 0).all()
    assert (expected[observed] > 0).all()
    terms = result.fit.loss(torch.arange(30))["counts"]
    rows = result.fit.train[:30].numpy()
    kept = observed[rows]
    counts = cut.counts[rows][kept]
    by_hand = (expected[rows][kept] - counts * np.log(expected[rows][kept])).sum() / kept.size
    assert terms.item() == pytest.approx(by_hand, rel=1e-3)
    assert wrong.expected(torch.arange(3))[0, :60].min() > 0


def test_impossible_input_is_refused(fitted):
    capture, held, intensity, grid, _ = fitted
    with pytest.raises(UserError, match="its grid"):
        fit_surfels(capture, intensity[1:], grid, QUICK, np.flatnonzero(~held))
    with pytest.raises(UserError, match="at least 1"):
        SurfelSettings(rounds=0)
    with pytest.raises(UserError, match="floor"):
        SurfelSettings(floor=1.5)
    with pytest.raises(UserError, match="evenness"):
        SurfelSettings(evenness=-1.0)


@pytest.mark.parametrize(("batch", "kept"), [(1, 24 * 200), (200, 160 * 200)])
def test_memory_is_that_of_a_step_or_of_the_paths_that_are_kept(fitted, monkeypatch, batch, kept):
    capture, held, intensity, grid, _ = fitted
    asked = []
    monkeypatch.setattr(start, "check_machine", lambda size, *_: asked.append(size))
    train, settings = (
        np.flatnonzero(~held),
        dataclasses.replace(QUICK, batch=batch, quadrature=1, subdivide=1),
    )
    fit = start.seed_surfels(capture, intensity, grid, settings, train)
    assert asked == [len(fit.model) * kept + 8 * fit.counts.numel()]


@pytest.mark.parametrize("opacity", [0.02, 0.98])
def test_the_counts_say_how_much_dark_surfels_hide(fitted, opacity):
    fit = fitted[-1].fit.copy(Extension([]), 0)
    model = fit.model
    model.keep(-model.normal()[:, 2] > STEEP)  # sides hide their neighbours
    front = model.centre()[:, 2] < 0.62
    model.set_albedo(torch.where(front, 0.1, 1.0).to(front.device))
    model.update_hiders()
    hiding = torch.bincount(model.hiders.flatten().long(), minlength=len(model) + 1)[1:]
    assert front[hiding > 0].all()
    model.set_opacity(torch.full((len(model),), opacity))
    fit.counts = model.expected(fit.train)
    model.set_opacity(torch.full((len(model),), 0.5))
    fit.schedule([Round(60, onward=True)])
    fit.finish()
    found = fit.model.opacity()[hiding > 0.5 * hiding.max()]
    assert len(found) > 3
    assert (found - opacity).abs().max() < 0.25
    assert torch.allclose(fit.model.opacity()[hiding == 0], torch.tensor(0.5))  # they say nothing of others


@pytest.mark.parametrize(("over", "share"), [(0.9, 1.0), (1.1, 1 / 1.1)])
def test_no_surfel_turns_by_more_than_a_radian_from_side_to_side(over, share):
    """What turns further is as curved as one that turns by a radian; one that turns less keeps its turn."""
    row = torch.tensor([[-0.1, 0.0, 1.0], [0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])

    def turn(angle: float) -> float:
        a = torch.tensor([-angle, 0.0, angle])
        facing = torch.stack([a.sin(), 0 * a, -a.cos()], 1)
        flat = torch.tensor([0.0, 0.0, -1.0]).expand(3, 3)
        sheet = lay_sheet(row, flat, torch.ones(3), neighbour_pairs(row, flat, 0.15), 0.1)
        return float(curvature_of(sheet, facing, cell)[1].norm())

    cell = 1.0
    small = turn(0.01) / math.sin(0.01)  # linear in the change of the normals
    cell = CURVED / (small * math.sin(0.3)) * over
    assert turn(0.3) == pytest.approx(share * small * math.sin(0.3), rel=1e-4)
