"""Simulate a capture of a hidden scene, with physical effects where they are asked for."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from data_modules.readers import write_capture
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
from nlos_lit.capture.errors import UserError
from nlos_lit.effects import EFFECTS
from nlos_lit.surfels.measure import measure


@dataclasses.dataclass(frozen=True)
class Options:
    """What is simulated, and where it goes.

    Args:
        scene: a procedural scene, or what is made of ``mesh``.
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
    mesh: str | None = None
    out: str | None = None
    overwrite: bool = False
    seed: int | None = 0
    two_sided: bool = False
    detail: float = 1.0
    exposure: float = 1.0
    effects: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 0 < self.exposure < float("inf"):
            raise UserError(f"exposure must be above 0; found {self.exposure}")


SECTIONS = (Options, ScanPlan, SensorModel)
SCENE_HELP = f"scene is one of {', '.join(SCENES)}, mesh (with mesh=FILE) or two_albedo (with mesh=FILE)"


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

    Raises:
        UserError: a key that no section has, or a value of the wrong type.

    Examples:
        >>> options, scan, _ = parse(["scene=letters", "nx=8", "effects=pile_up"])
        >>> options.scene, scan.nx, list(options.effects)
        ('letters', 8, ['pile_up'])
    """
    arguments = [argument for argument in arguments if "." not in argument.partition("=")[0]]
    names = [{field.name: field.default for field in dataclasses.fields(section)} for section in SECTIONS]
    keys = ", ".join(f"{key}={value}" for section in names for key, value in section.items())
    given = dict(argument.partition("=")[::2] for argument in arguments)
    if "effects" in given and not given["effects"].startswith("["):
        given["effects"] = f"[{given['effects']}]"
    for key in given:
        if not any(key in section for section in names):
            raise UserError(
                f"there is no option {key!r}; the options are key=value, with these defaults: {keys}\n"
                f"{SCENE_HELP}\n"
                f"effects are {', '.join(EFFECTS.names)}, their strengths EFFECT.PARAMETER=VALUE"
            )
    try:
        merged = (
            OmegaConf.merge(
                section, OmegaConf.from_dotlist([f"{key}={given[key]}" for key in given if key in own])
            )
            for section, own in zip(map(OmegaConf.structured, SECTIONS), names, strict=True)
        )
        options, scan, sensor = map(OmegaConf.to_object, merged)
    except OmegaConfBaseException as error:
        raise UserError(
            f"cannot use {error.full_key}={given.get(error.full_key or '')}: {str(error).splitlines()[0]}"
        ) from error
    return cast(Options, options), cast(ScanPlan, scan), cast(SensorModel, sensor)


def build(scene: str, mesh: str | None) -> Mesh:
    """The hidden scene that the options name.

    Args:
        scene: a procedural scene, ``mesh`` or ``two_albedo``.
        mesh: file of the latter two; None for the others.

    Returns:
        The scene.

    Raises:
        UserError: there is no such scene, or no file where one is needed.
    """
    if scene in SCENES and mesh is None:
        return SCENES[scene]()
    if scene in ("mesh", "two_albedo") and mesh is not None:
        return load_mesh(mesh) if scene == "mesh" else bunny_two_albedo(mesh)
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
    mesh = build(options.scene, options.mesh)
    sensor = exposed(sensor, options.exposure)
    how: dict[str, Any] = {"two_sided": options.two_sided, "detail": options.detail, "progress": True}
    if options.effects:
        capture, truth = measure(
            mesh, scan, sensor, options.seed, options.effects, values, exposure=options.exposure, **how
        )
    else:
        capture, truth = simulate_capture(mesh, scan, sensor, options.seed, **how)
    capture = dataclasses.replace(capture, provenance={**capture.provenance, "exposure": options.exposure})
    out.parent.mkdir(parents=True, exist_ok=True)
    write_capture(out, capture, overwrite=options.overwrite)
    save_truth(truth_file, truth)
    mean = capture.counts.sum(axis=1).mean()
    print(f"{out}: {capture.kind}, {capture.n_spots} spots × {capture.n_bins} bins, {mean:.0f} counts a spot")
    nx, ny = truth.depth.shape
    print(f"{truth_file}: depth, normals and albedo on {nx}×{ny} points, and the mesh")
