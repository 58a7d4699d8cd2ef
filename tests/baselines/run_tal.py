"""Images of y-tal, by the interpreter that has it: CAPTURE OUT.npz WAVELENGTH CYCLES FIRST STEP PLANES.

Leaves arrays pf and, of scans with several laser points, fk.
"""

import sys

import numpy as np


def main() -> None:
    import tal
    from tal.enums import CameraSystem

    capture, out = sys.argv[1:3]
    wavelength, cycles, first, step = (float(v) for v in sys.argv[3:7])
    data = tal.io.read_capture(capture)
    volume = tal.reconstruct.get_volume_project_rw(
        data, depths=[first + step * k for k in range(int(sys.argv[7]))]
    )
    phasor = tal.reconstruct.pf.solve(
        data,
        c_wavelength=wavelength,
        wave_cycles=cycles,
        camera_system=CameraSystem.DIRECT_LIGHT,
        volume=volume,
    )
    results = {"pf": np.moveaxis(np.abs(phasor), -1, 0)}
    if len(data.laser_grid_xyz.reshape(-1, 3)) > 1:
        results["fk"] = tal.reconstruct.fk.solve(tal.io.read_capture(capture))
    np.savez(out, **results)


if __name__ == "__main__":
    main()
