"""The benchmarks at tiny sizes: same numbers from the literal iteration, a GPU path that needs torch alone,
honest sizes.
"""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from conftest import ROOT

sys.path.append(str(ROOT / "benchmarks"))

import p_values
import ratio
import report
from literal_torch import LiteralIteration
from workload import (
    LAMBDA_ALBEDO,
    PROFILES,
    RATES,
    TABLE_2,
    Training,
    Workload,
    surface_points,
    synthetic_capture,
    tiny,
)

from nlos_lit.model.build import PipelineSettings
from nlos_lit.training.configs import compose

SMALL = Workload("small", (12, 12), 96, 1 / 12, 0.025, 0.5, 16, 0.025, batch=3, rays=40)


def command(*arguments: str, prelude: str = "") -> subprocess.CompletedProcess:
    script, *rest = arguments
    program = (
        f"{prelude}\nimport runpy, sys\nsys.argv = {[script, *rest]!r}\nsys.path.insert(0, 'benchmarks')\n"
    )
    program += f"runpy.run_path({script!r}, run_name='__main__')"
    return subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=300
    )


@pytest.fixture(scope="module")
def training() -> Training:
    made = Training(SMALL, synthetic_capture(SMALL), profile="paper")
    made.prepare()
    return made


def errors(training: Training, literal: LiteralIteration) -> dict[str, float]:
    batch = training.batch()
    return ratio.relative(ratio.evaluate(training, *batch), ratio.evaluate(literal, *batch))


def test_literal_iteration_has_the_same_loss_and_gradients(training):
    found = errors(training, LiteralIteration(training))
    assert set(found) == {
        "E_H",
        "loss",
        "omega_pf",
        "sigma_pf",
        "sigma_ls",
        "kappa_s",
        "I_l",
        "eta_s",
        "albedo",
    }
    assert {name: value for name, value in found.items() if not value < 1e-3} == {}


def test_ours_is_closer_to_double_precision_than_was_asked(training):
    exact = LiteralIteration(training, torch.float64, math.inf)
    assert exact.omega.tolist() == training.pipeline.phasor.omega.tolist()
    assert exact.pipeline.albedo.raw.dtype == torch.float64
    assert {name: value for name, value in errors(training, exact).items() if not value < 3e-4} == {}
    assert (
        training.pipeline.phasor.field.dtype == training.pipeline.albedo.raw.dtype == torch.float32
    )  # a copy was doubled


def test_the_comparison_sees_a_quarter_of_a_bin(training):
    literal = LiteralIteration(training)
    depths = literal.depths
    literal.depths = lambda *a: (depths(*a)[0] + training.pipeline.geometry.step / 2, depths(*a)[1])
    found = errors(training, literal)
    assert min(found["omega_pf"], found["sigma_pf"]) > 0.01


def test_literal_iteration_works_through_every_depth_frequency_and_sample(training):
    literal = LiteralIteration(training)
    planes, frequencies = SMALL.planes, len(literal.omega)
    assert frequencies > 20
    assert literal.ffts == frequencies + 2 * planes * frequencies + 2 * planes
    assert literal.n_samples == SMALL.bins  # the far corner, 1.57 m, lies behind the last bin, 1.2 m


def test_table_2_is_the_papers():
    """Scans, bins, volumes (x, y, depth), iterations and hours as printed in the supplement."""
    printed = {
        "Bunny": (256, 256, 1024, 256, 256, 201, 100, 1.93),
        "Dragon": (256, 256, 1024, 256, 256, 128, 100, 1.28),
        "Erato": (256, 256, 1024, 256, 256, 128, 100, 1.28),
        "Indonesian": (256, 256, 1024, 256, 256, 128, 150, 1.93),
        "34": (64, 64, 500, 64, 64, 105, 300, 1.05), "Bike": (256, 256, 512, 256, 256, 64, 170, 1.73),
        "Resolution": (256, 256, 512, 256, 256, 26, 300, 1.33), "SU": (64, 64, 2048, 64, 64, 584, 200, 6.10),
        "44i": (130, 180, 4096, 180, 180, 417, 150, 3.76), "NLOS": (130, 180, 4096, 180, 180, 417, 180, 4.38),
    }  # fmt: skip
    found = {
        w.name: (*w.spots, w.bins, *(w.lateral or w.spots), w.planes, w.iterations, w.paper_hours)
        for w in TABLE_2
    }
    assert found == printed
    assert {(w.batch, w.rays) for w in TABLE_2} == {(32, 200)}


@pytest.mark.parametrize("profile", PROFILES)
def test_profiles_are_those_of_the_configs(profile):
    config = compose("train", [f"model={profile}"])
    model, objective = config["model"], config["objective"]
    settings, sparsity = PROFILES[profile]
    mine = dataclasses.asdict(PipelineSettings(threshold=model["threshold"], rays=model["rays"], **settings))
    numbers = {name: value for name, value in mine.items() if isinstance(value, (int, float, tuple))}
    assert {
        n: model[n]
        for n, v in numbers.items()
        if model[n] != pytest.approx(list(v) if type(v) is tuple else v, rel=1e-4)
    } == {}
    assert {n: model[n] for n, v in mine.items() if n not in numbers and model[n] != v} == {}
    assert config["optimizer"]["rates"] == RATES
    assert (objective["lambda_albedo"], objective["lambda_sparsity"]) == (LAMBDA_ALBEDO, sparsity)


def test_surface_lies_in_the_volume_and_counts_average_what_was_asked():
    points, albedo = surface_points(SMALL, 0.05)
    assert points[:, 2].min() > SMALL.depth
    assert points[:, 2].max() < SMALL.depth + SMALL.planes * SMALL.plane_pitch
    assert set(albedo) == {0.4, 0.9}
    capture = synthetic_capture(SMALL, counts_per_spot=2000.0)
    assert capture.counts.sum(1).mean() == pytest.approx(2200, rel=0.1)


def test_gpu_benchmark_needs_torch_and_numpy_alone():
    blocked = (
        "lightning",
        "hydra",
        "omegaconf",
        "open3d",
        "psutil",
        "rich",
        "scipy",
        "matplotlib",
        "pooch",
        "tensorboard",
        "h5py",
    )
    prelude = f"import sys\nfor name in {blocked!r}: sys.modules[name] = None"
    done = command("benchmarks/gpu.py", "device=cpu", "sizes=tiny", "names=Bunny,NLOS", prelude=prelude)
    assert done.returncode == 0, done.stderr[-2000:]
    lines = [line for line in done.stdout.splitlines() if line.startswith("| ")]
    assert [line.split(" | ")[0] for line in lines] == ["| scene", "| ---", "| Bunny", "| NLOS"]


def test_gpu_benchmark_says_that_there_is_no_gpu():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    done = command("benchmarks/gpu.py", "sizes=tiny")
    assert done.returncode == 1
    assert "no CUDA device is at hand; device=cpu sizes=tiny runs the same path" in done.stderr


def test_table_2_command_at_a_tiny_size():
    done = command("benchmarks/table2.py", "tiny", "names=44i")
    assert done.returncode == 0, done.stderr[-2000:]
    row = json.loads(done.stdout.splitlines()[-1])
    small = tiny(next(w for w in TABLE_2 if w.name == "44i"))
    assert (row["spots"], row["bins"], row["complete"], row["measured_iterations"]) == (
        [16, 22],
        128,
        True,
        small.iterations,
    )
    assert row["total_s"] > row["setup_s"] > 0


def test_two_processes_hand_over_the_gradients_and_the_volume_where_they_divide_the_field():
    script = [
        sys.executable,
        "benchmarks/ddp.py",
        "sizes=tiny",
    ]  # as a file: the processes it spawns import it
    done = subprocess.run(script, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    row = json.loads(done.stdout.splitlines()[-1])
    whole, divided = row["whole"], row["divided"]
    voxels = 8 * 8 * 12
    assert whole["counted_bytes"] == whole["expected_bytes"] == 4 * (voxels + 6)
    assert (
        divided["counted_bytes"] == divided["expected_bytes"] == 4 * (voxels + 6) + 4 * (voxels // 2 + voxels)
    )
    assert 2 * divided["field_bytes"] == whole["field_bytes"]
    assert max(whole["difference"], divided["difference"]) < 1e-5


def test_reports(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "STORE", tmp_path)
    monkeypatch.setattr(report, "PAGE", tmp_path / "page.md")
    assert report.slope([1, 10, 100], [2, 2e2, 2e4]) == pytest.approx(2.0)
    assert report.table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
    report.store("kind", "a / b=2", {"x": 1})
    assert report.stored("kind", "a / b=2") == {"x": 1}
    assert report.stored("kind", "other") is None
    report.PAGE.write_text("before\n<!-- one -->\nold\n<!-- /one -->\nafter\n")
    report.write_section("one", "new")
    assert report.PAGE.read_text() == "before\n<!-- one -->\n\nnew\n\n<!-- /one -->\nafter\n"


def test_chances_are_held_against_uniform_ones():
    """One of each chance is uniform; twenty of the least are 9 of 10 steps away, five even ones one."""
    even = [k / 10 for k in range(1, 11)]
    assert p_values.summary(even) == {"captures": 10, "distance": 0, "as_far_by_chance": 1}
    least = p_values.summary([0.1] * 20)
    assert (least["distance"], least["as_far_by_chance"]) == (0.9, 0)
    assert p_values.distance(np.array([k / 5 for k in range(1, 6)])) == pytest.approx(0.1)
    # Of two, both at 1/10 come once in 100 draws, and both at 1, as far away, as rarely.
    assert p_values.summary([0.1, 0.1])["as_far_by_chance"] == pytest.approx(2 / 100, rel=0.1)
