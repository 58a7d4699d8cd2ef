"""The whole pipeline and its gradients against the paper's equations written out (tests/literal.py), on small
asymmetric scenes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import literal
import numpy as np
import pytest
import torch
from literal_scenes import BETA, BIN, BINS, CASES, NAMES, RAYS, START, STEP, Case, build

from nlos_lit.functional.losses import albedo_variation, sparsity, transient_loss
from nlos_lit.model.phasor import PhasorPlan

TOLERANCE = 1e-3


def terms_and_gradients(terms: dict[str, torch.Tensor], raw: dict[str, torch.Tensor]):
    gradients = {}
    for term, value in terms.items():
        found = torch.autograd.grad(value, list(raw.values()), retain_graph=True, allow_unused=True)
        gradients |= {(term, name): g for name, g in zip(raw, found, strict=True)}
    return gradients


def run_package(
    world: SimpleNamespace, precision: torch.dtype = torch.float32, plan: PhasorPlan | None = None
) -> SimpleNamespace:
    phasor = world.pipeline.phasor
    phasor.prepare(world.capture, plan or replace(phasor.plan(world.capture, 1 << 32), precision=precision))
    rendering = world.pipeline(world.spots)
    rendered, _, _ = world.pipeline.render(rendering.intensity, rendering.albedo, world.spots)
    scale = 400.0
    counts = torch.from_numpy(world.capture.gated_counts())[world.spots]
    terms = {
        "E_H": transient_loss(counts / scale, rendering.expected / scale),
        "E_I": sparsity(rendering.intensity),
        "E_rho": albedo_variation(rendering.albedo),
    }
    return SimpleNamespace(
        rendering=rendering, rendered=rendered, terms=terms, gradients=terms_and_gradients(terms, world.raw)
    )


def run_literal(case: Case, world: SimpleNamespace) -> SimpleNamespace:
    capture, grid = world.capture, world.grid
    raw = {name: value.detach().to(literal.DOUBLE).requires_grad_() for name, value in world.raw.items()}
    value = {name: literal.bounded(raw[name], *limits) for name, limits in world.limits.items()}
    points = {
        name: torch.from_numpy(np.array(getattr(capture, name)))
        for name in ("laser", "sensor", "laser_normal", "sensor_normal")
    }
    first, last = capture.gate
    counts = torch.from_numpy(capture.counts[:, first:last].astype(np.float64))
    time = START + (torch.arange(first, last, dtype=literal.DOUBLE) + 0.5) * BIN
    voxels = literal.voxel_centres(grid.origin, grid.pitch, grid.shape)
    omega = literal.frequencies(value["omega_pf"].item(), value["sigma_pf"].item(), longest=3.0)
    field = literal.propagate(counts, time, points["laser"], points["sensor"], voxels, omega)
    depth = voxels[:, 0, 0, 2]
    volume = literal.intensity(
        field, value["omega_pf"], value["sigma_pf"], depth, grid.shape, case.power, case.depth_exponent
    )
    if case.albedo == "free":
        albedo = 1 / (1 + torch.exp(-raw["albedo"]))
    else:
        shifted = torch.clamp(volume + 0.2 * torch.tanh(raw["albedo"]), 0, 1)
        albedo = torch.where(volume > case.threshold, shifted, torch.zeros_like(shifted))
    batch = {name: p[world.spots] for name, p in points.items()}
    found = literal.surface(
        volume,
        grid.origin,
        grid.pitch,
        batch["sensor"],
        batch["sensor_normal"],
        RAYS,
        case.threshold,
        STEP,
        BETA,
        1.3,
        case.fine,
    )
    surface_albedo, inside = literal.interpolate(albedo, found.point[found.valid], grid.origin, grid.pitch)
    assert inside.all()
    k, path, spot = literal.contributions(found, surface_albedo, **batch, n=RAYS)
    rendered = literal.rendered_transients(
        k, path, spot, len(world.spots), last, BIN, START, 0.62, case.conserve
    )
    sigma = value["sigma_ls"] / BIN
    if case.subtract:
        sigma = torch.sqrt(sigma**2 - literal.splat_variance(0.62))
    expected = literal.sensed(rendered, sigma, value["kappa_s"] * BIN, value["I_l"], value["eta_s"])[
        :, first:
    ]
    scale = 400.0
    terms = {
        "E_H": literal.data_term(counts[world.spots] / scale, expected / scale),
        "E_I": literal.sparsity_term(volume),
        "E_rho": literal.variation_term(albedo),
    }
    return SimpleNamespace(
        volume=volume, albedo=albedo, found=found, rendered=rendered, expected=expected, terms=terms,
        gradients=terms_and_gradients(terms, raw),
    )  # fmt: skip


@cache
def both(name: str) -> tuple[SimpleNamespace, SimpleNamespace, SimpleNamespace]:
    world = build(CASES[name])
    return world, run_package(world), run_literal(CASES[name], world)


def errors(package: SimpleNamespace, dense: SimpleNamespace) -> dict[str, float]:
    """Relative error of every quantity; the rays that meet something must be the same."""
    rendering, found = package.rendering, dense.found
    surface = rendering.surface
    spot, _, _ = torch.nonzero(found.valid, as_tuple=True)
    assert torch.equal(surface.spot, spot)
    result = {
        "volume": literal.relative(rendering.intensity, dense.volume),
        "distance": literal.relative(surface.distance, found.distance[found.valid]),
        "points": literal.relative(surface.point, found.point[found.valid]),
        "normals": literal.relative(surface.normal, found.normal[found.valid]),
        "albedo": literal.relative(rendering.albedo, dense.albedo),
        "H_r": literal.relative(package.rendered, dense.rendered),
        "H_R": literal.relative(rendering.expected, dense.expected),
    }
    result |= {term: literal.relative(package.terms[term], dense.terms[term]) for term in dense.terms}
    for key, gradient in dense.gradients.items():
        mine = package.gradients[key]
        if gradient is None or float(gradient.abs().max()) == 0:
            assert mine is None or float(mine.abs().max()) == 0, key
        else:
            result["d{}/d{}".format(*key)] = literal.relative(mine, gradient)
    return result


@pytest.mark.parametrize("name", CASES)
def test_pipeline_equals_the_equations(name):
    _, package, dense = both(name)
    assert len(package.rendering.surface.spot) > 100
    found = errors(package, dense)
    expected = 10 + len(NAMES) + 2 + 1 + (2 if CASES[name].albedo == "residual" else 0)
    assert len(found) == expected
    assert {k: v for k, v in found.items() if not v < TOLERANCE} == {}


def test_lattice_and_direct_cases_take_their_own_path():
    methods = {
        name: both(name)[0].pipeline.phasor.plan(both(name)[0].capture, 1 << 32).method for name in CASES
    }
    assert {name for name, method in methods.items() if method == "direct"} == {
        "curved wall",
        "irregular spots",
    }


PRECISION_CASES = ("confocal", "one laser", "curved wall")


@pytest.mark.parametrize("name", PRECISION_CASES)
def test_half_precision_storage(name):
    """Measured: |u| to 5e-4 (7e-4 on the curved wall), H_R to 3e-3; Θ_pf's gradient keeps its direction and a
    few per cent.
    """
    case = CASES[name]
    world = build(case)
    half = run_package(world, torch.float16)
    assert world.pipeline.phasor.field.dtype == torch.float16
    dense = both(name)[2]
    assert literal.relative(half.rendering.intensity, dense.volume) < 1e-3
    assert literal.relative(half.rendering.expected, dense.expected) < 5e-3
    found, expected = (
        torch.stack([torch.as_tensor(run.gradients["E_H", p]).double() for p in ("omega_pf", "sigma_pf")])
        for run in (half, dense)
    )
    assert literal.relative(found, expected) < 0.05


@pytest.mark.parametrize("rows", [1 << 20, 7])
def test_streamed_field_gives_the_same(rows, monkeypatch):
    """From a file, in one slab or in many, loss and gradients are those of the field in memory."""
    monkeypatch.setattr("nlos_lit.functional.streamed.SLAB_BYTES", 8 * 30 * rows)
    world = build(CASES["upsampled"])
    phasor = world.pipeline.phasor
    plan = replace(phasor.plan(world.capture, 1 << 32), on_disk=True)
    stored, streamed = both("upsampled")[1], run_package(world, plan=plan)
    assert phasor.field.numel() == 0
    assert literal.relative(streamed.rendering.intensity, stored.rendering.intensity) < 1e-6
    for name in NAMES:
        if stored.gradients["E_H", name] is not None:
            assert literal.relative(streamed.gradients["E_H", name], stored.gradients["E_H", name]) < 1e-4


def imaging_at(world: SimpleNamespace, omega_pf: float, sigma_pf: float) -> float:
    """Relative error of |u| against the virtual pulse applied photon by photon in the time domain."""
    with torch.no_grad():
        for name, value in (("omega_pf", omega_pf), ("sigma_pf", sigma_pf)):
            lower, upper = world.limits[name]
            share = math.log(value / lower) / math.log(upper / lower)
            world.raw[name].fill_(math.log(share / (1 - share)))
        found = world.pipeline.phasor()
    capture, grid = world.capture, world.grid
    counts = torch.from_numpy(capture.counts.astype(np.float64))
    time = START + (torch.arange(BINS, dtype=literal.DOUBLE) + 0.5) * BIN
    voxels = literal.voxel_centres(grid.origin, grid.pitch, grid.shape)
    laser, sensor = torch.from_numpy(capture.laser), torch.from_numpy(capture.sensor)
    wave = (
        literal.pulse_intensity(counts, time, laser, sensor, voxels, omega_pf, sigma_pf)
        * voxels[:, :1, :1, 2] ** 2
    )
    return literal.relative(found, wave / wave.max())


def test_imaging_equals_the_virtual_pulse_in_time_but_for_frequencies_below_zero():
    """Eq. 2 has all frequencies; the package leaves out those at and below zero, where a pulse of few cycles
    has weight.
    """
    world = build(CASES["confocal"])
    phasor = world.pipeline.phasor
    phasor.prepare(world.capture, phasor.plan(world.capture, 1 << 32))
    assert imaging_at(world, 42.0, 0.15) < 1e-5  # σΩ = 6.3, where the package starts
    assert imaging_at(world, 65.0, 0.25) < 1e-4
    assert 5e-5 < imaging_at(world, 42.0, 0.11) < 5e-4  # 4.6
    assert 0.01 < imaging_at(world, 42.0, 0.08) < 0.04  # 3.4
    assert 0.08 < imaging_at(world, 42.0, 0.063) < 0.2  # 2.6
