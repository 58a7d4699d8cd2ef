"""Simulate a capture of a hidden scene: ``python simulate.py scene=letters out=letters.hdf5 nx=64 ny=64``.

Writes OUT, a y-tal HDF5 capture, and OUT's name with ``_truth.h5``: depth, normals and albedo as seen from the wall, and the mesh.
"""

from __future__ import annotations

import dataclasses
import logging
import sys
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from data_modules.readers import write_capture
from data_modules.simulate import SCENES, Mesh, ScanPlan, SensorModel, bunny_two_albedo, load_mesh, save_truth, simulate_capture
from nlos_lit.command import sentence_errors
from nlos_lit.errors import UserError


@dataclasses.dataclass(frozen=True)
class Options:
    """What is simulated, and where it goes."""

    scene: str = "default"
    mesh: str | None = None
    out: str | None = None
    overwrite: bool = False
    seed: int | None = 0
    two_sided: bool = False
    detail: float = 1.0


SECTIONS = (Options, ScanPlan, SensorModel)
SCENE_HELP = f"scene is one of {', '.join(SCENES)}, mesh (with mesh=FILE) or two_albedo (with mesh=FILE)"


def parse(arguments: list[str]) -> tuple[Options, ScanPlan, SensorModel]:
    """``key=value`` arguments, each for the section that has that key."""
    names = [{field.name: field.default for field in dataclasses.fields(section)} for section in SECTIONS]
    keys = ", ".join(f"{key}={value}" for section in names for key, value in section.items())
    given = dict(argument.partition("=")[::2] for argument in arguments)
    for key in given:
        if not any(key in section for section in names):
            raise UserError(f"there is no option {key!r}; the options are key=value, with these defaults: {keys}\n{SCENE_HELP}")
    try:
        merged = (
            OmegaConf.merge(section, OmegaConf.from_dotlist([f"{key}={given[key]}" for key in given if key in own]))
            for section, own in zip(map(OmegaConf.structured, SECTIONS), names, strict=True)
        )
        options, scan, sensor = map(OmegaConf.to_object, merged)
    except OmegaConfBaseException as error:
        raise UserError(f"cannot use {error.full_key}={given.get(error.full_key)}: {str(error).splitlines()[0]}") from error
    return options, scan, sensor


def build(scene: str, mesh: str | None) -> Mesh:
    """The hidden scene an option names."""
    if scene in SCENES and mesh is None:
        return SCENES[scene]()
    if scene in ("mesh", "two_albedo") and mesh is not None:
        return load_mesh(mesh) if scene == "mesh" else bunny_two_albedo(mesh)
    raise UserError(f"found scene={scene} mesh={mesh}; {SCENE_HELP}")


@sentence_errors
def main(arguments: list[str]) -> None:
    options, scan, sensor = parse(arguments)
    if options.out is None:
        raise UserError("say where to write: out=FILE.hdf5")
    out = Path(options.out)
    truth_file = out.with_name(f"{out.stem}_truth.h5")
    for file in (out, truth_file):
        if file.exists() and not options.overwrite:
            raise UserError(f"{file} is already there; take another name or say overwrite=true")
    mesh = build(options.scene, options.mesh)
    capture, truth = simulate_capture(
        mesh, scan, sensor, options.seed, two_sided=options.two_sided, detail=options.detail, progress=True
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_capture(out, capture, overwrite=options.overwrite)
    save_truth(truth_file, truth)
    mean = capture.counts.sum(axis=1).mean()
    print(f"{out}: {capture.kind}, {capture.n_spots} spots × {capture.n_bins} bins, {mean:.0f} counts a spot")
    print(f"{truth_file}: depth, normals and albedo on {truth.depth.shape[0]}×{truth.depth.shape[1]} points, and the mesh")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main(sys.argv[1:])
