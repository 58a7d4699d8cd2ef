"""Every config composes, and every key is read by something."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from conftest import ROOT
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import volume_grid
from nlos_lit.inference.criticise import CriticismSettings
from nlos_lit.model.build import PipelineSettings
from nlos_lit.surfels.fit import RefineSettings

CONF = ROOT / "conf"


def names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml") if not path.stem.startswith("_"))


def composed(*overrides: str, command: str = "train") -> dict:
    overrides = tuple(re.sub(r"=(\d+)$", r"='\1'", override) for override in overrides)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(command, overrides=list(overrides))
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)


GROUPS = {
    "train": ("scene", "model", "ablation", "trainer", "logger", "experiment", "surfels"),
    "diagnose": ("scene", "model", "surfels", "criticism"),
    "reconstruct": ("scene", "method"),
}


@pytest.mark.parametrize(
    ("command", "group", "name"),
    [(c, g, n) for c, groups in GROUPS.items() for g in groups for n in names(g)],
)
def test_every_config_composes(command, group, name):
    config = composed(f"{group}={name}", command=command)
    assert config["scene"]["volume"]["depth"][0] < config["scene"]["volume"]["depth"][1]


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


def leaves(config: dict, above: str = "") -> list[str]:
    keys = []
    for key, value in config.items():
        keys += leaves(value, key) if isinstance(value, dict) else [key]
    return keys


def test_no_key_that_nothing_reads():
    modules = [path for folder in ("nlos_lit", "data_modules") for path in (ROOT / folder).rglob("*.py")]
    sources = "".join(
        path.read_text() for path in (*modules, *(ROOT / f"{command}.py" for command in GROUPS))
    )
    keys = {
        key
        for command, groups in GROUPS.items()
        for group in groups
        for name in names(group)
        for key in leaves(composed(f"{group}={name}", command=command))
    }
    assert {"effects", "refine", "toys", "run", "threads"} <= keys
    unread = {key for key in keys if not re.search(rf"\b{re.escape(key)}\b", sources)}
    assert not unread


def test_groups_are_the_settings_that_read_them():
    """Keys that a settings class does not know would only fail when the command runs."""
    for name in names("criticism"):
        settings = composed(f"criticism={name}", command="diagnose")["criticism"]
        assert set(settings) == {f.name for f in dataclasses.fields(CriticismSettings)}
        CriticismSettings(**settings)
    for name in names("surfels"):
        for command in ("train", "diagnose"):
            settings = composed(f"surfels={name}", command=command)["surfels"]
            assert set(settings) == {f.name for f in dataclasses.fields(RefineSettings)}
            RefineSettings(**settings)


def test_the_model_profiles_are_complete_settings():
    for profile in names("model"):
        model = composed(f"model={profile}")["model"]
        settings = {k: v for k, v in model.items() if k in PipelineSettings.__dataclass_fields__}
        assert set(settings) == set(PipelineSettings.__dataclass_fields__)
        PipelineSettings(**settings)
