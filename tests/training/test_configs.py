"""Every config composes, every key is read by something, and no default is stated twice."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import forked
import numpy as np
import pytest
import torch
from conftest import ROOT
from hydra.errors import ConfigCompositionException
from hydra.utils import get_class
from omegaconf import OmegaConf

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import volume_grid
from nlos_lit.commands.train import make_trainer
from nlos_lit.model.build import PipelineSettings
from nlos_lit.model.objective import Objective
from nlos_lit.places import CONF
from nlos_lit.runtime.arguments import check_config
from nlos_lit.runtime.keys import FOREIGN_SECTIONS, KEYS
from nlos_lit.surfels.fit import SurfelSettings
from nlos_lit.training.configs import SETTINGS, compose, run_config, settings_of
from nlos_lit.training.folder import file_name


def names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml") if not path.stem.startswith("_"))


def composed(*overrides: str, command: str = "train") -> dict:
    return compose(command, [re.sub(r"^scene=(\d+)$", r"scene='\1'", override) for override in overrides])


GROUPS = {
    "train": (
        "scene", "model", "objective", "optimizer", "profile", "ablation", "trainer", "callbacks", "logger",
        "surfels", "experiment",
    ),
    "diagnose": ("scene", "model", "surfels", "criticism"),
    "reconstruct": ("scene", "method"),
}  # fmt: skip


def test_every_group_is_looked_at():
    assert {path.name for path in CONF.iterdir() if path.is_dir()} == {"hydra"}.union(*GROUPS.values())


@functools.cache
def all_composed() -> dict[tuple[str, str, str], dict]:
    """Config of each command with each choice of each group."""
    return {
        (command, group, name): composed(f"{group}={name}", command=command)
        for command, groups in GROUPS.items()
        for group in groups
        for name in names(group)
    }


def test_every_config_composes():
    for choice, config in all_composed().items():
        planned = choice[1:] == ("scene", "capture")  # from its data
        assert (config["scene"]["volume"]["depth"] is None) == planned, choice


@pytest.mark.parametrize("scene", names("scene"))
def test_scene_configs_have_the_same_keys_and_their_own_name(scene):
    config = composed(f"scene={scene}")["scene"]
    assert set(config) == set(composed()["scene"])
    assert config["name"] == scene


def test_the_papers_scenes_are_there_with_its_thresholds_and_iterations():
    table = {
        "bunny": 100,
        "dragon": 100,
        "erato": 100,
        "indonesian": 150,
        "34": 300,
        "bike": 170,
        "resolution": 300,
        "su": 200,
    }
    table |= {"44i": 150, "nlos": 180}
    for scene, iterations in table.items():
        config = composed(f"scene={scene}")["scene"]
        assert config["iterations"] == iterations
        assert config["threshold"] == (0.05 if scene in ("bunny", "dragon", "erato", "indonesian") else 0.2)


def test_volumes_have_the_papers_numbers_of_planes():
    table = {
        "bunny": 201,
        "dragon": 128,
        "erato": 128,
        "indonesian": 128,
        "34": 105,
        "bike": 64,
        "resolution": 26,
    }
    table |= {"44i": 417, "nlos": 417}
    for scene, planes in table.items():
        volume = composed(f"scene={scene}")["scene"]["volume"]
        assert planes_of(volume) == planes
    full = composed("scene=su", "scene.sum_bins=1", "scene.volume.depth_pitch=0.0012")["scene"]["volume"]
    assert planes_of(full) == 584


def planes_of(volume: dict) -> int:
    near, far = volume["depth"]
    capture = Capture(
        np.ones((4, 4)), *[CORNERS] * 2, *[np.tile([0.0, 0.0, 1.0], (4, 1))] * 2, bin_length=2.0
    )
    return volume_grid(capture, depth=(near, far), depth_pitch=volume["depth_pitch"]).shape[0]


CORNERS = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]], dtype=float)


def leaves(config: dict, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path of keys → value, of everything that is no group."""
    for key, value in config.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, (*above, key))
        else:
            yield (*above, key), value


def readers(config: dict, path: tuple[str, ...]) -> tuple[str, ...] | None:
    """Names that the class which takes a key accepts; None where code reads the key by its name."""
    for depth in range(len(path) - 1, 0, -1):
        node = config
        for key in path[:depth]:
            node = node[key]
        if "_target_" in node:
            assert depth == len(path) - 1, f"{path}: below the arguments of {node['_target_']}"
            return (*inspect.signature(get_class(node["_target_"])).parameters, "_target_")
    if path[0] in SETTINGS:
        return tuple(field.name for field in dataclasses.fields(SETTINGS[path[0]]))
    return Objective._fields if path[0] == "objective" else None


@pytest.mark.parametrize("command", GROUPS)
def test_every_key_has_a_rule_and_every_value_keeps_it(command):
    seen = set()
    for config in (config for (of, *_), config in all_composed().items() if of == command):
        check_config(command, OmegaConf.create(config))
        seen |= {".".join(path) for path, value in leaves(config) if value != {}}
    rules = KEYS[command]
    assert {key for key in seen - set(rules) if not key.startswith(FOREIGN_SECTIONS)} == set()
    # Of what a scene may simulate, and of what it comes from, no config says all.
    assert {
        key for key in set(rules) - seen if not key.startswith(("scene.simulate", "scene.source"))
    } == set()


def test_no_key_that_nothing_reads():
    modules = [path for folder in ("nlos_lit", "data_modules") for path in (ROOT / folder).rglob("*.py")]
    sources = "".join(path.read_text() for path in modules if path.name != "keys.py")  # it lists, not reads
    used = "".join(re.findall(r"\$\{[\w.]+\}", "".join(path.read_text() for path in CONF.rglob("*.yaml"))))
    words = set(re.findall(r"\w+", sources + used))
    seen, unread = set(), set()
    for config in all_composed().values():
        for path, _ in leaves(config):
            seen.add(path[-1])
            accepted = readers(config, path)
            if path[-1] not in (words if accepted is None else accepted):
                unread.add(".".join(path))
    assert {
        "effects",
        "refine",
        "fit",
        "toys",
        "run",
        "threads",
        "iterations",
        "precision",
        "dirpath",
    } <= seen
    assert unread == set()


def stated(path: Path) -> Iterator[tuple[str, Any, Any]]:
    """Key, value and default of what a config file says about a class."""
    config = OmegaConf.to_container(OmegaConf.load(path))
    kind = SETTINGS.get(path.parent.name)
    if kind is not None:
        defaults = {field.name: field.default for field in dataclasses.fields(kind)}
        yield from ((key, value, defaults[key]) for key, value in config.items() if key != "defaults")
    for node in (config, *config.values()):
        if isinstance(node, dict) and "_target_" in node:
            parameters = inspect.signature(get_class(node["_target_"])).parameters
            yield from ((k, v, parameters[k].default) for k, v in node.items() if k in parameters)


def test_no_default_is_stated_twice():
    """A class states its defaults; a config says what differs."""
    looked_at = 0
    for path in CONF.glob("*/*.yaml"):
        for key, value, default in stated(path):
            looked_at += 1
            assert value != (list(default) if isinstance(default, tuple) else default), f"{path.name}: {key}"
    assert looked_at > 30


def test_wrong_types_and_unknown_settings_are_refused():
    for group, key in (("model", "rays"), ("surfels", "steps"), ("criticism", "spots")):
        command = "diagnose" if group == "criticism" else "train"
        with pytest.raises(ConfigCompositionException):
            composed(f"{group}.{key}=many", command=command)
        with pytest.raises(ConfigCompositionException):
            composed(f"{group}.{key}s_=3", command=command)
        added = composed(f"+{group}.nothing=3", command=command)[group]
        with pytest.raises(UserError, match=f"{group} has no setting 'nothing'; there are .*{key}"):
            settings_of(SETTINGS[group], added, group)
    with pytest.raises(UserError, match=r"model is incomplete: .*threshold"):
        settings_of(PipelineSettings, {"rays": 20}, "model")


def test_groups_are_the_settings_that_read_them():
    readers = [("criticism", "diagnose"), ("surfels", "train"), ("surfels", "diagnose")]
    for group, command in readers:
        for name in names(group):
            section = composed(f"{group}={name}", command=command)[group]
            assert isinstance(settings_of(SETTINGS[group], section, name), SETTINGS[group])


DEFAULT = {
    "threshold": 0.2, "rays": 200, "step_bins": 1.0, "beta": 1000.0, "fine": 4, "relative_beta": True,
    "power": 1.0, "depth_exponent": 2.0, "wavelength": None, "wavelength_start": 0.8, "sigma_start": 1.2,
    "wavelength_range": [0.6667, 2.0], "sigma_range": [0.33, 1.5], "basis_tolerance": 1e-4,
    "albedo": "free", "albedo_start": 0.5, "splat_sigma": 0.62, "conserve_energy": True,
    "subtract_splat": True, "jitter_fwhm_ps": 40.0, "decay_per_bin": 5.0, "background_start": None,
}  # fmt: skip
PAPER = DEFAULT | {
    "fine": 1, "relative_beta": False, "power": 2.0, "depth_exponent": 0.0, "conserve_energy": False,
    "subtract_splat": False, "background_start": 1e-3,
}  # fmt: skip
CODE = DEFAULT | {
    "fine": 1, "relative_beta": False, "albedo": "residual", "conserve_energy": False, "splat_sigma": 0.425,
    "subtract_splat": False, "background_start": 1e-3,
}  # fmt: skip


@pytest.mark.parametrize(
    ("profile", "model", "sparsity", "clip"),
    [
        ("default", DEFAULT, 3e-3, None),
        ("paper", PAPER, 100.0, None),
        ("reference_code", CODE, 100.0, 10.0),
        ("surface", DEFAULT, 3e-3, None),
    ],
)
def test_a_profile_sets_model_objective_and_optimiser(profile, model, sparsity, clip):
    config = composed(f"model={profile}")
    assert config["model"] == model
    assert config["objective"] == {"lambda_sparsity": sparsity, "lambda_albedo": 5e-3, "albedo_planes": 64}
    assert config["optimizer"] == {
        "rates": {"phasor": 0.05, "sensor": 0.1, "albedo": 0.3},
        "clip": clip,
        "method": {"_target_": "torch.optim.Adam"},
    }
    assert config["trainer"]["gradient_clip_val"] == clip
    assert composed(f"model={profile}", command="diagnose")["model"] == model
    assert composed(f"model={profile}", "optimizer.clip=3")["optimizer"]["clip"] == 3
    assert config["fit"] == ("surface" if profile == "surface" else "volume")
    assert set(names("model")) == {"default", "paper", "reference_code", "surface"}


def test_the_base_of_a_diagnosis_is_the_surface_of_a_run_but_for_how_it_divides_and_moves():
    """tests/blind and these configs speak of the same base."""
    assert composed()["surfels"] == dataclasses.asdict(SurfelSettings())
    assert composed(command="diagnose")["surfels"] == dataclasses.asdict(SurfelSettings(most=2400))


def test_experiments_and_trainers_overrule_what_train_says():
    quick, ddp = composed("experiment=quick"), composed("trainer=ddp")
    assert (quick["batch_spots"], quick["heldout"]["monitor_spots"], quick["model"]["rays"]) == (16, 32, 64)
    assert composed("experiment=evidence")["logger"] == {}
    assert composed("experiment=quick", "batch_spots=3")["batch_spots"] == 3
    assert (ddp["threads"], ddp["trainer"]["strategy"], ddp["trainer"]["devices"]) == (1, "ddp", 2)
    assert composed("trainer=ddp", "threads=2")["threads"] == 2


def test_a_trainer_as_the_config_says(tmp_path):
    settings = composed(f"folder={tmp_path}", "scene.iterations=7", "optimizer.clip=2", "logger=csv")
    trainer = make_trainer(settings)
    assert (trainer.max_epochs, trainer.check_val_every_n_epoch, trainer.gradient_clip_val) == (7, 10, 2)
    assert [type(c).__name__ for c in trainer.callbacks] == [
        "ScoreHeldout",
        "History",
        "ProgressBar",
        "Figures",
        "Explore",
        "Checkpoint",
    ]
    checkpoint = trainer.callbacks[-1]
    assert (checkpoint.folder, checkpoint.each) == (tmp_path / "checkpoints", False)
    assert checkpoint.pace.every is None
    assert [type(logger).__name__ for logger in trainer.loggers] == ["CSVLogger"]
    assert make_trainer(composed("logger=none", "trainer.max_epochs=3")).loggers == []
    both = make_trainer(composed("trainer.precision=64-true", "+trainer.max_time=00:01:00:00"))
    assert both.precision == "64-true"
    assert type(both.loggers[0]).__name__ == "TensorBoardLogger"


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (["+trainer.nothing=1"], "trainer has no argument 'nothing'; .*takes .*precision"),
        (["trainer.precision=nothing"], "Trainer cannot be made: .*nothing"),
        pytest.param(
            ["trainer=gpu"],
            "Trainer cannot be made: No supported gpu",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has what is asked for"),
        ),
        (["+trainer.callbacks=[]"], "trainer.callbacks is not read"),
        (["+callbacks.figures.size=3"], "callbacks.figures has no argument 'size'"),
        (["+logger.tensorboard.nothing._target_=os.system"], "nothing._target_=os.system is not built"),
    ],
)
def test_what_a_trainer_cannot_use_is_one_sentence(overrides, sentence):
    with pytest.raises(UserError, match=sentence):
        make_trainer(composed(*overrides))


def test_an_unknown_key_needs_a_plus_and_is_named():
    with pytest.raises(ConfigCompositionException, match=r"Could not override 'trainer.nothing'"):
        composed("trainer.nothing=1")


def test_a_folder_of_another_version_is_one_sentence(tmp_path):
    with pytest.raises(UserError, match=r"is not the folder of a finished run: config.yaml is missing"):
        run_config(tmp_path)
    config = composed()
    OmegaConf.save(OmegaConf.create(config), tmp_path / "config.yaml")
    assert run_config(tmp_path) == config
    old = {**config, "model": {**config["model"], "clip": None, "rates": {}}}
    del old["objective"]
    old["scene"] = {**config["scene"], "volume": {**config["scene"]["volume"], "refine": 1}}
    OmegaConf.save(OmegaConf.create(old), tmp_path / "config.yaml")
    unread = r"no objective, model.clip, model.rates, scene.volume.refine"
    with pytest.raises(UserError, match=rf"another version .* \(it has {unread}\)"):
        run_config(tmp_path)


@pytest.mark.parametrize("path", ["data/mine.hdf5", "../mine.mat", "'my=/mine'"])
def test_a_capture_of_your_own_is_called_after_its_file(path):
    config = composed("scene=capture", f"scene.path={path}")
    assert (config["scene"]["name"], config["scene"]["path"]) == ("mine", path.strip("'"))


def test_a_method_of_its_own_door_knows_that_name(tmp_path):
    (tmp_path / "our lab.mat").touch()
    asked = ["scene=capture", f"scene.path='{tmp_path}/our lab.mat'", "--cfg=job", "--resolve"]
    done = forked.command("reconstruct.py", *asked)
    assert "name: our_lab\n" in done.stdout, done.stderr


def test_no_file_name_leaves_the_outputs():
    assert [file_name(name) for name in ("..", "a/..", "/", "", "~/.ssh/", "x" * 5000, "e/é ü\n*.mat")] == [
        "capture", "capture", "capture", "capture", "ssh", "x" * 64, "é_ü",
    ]  # fmt: skip


def test_another_optimiser_is_a_word():
    config = composed("optimizer.method._target_=torch.optim.RAdam")
    assert get_class(config["optimizer"]["method"]["_target_"]) is torch.optim.RAdam
