"""Does what an effect explains have the effect's own form?

An effect's equation says that one strength holds everywhere. Once it is in the model, its change Δμ of the
expected counts is cut into bands of the time axis that weigh the same, and each may ask for a strength of its
own. A ripple that was accepted for a gap in the time codes wants four times the strength at the gap, and none
elsewhere.

A smooth map over wall or scan knows nothing of the hidden scene. One that falls with the scene's own light at
each spot belongs to the counting: a detector that saturates looks like a wall that is dark wherever the scene
is bright.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.smooth import SmoothEffect
from nlos_lit.inference.discrepancy import flexible
from nlos_lit.inference.joint_step import null_of
from nlos_lit.inference.problem import Problem
from nlos_lit.inference.screen import Projector

BANDS = 8
LIMITS = {
    "time": (0.5, 1e-6),
    "rate": (0.85, 1e-3),
}  # share of what the effect itself changes, and p-value, that are too much
POWERS, DRAWS = 2, 4000  # of the logarithm of the count rate; of random maps


@dataclass(frozen=True)
class Form:
    """How far an accepted effect is from its own form.

    ``own``: nats that the effect's own change is worth, ½‖Δμ/√μ‖². ``gain``: along time, nats that strengths
    of its own in every band bring beyond the common one, cross-validated over random spots; where the base
    leaves Δμ alone, gain/own is the relative mean square by which the strength varies. Along rate, nats of
    ``own`` that a falling function of the count rate makes.
    """

    name: str
    gain: float
    own: float
    statistic: float
    p_value: float
    axis: str = "time"

    @property
    def wrong(self) -> bool:
        """Whether the strength varies too much for one equation.

        By more than 70 % (root mean square) of itself, or 85 % of the map follow the count rate.
        """
        share, level = LIMITS[self.axis]
        return self.p_value < level and self.gain > share * self.own


def forms_of(problem: Problem, projector: Projector, effect: Effect) -> list[Form]:
    """Test an effect of the problem's extension.

    Args:
        problem: of the tested spots, with the effect.
        projector: takes off what base and effects can explain.
        effect: one of the extension's.

    Returns:
        its forms along time and, for a map, along the count rate; none for a per-spot effect, which has no
        common strength.
    """
    if effect.per_spot:
        return []
    without = Extension([null_of(e) if e is effect else e for e in problem.extension.effects])
    with torch.no_grad():
        light = problem.model.expected(problem.spots, without)
        change = (problem.expected - light) * problem.expected.rsqrt()
    found = [_over_time(problem, projector, effect, change)]
    if isinstance(effect, SmoothEffect) and effect.stage == "spot":
        found.append(_over_rate(problem, effect, change, light.sum(1)))
    return found


def _over_time(problem: Problem, projector: Projector, effect: Effect, change: Tensor) -> Form:
    weight = change.square().sum(0).cumsum(0)
    band = (weight / weight[-1].clamp_min(1e-30) * BANDS).long().clamp_max(BANDS - 1)
    columns = change[:, :, None] * torch.nn.functional.one_hot(band, BANDS)
    gain, statistic, _, p = flexible(columns[..., band.unique()], problem, projector)
    return Form(effect.name, gain, float(change.square().sum()) / 2, statistic, p)


@torch.no_grad()
def _over_rate(problem: Problem, effect: SmoothEffect, change: Tensor, rate: Tensor) -> Form:
    """Only maps that fall as the rate grows count.

    No detector sees better for more light, but a wall is lit most where a scene is. The p-value is the
    share of maps drawn from the prior that follow the rate as well.

    Args:
        problem: of the tested spots.
        effect: a smooth map.
        change: ``[S, T]`` Δμ/√μ.
        rate: ``[S]`` counts without the effect.
    """
    field = effect.field(problem.spots).double()
    worth = change.double().square().sum(1)
    weight = (
        worth / field.square().clamp_min(1e-12)
    ).sqrt()  # of a unit of the field; Δμ is nearly linear in it
    place = rate.double().log()
    place = (place - place.mean()) / place.std().clamp_min(1e-12)
    powers = torch.stack([place**k for k in range(POWERS + 1)], 1) * weight[:, None]
    basis, triangle = torch.linalg.qr(powers)
    (coefficients,) = effect.amplitudes
    random = torch.randn(
        DRAWS, coefficients.size, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    maps = (
        effect.functions[problem.spots].double()
        @ (random * torch.tensor(coefficients.prior, dtype=torch.float64)).T
    )
    values = torch.cat([field[:, None], maps], 1) * weight[:, None]
    common, slope, *bend = basis.T @ values
    share = sum(part.square() for part in (slope, *bend)) / (
        values.square().sum(0) - common.square()
    ).clamp_min(1e-30)
    share = share * (slope * triangle[1, 1] < 0)
    p = float((1 + (share[1:] >= share[0]).sum()) / (1 + DRAWS))
    own = float(worth.sum()) / 2
    gain = float(share[0]) * own
    return Form(effect.name, gain, own, 2 * gain, p, "rate")
