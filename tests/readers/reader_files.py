"""Small asymmetric captures, written in each public format by hand.

One bright bin at one place, in a field of ones.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import scipy.io

C = 299_792_458.0
BRIGHT = 9


def cube(shape: tuple[int, ...], at: tuple[int, ...], dtype: type = np.uint16) -> np.ndarray:
    values = np.ones(shape, dtype=dtype)
    values[at] = BRIGHT
    return values


def matlab73(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """As MATLAB saves with -v7.3: a user block with its text, axes reversed, the class as an attribute."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in arrays.items():
            dataset = file.create_dataset(
                name, data=np.asarray(values).T, compression="gzip" if np.ndim(values) > 1 else None
            )
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def lct(folder: Path) -> Path:
    """4 × 2 spots of a 0.8 m square, bright at the last x and the first y (the top), bin 300."""
    path = folder / "capture.mat"
    scipy.io.savemat(path, {"rect_data": cube((4, 2, 400), (3, 0, 300)), "width": 0.4}, do_compression=True)
    return path


def fk(folder: Path, beside: bool = False) -> Path:
    """2 rows × 4 columns of 2 m × 2 m, bright at the lower row, first column, bin 40.

    5 of the 40 are delay (others: 3).
    """
    delays = np.full((2, 4), 96.0)
    delays[1, 0] = 160.0
    arrays = {"meas": cube((2, 4, 64), (1, 0, 40))}
    if beside:
        scipy.io.savemat(folder / "tof.mat", {"tofgrid": delays})
    else:
        arrays["tofgrid"] = delays
    return matlab73(folder / "scene.mat", arrays)


def phasor_field(folder: Path) -> Path:
    """3 rows × 4 columns 0.02 m apart, bins of 8 ps, bright at the first row, second column.

    The detector is at row 2, column 4.
    """
    arrays = {
        "rect_data": cube((3, 4, 200), (0, 1, 150), np.float64),
        "ts": np.array([[8e-12]]),
        "sampling_spacing": np.array([[0.02]]),
        "aperturefullsize": np.array([[0.04, 0.06]]),
        "SPAD_index": np.array([[2.0, 4.0]]),
    }
    return matlab73(folder / "letters.mat", arrays)


def zaragoza(folder: Path, exhaustive: bool = False, reverse: bool = False) -> Path:
    """Wall y = 0 facing -y; x in (-0.4, 0, 0.4), z in (0, 0.4).

    Camera and laser are at (0, -0.3, 0), so that ways are 0.3 or 0.5 m. Bright at x = 0, z = 0.4 in bin 150
    of 0.01 m. Exhaustive: laser points x in (0, 0.4) at z = 0; bright for the laser at 0.4.
    """
    x, z = np.array([-0.4, 0.0, 0.4]), np.array([0.0, 0.4])
    points = np.stack([*np.broadcast_arrays(x[None, :], 0.0, z[:, None])])
    laser = np.array([[[0.0, 0.4]], [[0.0, 0.0]], [[0.0, 0.0]]])
    normals = np.broadcast_to(np.array([0.0, -1.0, 0.0])[:, None, None], points.shape)
    shape, at = (
        ((1, 200, 2, 2, 3, 1, 2), (0, 150, 1, 1, 1, 0, 1))
        if exhaustive
        else ((1, 200, 2, 2, 3), (0, 150, 1, 1, 1))
    )
    data = np.zeros(shape, dtype=np.float32)
    data[at] = BRIGHT
    arrays = {
        "data": data,
        "cameraGridPositions": points,
        "cameraGridNormals": normals,
        "laserGridPositions": laser if exhaustive else points,
        "laserGridNormals": normals[:, :1, :2] if exhaustive else normals,
        "cameraPosition": np.array([[0.0], [-0.3], [0.0]]),
        "laserPosition": np.array([[0.0], [-0.3], [0.0]]),
        "deltaT": np.array([[0.01]]),
        "t0": np.array([[0.0]]),
        "isConfocal": np.array([[0 if exhaustive else 1]]),
    }
    path = folder / "scene.hdf5"
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values.T if reverse else values
    return path


def radiance(path: Path, picture: np.ndarray, run_length: bool) -> Path:
    """An RGBE picture of grey values that are powers of two times 0.5; runs of equal bytes where asked."""
    rows, columns = picture.shape
    mantissa, exponent = np.frexp(picture)
    grey = np.where(picture > 0, np.rint(mantissa * 256), 0).astype(np.uint8)
    pixels = np.stack([grey] * 3 + [np.where(picture > 0, exponent + 128, 0).astype(np.uint8)], axis=-1)
    body = bytearray()
    for row in pixels:
        if not run_length:
            body += row.tobytes()
            continue
        body += bytes((2, 2, columns >> 8, columns & 255))
        for channel in row.T:
            half = columns // 2
            body += bytes((half,)) + channel[:half].tobytes()  # a literal run, then runs of equal values
            at = half
            while at < columns:
                same = int(np.argmax(np.append(channel[at:] != channel[at], True)))
                body += bytes((128 + same, channel[at]))
                at += same
    path.write_bytes(
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + f"-Y {rows} +X {columns}\n".encode() + bytes(body)
    )
    return path


def chen(folder: Path, run_length: bool = True) -> Path:
    """6 frames of 8 × 8 pixels over 2 m × 2 m, 0.5 in frame 4, third row, second column, else 0.125."""
    frames = np.full((6, 8, 8), 0.125)
    frames[4, 2, 1] = 0.5
    return radiance(folder / "light-1.hdr", frames.reshape(48, 8), run_length)


def ahn(folder: Path, confocal: bool = True) -> Path:
    """Wall at z = 0.6 of the file, object at its origin; laser points (±0.1, ±0.2, 0.6).

    Bright at (0.1, -0.2), bin 33 of 2 mm.
    """
    points = np.array([[x, y, 0.6] for y in (0.2, -0.2) for x in (-0.1, 0.1)])
    sensors = points if confocal else np.array([[0.3, 0.1, 0.6]])
    data = {
        "transient": cube((4, 1, 60), (3, 0, 33)),
        "l": points,
        "s": sensors,
        "is_confocal": float(confocal),
        "target_dist": 0.6,
        "delta": 0.002,
        "obj_name": "spot",
    }
    path = folder / "spot_transient.mat"
    scipy.io.savemat(path, {"NLOSDATA": data})
    return path


def tsai(folder: Path) -> Path:
    """Listed wall points with one transient each; bright at (0.2, -0.1) in bin 33."""
    points = np.array([[x, y, 0.0] for x in (0.2, -0.2) for y in (-0.1, 0.1, 0.3)])
    path = folder / "transient.mat"
    scipy.io.savemat(path, {"transient": cube((6, 60), (0, 33)), "lighting": points})
    return path


def plain_cube(folder: Path) -> Path:
    """4 × 2 spots in a MATLAB v5 file without any unit; bright at the first x and the last y, bin 33."""
    path = folder / "meas.mat"
    scipy.io.savemat(path, {"meas": cube((4, 2, 60), (0, 1, 33))})
    return path


def cid(folder: Path) -> Path:
    """3 × 2 laser points 0.02 m apart, heights falling; detector at (2, 4).

    Bright at (4, 6), bin 33; bins 20–49 full.
    """
    points = np.array([[0, a, b] for a in (0, 2, 4) for b in (6, 4)])
    counts = np.zeros((6, 60), dtype=np.uint16)
    counts[:, 20:50] = 1
    counts[4, 33] = BRIGHT
    for name, values in (("C_i", points), ("C_d", np.tile([0, 2, 4], (6, 1))), ("sub_Sig", counts)):
        scipy.io.savemat(
            folder / f"{name}.mat", {name: values.astype(float) if name != "sub_Sig" else counts}
        )
    return folder / "sub_Sig.mat"


def ytal(folder: Path, **changes: object) -> Path:
    """3 × 2 confocal spots, x in (-0.2, 0, 0.2), y in (-0.1, 0.1), 0.01 m bins from 0.5 m.

    Bright at x = 0.2, y = -0.1, bin 33.
    """
    grid = np.stack(np.meshgrid([-0.2, 0.0, 0.2], [-0.1, 0.1], [0.0], indexing="ij"), axis=-1)[
        :, :, 0
    ].astype(np.float32)
    items = {
        "H": cube((60, 3, 2), (33, 2, 0), np.float32),
        "H_format": np.array([1], dtype=np.int32),
        "sensor_xyz": np.array([0.0, 0.0, 0.3], dtype=np.float32),
        "laser_xyz": np.array([0.0, 0.0, 0.3], dtype=np.float32),
        "sensor_grid_xyz": grid,
        "laser_grid_xyz": grid,
        "sensor_grid_normals": np.broadcast_to(np.array([0, 0, 1]), grid.shape),
        "laser_grid_normals": np.broadcast_to(np.array([0, 0, 1]), grid.shape),
        "sensor_grid_format": np.array([2], dtype=np.int32),
        "laser_grid_format": np.array([2], dtype=np.int32),
        "delta_t": 0.01,
        "t_start": 0.5,
        "t_accounts_first_and_last_bounces": np.bool_(False),
        "volume_format": h5py.Empty(np.float64),
        "scene_info": "name: spot\n",
        **changes,
    }
    path = folder / "capture.hdf5"
    with h5py.File(path, "w") as file:
        for name, values in items.items():
            if values is not None:
                file[name] = values
    return path


WRITERS = {
    "ytal": ytal,
    "lct": lct,
    "fk": fk,
    "phasor_field": phasor_field,
    "zaragoza": zaragoza,
    "chen": chen,
    "ahn": ahn,
    "tsai": tsai,
    "cube": plain_cube,
    "cid": cid,
}
