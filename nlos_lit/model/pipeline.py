"""The simulated measurement: H → I_pf → G → H_r → H_R, four submodules in a row. Torch alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nlos_lit.capture import Capture
from nlos_lit.functional.march import expand, trilinear
from nlos_lit.model.albedo import FreeAlbedo, ResidualAlbedo
from nlos_lit.model.geometry import ImplicitGeometry, Surface
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.phasor import PhasorImaging
from nlos_lit.model.renderer import TransientRenderer


class Rendering(NamedTuple):
    """Everything one forward pass finds for a batch of S spots and K surface points."""

    expected: Tensor  # [S, T_gate] H_R, counts
    intensity: Tensor  # [nz, nx, ny] I_pf
    albedo: Tensor  # [nz, nx, ny] ρ
    surface: Surface
    surface_albedo: Tensor  # [K] ρ at the surface points


class Pipeline(nn.Module):
    """Phasor imaging, implicit geometry, transient rendering and laser-sensor response of one capture.

    Args:
        capture: gives the wall points, their normals, the gate and which bins were recorded; its counts are
            not kept.
        phasor: H → I_pf; :meth:`~nlos_lit.model.phasor.PhasorImaging.prepare` must have been called before
            the first forward pass.
        geometry: I_pf → G.
        albedo: I_pf → ρ per voxel.
        renderer: G, ρ → H_r.
        laser_sensor: H_r → H_R.
    """

    laser: Tensor
    sensor: Tensor
    laser_normal: Tensor
    sensor_normal: Tensor
    observed: Tensor | None

    def __init__(
        self,
        capture: Capture,
        phasor: PhasorImaging,
        geometry: ImplicitGeometry,
        albedo: FreeAlbedo | ResidualAlbedo,
        renderer: TransientRenderer,
        laser_sensor: LaserSensor,
    ) -> None:
        super().__init__()
        self.phasor, self.geometry, self.albedo = phasor, geometry, albedo
        self.renderer, self.laser_sensor = renderer, laser_sensor
        self.gate = capture.gate
        where = np.concatenate([capture.sensor, capture.sensor_normal], axis=1)
        self.one_sensor = bool((where == where[0]).all())
        for name in ("laser", "sensor", "laser_normal", "sensor_normal"):
            self.register_buffer(
                name, torch.tensor(getattr(capture, name), dtype=torch.float32), persistent=False
            )

        observed = capture.gated_observed()
        self.register_buffer(
            "observed", None if observed is None else torch.from_numpy(observed.copy()), persistent=False
        )

    def observed_at(self, spots: Tensor) -> Tensor | None:
        """``[S, T_gate]`` bool, which gated bins of some spots were recorded; None where all of them were."""
        return None if self.observed is None else self.observed[spots]

    def forward(self, spots: Tensor) -> Rendering:
        """Simulate the measurement of some spots.

        Args:
            spots: ``[S]`` long, rows of the capture.

        Returns:
            Expected counts inside the gate, and what led to them.
        """
        intensity = self.phasor()
        albedo = self.albedo(intensity)
        rendered, surface, surface_albedo = self.render(intensity, albedo, spots)
        return Rendering(
            self.laser_sensor(rendered)[:, self.gate[0] :], intensity, albedo, surface, surface_albedo
        )

    def surface(self, intensity: Tensor, sensor: Tensor, normal: Tensor) -> Surface:
        """The surface seen from wall points; those that occur several times are marched from once.

        Args:
            intensity: ``[nz, nx, ny]`` I_pf, unit maximum.
            sensor: ``[S, 3]`` wall points, m.
            normal: ``[S, 3]`` unit wall normals.

        Returns:
            The surface, with ``spot`` an index into ``sensor``.
        """
        if self.geometry.static:  # without asking the device which points are equal
            return self.geometry(intensity, sensor, normal)
        places, which = torch.unique(torch.cat([sensor, normal], dim=1), dim=0, return_inverse=True)
        if len(places) == len(sensor):
            return self.geometry(intensity, sensor, normal)
        seen = self.geometry(intensity, places[:, :3], places[:, 3:])
        order = torch.argsort(seen.spot, stable=True)
        counts = torch.bincount(seen.spot, minlength=len(places))
        start = torch.cumsum(counts, 0) - counts
        spot, rank = expand(counts[which])
        row = order[start[which][spot] + rank]
        return Surface(spot, *(field[row] for field in seen[1:]))

    def _from_one(self, intensity: Tensor, sensor: Tensor, normal: Tensor) -> Surface:
        """The surface for spots that all are seen from the same point."""
        seen, spots = self.geometry(intensity, sensor[:1], normal[:1]), len(sensor)
        spot = torch.arange(spots, device=sensor.device)[:, None].expand(-1, len(seen.spot)).reshape(-1)
        return Surface(spot, *(field.repeat(spots, *[1] * (field.dim() - 1)) for field in seen[1:]))

    def render(self, intensity: Tensor, albedo: Tensor, spots: Tensor) -> tuple[Tensor, Surface, Tensor]:
        """Transients of a given volume before the laser-sensor response.

        Args:
            intensity: ``[nz, nx, ny]`` I_pf, unit maximum.
            albedo: ``[nz, nx, ny]`` ρ.
            spots: ``[S]`` long, rows of the capture.

        Returns:
            H_r ``[S, T]`` over bins 0 … gate's end, the surface, and its albedo ``[K]``.
        """
        laser, sensor = self.laser[spots], self.sensor[spots]
        known = self.one_sensor and self.geometry.static
        look = self._from_one if known else self.surface
        surface = look(intensity, sensor, self.sensor_normal[spots])
        surface_albedo = trilinear(albedo, surface.point, self.geometry.lattice)
        rendered = self.renderer(
            surface, surface_albedo, laser, self.laser_normal[spots], sensor, self.sensor_normal[spots]
        )
        return rendered, surface, surface_albedo
