"""The hidden surface as surfels, and the measurement they predict."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nlos_lit.capture import Capture
from nlos_lit.effects.hooks import NOTHING, Hooks
from nlos_lit.functional.irf import convolve_time
from nlos_lit.functional.surfel_graph import (
    Sheet,
    albedo_cost,
    bend_of,
    bending,
    carry_along,
    curvature_of,
    lay_sheet,
    level_of,
    neighbour_pairs,
    rolled_off,
    sheet_normals,
)
from nlos_lit.functional.surfel_paths import (
    SPLINE_VARIANCE,
    STEEP,
    Paths,
    SplineSplat,
    Walls,
    on_patch,
    quadrature,
    spread,
    trace,
)
from nlos_lit.functional.surfel_visibility import who_hides
from nlos_lit.io.points import Points
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.parameters import BoundedParameter

UNKNOWN = 0.5  # opacity of a surfel of which the counts have said nothing yet …
WHOLE = 0.6  # … from this share of the mean albedo on; of fainter ones in proportion, since they may be false
HIDING = 0.1  # opacity below which a surfel is not drawn: it would stand before what does hide
LOOKED = 2.0  # bins that points of a surfel lie apart at which it is looked who hides it, at most two …
DRAWN = 0.5  # … and those at which it is drawn, at most five along each side


class Lateral(NamedTuple):
    """The lattice of lateral cells from which surfels begin, and on which pictures show them."""

    origin: tuple[float, float]  # centre of cell [0, 0], m
    pitch: tuple[float, float]  # signed, m
    shape: tuple[int, int]


class SurfelModel(nn.Module):
    """Surfels with place, normal and albedo, and the laser-sensor response.

    Every surfel moves along one fixed ``direction``: +z, or its own normal where it stands too steeply for
    that. "Depth" is the place along it. State dicts are complete: :meth:`from_state` rebuilds the model with
    its number of surfels.

    Args:
        capture: for its wall points and time axis; its counts are not kept.
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` towards the wall's side.
        albedo: ``[M]`` > 0.
        lateral: cells of the surfels.
        laser_sensor: from :func:`spline_sensor`.
        quadrature: points along each side of a surfel.

    What stands in front hides a share of what is behind, its ``opacity``: outlines are known to a cell only,
    dark surfels hide, and false ones do not.

    Attributes:
        anchor: ``[M, 3]`` m, centres at depth 0.
        direction: ``[M, 3]`` unit.
        outward: ``[M, 3]`` where sheets end, and how much of their neighbours surfels lack, as when they were
            last laid.
        roll: how far normals lean that way (:func:`~nlos_lit.functional.surfel_graph.rolled_off`), one number
            for the scene: boards end, and round bodies turn away.
        curvature: ``[M, 3, 3]`` 1/m, see :func:`~nlos_lit.functional.surfel_paths.on_patch`; it follows from
            the normals of neighbours when a sheet is laid or lifted.
        hiders: ``[1 or 2, S, M, K]`` which surfel hides each of K points of every surfel from each spot's
            laser (and sensor, unless confocal), counted from 1; 0 where none does. ``[0, 0, 0, 0]`` where
            nothing is hidden.
        observed: ``[S, T]`` which bins were recorded; ``[0, T]`` where all were.
        pairs: neighbours on one sheet, see :meth:`link`.
        sheet: how normals follow from places, between :meth:`lay` and :meth:`lift`; None otherwise.
    """

    laser: Tensor
    laser_normal: Tensor
    sensor: Tensor
    sensor_normal: Tensor
    cell: Tensor
    anchor: Tensor
    direction: Tensor
    outward: Tensor
    curvature: Tensor
    hiders: Tensor
    observed: Tensor
    pairs: tuple[Tensor, Tensor]
    sheet: Sheet | None

    def __init__(
        self,
        capture: Capture,
        *,
        centre: Tensor,
        normal: Tensor,
        albedo: Tensor,
        lateral: Lateral,
        laser_sensor: LaserSensor,
        quadrature: int = 2,
    ) -> None:
        super().__init__()
        self.gate, self.n_bins = capture.gate, capture.gate[1]
        self.bin_length, self.t_start, self.confocal = capture.bin_length, capture.t_start, capture.confocal
        self.laser_sensor, self.quadrature, self.lateral = laser_sensor, quadrature, lateral
        for name in ("laser", "sensor", "laser_normal", "sensor_normal"):
            self.register_buffer(
                name, torch.tensor(getattr(capture, name), dtype=torch.float32), persistent=False
            )
        seen = (
            np.ones((0, self.n_bins), bool)
            if capture.observed is None
            else capture.observed[:, : self.n_bins]
        )
        self.register_buffer("observed", torch.from_numpy(seen), persistent=False)
        cell = torch.tensor([abs(float(c)) for c in lateral.pitch], device=self.laser.device)
        self.register_buffer("cell", cell, persistent=False)
        self.roll = nn.Parameter(torch.zeros((), device=self.laser.device))
        self.place(centre, normal, albedo)

    def place(
        self,
        centre: Tensor,
        normal: Tensor,
        albedo: Tensor,
        opacity: Tensor | None = None,
        curvature: Tensor | None = None,
    ) -> None:
        """Replace all surfels; nothing is hidden until :meth:`update_hiders`.

        Args:
            centre: ``[M, 3]`` m.
            normal: ``[M, 3]`` of any length, towards the wall's side.
            albedo: ``[M]`` > 0.
            opacity: ``[N]`` of the first N; the others have an :func:`unknown_opacity`, all without any.
            curvature: ``[N, 3, 3]`` of the first N; the others are flat, all without any.
        """
        device = self.laser.device
        normal = torch.nn.functional.normalize(normal.to(device=device, dtype=torch.float32), dim=1)
        steep = -normal[:, 2:] < STEEP
        self.register_buffer("anchor", centre.to(device=device, dtype=torch.float32))
        self.register_buffer(
            "direction", torch.where(steep, -normal, torch.tensor([0.0, 0.0, 1.0], device=device))
        )
        self.register_buffer("outward", torch.zeros(len(centre), 3, device=device))
        curved = torch.zeros(len(centre), 3, 3, device=device)
        if curvature is not None:
            curved[: len(curvature)] = curvature
        self.register_buffer("curvature", curved)
        self.register_buffer("hiders", torch.zeros(0, 0, 0, 0, dtype=torch.int32, device=device))
        # In units of a bin there and back, so that one learning rate suits every capture.
        self.raw_depth = nn.Parameter(torch.zeros(len(centre), device=device))
        self.raw_shift = nn.Parameter(torch.zeros(len(centre), device=device))  # neighbours come along
        self.raw_normal = nn.Parameter(normal)
        self.raw_albedo = nn.Parameter(
            inverse_softplus(albedo.to(device=device, dtype=torch.float32).clamp_min(1e-7))
        )
        known = albedo[:0] if opacity is None else opacity
        opacity = torch.cat([known, unknown_opacity(albedo)[len(known) :]])
        self.raw_opacity = nn.Parameter(torch.logit(opacity.to(device=device, dtype=torch.float32)))
        self.sheet = None
        self.link()

    @torch.no_grad()
    def keep(self, which: Tensor) -> None:
        """Leave out all surfels but those of ``which`` ``[M]`` bool; nothing is hidden, as after place."""
        parts = (*self.placed(), self.albedo(), self.opacity(), self.curvature)
        self.place(*(part[which] for part in parts))

    @torch.no_grad()
    def divide(self, parts: int) -> None:
        """Replace each surfel by ``parts`` × ``parts`` smaller ones on its own patch."""
        (whole, normal), pitch = self.placed(), self.lateral.pitch
        shift, _ = spread(normal, self.cell, quadrature(parts, self.cell.device))
        shift, facing = on_patch(normal, shift, self.curvature)
        centre = (whole[:, None] + shift).reshape(-1, 3)
        finer = (pitch[0] / parts, pitch[1] / parts)
        x, y = (o - (parts - 1) / 2 * p for o, p in zip(self.lateral.origin, finer, strict=True))
        nx, ny = self.lateral.shape
        self.lateral, self.cell = Lateral((x, y), finer, (nx * parts, ny * parts)), self.cell / parts
        same = (self.albedo(), self.opacity(), self.curvature)
        self.place(centre, facing.reshape(-1, 3), *(v.repeat_interleave(parts**2, 0) for v in same))

    def centre(self) -> Tensor:
        """``[M, 3]`` m."""
        together = 0 if self.sheet is None else carry_along(self.sheet, self.raw_shift)
        depth = self.raw_depth + together
        return self.anchor + (depth * (self.bin_length / 2))[:, None] * self.direction

    def normal(self) -> Tensor:
        """``[M, 3]`` unit, towards the wall's side."""
        return self.placed()[1]

    def placed(self) -> tuple[Tensor, Tensor]:
        """:meth:`centre` and :meth:`normal`; on a sheet the second follows from the first."""
        return self.leaning(self.laid())

    def leaning(self, laid: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """:meth:`placed` from :meth:`laid`."""
        centre, normal = laid
        return centre, rolled_off(normal, self.outward, self.roll)

    def laid(self) -> tuple[Tensor, Tensor]:
        """:meth:`placed` with normals that do not lean outwards at rims."""
        centre = self.centre()
        if self.sheet is not None:
            return centre, sheet_normals(self.sheet, centre)
        return centre, torch.nn.functional.normalize(self.raw_normal, dim=1)

    def albedo(self) -> Tensor:
        """``[M]`` ≥ 0, relative to the response's intensity."""
        return torch.nn.functional.softplus(self.raw_albedo)

    @torch.no_grad()
    def set_albedo(self, albedo: Tensor) -> None:
        """Store albedos ``[M]``, in place."""
        self.raw_albedo.copy_(inverse_softplus(albedo.clamp_min(1e-7)))

    def __len__(self) -> int:
        return len(self.anchor)

    @torch.no_grad()
    def link(self) -> None:
        """Find each surfel's neighbours on its sheet."""
        centre, normal = self.placed()
        stretch = (1 / (-normal[:, 2]).clamp_min(STEEP)).clamp_max(2.0)
        self.pairs = neighbour_pairs(centre, normal, 1.6 * self.cell.max() * stretch)

    @torch.no_grad()
    def lay(self, as_it_is: bool = False) -> None:
        """From now on normals follow from the places of neighbours, until :meth:`lift`.

        Args:
            as_it_is: they begin as they are, and follow as places change.
        """
        self.lift()
        cell = float(self.cell.max())
        self.sheet = lay_sheet(*self.laid(), self.trust(), self.pairs, cell, as_it_is)
        if not as_it_is:
            self.outward.copy_(self.sheet.outward)
        self._curve()

    @torch.no_grad()
    def lift(self) -> None:
        """Places and normals stay as they are, and stand for themselves from now on."""
        centre, normal = self.laid()
        self._curve()
        self.raw_normal.copy_(normal)
        self.anchor.copy_(centre)
        self.raw_depth.zero_()
        self.raw_shift.zero_()
        self.sheet = None

    def _curve(self) -> None:
        """Curvatures that go with the normals of a sheet; they stay where it was laid as it was."""
        if self.sheet is not None and not self.sheet.as_it_was:
            self.curvature.copy_(curvature_of(self.sheet, self.normal(), float(self.cell.max())))

    def trust(self) -> Tensor:
        """``[M]`` weight of each surfel among its neighbours, from 0 for dark ones to 1."""
        albedo = self.albedo().detach()
        return albedo / (albedo + 0.3 * albedo.mean())

    @torch.no_grad()
    def bend(self) -> float:
        """How much neighbours misfit, see :func:`~nlos_lit.functional.surfel_graph.bend_of`."""
        return bend_of(*self.laid(), self.trust(), self.pairs)

    def bending(self, laid: tuple[Tensor, Tensor], bend: float) -> Tensor:
        """How badly neighbours fit one surface, see :func:`~nlos_lit.functional.surfel_graph.bending`.

        Args:
            laid: from :meth:`laid`: how rims roll off is one number, and no bend of each.
            bend: rad, of :meth:`bend` as it was lately.

        Returns:
            A scalar, differentiable.
        """
        return bending(*laid, self.trust(), self.pairs, bend)

    def albedo_cost(
        self, evenness: float, bright: float, there: float, albedo: Tensor | None = None
    ) -> Tensor:
        """What albedos cost that differ between neighbours, exceed the scene's own level, or are there.

        Args:
            evenness: weight of :func:`~nlos_lit.functional.surfel_graph.albedo_steps` …
            bright: … of :func:`~nlos_lit.functional.surfel_graph.brightness` …
            there: … and of :func:`~nlos_lit.functional.surfel_graph.presence`.
            albedo: ``[M]`` instead of the surfels' own, whose level stays.

        Returns:
            A scalar, differentiable.
        """
        own = self.albedo()
        level, albedo = level_of(own), own if albedo is None else albedo
        return albedo_cost(albedo, self.pairs, level, evenness, bright, there)

    def opacity(self) -> Tensor:
        """``[M]`` share of the light that a surfel keeps from what is behind it."""
        return torch.sigmoid(self.raw_opacity)

    @torch.no_grad()
    def set_opacity(self, opacity: Tensor) -> None:
        """Store opacities ``[M]``, in place; a fit leaves 0 and 1 as they are."""
        self.raw_opacity.copy_(torch.logit(opacity))

    @torch.no_grad()
    def update_hiders(self, spots: Tensor | None = None) -> None:
        """Find who hides each surfel, at :meth:`points_of` it: see :meth:`hidden_by`.

        Args:
            spots: ``[B]`` rows of the capture; the others see all. None finds it for every spot.
        """
        rows = torch.arange(len(self.laser), device=self.laser.device) if spots is None else spots
        found = self.hidden_by(rows, self.points_of(*self.placed()))
        if spots is None:
            self.hiders = found
            return
        self.hiders = found.new_zeros(len(found), len(self.laser), *found.shape[2:])
        self.hiders[:, rows] = found

    def points_of(self, centre: Tensor, normal: Tensor) -> Tensor:
        """Points of surfels at which it is looked who hides them.

        Args:
            centre: ``[V, 3]`` m.
            normal: ``[V, 3]`` unit.

        Returns:
            ``[V, K, 3]`` m.
        """
        shift, _ = spread(normal, self.cell, quadrature(self._along(LOOKED, 2), self.cell.device))
        return centre[:, None] + shift

    def _along(self, apart: float, most: int) -> int:
        return points_along(float(self.cell.max()), self.bin_length, apart, most)

    @torch.no_grad()
    def hidden_by(self, spots: Tensor, places: Tensor) -> Tensor:
        """Which surfels hide places from laser and sensor; those below an opacity of ``HIDING`` hide nothing.

        Args:
            spots: ``[B]`` rows of the capture.
            places: ``[V, K, 3]`` m, K points of each place.

        Returns:
            ``[1 or 2, B, V, K]`` int32, as ``hiders``.
        """
        centre, normal = self.placed()
        drawn = torch.nonzero(self.opacity() > HIDING)[:, 0]
        along, names = self._along(DRAWN, 5), (drawn + 1).to(torch.int32)

        def found(wall: Tensor) -> Tensor:
            points, row = torch.unique(wall, dim=0, return_inverse=True)
            once = len(points) < len(wall)
            given = (centre[drawn], normal[drawn], self.cell, points if once else wall, places, along)
            by = who_hides(*given, names=names)
            return by.index_select(0, row) if once else by

        legs = [self.laser] if self.confocal else [self.laser, self.sensor]
        return torch.stack([found(wall[spots]) for wall in legs])

    def arriving(self, hiders: Tensor) -> Tensor:
        """Share of the light of some places that is not hidden.

        Args:
            hiders: ``[1 or 2, B, V, K]`` of their points.

        Returns:
            ``[B, V]`` mean over the points, differentiable in the opacities.
        """
        passes = torch.cat([self.raw_opacity.new_ones(1), 1 - self.opacity()])
        legs = [passes.index_select(0, leg.reshape(-1)).view(leg.shape) for leg in hiders]
        return math.prod(legs[1:], start=legs[0]).mean(2)

    def walls(self, spots: Tensor, hooks: Hooks = NOTHING) -> Walls:
        """Wall points and normals of spots.

        Args:
            spots: ``[B]`` rows of the capture.
            hooks: effects that move them.

        Returns:
            the points.
        """
        stated = (self.laser[spots], self.laser_normal[spots], self.sensor[spots], self.sensor_normal[spots])
        return hooks.walls(Walls(*stated, self.confocal), spots)

    def paths(
        self, spots: Tensor, hooks: Hooks = NOTHING, placed: tuple[Tensor, Tensor] | None = None
    ) -> Paths:
        """Stage 1: all paths over all surfels, for unit albedo.

        Args:
            spots: ``[B]`` rows of the capture.
            hooks: effects that move the wall's points.
            placed: from :meth:`placed`, where it is known.

        Returns:
            the paths.
        """
        offsets = quadrature(self.quadrature, self.anchor.device)
        centre, normal = placed or self.placed()
        seen = self.arriving(self.hiders[:, spots]) if len(self.hiders) else None
        return trace(centre, normal, self.cell, offsets, self.walls(spots, hooks), self.curvature, seen)

    def arrival(self, length: Tensor) -> Tensor:
        """Stage 2: path length (m) as time in bins from the capture's bin 0."""
        return (length - self.t_start) / self.bin_length

    def transients(self, paths: Paths, spots: Tensor, hooks: Hooks, albedo: Tensor | None = None) -> Tensor:
        """Stages 2 and 3: light on arrival, H_r.

        Args:
            paths: of the spots, for unit albedo.
            spots: ``[B]`` rows of the capture.
            hooks: effects that act on paths, times and transients.
            albedo: ``[M]`` instead of the surfels' own.

        Returns:
            ``[B, T]`` from the capture's bin 0 to the gate's end.
        """
        albedo = self.albedo() if albedo is None else albedo
        energy, time = self.arrivals(paths, spots, hooks, albedo)
        transients = SplineSplat.apply(energy.flatten(1), time.flatten(1), self.n_bins)
        return hooks.transients(transients, energy, albedo, paths, spots)

    def arrived(self, spots: Tensor, hooks: Hooks, placed: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """Stages 1 to 3.

        Args:
            spots: ``[B]`` rows of the capture.
            hooks: effects that act on walls, paths, times and transients.
            placed: from :meth:`placed`, where it is known.

        Returns:
            ``[B, T]`` as of :meth:`transients`.
        """
        return self.transients(self.paths(spots, hooks, placed), spots, hooks)

    def arrivals(self, paths: Paths, spots: Tensor, hooks: Hooks, albedo: Tensor) -> tuple[Tensor, Tensor]:
        """Stage 2: energy of each path, and when it arrives.

        Args:
            paths: of the spots, for unit albedo.
            spots: ``[B]`` rows of the capture.
            hooks: effects that act on paths and times.
            albedo: ``[M]``.

        Returns:
            ``[B, M, Q]`` each, the second in bins from the capture's bin 0.
        """
        energy = hooks.path(paths.contribution * albedo[:, None], paths, spots)
        return energy, self.arrival(hooks.time(paths.length, paths, spots))

    def signal(self, transients: Tensor, hooks: Hooks) -> Tensor:
        """Stage 4: transients through the response.

        Args:
            transients: ``[B, T]`` light on arrival.
            hooks: effects that act on the response.

        Returns:
            ``[B, T]`` counts.
        """
        sensor = self.laser_sensor
        return sensor.intensity() * convolve_time(
            transients, hooks.response(sensor.kernel(), sensor.lead), sensor.lead
        )

    def detect(self, signal: Tensor, spots: Tensor, hooks: Hooks) -> Tensor:
        """Stage 5: gain, background and counting; nothing in bins that were not recorded.

        Args:
            signal: ``[B, T]`` counts of the light.
            spots: ``[B]`` rows of the capture.
            hooks: effects that act on them.

        Returns:
            ``[B, T]`` expected counts.
        """
        light, background = self.incident(signal, spots, hooks)
        counted = hooks.counting(light + background, spots)
        return counted * self.observed[spots] if len(self.observed) else counted

    def incident(self, signal: Tensor, spots: Tensor, hooks: Hooks) -> tuple[Tensor, Tensor]:
        """What there is to be counted.

        Args:
            signal: ``[B, T]`` counts of the light.
            spots: ``[B]`` rows of the capture.
            hooks: effects that act on it.

        Returns:
            ``[B, T]`` light of the scene after its gain, and background that broadcasts with it.
        """
        return hooks.gain(signal, spots), hooks.background(self.laser_sensor.background(), spots)

    def record(self, transients: Tensor, spots: Tensor, hooks: Hooks) -> Tensor:
        """Stages 4 and 5.

        Args:
            transients: ``[B, T]`` light on arrival.
            spots: ``[B]`` rows of the capture.
            hooks: effects that act there.

        Returns:
            ``[B, T]`` expected counts.
        """
        return self.detect(self.signal(transients, hooks), spots, hooks)

    def render(
        self, spots: Tensor, hooks: Hooks = NOTHING, placed: tuple[Tensor, Tensor] | None = None
    ) -> Tensor:
        """All stages.

        Args:
            spots: ``[B]`` rows of the capture.
            hooks: effects.
            placed: from :meth:`placed`, where it is known.

        Returns:
            ``[B, T_gate]`` expected counts.
        """
        return self.record(self.arrived(spots, hooks, placed), spots, hooks)[:, self.gate[0] :]

    forward = render

    @torch.no_grad()
    def expected(self, spots: Tensor, hooks: Hooks = NOTHING) -> Tensor:
        """:meth:`render` without gradients, in batches of about two million paths.

        Args:
            spots: ``[B]`` rows of the capture.
            hooks: effects.

        Returns:
            ``[B, T_gate]`` expected counts.
        """
        return torch.cat([self.render(part, hooks) for part in self._batches(spots)])

    @torch.no_grad()
    def pull_back(self, spots: Tensor, hooks: Hooks, asked: Tensor) -> tuple[Tensor, Tensor]:
        """What counts ask of light that arrives, back through counting and gain.

        Args:
            spots: ``[B]`` rows of the capture.
            hooks: effects.
            asked: ``[B, T_gate]`` of each count.

        Returns:
            ``[B, T_gate]`` of each that arrives in a bin, and counts for each; 0 in bins that were not
            recorded.
        """
        found = []
        for part, of_counts in zip(self._batches(spots), self._batches(spots, asked), strict=True):
            signal = self.signal(self.arrived(part, hooks), hooks)
            with torch.enable_grad():
                counted = self.detect(signal.requires_grad_(), part, hooks)[:, self.gate[0] :]
                by = [(counted * of_counts).sum(), counted.sum()]
                found.append(torch.stack([torch.autograd.grad(x, signal, retain_graph=True)[0] for x in by]))
        pulled, counts = torch.cat(found, 1)[..., self.gate[0] :]
        return pulled, counts

    @torch.no_grad()
    def light(self, spots: Tensor, hooks: Hooks = NOTHING) -> Tensor:
        """The light by itself, before background and counting effects.

        Args:
            spots: ``[B]`` rows of the capture.
            hooks: effects.

        Returns:
            ``[B, T_gate]`` counts.
        """
        parts = self._batches(spots)
        signals = [hooks.gain(self.signal(self.arrived(p, hooks), hooks), p) for p in parts]
        return torch.cat(signals)[:, self.gate[0] :]

    @property
    def batch(self) -> int:
        """Spots that have about two million paths together."""
        return max(1, (1 << 21) // max(1, len(self) * self.quadrature**2))

    def _batches(self, spots: Tensor, rows: Tensor | None = None) -> tuple[Tensor, ...]:
        """Parts of some spots, or of what belongs to them."""
        return (spots if rows is None else rows).split(self.batch)

    def points(self) -> Points:
        """Surfel centres with normals and albedo."""
        arrays = (*self.placed(), self.albedo())
        return Points(*(a.detach().cpu().double().numpy() for a in arrays))

    def get_extra_state(self) -> dict[str, Any]:
        response = {name: (p.lower, p.upper, p.unit) for name, p in self.laser_sensor.named_children()}
        own = {"quadrature": self.quadrature, "lateral": tuple(self.lateral)}
        return {"response": response, **own}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.quadrature = state["quadrature"]

    @classmethod
    def from_state(cls, capture: Capture, state: dict[str, Any]) -> SurfelModel:
        """The model whose ``state_dict()`` this is.

        Args:
            capture: of the model.
            state: with ``_extra_state``.

        Returns:
            a model with as many surfels, neighbours linked anew.
        """
        extra = state["_extra_state"]
        middle = {
            name: (math.sqrt(low * high), low, high, unit)
            for name, (low, high, unit) in extra["response"].items()
        }
        sensor = spline_sensor(capture, {name: BoundedParameter(*values) for name, values in middle.items()})
        m = len(state["anchor"])
        normal = torch.tensor([0.0, 0.0, -1.0]).expand(m, 3)
        lateral = Lateral(*(tuple(v) for v in extra["lateral"]))
        model = cls(
            capture,
            centre=state["anchor"].clone(),  # what becomes of the model must not change the state
            normal=normal,
            albedo=torch.ones(m),
            lateral=lateral,
            laser_sensor=sensor,
        )
        model.hiders = torch.empty_like(state["hiders"])
        model.load_state_dict(state)
        model.link()
        return model


def spline_sensor(capture: Capture, parameters: dict[str, BoundedParameter]) -> LaserSensor:
    """A laser-sensor model for transients splatted by cubic B-splines, whose width it takes out of Ψ.

    σ_ls cannot be below √(1/3 + 0.05²) = 0.58 bins.

    Args:
        capture: for its bins.
        parameters: ``sigma_ls``, ``kappa_s``, ``intensity``, ``background``.

    Returns:
        the response, from the capture's bin 0 to the gate's end.
    """
    sensor = LaserSensor(
        bin_length=capture.bin_length,
        n_bins=capture.gate[1],
        sigma_ls=parameters["sigma_ls"],
        kappa_s=parameters["kappa_s"],
        intensity=parameters["intensity"],
        background=parameters["background"],
    )
    sensor.splat_variance = SPLINE_VARIANCE
    return sensor


def inverse_softplus(value: Tensor) -> Tensor:
    """x with softplus(x) = value > 0."""
    return value + torch.log(-torch.expm1(-value))


def unknown_opacity(albedo: Tensor) -> Tensor:
    """What surfels are taken to hide until the counts say more.

    Args:
        albedo: ``[M]``.

    Returns:
        ``[M]`` between 0 and 1.

    Examples:
        >>> unknown_opacity(torch.tensor([0.15, 1.0, 1.85]))
        tensor([0.1250, 0.5000, 0.5000])
    """
    return UNKNOWN * (albedo / (WHOLE * albedo.mean()).clamp_min(1e-30)).clamp(0.02, 1.0)


def points_along(cell: float, bin_length: float, apart: float = 1 / 0.55, most: int = 8) -> int:
    """Points along each side of a surfel; those of its quadrature have arrivals about two bins apart.

    Args:
        cell: side of the surfel, m.
        bin_length: optical path of one bin, m.
        apart: bins between points, at most …
        most: … unless there would be more than so many.

    Returns:
        at least 1.

    Examples:
        >>> points_along(0.03, 0.0096), points_along(0.01, 0.0096)
        (2, 1)
    """
    return min(most, max(1, math.ceil(cell / (apart * bin_length) - 1e-6)))  # cells are single precision
