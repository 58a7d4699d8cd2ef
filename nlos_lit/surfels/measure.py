"""The effects as a measurement simulator: counts of a known scene with known effects.

Path and time effects act on single paths, so the light is rendered by
:class:`~nlos_lit.surfels.model.SurfelModel` from surfels cut from the true mesh, with the mesh's own
visibility. Without effects this agrees with the ground-truth simulator, which shares no code with it, to 1e-3
in each spot's energy and 1e-5 in NMSE. With effects it is the model that is later fitted: a capture made here
is no independent test of an effect's equation.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from data_modules.simulate import Mesh, ScanPlan, SensorModel, Truth, simulate_capture
from data_modules.simulate.sensor import draw_counts
from data_modules.simulate.transients import BLOCK_PAIRS, Patches
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.strengths import effects_at, report
from nlos_lit.functional.surfel_paths import SPLINE_VARIANCE, quadrature, spread
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.runtime.memory import check_machine
from nlos_lit.surfels.model import Lateral, SurfelModel, spline_sensor

log = logging.getLogger(__name__)

NARROWEST = float(
    np.sqrt(SPLINE_VARIANCE + 0.05**2)
)  # σ in bins, of the splines that arrivals are splatted with


def measure(
    mesh: Mesh,
    scan: ScanPlan,
    sensor: SensorModel,
    seed: int | None,
    effects: Iterable[str],
    values: Mapping[str, float],
    *,
    exposure: float = 1.0,
    two_sided: bool = False,
    detail: float = 1.0,
    progress: bool = False,
) -> tuple[Capture, Truth]:
    """Measure a mesh with effects.

    ``sensor.mean_counts`` and ``background`` are those without effects. Provenance gets ``effects``: what the
    effects report.

    Args:
        mesh, scan, sensor, two_sided, detail, progress: as of
            :func:`~data_modules.simulate.simulate_capture`.
        seed: of counts and random fields; None gives expected values (with the fields of seed 0).
        effects, values, exposure: as of :func:`~nlos_lit.effects.strengths.effects_at`; ``sensor`` is exposed
            already.

    Returns:
        The capture, counts of float or, with a seed, whole counts; and the truth that it shows.

    Raises:
        UserError: effects or values that do not exist or fit, a direct pulse, a gate that ends before the
            record.
        MemoryBudgetError: who sees whom does not fit this machine's free memory.
    """
    if sensor.direct_counts:
        raise UserError("the direct pulse cannot be simulated with effects; set direct_counts to 0")
    if scan.gate is not None and scan.gate[1] != scan.n_bins:
        raise UserError(
            f"with effects the record ends with the gate; found gate={list(scan.gate)},"
            f" so take n_bins={scan.gate[1]}"
        )
    built = effects_at(effects, values, planned_scan(scan, sensor), seed, exposure)
    capture, truth = simulate_capture(
        mesh, scan, sensor, None, two_sided=two_sided, detail=detail, progress=progress
    )
    assert truth.gain is not None  # it is known of what was simulated
    intensity = truth.gain * scan.wall_albedo**2 / np.pi**3
    model = truth_surfels(mesh, capture, sensor, intensity, two_sided=two_sided, detail=detail)
    log.info("effects on %d spots × %d surfels", capture.n_spots, len(model))
    expected = expected_counts(model, built).double().numpy()
    provenance = {
        **capture.provenance,
        "source": "nlos_lit.surfels.measure",
        "seed": seed,
        "effects": report(built),
    }
    counts = expected.astype(np.float32) if seed is None else draw_counts(expected, seed)
    return dataclasses.replace(
        capture, counts=counts, is_counts=seed is not None, provenance=provenance
    ), truth


def planned_scan(scan: ScanPlan, sensor: SensorModel) -> Scan:
    """What effects know of a scan that has not been measured yet.

    Args:
        scan: its points and bins.
        sensor: for the level of the counts.

    Returns:
        As :meth:`Scan.of` would have it, the background as stated.
    """
    laser, point = scan.points()
    up = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    level = sensor.mean_counts / scan.n_bins + sensor.background
    counts = np.full((len(laser), scan.n_bins), level, dtype=np.float32)
    flat = Capture(counts, laser, point, up, up, scan.bin_length, scan.t_start, scan.gate, scan.scan_shape)
    return dataclasses.replace(Scan.of(flat), background=max(sensor.background, 1e-3 * level))


def truth_surfels(
    mesh: Mesh,
    capture: Capture,
    sensor: SensorModel,
    intensity: float,
    *,
    two_sided: bool = False,
    detail: float = 1.0,
) -> SurfelModel:
    """Surfels that are the patches of a mesh: their places, normals, albedo × area, and who sees whom.

    Patches are as small as the ground-truth simulator's and taken as points. The model's bins are all of the
    capture's.

    Args:
        mesh: the hidden scene.
        capture: wall points and time bins.
        sensor: its response and background.
        intensity: counts per unit of H_r.
        two_sided: triangles reflect on both sides.
        detail: factor on the number of patches along a line.

    Returns:
        The model, with who sees whom.
    """
    ends = np.concatenate(
        [np.c_[capture.laser, capture.laser_normal], np.c_[capture.sensor, capture.sensor_normal]]
    )
    points, rows = np.unique(ends, axis=0, return_inverse=True)
    laser, point = rows.reshape(2, -1)
    patches = Patches(mesh, points[:, :3], capture.bin_length, detail)
    needed = (3 * capture.n_spots + len(points)) * len(patches) * (1 + two_sided)
    check_machine(needed, "what each spot sees of the surfels", "use fewer spots or less detail")
    facing = np.empty((len(points), len(patches)), dtype=np.int8)
    size = max(1, BLOCK_PAIRS // len(patches))
    for start in range(0, len(points), size):
        block = slice(start, start + size)
        facing[block] = np.sign(patches.legs(points[block, :3], points[block, 3:], two_sided, True)[0])
    sides = (1, -1) if two_sided else (1,)
    visible = np.concatenate([(facing[laser] == side) & (facing[point] == side) for side in sides], axis=1)
    lit = visible.any(axis=0)

    def joined(*parts: np.ndarray) -> Tensor:
        return torch.from_numpy(np.concatenate(parts)[lit]).float()

    copies = len(sides)
    normal = joined(*(side * patches.normal for side in sides))
    cell = float(np.sqrt(patches.area.mean()))
    _, area = spread(normal, torch.tensor([cell, cell]), quadrature(1))
    model = SurfelModel(
        dataclasses.replace(capture, gate=None),
        centre=joined(*[patches.centroid] * copies),
        normal=normal,
        # A surfel's area follows from its normal: what the patch has more or less goes into the albedo.
        albedo=joined(*[patches.albedo * patches.area] * copies) / area,
        lateral=Lateral((0.0, 0.0), (cell, cell), (1, 1)),
        laser_sensor=spline_sensor(capture, _response(sensor, capture.bin_length, intensity)),
        quadrature=1,
    )
    # Who looks at a patch's other side is kept from it as if by the first patch.
    model.hiders = torch.from_numpy(~visible[:, lit]).to(torch.int32)[None, :, :, None]
    model.set_opacity(torch.ones(len(model)))
    return model


@torch.no_grad()
def expected_counts(model: SurfelModel, effects: list[Effect]) -> Tensor:
    """Expected counts of all spots.

    Args:
        model: of the light.
        effects: in the order in which they act; each settles on the light there is (:meth:`Effect.settle`).

    Returns:
        ``[S, T]``.
    """
    spots = torch.arange(len(model.laser))
    counting = [effect for effect in effects if effect.stage == "counting"]
    expected = model.expected(spots, Extension([effect for effect in effects if effect.stage != "counting"]))
    for effect in counting:
        effect.settle(expected)
        expected = effect.counting(expected, spots)
    return expected


def _response(sensor: SensorModel, bin_length: float, intensity: float) -> dict[str, BoundedParameter]:
    sigma, kappa = sensor.sigma, min(sensor.kappa, 100 / bin_length)
    if sigma < NARROWEST * bin_length:
        log.warning(
            "sigma=%g is below %.2f bins, as narrow as effects can be simulated; that is taken",
            sigma,
            NARROWEST,
        )
        sigma = NARROWEST * bin_length
    start = {
        "sigma_ls": (sigma, "m"),
        "kappa_s": (kappa, "1/m"),
        "intensity": (intensity, "counts m2"),
        "background": (max(sensor.background, 1e-9), "counts/bin"),
    }
    return {
        name: BoundedParameter(value, value / 1.01, value * 1.01, unit)
        for name, (value, unit) in start.items()
    }
