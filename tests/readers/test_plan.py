"""What to fit of a capture is planned from its data, said, and overridable."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pytest
from conftest import real_file
from omegaconf import OmegaConf

from data_modules.load import load_scene, planned_scene
from data_modules.plan import plan_capture
from data_modules.readers import read_capture, write_capture
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.commands.plan import plan
from nlos_lit.training.configs import compose

SIDE, BINS, LENGTH, PITCH = 16, 2048, 0.0012, 0.02
NEAR, FAR = 0.6, 0.9  # two points, m


def point_scene(pulse: float = 0.0) -> Capture:
    """Counts of two points behind the wall's middle, in bins of 4 ps, with a direct pulse on request."""
    rng = np.random.default_rng(0)
    wall = PITCH * np.stack([*np.indices((SIDE, SIDE)).reshape(2, -1), np.zeros(SIDE**2)], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], wall.shape)
    mean = np.full((SIDE**2, BINS), 0.05)
    mean += pulse * np.exp(-np.arange(BINS) / 30)
    for depth, counts in ((NEAR, 30), (FAR, 20)):
        point = np.array([PITCH * SIDE / 2, PITCH * SIDE / 2, depth])
        path = 2 * np.linalg.norm(wall - point, axis=1)
        since = np.arange(BINS) - path[:, None] / LENGTH
        mean += counts * np.where(since >= 0, np.exp(-since / 10), 0)
    counts = rng.poisson(mean).astype(np.uint32)
    return Capture(counts, wall, wall, up, up, LENGTH, scan_shape=(SIDE, SIDE))


def test_depths_hold_the_scene_and_bins_the_wavelength():
    plan = plan_capture(point_scene())
    assert plan.wavelength == pytest.approx(4 * PITCH)
    assert plan.sum_bins == 8  # 0.08 m / 8 / 1.2 mm = 8.3
    assert plan.gate == (0, BINS // 8)
    assert plan.depth_pitch == pytest.approx(8 * LENGTH / 2)
    near, far = plan.depth
    assert NEAR - 0.08 < near < NEAR
    assert FAR < far < FAR + 0.12


def test_the_gate_begins_behind_a_direct_pulse():
    plan = plan_capture(point_scene(pulse=2000.0))
    assert 2 * NEAR > plan.gate[0] * 8 * LENGTH > 5 * 30 * LENGTH  # five decays of the pulse
    assert plan.depth == pytest.approx(plan_capture(point_scene()).depth, abs=0.03)


def test_what_is_given_is_taken():
    plan = plan_capture(point_scene(), wavelength=0.02, sum_bins=None)
    assert plan.sum_bins == 2
    plan = plan_capture(point_scene(), sum_bins=4, gate=(300, 400))
    assert (plan.sum_bins, plan.gate) == (4, (300, 400))
    assert plan.depth[0] > 0.7  # the nearer point's light lies before this gate


@pytest.fixture
def file(tmp_path):
    return write_capture(tmp_path / "mine.hdf5", point_scene())


def composed(file, *overrides: str) -> dict:
    return compose("train", ["scene=capture", f"scene.path={file}", *overrides])


def test_a_scene_of_ones_own_needs_a_path_alone(file, caplog):
    with caplog.at_level(logging.INFO, "data_modules"):
        config = OmegaConf.create(composed(file))
        plan(config)
    (line,) = [r.message for r in caplog.records if r.message.startswith("plan for mine.hdf5: ")]
    assert line.startswith("plan for mine.hdf5: 8 bins summed to 32 ps, gate [0, 256), depth 0.5")
    scene = OmegaConf.to_container(config.scene)
    expected = plan_capture(point_scene())
    assert (scene["sum_bins"], tuple(scene["volume"]["depth"])) == (8, expected.depth)
    capture = load_scene(scene, "data", 0)[0]
    assert (capture.bin_length, capture.gate) == (pytest.approx(8 * LENGTH), (0, 256))
    again = OmegaConf.create(OmegaConf.to_container(config))
    plan(again)  # what is planned is not planned again
    assert again == config


def test_every_part_of_the_plan_can_be_overruled(file):
    given = ["scene.sum_bins=2", "scene.gate=[400,1000]", "scene.volume.depth=[0.4,1.0]"]
    scene = composed(file, *given)["scene"]
    assert planned_scene(scene, "data") == (scene, None)
    for override, key, value in [
        ("scene.sum_bins=2", "sum_bins", 2),
        ("scene.gate=[50,200]", "gate", [50, 200]),
    ]:
        assert planned_scene(composed(file, override)["scene"], "data")[0][key] == value
    scene = planned_scene(composed(file, "scene.volume.depth=[0.4,1.0]")["scene"], "data")[0]
    assert (scene["sum_bins"], scene["volume"]["depth"]) == (8, [0.4, 1.0])


def test_darkness_is_no_depth(tmp_path):
    dark = np.random.default_rng(0).poisson(0.2, (SIDE**2, BINS)).astype(np.uint32)
    file = write_capture(tmp_path / "dark.hdf5", dataclasses.replace(point_scene(), counts=dark))
    with pytest.raises(UserError, match=r"holds nothing but noise, .* \(force=true goes on\)"):
        planned_scene(composed(file)["scene"], "data")
    with pytest.raises(UserError, match=r"dark.hdf5: no light .* give them as 'scene.volume.depth="):
        planned_scene(composed(file)["scene"], "data", force=True)


@pytest.mark.parametrize(
    "large",
    ["scene.volume.depth_pitch=0.0001 scene.volume.lateral=[400,400]", "scene.iterations=100000"],
)
def test_what_is_very_large_asks(file, large):
    with pytest.raises(UserError, match=r"million voxels .* hours on one core: .* or say force=true"):
        plan(OmegaConf.create(composed(file, *large.split())))
    plan(OmegaConf.create(composed(file, *large.split(), "force=true")))


@pytest.mark.parametrize(
    ("name", "sum_bins", "near", "far"),
    [  # where the scene is, by the configs and pages of these captures
        ("measured/data_s_u.mat", 4, 0.57, 1.1),
        ("measured/data_diffuse_s.mat", 4, 0.48, 0.53),
        ("measured/data_dot_chart_65cm.mat", 2, 0.65, 0.65),
        ("measured/figure_4", 2, 0.85, 1.0),
        ("rendered/z_single_32_d3.hdf5", 2, 0.5, 0.5),
        ("rendered/su_corner_single_32_d3.hdf5", 2, 0.4, 1.2),
    ],
)
def test_real_captures_are_planned_around_their_scenes(name, sum_bins, near, far):
    plan = plan_capture(read_capture(real_file(name)))
    assert plan.sum_bins == sum_bins
    assert plan.depth[0] < near
    assert plan.depth[1] > far
    assert plan.depth[1] < far + 0.5
