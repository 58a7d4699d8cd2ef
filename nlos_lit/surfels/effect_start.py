"""Where scanned parameters of effects (delays, decays, periods) start: where the counts ask for them most."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.effects.effect import Asked, Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.surfels.model import SurfelModel


def asked_of(
    model: SurfelModel, extension: Extension, spots: Tensor, excess: Tensor, expected: Tensor
) -> Asked:
    """What the counts ask of the light of each path.

    Args:
        model: the surfels.
        extension: effects.
        spots: ``[B]`` rows of the capture.
        excess: ``[B, T_gate]`` counts over the expected ones, by the noise.
        expected: ``[B, T_gate]``.

    Returns:
        from one pass back through the model for all paths together.
    """
    noise = expected.rsqrt()
    found = []
    for part, pull, unit in zip(spots.split(32), (excess * noise).split(32), noise.split(32), strict=True):
        with torch.no_grad():
            paths = model.paths(part, extension)
        light = paths.contribution.requires_grad_()
        rendered = model.record(model.transients(paths, part, extension), part, extension)
        rendered = rendered[:, model.gate[0] :]
        by = [
            torch.autograd.grad((rendered * w).sum(), light, retain_graph=w is pull)[0] for w in (pull, unit)
        ]
        found.append(torch.stack([(light.detach() * g).sum(2) for g in by]))
    score, amount = torch.cat(found, 1)
    return Asked(spots, model.centre().detach(), -score, amount)


def likely(
    model: SurfelModel, extension: Extension, spots: Tensor, effect: Effect, over: Tensor, expected: Tensor
) -> list[dict[str, float]]:
    """Shapes of an effect that are worth a test.

    Args:
        model: the surfels.
        extension: effects.
        spots: ``[B]`` rows of the capture.
        effect: whose they are.
        over: ``[B, T_gate]`` counts over the expected ones.
        expected: ``[B, T_gate]``.

    Returns:
        as of :meth:`~nlos_lit.effects.effect.Effect.shape_grid`.
    """
    if not effect.needs_paths:
        return effect.likely_in_time(over.sum(0), expected.sum(0))
    with torch.enable_grad():
        return effect.likely_shapes(asked_of(model, extension, spots, over * expected.rsqrt(), expected))


@torch.no_grad()
def choose_shapes(model: SurfelModel, extension: Extension, spots: Tensor, counts: Tensor) -> None:
    """Set every effect that has scanned parameters to the best of its grid, its amplitudes to a scoring step.

    The step x maximises ``g·x - x·F x/2``, within bounds, with ``g = Σ (H/μ - 1) ∂μ/∂x`` and ``F = Σ ∂μ/∂x
    ∂μ/∂x / μ``; the best grid point is that of the largest maximum. Surfels and other effects are held, so
    this is a start and not a test. An effect that gains nothing anywhere is left at the null in the middle of
    its grid.

    Args:
        model: the surfels.
        extension: effects, which are changed.
        spots: ``[B]`` indices into the scan.
        counts: ``[B, T_gate]`` of them.
    """

    def arriving() -> Tensor:
        return torch.cat([model.arrived(part, extension) for part in spots.split(32)])

    def expected(effect: Effect, light: Tensor) -> Tensor:
        transients = arriving() if effect.needs_paths else light
        return model.record(transients, spots, extension)[:, model.gate[0] :].clamp_min(1e-9)

    light = arriving()
    for effect in extension.effects:
        if not effect.shapes:
            continue
        effect.reset()
        base = expected(effect, light)
        excess = counts / base - 1
        sizes = [p.size for p in effect.amplitudes]
        scale = torch.cat([torch.full((p.size,), p.scale, dtype=torch.float64) for p in effect.amplitudes])
        scale = scale.to(counts.device)
        precision = effect.precision()[: len(scale)].double().to(counts.device) / scale**2
        low, high = (bound.to(counts.device) * scale for bound in effect.step_bounds())
        null = {p.name: p.null or 0.0 for p in effect.amplitudes}
        best, most = dict[str, float | Tensor](), 0.0
        for shape in likely(model, extension, spots, effect, counts - base, base):
            effect.set_all(shape)
            columns = []
            for p in effect.amplitudes:
                for unit in p.scale * torch.eye(p.size):
                    effect.set(p.name, null[p.name] + unit)
                    columns.append((expected(effect, light) - base) / p.scale)
                effect.set(p.name, null[p.name])
            sensitivity = torch.stack(columns).flatten(1).double()
            score = sensitivity @ excess.flatten().double()
            information = (sensitivity / base.flatten()) @ sensitivity.T + torch.diag(precision)
            if float(information.diagonal().min()) <= 0:  # nothing in the gate changes
                continue
            step = torch.linalg.lstsq(information, score[:, None]).solution[:, 0].clamp(low, high)
            gain = float(score @ step - step @ information @ step / 2)
            if gain > most:
                each = zip(effect.amplitudes, step.split(sizes), strict=True)
                best, most = shape | {p.name: null[p.name] + x for p, x in each}, gain
        effect.reset()
        effect.set_all(best)
        light = arriving() if effect.needs_paths else light
