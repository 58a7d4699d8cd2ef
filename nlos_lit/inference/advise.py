"""Which capture to take next: what each would tell of names that this one leaves open, before it is taken.

Two terms explain a capture equally well, each with a scene of its own. In another capture of the same scene
the first would leave other counts than the second can follow, however the scene bends, and it itself if it is
no property of the wall. So many nats are expected of it:

    ½ |P⊥ (μ_one − μ_other)/√μ_other|²

P⊥ takes off what the scene, the response, and the other term where it is free may do (the linear problem of
:mod:`nlos_lit.inference.problem`). Of the two, that which is harder to tell counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.inference.evidence import Projector
from nlos_lit.inference.problem import build_problem
from nlos_lit.surfels.fit import SurfelFit
from nlos_lit.surfels.model import SurfelModel

SPOTS = 256  # that are looked at
PATCHES = 64  # of the scene, that have an albedo and a depth of their own
DARK = 1e-4  # of the laser's power, with the laser off


@dataclass(frozen=True)
class Plan:
    """Another capture of the same scene, as long as this one.

    Args:
        name: what is done.
        of: the capture that it would be; its counts are not looked at.
        power: of the laser, over this capture's.
    """

    name: str
    of: Capture
    power: float = 1.0


AGAIN = "the same scan again"


def plans(capture: Capture) -> list[Plan]:
    """What can be done on any rig.

    Args:
        capture: that was taken.

    Returns:
        the same again first.
    """
    return [
        Plan(AGAIN, capture),
        Plan("a second scan in another order", replace(capture, scan_order=across(capture))),
        Plan("a capture at a tenth of the laser power", capture, 0.1),
        Plan("a capture with the laser off", capture, DARK),
    ]


def across(capture: Capture) -> np.ndarray:
    """``[S]`` ranks of the spots along the axis of the wall that the scan's own order follows less.

    Examples:
        A scan by rows becomes one by columns.

        >>> wall = np.array([[0.0, 0, 0], [0.0, 1, 0], [1.0, 0, 0], [1.0, 1, 0]])
        >>> up = np.tile([0.0, 0.0, 1.0], (4, 1))
        >>> across(Capture(np.ones((4, 4)), wall, wall, up, up, bin_length=0.02)).tolist()
        [0, 2, 1, 3]
    """
    points = capture.sensor if np.ptp(capture.sensor, axis=0).max() > 0 else capture.laser
    ranks = [np.argsort(np.lexsort((points[:, 1 - axis], points[:, axis])), kind="stable") for axis in (0, 1)]
    return min(ranks, key=lambda rank: abs(float(np.corrcoef(rank, capture.scan_order)[0, 1])))


def expected_nats(
    one: SurfelFit, other: SurfelFit, names: tuple[str, str], seed: int = 0
) -> dict[str, float]:
    """How well each plan would tell two terms apart.

    Args:
        one: a fit with the first term. other: one with the second in its place.
        names: of both.
        seed: of the spots that are looked at.

    Returns:
        by the plan's name, nats over all its spots.
    """
    spots = np.random.default_rng(seed).permutation(one.capture.n_spots)[:SPOTS]
    told, share = {}, one.capture.n_spots / len(spots)
    rows = torch.from_numpy(np.sort(spots))
    for plan in plans(one.capture):
        views = [_seen(fit, plan) for fit in (one, other)]
        pairs = zip(views, reversed(views), reversed(names), strict=True)
        told[plan.name] = min(share * _nats(truth, model, name, rows) for truth, model, name in pairs)
    return told


View = tuple[SurfelModel, Extension]


def _seen(fit: SurfelFit, plan: Plan) -> View:
    """A fit's scene and effects in another capture."""
    model = SurfelModel.from_state(plan.of, fit.model.state_dict())
    sensor = model.laser_sensor
    sensor.set_intensity(plan.power * sensor.intensity().item())
    scan = Scan.of(plan.of)
    return model, Extension([_moved(effect, scan, plan.power) for effect in fit.extension.effects])


@torch.no_grad()
def _moved(effect: Effect, scan: Scan, power: float) -> Effect:
    """An effect as another capture has it."""
    light = effect.scan.light
    scan = replace(scan, light=light if light is None or power == 1 else power * light)
    other = type(effect)(scan)
    other.load_state_dict(effect.state_dict())
    other.width, other.share, other.prior_scale = effect.width, effect.share, effect.prior_scale
    for name in effect.with_power:
        other.set(name, power * effect.value(name))
    return other


def _nats(truth: View, model: View, name: str, spots: torch.Tensor) -> float:
    """How much likelier counts of ``truth`` are than ``model``, with its term ``name``, can make them."""
    with torch.no_grad():
        counts = truth[0].expected(spots, truth[1])
    scene, extension = model
    term = next(e for e in extension.effects if e.name == name)
    held = term if term.lasting else None
    problem = build_problem(scene, extension, spots, counts, patches=PATCHES, without=held)
    return 0.5 * float(Projector(problem).residual.double().square().sum())
