"""The captures that experiments work on: simulated, rendered, or real.

They are thinned or drawn anew where an experiment asks for it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_modules.readers import read_capture, write_capture
from data_modules.simulate import (
    SCENES,
    Mesh,
    ScanPlan,
    SensorModel,
    bunny_two_albedo,
    load_mesh,
    save_truth,
    simulate_capture,
)
from data_modules.simulate.sensor import draw_counts, respond
from data_modules.simulate.truth import view_from_wall
from nlos_lit.capture import Capture
from nlos_lit.paper.workspace import Subject, Workspace

BACKGROUND = 0.15 / 5000  # counts a bin for each of the mean counts of a spot


@dataclass(frozen=True)
class Size:
    """How large the experiments are.

    Args:
        name: of the size.
        experiment: config of conf/experiment for trainings.
        real: real captures, renders and the bunny are used; otherwise small procedural scenes in their
            places.
        seeds: of Table 1.
        counts: mean counts a spot of the noise ladder.
        minutes: exposures that the real capture is thinned to; the last is the whole file.
        steps: iterations at which progress is shown; the last is the whole training.
        snrs: of the light-cone transforms' sweep.
        effects: sets of effects that are fitted along with the surfels to SU.
        samples: points on a surface for distances.
    """

    name: str
    experiment: str
    real: bool
    seeds: tuple[int, ...]
    counts: tuple[int, ...]
    minutes: tuple[int, ...]
    steps: tuple[int, ...]
    snrs: tuple[float, ...]
    effects: tuple[tuple[str, ...], ...]
    samples: int


SIZES = {
    "full": Size(
        name="full",
        experiment="evidence",
        real=True,
        seeds=(0, 1, 2),
        counts=(50, 200, 800, 3200, 12800),
        minutes=(10, 30, 60, 180),
        steps=(0, 10, 50, 100),
        snrs=(0.001, 0.01, 0.1, 1.0, 10.0),
        effects=(("wall_reflectance", "ambient_map", "afterpulsing"),),
        samples=20_000,
    ),
    "reduced": Size(
        name="reduced",
        experiment="evidence_reduced",
        real=False,
        seeds=(0,),
        counts=(400, 4000),
        minutes=(60, 180),
        steps=(0, 2, 4),
        snrs=(0.01, 1.0),
        effects=(("vignetting",),),
        samples=2_000,
    ),
}


def sensor_of(bin_length: float, counts: float) -> SensorModel:
    """Response of every simulated capture: σ 1 bin, κ 0.6 a bin; background in proportion to the counts.

    Args:
        bin_length: optical path of one bin, m.
        counts: mean third-bounce counts a spot.

    Returns:
        the sensor.

    Examples:
        >>> sensor_of(0.01, 5000.0)
        SensorModel(sigma=0.01, kappa=60.0, background=0.15, mean_counts=5000.0, direct_counts=0.0)
    """
    return SensorModel(
        sigma=bin_length, kappa=0.6 / bin_length, background=BACKGROUND * counts, mean_counts=counts
    )


def bunny(work: Workspace, size: Size) -> Subject:
    """The paper's two-albedo bunny by the own simulator; reduced: the sphere before the plate.

    Args:
        work: where captures are kept; the full size needs the bunny's mesh in its data.
        size: of the experiments.

    Returns:
        the subject, its capture made where it was not there.

    Raises:
        UserError: the mesh is not there.
    """
    if size.real:
        scan = ScanPlan(nx=64, ny=64, width=2.0, bin_length=0.006, n_bins=512, t_start=1.8)
        label = "bunny, own simulator, 64×64 spots over 2 m, 5000 counts a spot"
        return _simulated(work, "bunny", label, _bunny_mesh(work), scan, 5000.0, (0.9, 1.8, 0.005), 0.05)
    return _simulated(
        work, "bunny", "sphere and plate, 16×16", _stand_in(), _small_scan(), 5000.0, (0.5, 1.6, 0.02), 0.05
    )


def noisy_bunny(work: Workspace, size: Size, counts: int) -> Subject:
    """The bunny on a quarter of the spots, at another exposure.

    Args:
        work: as of `bunny`.
        size: of the experiments.
        counts: mean third-bounce counts a spot.

    Returns:
        the subject.

    Raises:
        UserError: the mesh is not there.
    """
    if size.real:
        scan = ScanPlan(nx=32, ny=32, width=2.0, bin_length=0.006, n_bins=512, t_start=1.8)
        label = f"bunny, own simulator, 32×32 spots over 2 m, {counts} counts a spot"
        return _simulated(
            work, f"bunny_{counts}", label, _bunny_mesh(work), scan, counts, (0.9, 1.8, 0.005), 0.2
        )
    label = f"sphere and plate, 16×16, {counts} counts a spot"
    return _simulated(
        work, f"bunny_{counts}", label, _stand_in(), _small_scan(), counts, (0.5, 1.6, 0.02), 0.2
    )


def with_geometry(work: Workspace, size: Size) -> list[Subject]:
    """Independent renders with known surfaces; reduced: none.

    Args:
        work: where captures are kept; its data hold the renders and their meshes.
        size: of the experiments.

    Returns:
        the subjects.

    Raises:
        UserError: a render or mesh is not there.
    """
    if not size.real:
        return []
    return [
        _rendered(work, "z", "z_confocal_64_d3", load_mesh(work.needed("z_mesh.obj")), (0.35, 0.75, 0.004)),
        _rendered(
            work,
            "bunny_render",
            "bunny_confocal_32_d3",
            load_mesh(work.needed("bunny_mesh.obj")),
            (0.9, 1.8, 0.005),
        ),
        _rendered(
            work, "sphere", "sphereplate_single_32_d3", SCENES["sphere_before_plate"](), (0.5, 1.6, 0.005)
        ),
    ]


def exposed(work: Workspace, size: Size, minutes: int) -> Subject:
    """SU (reduced: the simulated letters), its counts thinned binomially to a shorter exposure.

    Args:
        work: where captures are kept; the full size needs SU's file in its data.
        size: of the experiments.
        minutes: exposure, out of those of the size.

    Returns:
        the subject; at the last of the size's exposures the whole file.

    Raises:
        UserError: the file is not there.
    """
    share = minutes / size.minutes[-1]
    settings: tuple[str, ...]
    if size.real:
        source, label = work.needed("data_s_u.mat"), "SU, real, 64×64 spots, bins of 16 ps"
        settings = ("scene=su", "scene.iterations=100")
    else:
        scan = ScanPlan(nx=16, ny=16, width=1.0, bin_length=0.0144, n_bins=170)
        plain = _simulated(
            work, "letters", "letters, 16×16", SCENES["letters"](), scan, 3000.0, (0.4, 1.1, 0.02), 0.2
        )
        source, label, settings = work.path("captures/letters.hdf5"), plain.label, plain.overrides
    settings = tuple(item for item in settings if not item.startswith("scene.path="))
    if share == 1:
        return Subject(f"exposure_{minutes}", label, (*settings, f"scene.path={source.resolve()}"))
    path = work.path(f"captures/exposure_{minutes}.hdf5")
    if not path.exists():
        write_capture(path, thinned(read_capture(source), share, seed=minutes))
    return Subject(
        f"exposure_{minutes}",
        f"{label}, {minutes} of {size.minutes[-1]} min",
        (*settings, f"scene.path={path.resolve()}"),
    )


def real_scenes(work: Workspace, size: Size) -> list[Subject]:
    """Captures of real scenes; reduced: the stand-in for SU.

    Args:
        work: where captures are kept; the full size needs the files in its data.
        size: of the experiments.

    Returns:
        the subjects.

    Raises:
        UserError: a file is not there.
    """
    scenes = [exposed(work, size, size.minutes[-1])]
    if size.real:
        for name, file, label in (
            ("figure_4", "figure_4", "4, real, one detector, 64×64 laser points"),
            ("diffuse_s", "data_diffuse_s.mat", "diffuse S, real, 64×64 spots, strong ambient light"),
        ):
            settings = (f"scene={name}", "scene.iterations=100", f"scene.path={work.needed(file).resolve()}")
            scenes.append(Subject(name, label, settings))
    return scenes


def thinned(capture: Capture, share: float, seed: int) -> Capture:
    """A capture of which every photon is kept with the same probability.

    This is what a shorter exposure would have counted, where nothing saturates.

    Args:
        capture: photon counts.
        share: probability to keep a photon, in [0, 1].
        seed: of the draw.

    Returns:
        the capture with fewer counts; its provenance says so.
    """
    counts = np.random.default_rng(seed).binomial(capture.counts.astype(np.int64), share)
    steps = [*capture.provenance.get("steps", []), f"thinned binomially to {share:.4g}, seed {seed}"]
    return dataclasses.replace(
        capture,
        counts=counts.astype(np.uint16 if counts.max() < 2**16 else np.uint32),
        provenance={**capture.provenance, "steps": steps},
    )


def _small_scan() -> ScanPlan:
    return ScanPlan(nx=16, ny=16, width=1.6, bin_length=0.0144, n_bins=260)


def _bunny_mesh(work: Workspace) -> Mesh:
    return bunny_two_albedo(work.needed("bunny_mesh.obj"))


def _stand_in() -> Mesh:
    mesh = SCENES["sphere_before_plate"]()
    nearer = mesh.corners[:, :, 2].mean(axis=1) < 1.1
    return Mesh.from_face_albedo(mesh.vertices, mesh.faces, np.where(nearer, 1.0, 0.3))


def _settings(path: Path, depth: tuple[float, float, float], threshold: float) -> tuple[str, ...]:
    truth = path.with_name(f"{path.stem}_truth.h5")
    near, far, pitch = depth
    return (
        "scene=capture",
        f"scene.path={path.resolve()}",
        f"scene.truth={truth.resolve()}",
        "scene.sum_bins=1",
        f"scene.volume.depth=[{near},{far}]",
        f"scene.volume.depth_pitch={pitch}",
        f"scene.threshold={threshold}",
    )


def _simulated(
    work: Workspace,
    name: str,
    label: str,
    mesh: Mesh,
    scan: ScanPlan,
    counts: float,
    depth: tuple[float, float, float],
    threshold: float,
) -> Subject:
    path = work.path(f"captures/{name}.hdf5")
    if not path.exists():
        capture, truth = simulate_capture(mesh, scan, sensor_of(scan.bin_length, counts), seed=1)
        save_truth(path.with_name(f"{name}_truth.h5"), truth)
        write_capture(path, capture)
    return Subject(name, label, _settings(path, depth, threshold))


def _rendered(
    work: Workspace,
    name: str,
    file: str,
    mesh: Mesh,
    depth: tuple[float, float, float],
    counts: float = 5000.0,
) -> Subject:
    """An expected-value render as a measurement: response, exposure, background, Poisson counts."""
    path = work.path(f"captures/{name}.hdf5")
    source = read_capture(work.needed(f"{file}.hdf5"))
    assert source.scan_shape is not None
    spots = "×".join(map(str, source.scan_shape))
    label = (
        f"{name.split('_')[0]}, path-traced render, {source.kind}, {spots} spots, {counts:.0f} counts a spot"
    )
    if not path.exists():
        sensor = sensor_of(source.bin_length, counts)
        gain = counts * source.n_spots / source.counts.sum(dtype=np.float64)
        expected = (
            respond(gain * source.counts.astype(np.float64), sensor, source.bin_length) + sensor.background
        )
        side = np.abs(source.sensor[:, :2]).max() * (1 + 1 / source.scan_shape[0])
        lattice = side * (2 * (np.arange(128) + 0.5) / 128 - 1)
        save_truth(path.with_name(f"{name}_truth.h5"), view_from_wall(mesh, lattice, lattice))
        write_capture(path, dataclasses.replace(source, counts=draw_counts(expected, 1), is_counts=True))
    return Subject(name, label, _settings(path, depth, 0.2))
