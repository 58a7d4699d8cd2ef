"""The march with tensors of fixed size against the other one, and an iteration that never needs a value on
the host.
"""

from __future__ import annotations

import literal
import numpy as np
import pytest
import torch
from literal_scenes import CASES, NAMES, build
from pretended_device import DEVICE, pretended

from nlos_lit.functional.fixed_size_march import compact
from nlos_lit.model.objective import Objective, rated_groups
from nlos_lit.training.shown import surface_points

RATES = {"phasor": 0.05, "sensor": 0.1, "albedo": 0.3}
CRITERION = Objective(400.0, 0.01, 0.005, albedo_planes=5, seed=3)


def world(name: str):
    made = build(CASES[name])
    phasor = made.pipeline.phasor
    phasor.prepare(made.capture, phasor.plan(made.capture, 1 << 32))
    made.counts = torch.from_numpy(made.capture.gated_counts())[made.spots]
    made.pipeline.geometry.fine, made.pipeline.geometry.relative = 4, True
    return made


def loss_and_gradients(made):
    terms = CRITERION.terms(made.pipeline, made.spots, made.counts, 0)
    return terms, torch.autograd.grad(terms["loss"], [made.raw[name] for name in NAMES])


def test_compact_by_hand():
    mask = torch.tensor([False, True, True, False, True])
    places, used, needed = compact(mask, 4)
    assert (places.tolist(), used.tolist(), needed.tolist()) == ([1, 2, 4, 0], [True, True, True, False], [3])
    places, used, needed = compact(mask, 2)
    assert (places.tolist(), used.tolist(), needed.tolist()) == ([1, 2], [True, True], [3])


@pytest.mark.parametrize("name", ["fine", "confocal, mirrored", "one sensor", "one laser", "upsampled"])
def test_fixed_sizes_change_nothing(name):
    made = world(name)
    expected, gradients = loss_and_gradients(made)
    surface = made.pipeline(made.spots).surface
    made.pipeline.geometry.wants_static = True
    found, static_gradients = loss_and_gradients(made)
    static = made.pipeline(made.spots).surface
    real = static.normal.abs().sum(1) > 0
    order, other = (
        (s.spot * 1e4 + s.distance.double()).argsort()
        for s in (surface, type(static)(*(f[real] for f in static)))
    )
    assert int(real.sum()) == len(surface.spot) > 50
    for field, mine in zip(surface, static, strict=True):
        assert torch.allclose(field[order].double(), mine[real][other].double(), atol=2e-6)
    for key, value in expected.items():
        assert found[key].item() == pytest.approx(value.item(), rel=1e-5)
    for mine, gradient in zip(static_gradients, gradients, strict=True):
        assert literal.relative(mine, gradient) < 1e-4


@pytest.mark.parametrize("name", ["fine", "one sensor"])
def test_points_that_are_shown_are_the_same(name):
    """Rows to spare have no normal and are not points; one sensor's surface is shown from the laser's."""
    made, shown = world(name), {}
    for static in (False, True):
        made.pipeline.geometry.wants_static = static
        points = surface_points(made.pipeline, made.capture, np.arange(made.capture.n_spots), block=4)
        rows = np.column_stack([points.positions, points.normals, points.albedo])
        shown[static] = rows[np.lexsort(np.round(rows[:, :3], 4).T)]
    assert len(shown[True]) == len(shown[False]) > 50
    assert np.allclose(shown[True], shown[False], atol=1e-5)


def test_too_little_room_is_noticed_and_made():
    made = world("fine")
    geometry = made.pipeline.geometry
    geometry.wants_static = True
    whole = made.pipeline(made.spots).expected
    assert not geometry.renew_capacity()
    geometry.capacity = (40.0, 30.0)
    part = made.pipeline(made.spots).expected
    assert part.sum() < 0.9 * whole.sum()
    assert torch.isfinite(part).all()
    assert geometry.renew_capacity()
    assert torch.allclose(made.pipeline(made.spots).expected, whole, rtol=1e-5)
    assert not geometry.renew_capacity()


def iterations(made, number: int) -> tuple[list[float], list[list[str]]]:
    """The loss of each, and for what each made the host wait; before, the field is made on its device."""
    phasor = made.pipeline.phasor
    device, losses, waited = phasor.omega_pf.raw.device, [], []
    with pretended() as waits:
        phasor.prepare(made.capture, phasor.plan(made.capture, 1 << 32))
        optimiser = torch.optim.Adam(rated_groups(made.pipeline, RATES, list(RATES)))
        spots, counts = made.spots.to(device), made.counts.to(device)
        for step in range(number):
            waits.clear()
            optimiser.zero_grad()
            loss = CRITERION.terms(made.pipeline, spots, counts, step)["loss"]
            loss.backward()
            optimiser.step()
            waited.append(list(waits))
            losses.append(loss.item())
    return losses, waited


@pytest.mark.parametrize("name", ["fine", "one sensor"])
def test_an_iteration_on_a_device_needs_no_value_on_the_host(name):
    """And its losses are those of the CPU."""
    expected, _ = iterations(world(name), 3)
    made = world(name)
    with pretended():
        made.pipeline.to(DEVICE)
    losses, waited = iterations(made, 3)
    assert waited[0] == ["aten._local_scalar_dense.default", "tolist"]  # how much room is needed
    assert waited[1:] == [[], []]
    assert losses == pytest.approx(expected, rel=1e-4)


def test_the_other_march_would_wait():
    """The check above can fail: the march with sizes of its own needs values."""
    made = world("fine")
    made.pipeline.geometry.wants_static = False
    with pretended():
        made.pipeline.to(DEVICE)
    _, waited = iterations(made, 2)
    assert "aten.nonzero.default" in waited[1]


def test_a_tensor_left_behind_is_refused():
    with pretended():
        there = torch.ones(3, device=DEVICE)
        with pytest.raises(AssertionError, match=r"aten.add.Tensor: tensors \[\(3,\)\] lie on the CPU"):
            there + torch.ones(3)
        assert (there + 1).cpu().tolist() == [2, 2, 2]
