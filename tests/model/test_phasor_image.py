"""The phasor image: what it needs in memory, where a scatterer is imaged."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from small_capture import NORMAL, fields, grid_points

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import MemoryBudgetError
from nlos_lit.capture.volume_grid import VolumeGrid, volume_grid
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.model.phasor import PhasorImaging


def imaging(grid: VolumeGrid, sigma: float = 0.1) -> PhasorImaging:
    return PhasorImaging(
        grid, BoundedParameter(60.0, 30.0, 90.0, "rad/m"), BoundedParameter(sigma, 0.03, 0.2, "m")
    )


def test_memory_budget(monkeypatch):
    capture = Capture(**fields())
    grid = VolumeGrid((-0.2, 0.1, 0.3), (0.1, 0.2, 1e-5), (400_000, 4, 3))
    phasor = imaging(grid)
    full = phasor.plan(capture, 1 << 40)
    voxels = 400_000 * 12
    assert (full.method, full.precision, full.field_bytes) == (
        "lattice",
        torch.float32,
        voxels * 2 * full.rank * 4,
    )
    assert str(full).startswith(
        f"phasor basis by FFT convolution: {full.n_frequencies} frequencies in {full.rank} dimensions"
    )
    half = phasor.plan(capture, full.total_bytes - 1)
    assert (half.precision, half.on_disk, half.field_bytes * 2) == (torch.float16, False, full.field_bytes)
    streamed = phasor.plan(capture, half.total_bytes - 1)
    assert (streamed.precision, streamed.on_disk, streamed.field_bytes) == (
        torch.float32,
        True,
        full.field_bytes,
    )
    assert streamed.total_bytes < half.total_bytes
    assert "GiB float32 on disk +" in str(streamed)
    sentence = (
        r"\(400000, 4, 3\) voxels × \d+ needs .* GiB of memory and .* GiB of temporary disk .* "
        r"the budget is .* GiB"
    )
    with pytest.raises(MemoryBudgetError, match=sentence):
        phasor.plan(capture, streamed.total_bytes - 1)
    monkeypatch.setattr("nlos_lit.model.phasor._free_disk", lambda: full.field_bytes - 1)
    with pytest.raises(MemoryBudgetError, match=sentence):
        phasor.plan(capture, half.total_bytes - 1)


SCATTERER = np.array(
    [0.12, -0.06, 0.523]
)  # on a lateral voxel: elsewhere a slanted path trades lateral offset for depth


def scanned(kind: str) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    points = grid_points(12, 12, (0.06, 0.06), (-0.33, -0.33, 0.0))
    if kind == "confocal":
        return points, points, (12, 12)
    if kind == "mirrored":
        points = points * [-1, 1, 1]
        return points, points, (12, 12)
    if kind == "single_laser":
        return np.tile([-0.21, 0.4, 0.0], (144, 1)), points, (12, 12)
    if kind == "single_sensor":
        return points, np.tile([0.3, 0.1, 0.0], (144, 1)), (12, 12)
    lasers = grid_points(2, 2, (0.5, 0.4), (-0.3, -0.1, 0.0))
    return np.repeat(lasers, 144, axis=0), np.tile(points, (4, 1)), (2, 2, 12, 12)


@pytest.mark.parametrize("kind", ["confocal", "mirrored", "single_laser", "single_sensor", "exhaustive"])
def test_a_scatterer_is_imaged_where_it_is(kind):
    """Within half a voxel in every direction, off-centre and with an offset first bin.

    The pulse is short: the image's slope with depth shifts a maximum by an amount that grows as σ² (1 cm at σ
    = 0.1 m).
    """
    laser, sensor, shape = scanned(kind)
    path = np.linalg.norm(laser - SCATTERER, axis=1) + np.linalg.norm(sensor - SCATTERER, axis=1)
    bin_length, t_start = 0.01, 0.23
    counts = np.zeros((len(path), 220), dtype=np.uint16)
    counts[np.arange(len(path)), np.floor((path - t_start) / bin_length).astype(int)] = 100
    normal = np.tile(NORMAL, (len(path), 1))
    capture = Capture(counts, laser, sensor, normal, normal, bin_length, t_start, scan_shape=shape)
    grid = volume_grid(capture, depth=(0.3, 0.8), depth_pitch=0.01, upsample=2)
    phasor = imaging(grid, sigma=0.05)
    plan = phasor.plan(capture, 1 << 32)
    assert plan.method == "lattice"
    phasor.prepare(capture, plan)
    with torch.no_grad():
        k, i, j = np.unravel_index(int(phasor().argmax()), grid.shape)
    found = np.array([grid.x[i], grid.y[j], grid.z[k]])
    assert (np.abs(found - SCATTERER) <= 0.5 * np.abs(grid.pitch) + 1e-9).all()


def test_everything_made_by_planning_lies_on_the_modules_device():
    """Stands in for a GPU: on the meta device a tensor left behind on the CPU cannot be combined with the
    others.
    """
    phasor = imaging(VolumeGrid((-0.2, 0.1, 0.3), (0.1, 0.2, 0.01), (4, 4, 3))).to("meta")
    phasor.plan(Capture(**fields()), 1 << 40)
    assert phasor.omega.device.type == phasor.basis.device.type == "meta"
