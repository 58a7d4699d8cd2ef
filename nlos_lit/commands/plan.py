"""What a command will fit of a capture of one's own, and whether that is too much to begin unasked."""

from __future__ import annotations

from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from data_modules.load import planned_scene
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import volume_grid

BYTES = 10**9  # of a volume's 32-bit numbers
HOURS = 1.0
# The most that docs/speed.md measured on one core (256 x 256 spots, a sixth of the rays meet a surface).
SECONDS_A_VOXEL = 25e-6  # once, of the propagation
SECONDS_A_RAY = 4e-6  # of each iteration


def plan(config: DictConfig) -> None:
    """Fill in what the scene leaves to its data; refuse what is very large, unless ``force=true``.

    Args:
        config: of a command, changed in place. One that takes a finished run is left alone.

    Raises:
        UserError: the data are not there or unusable, or the volume or the time is very large.
    """
    if config.get("run") is not None and "criticism" in config:
        return
    scene = cast(dict[str, Any], OmegaConf.to_container(config.scene, resolve=True))
    planned, capture = planned_scene(scene, config.data_dir, config.force)
    if capture is None:
        return
    for key in ("sum_bins", "gate", "volume"):
        OmegaConf.update(config, f"scene.{key}", planned[key], merge=False)
    if config.force:
        return
    voxels = volume_grid(capture, **planned["volume"]).n_voxels
    rays = config.model.rays**2 * config.batch_spots * planned["iterations"] if "batch_spots" in config else 0
    hours = (SECONDS_A_VOXEL * voxels + SECONDS_A_RAY * rays) / 3600
    if 4 * voxels > BYTES or hours > HOURS:
        raise UserError(
            f"a volume of {voxels / 1e6:.3g} million voxels ({4e-9 * voxels:.2g} GB) may take "
            f"{hours:.1f} hours on one core: take fewer depths (scene.volume.depth), planes "
            "(scene.volume.depth_pitch), spots (scene.sum_spots), rays (model.rays) or iterations "
            "(scene.iterations), or say force=true"
        )
