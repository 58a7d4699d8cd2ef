"""Simulate a capture of a hidden scene, with physical effects where they are asked for."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from data_modules.readers import write_capture
from data_modules.simulate import (
    BODIES,
    SCENES,
    Body,
    Mesh,
    ScanPlan,
    SensorModel,
    assemble,
    bodies_from,
    bunny_two_albedo,
    draw_scene,
    load_mesh,
    one_line,
    save_truth,
    simulate_capture,
)
from nlos_lit.capture.errors import UserError
from nlos_lit.runtime.arguments import check_assignments
from nlos_lit.runtime.command_line import sentence_errors
from nlos_lit.runtime.memory import check_disk
from nlos_lit.surfels.measure import measure

SCENE_HELP = (
    f"scene is one of {', '.join(SCENES)}, mesh (with mesh=FILE) or two_albedo (with mesh=FILE); or give "
    f"bodies=[{{kind: sphere, radius: 0.1, at: [0, 0, 0.6]}}, …], kinds {', '.join(b.kind for b in BODIES)}; "
    "or random=SEED"
)


def main(arguments: list[str]) -> int:
    """Run the command with the arguments of its command line; the exit status."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    sentence_errors(simulate)(arguments)
    return 0


@dataclasses.dataclass(frozen=True)
class Options:
    """What is simulated, and where it goes.

    Args:
        scene: a procedural scene, or what is made of ``mesh``.
        bodies: bodies that make up the scene instead, each KEY: VALUE pairs.
        random: seed of a scene drawn at random, with its scan and sensor.
        mesh: file of the scenes ``mesh`` and ``two_albedo``.
        out: the capture's file; must be given.
        overwrite: it may be there already.
        seed: of the photon statistics; None writes expected values.
        two_sided: surfaces reflect on both sides.
        detail: factor on the number of patches.
        exposure: factor on the time each spot is looked at, and so on mean, background and direct counts.
        effects: physical effects, with strengths as ``EFFECT.PARAMETER=VALUE``.
    """

    scene: str = "default"
    bodies: tuple[Any, ...] | None = None
    random: int | None = None
    mesh: str | None = None
    out: str | None = None
    overwrite: bool = False
    seed: int | None = 0
    two_sided: bool = False
    detail: float = 1.0
    exposure: float = 1.0
    effects: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        named = ["scene"] if self.scene != "default" else []
        named += [name for name in ("bodies", "random") if getattr(self, name) is not None]
        if len(named) > 1:
            raise UserError(f"found {' and '.join(named)}; each is a whole scene, so give one of them")
        if self.mesh is not None and named != ["scene"]:
            raise UserError(f"found mesh={self.mesh} without scene=mesh or scene=two_albedo; {SCENE_HELP}")


def strengths(arguments: list[str]) -> dict[str, float]:
    """``EFFECT.PARAMETER`` → value, of the arguments that have a dot in their key."""
    values = {}
    for argument in arguments:
        key, _, value = argument.partition("=")
        if "." in key:
            try:
                values[key] = float(value)
            except ValueError as error:
                raise UserError(f"{key} must be a number; found {value!r}") from error
    return values


def parse(arguments: list[str]) -> tuple[Options, ScanPlan, SensorModel]:
    """Options, scan and sensor from ``key=value`` arguments, each for the section that has that key.

    With ``random=SEED`` what is not given of the scan and the sensor is as drawn.

    Raises:
        UserError: a key that no section has, or a value of the wrong type.

    Examples:
        >>> options, scan, _ = parse(["scene=letters", "nx=8", "effects=pile_up"])
        >>> options.scene, scan.nx, list(options.effects)
        ('letters', 8, ['pile_up'])
    """
    arguments = [argument for argument in arguments if "." not in argument.partition("=")[0]]
    check_assignments("simulate", arguments)
    given = dict(argument.partition("=")[::2] for argument in arguments)
    for key in {"effects", "bodies"} & set(given):
        if not given[key].startswith("["):
            given[key] = f"[{given[key]}]"
    options = cast(Options, _filled(Options, given))
    drawn = None if options.random is None else draw_scene(options.random)
    scan = cast(ScanPlan, _filled(drawn.scan if drawn else ScanPlan, given))
    return options, scan, cast(SensorModel, _filled(drawn.sensor if drawn else SensorModel, given))


def _filled(section: object, given: Mapping[str, str]) -> object:
    """A section with those of the given values that are its own."""
    own = {field.name for field in dataclasses.fields(cast(Any, section))} & set(given)
    try:
        values = [_read(key, given[key]) for key in given if key in own]
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(section), *values))
    except OmegaConfBaseException as error:
        raise UserError(
            f"cannot use {error.full_key}={given.get(error.full_key or '')}: {str(error).splitlines()[0]}"
        ) from error


def _read(key: str, value: str) -> DictConfig:
    try:
        return OmegaConf.from_dotlist([f"{key}={value}"])
    except yaml.YAMLError as error:
        raise UserError(f"cannot read {key}={value}: brackets, braces or quotes do not match") from error


def build(options: Options) -> tuple[Mesh, tuple[Body, ...]]:
    """The hidden scene that the options name.

    Returns:
        the scene, and the bodies it is made of, where it is.

    Raises:
        UserError: there is no such scene or body, or no file where one is needed.
    """
    if options.random is not None:
        drawn = draw_scene(options.random)
        return drawn.mesh(), drawn.bodies
    if options.bodies is not None:
        bodies = bodies_from(options.bodies)
        return assemble(bodies), bodies
    scene, mesh = options.scene, options.mesh
    if scene in SCENES and mesh is None:
        return SCENES[scene](), ()
    if scene in ("mesh", "two_albedo") and mesh is not None:
        return load_mesh(mesh) if scene == "mesh" else bunny_two_albedo(mesh), ()
    raise UserError(f"found scene={scene} mesh={mesh}; {SCENE_HELP}")


def exposed(sensor: SensorModel, exposure: float) -> SensorModel:
    """The sensor, looking longer; counts per laser cycle, and so pile-up, stay what they are.

    Args:
        sensor: as it is for an exposure of 1.
        exposure: factor on the time.

    Returns:
        The sensor with as many times the counts.
    """
    counts = ("mean_counts", "background", "direct_counts")
    return dataclasses.replace(sensor, **{name: exposure * getattr(sensor, name) for name in counts})


def simulate(arguments: list[str]) -> None:
    """Write the capture that ``key=value`` arguments describe, and its truth beside it.

    Raises:
        UserError: the arguments make no sense, or a file is already there.
    """
    options, scan, sensor = parse(arguments)
    values = strengths(arguments)
    if values and not options.effects:
        raise UserError(
            f"found {next(iter(values))}=… but no effects; name them: "
            f"effects=[{next(iter(values)).partition('.')[0]}]"
        )
    if options.out is None:
        raise UserError("say where to write: out=FILE.hdf5")
    out = Path(options.out)
    truth_file = out.with_name(f"{out.stem}_truth.h5")
    for file in (out, truth_file):
        if file.exists() and not options.overwrite:
            raise UserError(f"{file} is already there; take another name or say overwrite=true")
    check_disk(out.parent, math.prod(scan.scan_shape) * scan.n_bins, str(out))  # packed, about a byte a bin
    mesh, bodies = build(options)
    if options.random is not None:
        print(one_line(bodies))
    sensor = exposed(sensor, options.exposure)
    how: dict[str, Any] = {"two_sided": options.two_sided, "detail": options.detail, "progress": True}
    if options.effects:
        capture, truth = measure(
            mesh, scan, sensor, options.seed, options.effects, values, exposure=options.exposure, **how
        )
    else:
        capture, truth = simulate_capture(mesh, scan, sensor, options.seed, **how)
    told = {"exposure": options.exposure} | ({"bodies": [body.config() for body in bodies]} if bodies else {})
    capture = dataclasses.replace(capture, provenance=capture.provenance | told)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_capture(out, capture, overwrite=options.overwrite)
    save_truth(truth_file, truth)
    mean = capture.counts.sum(axis=1).mean()
    print(f"{out}: {capture.kind}, {capture.n_spots} spots × {capture.n_bins} bins, {mean:.0f} counts a spot")
    nx, ny = truth.depth.shape
    print(f"{truth_file}: depth, normals and albedo on {nx}×{ny} points, and the mesh")
