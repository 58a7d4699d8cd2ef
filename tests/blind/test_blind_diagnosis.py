"""Captures with something hidden in them are diagnosed from their files alone.

benchmarks/blind.py does the same at length.
"""

from __future__ import annotations

import dataclasses

import pytest
from blind_judge import Outcome, run_case
from blind_truth import CASES, Spec

from nlos_lit.inference.settings import CriticismSettings

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
# Fewer spots and terms than a diagnosis takes.
QUICK = CriticismSettings(spots=256, most=1)
WHOLE = CriticismSettings()
HARD = {
    "retroreflection": "without cosines the counts do not tell normals; the base breaks (docs/criticism.md)",
    "wall_tilt": "a tilted wall and a turned scene are the same to second order (docs/blind.md)",
    "clock_scale": "0.05 % of its information is retained; the base's own misfit is larger (docs/blind.md)",
    "laser_sensor_baseline": "surfels lean with it, and the fit is as good (docs/blind.md)",
}


def check(outcome: Outcome) -> None:
    """What was hidden is named first, alone or in its group; where nothing known is hidden, nothing is."""
    if outcome.unknown:
        assert outcome.named == [], "something outside the registry was given a name of the registry"
        assert outcome.unexplained == outcome.axis
    elif not outcome.hidden:
        assert outcome.named == [], "a false alarm"
        assert outcome.unexplained == ""
    else:
        assert outcome.first_right, f"{outcome.hidden} hidden, {outcome.named or 'nothing'} named"
        assert outcome.named_or_grouped >= set(outcome.hidden)
        assert outcome.gain > 25


@pytest.mark.slow
def test_nothing_hidden_nothing_named():
    outcome = run_case(Spec("letters", level=1500, seed=12), QUICK, oracle=False)
    check(outcome)
    assert outcome.ratio < 1.1


@pytest.mark.slow
def test_two_effects_are_both_named_and_measured():
    names = ("irf_tail", "wall_reflectance")
    outcome = run_case(
        Spec("letters", names, (3, 3), 1500, 1), dataclasses.replace(QUICK, most=2), oracle=False
    )
    check(outcome)
    assert set(outcome.named) == set(names)
    for name, quantity, within in (("irf_tail", "fraction", 0.25), ("wall_reflectance", "rms", 0.15)):
        assert abs(outcome.errors[name][quantity][1]) < within, outcome.found


@pytest.mark.slow
def test_an_echo_is_found_that_surfels_would_be():
    """Beside a scene that was built without it nothing asks for it (test_blind_screening.py)."""
    outcome = run_case(Spec("letters", ("ghost_pulse",), (3,), 1500, 5), QUICK, oracle=False)
    check(outcome)
    assert outcome.named == ["ghost_pulse"]
    for quantity in ("fraction", "delay"):
        assert abs(outcome.errors["ghost_pulse"][quantity][1]) < 0.02, outcome.found


@pytest.mark.slow
@pytest.mark.xfail(
    reason="said to be unknown from spot to spot instead of along the scan (docs/criticism.md)", strict=False
)
def test_what_no_effect_explains_is_called_unexplained():
    """Mains ripple along the scan: fifteen cycles are too many for the drift's 23 coefficients."""
    check(run_case(Spec("default", ("mains_ripple",), (2,), 1500, 15), QUICK, oracle=False))


@pytest.mark.slow
def test_a_gap_in_the_time_codes_is_not_called_a_ripple():
    """Five codes lose 90 %.

    A ripple with half a period there gains most by far, but its strength is not the same everywhere.
    """
    check(run_case(Spec("sphere_before_plate", ("missing_codes",), (3,), 500, 1), QUICK, oracle=False))


@pytest.mark.slow
def test_a_detector_that_saturates_is_not_called_a_dark_wall():
    """It loses most where the scene is bright.

    A smooth map over the wall explains it, but the map follows the count rate.
    """
    outcome = run_case(Spec("default", ("saturation",), (3,), 1500, 4108), QUICK, oracle=False)
    check(outcome)
    assert outcome.formulas == ["counts_over_rate_log"]  # it is 1/(1 + n/n0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.xfail(reason=HARD[name], strict=False) if name in HARD else ())
        for name in CASES
    ],
)
def test_every_case_of_the_table(name):
    check(run_case(CASES[name], WHOLE, oracle=False))
