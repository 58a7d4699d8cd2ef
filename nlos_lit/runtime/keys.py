"""Every key of every config, with the type, range and unit of its value.

What a key means stands beside it in ``conf/`` and in the docstrings of the settings that ``conf/`` names. A
test holds this table to the composed configs: no key without a rule, no rule without a key.
"""

from __future__ import annotations

from nlos_lit.runtime.schema import (
    FILE,
    FLAG,
    NAME,
    SETTINGS,
    SIZE,
    TEXT,
    Rule,
    either,
    many,
    number,
    optional,
    whole,
    word,
    zero_or,
)

FORMATS = ("auto", "ytal", "lct", "fk", "phasor_field", "zaragoza", "chen", "tsai_ahn", "cid")
METHODS = ("rsd", "lct", "dlct", "fk", "bp", "fbp")
MESHES = ("default", "letters", "sphere_before_plate")

_fraction = number(0, 1, above=True, below=True)
_rate = number(0, 100)
_weight = number(0, 1e6)
_length = number(0, 1000, "m", above=True)
_wavelength = optional(number(1e-4, 100, "m"))
_factors = many(number(1e-3, 1e3), 2, ascending=True)
_pair = many(whole(0), 2, ascending=True)

COMMON: dict[str, Rule] = {
    "seed": whole(0, 2**32 - 1),
    "threads": optional(whole(1, 1024)),
    "data_dir": TEXT,
    "memory_budget": SIZE,
    "force": FLAG,
}
SCAN: dict[str, Rule] = {
    "kind": word("confocal", "single", "exhaustive"),
    "nx": whole(1, 10_000),
    "ny": whole(1, 10_000),
    "width": _length,
    "height": optional(_length),
    "bin_length": number(0, 10, "m", above=True),
    "n_bins": whole(1, 1_000_000),
    "t_start": number(-1e4, 1e4, "m"),
    "fixed": word("laser", "sensor"),
    "fixed_point": many(number(-1000, 1000, "m"), 2),
    "gate": optional(_pair),
    "wall_albedo": number(0, 1, above=True),
}
SENSOR: dict[str, Rule] = {
    "sigma": number(0, 100, "m"),
    "kappa": either(number(0, 1e9, "1/m", above=True), Rule("infinite", lambda v: v == float("inf"))),
    "background": number(0, 1e9, "counts a bin"),
    "mean_counts": number(0, 1e12, "counts a spot", above=True),
    "direct_counts": number(0, 1e12, "counts a spot"),
}
SCENE: dict[str, Rule] = {
    "name": NAME,
    "path": optional(FILE),
    "format": word(*FORMATS),
    "source": optional(SETTINGS),
    "source.file": TEXT,
    "source.origin": TEXT,
    "source.url": optional(TEXT),
    "source.sha256": optional(TEXT),
    "simulate": optional(SETTINGS),
    "simulate.mesh": word(*MESHES),
    **{f"simulate.scan.{key}": rule for key, rule in SCAN.items()},
    **{f"simulate.sensor.{key}": rule for key, rule in SENSOR.items()},
    "truth": optional(FILE),
    "reader.bin_width_ps": optional(number(0, 1e6, "ps", above=True)),
    "reader.wall_size": optional(either(_length, many(_length, 2))),
    "reader.t_start": optional(number(-1e4, 1e4, "m")),
    "reader.flip_x": optional(FLAG),
    "reader.flip_y": optional(FLAG),
    "reader.swap_xy": optional(FLAG),
    "reader.scan_order": optional(either(word("raster", "serpentine", "columns"), many(whole(0)))),
    "reader.exposure_s": optional(number(0, 1e9, "s", above=True)),
    "reader.raw_scale": optional(FLAG),
    "reader.counts": optional(FLAG),
    "reader.observed": optional(word("all")),
    "gate": optional(_pair),
    "sum_bins": optional(whole(1, 100_000, "bins")),
    "sum_spots": whole(1, 10_000, "spots"),
    "volume.depth": optional(many(_length, 2, ascending=True)),
    "volume.depth_pitch": optional(number(1e-5, 10, "m")),
    "volume.upsample": whole(1, 64),
    "volume.lateral": optional(many(whole(1, 10_000, "voxels"), 2)),
    "falloff": number(0, 8),
    "threshold": _fraction,
    "wavelength": _wavelength,
    "iterations": whole(1, 10_000_000),
}
MODEL: dict[str, Rule] = {
    "threshold": _fraction,
    "rays": whole(4, 10_000),
    "step_bins": number(0.01, 100, "bins"),
    "beta": number(0, 1e12, above=True),
    "fine": whole(1, 1000),
    "relative_beta": FLAG,
    "power": number(0, 10, above=True),
    "depth_exponent": number(-10, 10),
    "wavelength": _wavelength,
    "wavelength_start": number(0.01, 100),
    "sigma_start": number(0.01, 100),
    "wavelength_range": _factors,
    "sigma_range": _factors,
    "albedo": word("free", "residual"),
    "albedo_start": number(0, 1),
    "splat_sigma": number(0.01, 100, "bins"),
    "conserve_energy": FLAG,
    "subtract_splat": FLAG,
    "jitter_fwhm_ps": number(0, 1e5, "ps"),
    "decay_per_bin": number(0.01, 50, "1/bin"),
    "background_start": optional(number(0, 0.5)),
    "basis_tolerance": number(1e-10, 0.5),
}
SURFELS: dict[str, Rule] = {
    "floor": _fraction,
    "significance": number(0, 1000),
    "per_cell": whole(1, 1000),
    "max_seeds": whole(1, 10_000_000),
    "subdivide": optional(whole(1, 64)),
    "most": whole(1, 10_000_000),
    "quadrature": optional(whole(1, 64)),
    "contest": whole(0, 1_000_000, "batches"),
    "rounds": whole(1, 10_000),
    "outlines": whole(0, 10_000, "rounds"),
    "steps": whole(1, 1_000_000, "batches"),
    "more": whole(0, 10_000, "rounds"),
    "batch": whole(1, 1_000_000, "spots"),
    "depth_rate": number(0, 100, "bins"),
    "albedo_rate": _rate,
    "opacity_rate": _rate,
    "roll_rate": _rate,
    "response_rate": _rate,
    "effect_rate": _rate,
    "bending": _weight,
    "evenness": _weight,
    "brightness": _weight,
    "lean": number(0, 1e6, "nats"),
    "surfel_cost": number(0, 1e6, "nats"),
    "test_spots": whole(1, 10_000_000, "spots"),
    "visibility": FLAG,
}
CRITICISM: dict[str, Rule] = {
    "spots": whole(1, 10_000_000),
    "level": _fraction,
    "share": number(0, 1),
    "form": number(0, 1),
    "rivals": whole(0, 1000),
    "open_share": number(0, 1),
    "odds": number(0, 1),
    "most": whole(0, 1000),
    "toys": whole(0, 1_000_000),
    "processes": whole(1, 1024),
}
_count = optional(whole(0))
_part = optional(either(whole(0), number(0, 1)))
TRAINER: dict[str, Rule] = {
    "accelerator": either(word("auto", "cpu", "gpu", "cuda", "mps", "tpu"), SETTINGS),
    "strategy": either(TEXT, SETTINGS),
    "devices": either(word("auto"), whole(-1), TEXT, many(whole(0))),
    "num_nodes": whole(1, 100_000),
    "precision": optional(either(TEXT, word("16", "32", "64"), whole(16, 64))),
    "fast_dev_run": either(FLAG, whole(0)),
    "max_epochs": optional(whole(-1)),
    "min_epochs": _count,
    "max_steps": whole(-1),
    "min_steps": _count,
    "max_time": optional(either(TEXT, SETTINGS)),
    "limit_train_batches": _part,
    "limit_val_batches": _part,
    "limit_test_batches": _part,
    "limit_predict_batches": _part,
    "overfit_batches": either(whole(0), number(0, 1)),
    "val_check_interval": optional(either(whole(1), number(0, 1, above=True), TEXT, SETTINGS)),
    "check_val_every_n_epoch": optional(whole(1)),
    "num_sanity_val_steps": optional(whole(-1)),
    "log_every_n_steps": optional(whole(0)),
    "enable_checkpointing": optional(FLAG),
    "enable_progress_bar": optional(FLAG),
    "enable_model_summary": optional(FLAG),
    "accumulate_grad_batches": whole(1),
    "gradient_clip_val": optional(number(0, 1e12)),
    "gradient_clip_algorithm": optional(word("norm", "value")),
    "deterministic": optional(either(FLAG, word("warn"))),
    "benchmark": optional(FLAG),
    "inference_mode": FLAG,
    "use_distributed_sampler": FLAG,
    "profiler": optional(either(word("simple", "advanced", "pytorch", "xla"), SETTINGS)),
    "detect_anomaly": FLAG,
    "barebones": FLAG,
    "plugins": optional(either(TEXT, SETTINGS, many(SETTINGS))),
    "sync_batchnorm": FLAG,
    "reload_dataloaders_every_n_epochs": whole(0),
    "default_root_dir": optional(TEXT),
    "enable_autolog_hparams": FLAG,
    "model_registry": optional(TEXT),
    "_target_": TEXT,
}
# What a run that goes on may do otherwise, where it is told to: it stays the same model of the same spots.
CHANGEABLE = (
    "batch_spots",
    "objective.albedo_planes",
    "objective.lambda_albedo",
    "objective.lambda_sparsity",
    "optimizer.clip",
    "optimizer.rates.albedo",
    "optimizer.rates.phasor",
    "optimizer.rates.sensor",
)
TRAIN: dict[str, Rule] = {
    "folder": TEXT,
    "fit": word("volume", "surface"),
    "run": optional(FILE),
    "refine": FLAG,
    "effects": either(many(TEXT), TEXT),
    "resume.change": many(word(*CHANGEABLE)),
    "ckpt_path": optional(either(word("last"), FILE)),
    "shard_field": FLAG,
    "batch_spots": whole(1, 10_000_000, "spots"),
    "heldout.block": whole(1, 10_000, "spots"),
    "heldout.every": zero_or(whole(2, 10_000)),
    "heldout.monitor_spots": whole(1, 10_000_000, "spots"),
    "heldout.imaging": FLAG,
    "export.spots": whole(1, 10_000_000),
    "export.transients": whole(1, 1000),
    "export.mesh_depth": whole(1, 14),
    "objective.lambda_sparsity": _weight,
    "objective.lambda_albedo": _weight,
    "objective.albedo_planes": optional(whole(1, 1_000_000, "planes")),
    "optimizer.rates.phasor": _rate,
    "optimizer.rates.sensor": _rate,
    "optimizer.rates.albedo": _rate,
    "optimizer.clip": optional(number(0, 1e12, above=True)),
    "ablation.name": NAME,
    "ablation.optimise.phasor": FLAG,
    "ablation.optimise.albedo": FLAG,
    "ablation.optimise.sensor": FLAG,
}
METHOD: dict[str, Rule] = {
    "name": word(*METHODS),
    "options.wavelength": _wavelength,
    "options.cycles": number(0, 1000, above=True),
    "options.power": number(0, 10, above=True),
    "options.depth_exponent": number(-10, 10),
    "options.snr": number(0, 1e12, above=True),
    "options.falloff": number(0, 8),
}
SIMULATE: dict[str, Rule] = {
    "scene": word(*MESHES, "mesh", "two_albedo"),
    "bodies": optional(either(many(SETTINGS), SETTINGS)),
    "random": optional(whole(0)),
    "mesh": optional(FILE),
    "out": optional(TEXT),
    "overwrite": FLAG,
    "seed": optional(whole(0, 2**32 - 1)),
    "two_sided": FLAG,
    "detail": number(0, 100, above=True),
    "exposure": number(0, 1e12, above=True),
    "effects": either(many(TEXT), TEXT),
    **SCAN,
    **SENSOR,
}


def _below(section: str, rules: dict[str, Rule]) -> dict[str, Rule]:
    return {f"{section}.{key}": rule for key, rule in rules.items()}


_scene = COMMON | _below("scene", SCENE)
_modelled = _scene | _below("model", MODEL) | _below("surfels", SURFELS)
KEYS: dict[str, dict[str, Rule]] = {
    "train": _modelled | _below("trainer", TRAINER) | TRAIN,
    "diagnose": _modelled
    | _below("criticism", CRITICISM)
    | {"run": optional(FILE), "split_with": optional(FILE)},
    "reconstruct": _scene | _below("method", METHOD),
    "simulate": SIMULATE,
}
# Sections that name a class with its arguments, which that class checks when it is built.
FOREIGN_SECTIONS = ("callbacks", "logger", "optimizer.method")
