"""The effects as a measurement simulator: against the ground-truth simulator without effects, by hand with
them.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from effect_contract import scene

from data_modules.simulate import Mesh, ScanPlan, SensorModel, join, simulate_capture
from data_modules.simulate.scenes import plate
from nlos_lit.capture.errors import UserError
from nlos_lit.effects import EFFECTS, build_effects
from nlos_lit.effects.pile_up import laser_cycles
from nlos_lit.effects.strengths import effects_at, report, typical
from nlos_lit.surfels.measure import measure, planned_scan

SENSOR = SensorModel(mean_counts=1500, background=0.2)
PLAN = ScanPlan(nx=5, ny=4, width=0.9, height=0.7, n_bins=230)


def hidden() -> Mesh:
    """A plate that turns away and hides part of a darker one behind it."""
    front = plate((0.1, 0.05, 0.5), 0.3, 0.25, turn_y=0.3, albedo=0.9)
    return join(front, plate((-0.05, -0.1, 0.75), 0.4, 0.3, albedo=0.4))


def expected(
    plan: ScanPlan = PLAN,
    sensor: SensorModel = SENSOR,
    effects: tuple = (),
    two_sided: bool = False,
    **values,
) -> np.ndarray:
    values = {key.replace("__", "."): value for key, value in values.items()}
    return measure(hidden(), plan, sensor, None, effects, values, two_sided=two_sided)[0].counts


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("kind", ["confocal", "single", "exhaustive"])
def test_without_effects_it_is_the_ground_truth(kind, two_sided):
    plan = dataclasses.replace(PLAN, kind=kind, fixed_point=(0.2, -0.1), t_start=0.1)
    plan = plan if kind != "exhaustive" else dataclasses.replace(plan, nx=3, ny=2)
    mesh = hidden() if not two_sided else join(hidden(), plate((0.3, 0.3, 0.6), 0.2, 0.2).flipped())
    truth, _ = simulate_capture(mesh, plan, SENSOR, None, two_sided=two_sided)
    capture, _ = measure(mesh, plan, SENSOR, None, [], {}, two_sided=two_sided)
    energy = (capture.counts - 0.2).sum(1) / (truth.counts - 0.2).sum(1)
    assert energy == pytest.approx(np.ones(capture.n_spots), abs=2e-3)
    assert ((capture.counts - truth.counts) ** 2).sum() < 3e-5 * (truth.counts**2).sum()


def test_pile_up_is_that_of_the_photons_without_it():
    photons, seen = (
        expected().astype(float),
        expected(effects=("pile_up",), pile_up__detections=0.3).astype(float),
    )
    recorded, total = seen.sum(1), photons.sum(1)
    cycles = recorded.mean() / 0.3
    # Coates: a cycle without any photon records nothing.
    assert recorded / cycles == pytest.approx(-np.expm1(-total / cycles), rel=1e-4)
    assert seen[:, :50] == pytest.approx(photons[:, :50], rel=0.01)
    late = photons[:, -1] * np.exp(-total / cycles)
    assert seen[:, -1] == pytest.approx(late, rel=1e-3)


def test_laser_cycles_by_hand():
    # 1 - e^{-M/N} = ½ at M = N ln 2; a spot with no light halves the mean.
    assert laser_cycles(torch.tensor([70.0, 70.0]), 0.5) == pytest.approx(70 / math.log(2))
    assert laser_cycles(torch.tensor([70.0, 0.0]), 0.25) == pytest.approx(70 / math.log(2))
    assert laser_cycles(torch.tensor([70.0]), 0.0) == math.inf
    with pytest.raises(UserError, match="50% of the spots are dark"):
        laser_cycles(torch.tensor([70.0, 0.0]), 0.6)


def test_a_time_offset_moves_the_light():
    plain, late = expected(), expected(effects=("time_offset",), time_offset__offset=3 * PLAN.bin_length)
    assert late[:, 3:] == pytest.approx(plain[:, :-3], abs=2e-3)


def test_counts_and_fields_follow_the_seed():
    plan, chosen = dataclasses.replace(PLAN, n_bins=160), ["power_drift", "irf_tail"]
    first, again, other = (measure(hidden(), plan, SENSOR, seed, chosen, {})[0] for seed in (1, 1, 2))
    assert np.array_equal(first.counts, again.counts)
    assert first.provenance["effects"]["power_drift"] != other.provenance["effects"]["power_drift"]
    assert first.provenance["effects"]["power_drift"]["rms"]["value"] == pytest.approx(0.2, abs=1e-3)
    assert first.is_counts
    assert first.counts.dtype == np.uint16
    assert list(first.provenance["effects"]) == ["irf_tail", "power_drift"]


@pytest.fixture
def scan():
    return planned_scan(dataclasses.replace(PLAN, nx=12, ny=10), SENSOR)


def test_every_effect_has_a_strength_that_does_something(scan):
    usual = typical(scan)
    assert list(usual) == [effect.name for effect in EFFECTS]
    for effect in effects_at(usual, {}, scan):
        assert set(usual[effect.name]) <= set(effect.settable())
        null = dict(build_effects([effect.name], scan)[0].named_parameters())
        assert any(not torch.equal(p, null[name]) for name, p in effect.named_parameters()), effect.name


def test_given_sizes_are_kept(scan):
    sizes = {
        "time_drift.rms": 0.012,
        "timing_jitter.sigma": 0.004,
        "wall_reflectance.rms": 0.15,
        "ambient_map.rms": 0.4,
        "hot_spots.level": 3.0,
        "hot_spots.number": 7,
        "irf_tail.decay": 0.3,
    }
    effects = effects_at({key.partition(".")[0] for key in sizes}, sizes, scan, seed=5, exposure=2.0)
    told = report(effects)
    assert told["time_drift"]["rms"] == {"value": pytest.approx(0.012, rel=1e-2), "unit": "m"}
    assert told["wall_reflectance"]["rms"]["value"] == pytest.approx(0.15, rel=1e-3)
    assert told["ambient_map"]["rms"]["value"] == pytest.approx(0.4, rel=1e-3)
    assert told["timing_jitter"]["sigma"]["value"] == pytest.approx(0.004, rel=0.25)
    # Counts per bin are those at exposure 1.
    assert told["hot_spots"] == {
        "level": {"value": pytest.approx(6.0), "unit": "counts/bin"},
        "number": {"value": 7, "unit": "1"},
    }
    # A shape alone keeps the typical amplitude.
    assert told["irf_tail"]["fraction"]["value"] == pytest.approx(0.2)
    assert told["irf_tail"]["decay"]["value"] == pytest.approx(0.3)
    alone = report(effects_at(["time_drift"], {"time_drift.rms": 0.012}, scan, seed=5))
    assert alone["time_drift"] == told["time_drift"]


def test_one_amplitude_given_leaves_the_others_at_their_null(scan):
    (tilt,) = effects_at(["wall_tilt"], {"wall_tilt.tilt_y": -0.02}, scan)
    assert (tilt.value("tilt_x").item(), tilt.value("tilt_y").item()) == (0, pytest.approx(-0.02))
    (hot,) = effects_at(["hot_spots"], {"hot_spots.number": 4}, scan)
    assert report([hot])["hot_spots"]["level"]["value"] == pytest.approx(5 * 0.2)


@pytest.mark.parametrize(
    ("names", "values", "words"),
    [
        (["pileup"], {}, "no effect 'pileup'; did you mean pile_up"),
        (["pile_up"], {"irf_tail.fraction": 0.1}, "irf_tail is not among"),
        (
            ["pile_up"],
            {"pile_up.probability": 0.1},
            "no parameter 'probability'; give one of pile_up.detections",
        ),
        (["power_drift"], {"power_drift.drift": 0.1}, "give one of power_drift.rms"),
        (["pile_up"], {"pile_up.detections": 2.0}, "pile_up.detections must keep within 0 … 0.95; found 2"),
        (["pile_up"], {"pile_up.detections": math.nan}, "must keep within"),
        (["power_drift"], {"power_drift.rms": 9.0}, "in the field drawn"),
        (["time_drift"], {"time_drift.rms": -1.0}, "must be 0 or more"),
        (["hot_spots"], {"hot_spots.number": 2.5}, "whole number from 1 to 60, half of the scan's spots"),
    ],
)
def test_values_that_make_no_sense_are_explained(scan, names, values, words):
    with pytest.raises(UserError, match=words):
        effects_at(names, values, scan)


@pytest.mark.parametrize(
    ("plan", "sensor", "words"),
    [
        ({}, {"direct_counts": 10.0}, "direct_counts"),
        ({"gate": (10, 150)}, {}, "so take n_bins=150"),
    ],
)
def test_what_cannot_be_simulated_with_effects_is_refused(plan, sensor, words):
    with pytest.raises(UserError, match=words):
        measure(
            hidden(),
            dataclasses.replace(PLAN, **plan),
            dataclasses.replace(SENSOR, **sensor),
            None,
            ["pile_up"],
            {},
        )


def test_a_gate_from_a_later_bin_on_is_kept():
    plan = dataclasses.replace(PLAN, gate=(40, 230))
    capture, _ = measure(hidden(), plan, SENSOR, None, ["background_slope"], {"background_slope.slope": 0.5})
    assert capture.gate == (40, 230)
    # τ at the last bin's middle: 1 - 1/190.
    assert capture.counts[0, -1] == pytest.approx(0.2 * math.exp(0.5 * (1 - 1 / 190)), rel=1e-3)
    assert capture.counts[0, 0] == pytest.approx(0.2 * math.exp(-0.5), rel=1e-4)


def test_a_response_narrower_than_the_splines_is_said(caplog):
    expected(sensor=dataclasses.replace(SENSOR, sigma=0.002))
    assert "sigma=0.002 is below 0.58 bins" in caplog.text


def test_contract_scene_reports_are_json(tmp_path):
    import json

    told = report(effect(scene("confocal")[1]) for effect in EFFECTS)
    assert json.loads(json.dumps(told, allow_nan=False)) == told
