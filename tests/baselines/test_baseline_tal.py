"""Phasor imaging and f-k migration against y-tal's ``pf`` and ``fk`` on one capture each.

y-tal needs an environment of its own (``make tal``), or one named by ``TAL_PYTHON``; without it these tests
are skipped.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, real_file

from data_modules.readers import read_capture, write_capture
from nlos_lit.baselines import reconstruct
from nlos_lit.capture import Capture
from nlos_lit.capture.aperture import find_lattice
from nlos_lit.capture.volume_grid import VolumeGrid

WAVELENGTH, CYCLES, FIRST, STEP, PLANES = 0.125, 4.0, 0.35, 0.008, 51


def tal_python() -> Path:
    python = Path(os.environ.get("TAL_PYTHON", ROOT / ".venv-tal/bin/python"))
    if not python.exists():
        pytest.skip("y-tal is not installed: `make tal`, or TAL_PYTHON=PYTHON of an environment that has it")
    return python


def captured(name: str) -> Capture:
    """A render of the letter Z on 32×32 spots, its first 300 bins."""
    capture = read_capture(real_file(f"rendered/{name}.hdf5"))
    side = capture.scan_shape[0]
    keep = np.arange(side * side).reshape(side, side)[:: side // 32, :: side // 32].ravel()
    fields = {n: getattr(capture, n)[keep] for n in ("laser", "sensor", "laser_normal", "sensor_normal")}
    counts = np.ascontiguousarray(capture.counts[keep, :300])
    return dataclasses.replace(
        capture, counts=counts, gate=None, scan_shape=(32, 32), scan_order=None, **fields
    )


def by_tal(capture: Capture, folder: Path) -> dict[str, np.ndarray]:
    python = tal_python()
    write_capture(folder / "capture.hdf5", capture)
    options = [str(v) for v in (WAVELENGTH, CYCLES, FIRST, STEP, PLANES)]
    command = [
        str(python),
        str(Path(__file__).with_name("run_tal.py")),
        str(folder / "capture.hdf5"),
        str(folder / "out.npz"),
    ]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    return dict(np.load(folder / "out.npz"))


def grid_of(capture: Capture, first: float, step: float, planes: int) -> VolumeGrid:
    lattice = find_lattice(capture.sensor)
    return VolumeGrid((*lattice.origin[:2], first), (*lattice.pitch, step), (planes, *lattice.shape))


def compare(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, int]:
    """Correlation of the two volumes, and how many voxels their maxima are apart along the worst axis."""
    places = [np.array(np.unravel_index(volume.argmax(), volume.shape)) for volume in (ours, theirs)]
    return float(np.corrcoef(ours.ravel(), theirs.ravel())[0, 1]), int(np.abs(places[0] - places[1]).max())


@pytest.mark.parametrize("name", ["z_single_32_d3", "z_confocal_64_d3"])
def test_phasor_imaging(name, tmp_path):
    capture = captured(name)
    theirs = by_tal(capture, tmp_path)["pf"]
    grid = grid_of(capture, FIRST, STEP, PLANES)
    options = {"wavelength": WAVELENGTH, "cycles": CYCLES, "power": 1.0, "depth_exponent": 0.0}
    correlation, apart = compare(reconstruct(capture, grid, "rsd", **options).numpy(), theirs)
    assert correlation > 0.995
    assert apart <= 1


def test_migration(tmp_path):
    """Plane k of tal lies k + 1/2 half bins away. Its f-k interpolates linearly, ours by splines: side lobes
    along z differ.
    """
    capture = captured("z_confocal_64_d3")
    theirs = by_tal(capture, tmp_path)["fk"][120:240]
    ours = reconstruct(capture, grid_of(capture, 120.5 * 0.003, 0.003, 120), "fk").numpy()
    assert compare(ours, theirs)[0] > 0.78
    assert np.corrcoef(ours.max(0).ravel(), theirs.max(0).ravel())[0, 1] > 0.95
    bright = theirs.max(0) > 0.3 * theirs.max()
    assert bright.sum() > 40
    assert np.abs(ours.argmax(0) - theirs.argmax(0))[bright].max() <= 1
