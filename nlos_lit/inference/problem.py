"""How the expected counts answer to everything that is, or could be, in the model: columns of one weighted
least-squares problem.

Rows are gated bins of the looked-at spots, divided by √μ, so that counts of the model itself have unit
variance.

- ``X [N, P]``: nuisance, what the base may do by itself: each surfel's albedo and depth, where each patch of
  the scene lies along x and y, the laser-sensor response without the intensity, what passes the sheets in
  front, how far rims roll off, and the parameters of effects that were accepted before.
- ``U [N, Q]``: how bright each patch is from where on the wall, all alike unknown by a deviation of its own.
- ``r [N]``: residual (counts - μ)/√μ.
- ``Z [N, K]``: effects at their null, :func:`expected_and_columns`.

All derivatives are exact (forward mode); the response, gain and counting stages enter through the Jacobian of
:meth:`SurfelModel.record`, one ``[T, T]`` matrix a spot where counts of a bin depend on the light of others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any

import torch
from torch import Tensor, nn

from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE
from nlos_lit.effects.parameter import Parameter
from nlos_lit.functional.compiled import tensor_by_tensor
from nlos_lit.functional.surfel_paths import quadrature, spline_slopes, spline_weights, trace
from nlos_lit.surfels.model import SurfelModel

# Of the scene. Each looks brighter from some wall points than from others: normals are not known exactly.
PATCHES = 32
FEWEST = 1e-6  # counts that are expected in a bin, so that √μ can be divided by
CHUNK = 1 << 25  # elements of a batch's columns
BATCH = 1 << 19  # … of a batch's transients
LANES = 1 << 22  # … of changes that are worked out side by side
LATE = frozenset({"spot", "counting"})  # stages that act on light after the response
_dual = Lock()  # torch counts the levels of dual numbers for all threads together


def pushed(function: Callable[..., Any], at: tuple[Tensor, ...], towards: tuple[Tensor, ...]) -> Any:
    """Values and directional derivatives by forward mode, one thread at a time.

    Args:
        function: of as many tensors as ``at`` has.
        at: where.
        towards: change of each.

    Returns:
        value and derivative, of the form that ``function`` returns.
    """
    with _dual, tensor_by_tensor():
        return torch.func.jvp(function, at, towards)


@dataclass
class Problem:
    """Everything about one model and one set of spots that screening needs.

    Args:
        model: of the counts.
        extension: present effects.
        spots: ``[S]``, one row block of ``bins`` rows each.
        counts: ``[S, bins]``.
        expected: ``[S, bins]`` μ.
        nuisance: ``[S·bins, P]`` X.
        prior: ``[P]`` precision of each nuisance column's coefficient.
        uneven: ``[S·bins, Q]`` U, in units of a patch's own light (rms over the wall).
        lit: ``[S·bins]`` share of the expected counts that is the scene's light.
        residual: ``[S·bins]``.
        transients: ``[S, T]`` light on arrival, which response, spot and counting effects start from.
    """

    model: SurfelModel
    extension: Extension
    spots: Tensor
    counts: Tensor
    expected: Tensor
    nuisance: Tensor
    prior: Tensor
    uneven: Tensor
    lit: Tensor
    residual: Tensor
    transients: Tensor

    @property
    def bins(self) -> int:
        return self.expected.shape[1]


def build_problem(
    model: SurfelModel,
    extension: Extension,
    spots: Tensor,
    counts: Tensor,
    with_effects: bool = True,
    patches: int | None = None,
    without: Effect | None = None,
) -> Problem:
    """Nuisance columns and residual of some spots.

    Args:
        model: of the counts.
        extension: present effects.
        spots: ``[S]`` rows of the capture.
        counts: ``[S, T_gate]`` of them.
        with_effects: parameters of the extension's effects are nuisance, too.
        patches: surfels that are near each other share their columns, so that there are at most as many;
            None leaves each its own.
        without: one of the extension's effects whose parameters are none.

    Returns:
        the problem.
    """
    with torch.no_grad():
        expected = model.expected(spots, extension).clamp_min(FEWEST)
    m, first = len(model), model.gate[0]
    towards, patch, coarse = towards_wall(model), patches_of(model, patches or m), patches_of(model, PATCHES)
    size = max(1, CHUNK // (model.n_bins * (3 * m + 6 * PATCHES)))
    surfels, others, light = [], [], []
    response = {f"model.laser_sensor.{n}": p.detach() for n, p in model.laser_sensor.named_parameters()}
    # Albedos do by themselves what the intensity does. Their columns are of the third bounce alone, and with
    # the intensity's, which is of all light, they would do whatever the fourth does.
    response.pop("model.laser_sensor.intensity.raw")
    for part in spots.split(size):
        with torch.no_grad():
            light.append(model.arrived(part, extension))
        surfels.append(_surfel_columns(model, extension, part, light[-1], towards[part], patch, coarse))
        forward = _recording(model, extension, part, light[-1])
        both = [_jvp(forward, name, p, torch.ones_like(p))[1][:, first:] for name, p in response.items()]
        whole = _Forward(model, extension, partial(_render, part))
        does = {"roll": bool(model.outward.any()), "raw_opacity": len(model.hiders) > 0}
        for name in (n for n, some in does.items() if some):
            p = getattr(model, name).detach()
            both.append(_jvp(whole, f"model.{name}", p, torch.ones_like(p))[1])
        others.append(torch.stack(both, -1).flatten(0, 1))
    transients = torch.cat(light)
    accepted = [e for e in extension.effects if with_effects and not e.per_spot and e is not without]
    more = [
        expected_and_columns(model, extension, spots, e, shapes=True, transients=transients)[1]
        for e in accepted
    ]
    weight = expected.reshape(-1, 1).rsqrt()
    number = 2 * (int(patch.max()) + 1) + 2 * (int(coarse.max()) + 1)
    nuisance = torch.cat([torch.cat([s[:, :number] for s in surfels]), torch.cat(others), *more], 1)
    nuisance *= weight
    uneven = torch.cat([s[:, number:] for s in surfels]) * weight
    residual = ((counts - expected).reshape(-1, 1) * weight)[:, 0]
    prior = torch.zeros(nuisance.shape[1])
    if accepted:
        own = torch.cat([e.precision() for e in accepted])
        prior[len(prior) - len(own) :] = own
    given = (model, extension, spots, counts, expected, nuisance, prior, uneven)
    return Problem(*given, _lit(model, extension, spots, transients), residual, transients)


@torch.no_grad()
def _lit(model: SurfelModel, extension: Extension, spots: Tensor, transients: Tensor) -> Tensor:
    """``[S·bins]`` scene's light over all light, before what counts it."""
    light, background = model.incident(model.signal(transients, extension), spots, extension)
    return (light / (light + background).clamp_min(1e-9))[:, model.gate[0] :].clamp(0.0, 1.0).reshape(-1)


def expected_and_columns(
    model: SurfelModel,
    extension: Extension,
    spots: Tensor,
    effect: Effect,
    shapes: bool = False,
    transients: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """μ, and ∂μ/∂(stored values) of an effect at its present values, beside those of the extension.

    Args:
        model: of the counts.
        extension: present effects.
        spots: ``[S]`` rows of the capture.
        effect: one of the extension's, or another.
        shapes: also by its shape parameters (after the amplitudes).
        transients: ``[S, T]`` of these spots, where they are known already.

    Returns:
        ``[S, bins]`` expected counts with the effect, and ``[S·bins, k]`` columns; a per-spot effect gives
        one column: every spot's own.
    """
    first, whole = model.gate[0], _with(extension, effect)
    factors = effect.factors(spots)
    if factors is not None:
        one = effect.alone()
        expected, alike = expected_and_columns(model, whole, spots, one, transients=transients)
        unit = effect.amplitudes[0].scale / one.amplitudes[0].scale
        by_spot = alike.view(len(spots), -1, 1, alike.shape[1])
        return expected, (by_spot * (unit * factors)[:, None, :, None]).flatten(2).flatten(0, 1)
    prefix = _prefix(whole, effect)
    wanted = effect.amplitudes + (effect.shapes if shapes else [])
    parts, values = [], []
    by_paths = effect.needs_paths or transients is None
    size = model.batch if by_paths else max(1, BATCH // model.n_bins)
    for start in range(0, len(spots), size):
        part = spots[start : start + size]
        forward = _staged(
            model, whole, effect, part, None if transients is None else transients[start : start + size]
        )
        if effect.stage in LATE:
            with torch.no_grad():
                value = forward()
            columns = _side_by_side(forward, prefix, effect, wanted, value.numel(), {}).permute(1, 2, 0)
        else:
            changes = []
            for p in wanted:
                raw = getattr(effect, f"raw_{p.name}")
                for tangent in _tangents(effect, p):
                    value, change = _jvp(forward, f"{prefix}{p.name}", raw, tangent)
                    changes.append(change)
            columns = torch.stack(changes, -1)
        values.append(value[:, first:])
        parts.append(columns[:, first:].flatten(0, 1))
    return torch.cat(values), torch.cat(parts)


def columns_at(problem: Problem, effect: Effect, shapes: Sequence[Mapping[str, float]]) -> Iterator[Tensor]:
    """:func:`weighted_columns` of an effect at each of some shapes.

    What acts on light that has arrived is worked out for many of them side by side: one pass waits for its
    calls more than for its numbers.

    Args:
        problem: of the spots.
        effect: one of the extension's, or another; it is left at one of the shapes.
        shapes: values of its shape parameters.

    Yields:
        ``[S·bins, k]`` of each.
    """
    if effect.stage not in LATE or len(shapes) < 2:
        for shape in shapes:
            effect.set_all(shape)
            yield weighted_columns(problem, effect)
        return
    whole, first = _with(problem.extension, effect), problem.model.gate[0]
    forward = _staged(problem.model, whole, effect, problem.spots, problem.transients)
    number = sum(1 if effect.per_spot else p.size for p in effect.amplitudes)
    weight, size = problem.expected.rsqrt()[..., None], max(1, CHUNK // (number * problem.transients.numel()))
    for start in range(0, len(shapes), size):
        stored = list[list[Tensor]]()
        for shape in shapes[start : start + size]:
            effect.set_all(shape)
            stored.append([getattr(effect, f"raw_{p.name}").detach().clone() for p in effect.shapes])
        at = {p.name: torch.stack(v) for p, v in zip(effect.shapes, zip(*stored, strict=True), strict=True)}
        given = (forward, _prefix(whole, effect), effect, effect.amplitudes, problem.transients.numel(), at)
        changes = _side_by_side(*given)
        for columns in changes.split(number):
            yield (columns.permute(1, 2, 0)[:, first:] * weight).flatten(0, 1)


def _with(extension: Extension, effect: Effect) -> Extension:
    """The extension with an effect that it may have already, in order of application."""
    present = list(extension.effects)
    return Extension(sorted([*present, *(() if effect in present else (effect,))], key=acting_order))


def _prefix(whole: Extension, effect: Effect) -> str:
    """What the names of an effect's stored values begin with in :class:`_Forward`."""
    return f"extension.effects.{list(whole.effects).index(effect)}.raw_"


def _tangents(effect: Effect, p: Parameter) -> Tensor:
    """``[k, size]`` by each stored value of a parameter, or by all together: every spot's own."""
    return torch.ones(1, p.size) if effect.per_spot and p.null is not None else torch.eye(p.size)


@torch.no_grad()
def _side_by_side(
    forward: _Forward,
    prefix: str,
    effect: Effect,
    wanted: list[Parameter],
    elements: int,
    at: dict[str, Tensor],
) -> Tensor:
    """``[J·k, B, T]`` changes of what comes out with each of k stored values, at each of J shapes.

    Args:
        forward: the model.
        prefix: of the names of the effect's stored values.
        effect: whose they are.
        wanted: parameters by which it is.
        elements: B·T.
        at: ``[J, 1]`` stored values of its shapes, by name; its own where there are none.
    """
    raws = {p.name: getattr(effect, f"raw_{p.name}").detach() for p in wanted}
    tangents = torch.block_diag(*(_tangents(effect, p) for p in wanted))
    count = len(next(iter(at.values()))) if at else 1
    each = tangents.repeat(count, 1).split([p.size for p in wanted], 1)
    towards = dict(zip(raws, each, strict=True))
    at = {name: values.repeat_interleave(len(tangents), 0) for name, values in at.items()}

    def change(towards: dict[str, Tensor], at: dict[str, Tensor]) -> Tensor:
        def out(values: dict[str, Tensor]) -> Tensor:
            given = {prefix + name: value for name, value in {**at, **values}.items()}
            found: Tensor = torch.func.functional_call(forward, given, ())
            return found

        both = torch.func.jvp(out, (raws,), (towards,))
        found: Tensor = both[1].to(both[0].dtype)
        return found

    with _dual, tensor_by_tensor():
        found: Tensor = torch.func.vmap(change, chunk_size=max(1, LANES // elements))(towards, at)
    return found


def weighted_columns(problem: Problem, effect: Effect, shapes: bool = False) -> Tensor:
    """:func:`expected_and_columns` of a problem's spots, divided by √μ.

    Args:
        problem: of the spots.
        effect: one of the extension's, or another.
        shapes: also by its shape parameters.

    Returns:
        ``[S·bins, k]``.
    """
    given = (problem.model, problem.extension, problem.spots, effect, shapes, problem.transients)
    return expected_and_columns(*given)[1] * problem.expected.reshape(-1, 1).rsqrt()


def acting_order(effect: Effect) -> int:
    """Sort key: the registry's order, which is that of the light's way, and free terms after it."""
    order = [*EFFECTS, *FREE]
    return order.index(type(effect)) if type(effect) in order else len(order)


class _Forward(nn.Module):
    """Model and extension as one module, so that any parameter can be replaced by a dual number."""

    def __init__(
        self, model: SurfelModel, extension: Extension, call: Callable[[SurfelModel, Extension], Tensor]
    ) -> None:
        super().__init__()
        self.model, self.extension, self.call = model, extension, call

    def forward(self) -> Tensor:
        return self.call(self.model, self.extension)


@torch.no_grad()
def _jvp(forward: _Forward, name: str, value: Tensor, tangent: Tensor) -> tuple[Tensor, Tensor]:
    """What comes out, and its change with one parameter, in the same precision.

    Numbers without a dimension lose theirs in forward mode, where a Python number meets them.
    """

    def at(v: Tensor) -> Tensor:
        return torch.func.functional_call(forward, {name: v}, ())

    out, change = pushed(at, (value.detach(),), (tangent,))
    return out, change.to(out.dtype)


@torch.no_grad()
def _staged(
    model: SurfelModel, extension: Extension, effect: Effect, spots: Tensor, transients: Tensor | None
) -> _Forward:
    """The part of the forward model after what an effect cannot change, the part before worked out."""
    if effect.needs_paths:
        paths = None if "walls" in effect.hooks else model.paths(spots, extension)

        def render(m: SurfelModel, e: Extension) -> Tensor:
            arrived = m.arrived(spots, e) if paths is None else m.transients(paths, spots, e)
            return m.record(arrived, spots, e)

        return _Forward(model, extension, render)
    if transients is None:
        transients = model.arrived(spots, extension)
    if effect.stage == "response":
        return _recording(model, extension, spots, transients)
    signal = model.signal(transients, extension)
    if effect.stage == "spot":
        return _Forward(model, extension, lambda m, e: m.detect(signal, spots, e))
    light = torch.add(*model.incident(signal, spots, extension))
    return _Forward(model, extension, lambda m, e: e.counting(light, spots))


def _render(spots: Tensor, model: SurfelModel, extension: Extension) -> Tensor:
    return model.render(spots, extension)


def _recording(model: SurfelModel, extension: Extension, spots: Tensor, transients: Tensor) -> _Forward:
    return _Forward(model, extension, lambda m, e: m.record(transients, spots, e))


@torch.no_grad()
def _surfel_columns(
    model: SurfelModel,
    extension: Extension,
    spots: Tensor,
    transients: Tensor,
    towards: Tensor,
    patch: Tensor,
    coarse: Tensor,
) -> Tensor:
    """``[B·T_gate, P]`` derivatives of the expected counts by all that the scene may do."""
    first, columns = model.gate[0], _transient_columns(model, extension, spots, towards, patch, coarse)
    unit = model.signal(torch.eye(transients.shape[1]), extension)
    signal = model.signal(transients, extension)
    if (alone := _by_bin(lambda x: model.detect(x, spots, extension), signal)) is not None:
        return ((unit.T[first:] @ columns) * alone[:, first:, None]).flatten(0, 1)
    return torch.bmm(_record_jacobian(model, extension, spots, signal, unit), columns).flatten(0, 1)


@torch.no_grad()
def _by_bin(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor | None:
    """Derivatives ``[B, T]`` of what comes out in each bin by what goes in there; None where other bins see
    it, too, which a random change of all of them tells.
    """
    tried = torch.rand(at.shape, generator=torch.Generator().manual_seed(0)) - 0.5
    alone = pushed(function, (at,), (torch.ones_like(at),))[1]
    off = pushed(function, (at,), (tried,))[1] - alone * tried
    return alone if bool((off.abs() <= 1e-5 * alone.abs().max()).all()) else None


@torch.no_grad()
def _record_jacobian(
    model: SurfelModel, extension: Extension, spots: Tensor, signal: Tensor, unit: Tensor
) -> Tensor:
    """``[B, T_gate, T]`` ∂(expected counts)/∂(transients), for any gain and counting stage.

    The response is the same at all spots and linear: ``unit`` ``[T, T]`` is what each bin's light becomes.
    """
    b, t = signal.shape
    again = spots.repeat_interleave(t)
    given = (signal.repeat_interleave(t, 0),), (unit.repeat(b, 1),)
    rows = pushed(lambda x: model.detect(x, again, extension), *given)[1]
    return rows.view(b, t, t)[:, :, model.gate[0] :].transpose(1, 2)


@torch.no_grad()
def _transient_columns(
    model: SurfelModel, extension: Extension, spots: Tensor, towards: Tensor, patch: Tensor, coarse: Tensor
) -> Tensor:
    """``[B, T, 2N + P·(2 + J)]`` derivatives of the transients.

    By albedos (in units of themselves) and depths (in bins) of the N groups ``patch`` ``[M]``, by moves along
    x and y (in bins) of the P groups ``coarse`` ``[M]``, and by how much brighter each of these is where each
    of the J functions ``towards`` ``[B, J]`` of the wall point is 1.
    """
    centre, normal, albedo = (v.detach() for v in (*model.placed(), model.albedo()))
    walls, offsets = model.walls(spots, extension), quadrature(model.quadrature, centre.device)
    seen = model.arriving(model.hiders[:, spots]).detach()[:, :, None] if len(model.hiders) else 1.0

    def place(rho: Tensor, depth: Tensor, side: Tensor) -> tuple[Tensor, Tensor]:
        moved = centre + (depth * model.bin_length / 2)[:, None] * model.direction
        moved = moved + torch.nn.functional.pad(side * model.bin_length / 2, (0, 1))
        paths = trace(moved, normal, model.cell, offsets, walls, model.curvature)
        paths = paths._replace(contribution=paths.contribution * seen)
        energy = extension.path(paths.contribution * rho[:, None], paths, spots)
        return energy, model.arrival(extension.time(paths.length, paths, spots))

    zero, one, still = torch.zeros_like(albedo), torch.ones_like(albedo), torch.zeros_like(centre[:, :2])
    here = (albedo, zero, still)
    at, by_albedo = pushed(place, here, (albedo_unit(albedo), zero, still))[:2]
    (energy, time), brighter = at, by_albedo[0]
    first, weights = spline_weights(time)
    slopes = spline_slopes(time)

    def moving(*tangent: Tensor) -> Tensor:
        d_energy, d_time = pushed(place, here, tangent)[1]
        return d_energy[..., None] * weights + (energy * d_time)[..., None] * slopes

    blocks = [
        _scatter_columns(values, first, model.n_bins, patch)
        for values in (brighter[..., None] * weights, moving(zero, one, still))
    ]
    for axis in torch.eye(2).to(still):
        values = moving(zero, zero, axis.expand_as(still))
        blocks.append(_scatter_columns(values, first, model.n_bins, coarse))
    light = _scatter_columns(energy[..., None] * weights, first, model.n_bins, coarse)
    blocks.append((light[..., None] * towards[:, None, None, :]).flatten(2))
    return torch.cat(blocks, 2)


def _scatter_columns(values: Tensor, first: Tensor, n_bins: int, column: Tensor) -> Tensor:
    """``[B, T, N]`` from ``[B, M, Q, 4]`` values that start at bins ``first`` ``[B, M, Q]``.

    ``column`` ``[M]`` says to which of N columns each surfel adds.
    """
    b, m = len(first), int(column.max()) + 1
    pad = 4
    start = (first.clamp(-pad, n_bins) + pad) + (n_bins + 2 * pad) * torch.arange(b)[:, None, None]
    flat = torch.zeros(b * (n_bins + 2 * pad) * m)
    for k in range(4):
        flat.index_add_(0, ((start + k) * m + column[:, None]).reshape(-1), values[..., k].reshape(-1))
    return flat.view(b, n_bins + 2 * pad, m)[:, pad:-pad]


def patches_of(model: SurfelModel, most: int) -> Tensor:
    """Surfels in groups that lie together: halved along their widest side until there are enough.

    Args:
        model: of the surfels.
        most: groups, at most.

    Returns:
        ``[M]`` number of each surfel's group.
    """
    place = model.centre().detach()
    if most >= len(place):
        return torch.arange(len(place))
    groups = [torch.arange(len(place))]
    while 2 * len(groups) <= most:
        halves: list[Tensor] = []
        for rows in groups:
            widest = int((place[rows].amax(0) - place[rows].amin(0)).argmax())
            order = rows[place[rows, widest].argsort()]
            halves += order.tensor_split(2)
        groups = halves
    patch = torch.empty(len(place), dtype=torch.long)
    for number, rows in enumerate(groups):
        patch[rows] = number
    return patch


def towards_wall(model: SurfelModel) -> Tensor:
    """``[S, J]`` linear functions of every spot's wall point, of mean 0 and mean square 1.

    Two of each of laser and sensor point that moves: a patch whose normal is wrong is brighter on one side.
    """
    points = [p[:, :2] for p in (model.sensor, model.laser) if float((p - p[:1]).abs().max()) > 0]
    if len(points) == 2 and torch.equal(*points):
        points = points[:1]
    found = list[Tensor]()
    for p in points:
        found += (p - p.mean(0)).unbind(1)
    functions = torch.stack(found, 1)
    return functions / functions.square().mean(0).sqrt().clamp_min(1e-12)


def albedo_unit(albedo: Tensor) -> Tensor:
    """``[M]`` that albedo columns count in: the albedo itself, for weak surfels a twentieth of the mean."""
    return torch.maximum(albedo, 0.05 * albedo.mean())
