"""A whole simulated measurement: scan, transients, sensor and photon statistics, with the truth beside it."""

from __future__ import annotations

import dataclasses
import logging
from typing import Any

import numpy as np

from data_modules.simulate.mesh import Mesh
from data_modules.simulate.plan import ScanPlan, wall_grid
from data_modules.simulate.sensor import SensorModel, direct_pulse_counts, draw_counts, respond
from data_modules.simulate.transients import simulate_with_rest
from data_modules.simulate.truth import Truth, view_from_wall
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError

log = logging.getLogger(__name__)


def simulate_capture(
    mesh: Mesh,
    scan: ScanPlan,
    sensor: SensorModel,
    seed: int | None,
    *,
    two_sided: bool = False,
    detail: float = 1.0,
    oversample: int = 4,
    truth_shape: tuple[int, int] = (128, 128),
    keep_transients: bool = False,
    progress: bool = False,
) -> tuple[Capture, Truth]:
    """Measure a mesh.

    Args:
        mesh: the hidden scene.
        scan: wall points and time bins.
        sensor: response, exposure and background.
        seed: of the Poisson counts; None gives expected values instead of counts.
        two_sided: faces reflect from both sides.
        detail: see `simulate_transients`.
        oversample: the response is applied on bins this many times finer.
        truth_shape: lattice over the scanned wall on which the truth is given.
        keep_transients: put the clean and the expected transients into the truth.
        progress: show a progress bar when it takes more than a few seconds.

    Returns:
        the capture, and what is really there.

    Raises:
        UserError: nothing of the scene falls into the time window, or a direct pulse is asked of a scan that
            is not confocal.
    """
    if sensor.direct_counts and scan.kind != "confocal":
        raise UserError("only a confocal scan sees the direct pulse at path 0; set direct_counts to 0")
    laser, point = scan.points()
    normals = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    # What arrives outside the window can still smear into it.
    before, after = (int(np.ceil(reach / scan.bin_length)) for reach in reversed(sensor.reach))
    before = min(before, max(0, int(np.ceil(scan.t_start / scan.bin_length))))
    n_bins = before + scan.n_bins + after
    fine = simulate_with_rest(
        mesh,
        laser,
        point,
        normals,
        normals,
        bin_length=scan.bin_length / oversample,
        n_bins=n_bins * oversample,
        t_start=scan.t_start - before * scan.bin_length,
        wall_albedo=scan.wall_albedo,
        two_sided=two_sided,
        detail=detail,
        progress=progress,
    )
    window = slice(before, before + scan.n_bins)

    def to_bins(transients: np.ndarray) -> np.ndarray:
        return transients.reshape(len(laser), n_bins, oversample).sum(axis=2)[:, window]

    clean = to_bins(fine[:, 1:-1])
    inside = clean.sum() / fine.sum()
    end = scan.t_start + scan.n_bins * scan.bin_length
    if inside == 0:
        raise UserError(
            f"no light of the scene arrives between {scan.t_start:g} and {end:g} m of path; change the "
            "time window"
        )
    if inside < 0.99:
        log.warning(
            "%.0f %% of the light arrives outside the window of %g … %g m of path",
            100 * (1 - inside),
            scan.t_start,
            end,
        )
    gain = sensor.mean_counts * len(laser) / clean.sum()
    expected = (
        to_bins(respond(gain * fine[:, 1:-1], sensor, scan.bin_length / oversample)) + sensor.background
    )
    gate = scan.gate
    if sensor.direct_counts:
        pulse = direct_pulse_counts(sensor, scan.bin_length, scan.n_bins, scan.t_start)
        expected += pulse
        gate = gate or (int(np.flatnonzero(pulse > 0.01).max(initial=-1)) + 1, scan.n_bins)
    provenance: dict[str, Any] = {
        "source": "data_modules.simulate",
        "scan": dataclasses.asdict(scan),
        "sensor": dataclasses.asdict(sensor) | {"kappa": sensor.kappa if np.isfinite(sensor.kappa) else None},
        "seed": seed,
        "detail": detail,
        "light_inside_window": min(float(inside), 1.0),
        "steps": [],
    }
    capture = Capture(
        counts=expected.astype(np.float32) if seed is None else draw_counts(expected, seed),
        laser=laser,
        sensor=point,
        laser_normal=normals,
        sensor_normal=normals,
        bin_length=scan.bin_length,
        t_start=scan.t_start,
        gate=gate,
        scan_shape=scan.scan_shape,
        is_counts=seed is not None,
        provenance=provenance,
    )
    lattice = wall_grid(*truth_shape, scan.width, scan.extent_y)
    truth = view_from_wall(mesh, lattice[:, 0, 0], lattice[0, :, 1], two_sided=two_sided)
    truth = dataclasses.replace(truth, gain=float(gain))
    return capture, dataclasses.replace(truth, clean=clean, expected=expected) if keep_transients else truth
