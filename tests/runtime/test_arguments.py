"""A mistake in a command line or a config is one sentence, before anything is read, and leaves nothing."""

from __future__ import annotations

import contextlib
import copy
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ROOT
from omegaconf import OmegaConf

from data_modules.readers import READERS
from data_modules.simulate import SCENES
from data_modules.simulate.plan import KINDS
from nlos_lit.baselines import METHODS
from nlos_lit.capture.errors import UserError
from nlos_lit.runtime import arguments, keys
from nlos_lit.runtime.arguments import begun, check_assignments, check_overrides, look_over
from nlos_lit.runtime.keys import KEYS
from nlos_lit.runtime.meanings import meanings
from nlos_lit.runtime.schema import Rule
from nlos_lit.training.configs import compose

COMMANDS = ("train", "diagnose", "reconstruct")
HERE = str(ROOT / "README.md")  # a file that is there


def test_every_rule_says_what_it_expects():
    for command, rules in KEYS.items():
        for key, rule in rules.items():
            assert isinstance(rule, Rule), key
            if "number" in rule.expected:
                assert re.search(r"(from|above) -?[\d.e+-]+", rule.expected), f"{command} {key}"


def test_the_choices_are_those_of_the_code():
    assert set(keys.FORMATS) == {"auto", *(reader.NAME for reader in READERS)}
    assert set(keys.METHODS) == set(METHODS)
    assert set(keys.MESHES) == set(SCENES)
    assert keys.SCAN["kind"].expected == f"one of {', '.join(KINDS)}"


NEAR = "did you mean"
MISTAKES = [
    ("scen=su", "there is no key scen; did you mean scene?"),
    ("scene=suu", f"there is no scene=suu; {NEAR} su"),
    ("scene=su,suu", f"there is no scene=suu; {NEAR} su"),
    ("scene=[su,suu]", f"there is no scene=suu; {NEAR} su"),
    ("model=papers", f"there is no model=papers; {NEAR} paper"),
    ("trainer=gpus", f"there is no trainer=gpus; {NEAR} gpu"),
    ("logger=tensorbord", f"there is no logger=tensorbord; {NEAR} tensorboard"),
    ("ablation=phazor", f"there is no ablation=phazor; {NEAR} phasor"),
    ("experiment=zzz", "there is no experiment=zzz; there are evidence, evidence_reduced, quick"),
    ("scene.itrations=5", f"no key scene.itrations; {NEAR} scene.iterations"),
    ("scene.volume.deph=[1,2]", f"no key scene.volume.deph; {NEAR} scene.volume.depth"),
    ("+scene.volume.deph=[1,2]", f"no key scene.volume.deph; {NEAR} scene.volume.depth"),
    ("scenes.iterations=5", f"no key scenes.iterations; {NEAR} scene.iterations"),
    ("trainer.precison=16", f"no key trainer.precison; {NEAR} trainer.precision"),
    ("modell.rays=20", f"no key modell.rays; {NEAR} model.rays"),
    (
        "+zzzz=1",
        r"there is no key zzzz; there are seed, threads, data_dir, memory_budget, force, scene, model",
    ),
    ("~scene.iteration", f"no key scene.iteration; {NEAR} scene.iterations"),
    ("scene.iterations=-5", "scene.iterations must be a whole number from 1 to 10000000; found -5"),
    ("scene.iterations=0", "found 0"),
    ("scene.iterations=1.5", "found 1.5"),
    ("scene.iterations=ten", "found ten"),
    ("scene.iterations=null", "found null"),
    ("scene.iterations=100,-1", "found -1"),
    ("scene.iterations=true", "found True"),
    ("batch_spots=0", "batch_spots must be a whole number from 1 to 10000000 spots; found 0"),
    ("seed=-1", "seed must be a whole number from 0 to 4294967295; found -1"),
    ("seed=1e3", "found 1000.0"),
    ("threads=0", "threads must be a whole number from 1 to 1024, or null; found 0"),
    ("heldout.every=1", "must be 0 or a whole number from 2 to 10000; found 1"),
    (
        "scene.volume.depth=1",
        r"depth must be \[a, b\], each a number above 0 to 1000 m, a < b, or null; found 1",
    ),
    ("scene.volume.depth=[1.5,0.5]", "a < b, or null; found"),
    ("scene.volume.depth=[0.5,0.5]", "a < b, or null; found"),
    ("scene.volume.depth=[0.5]", "a < b, or null; found"),
    ("scene.volume.depth=[0.5,1,2]", "a < b, or null; found"),
    ("scene.volume.depth=[-1,1]", "a < b, or null; found"),
    ("scene.volume.depth=[0.5,500000]", "a < b, or null; found"),
    ("scene.volume.depth=[a,b]", "a < b, or null; found"),
    ("scene.volume.depth_pitch=1e-9", "a number from 1e-05 to 10 m, or null; found 1e-09"),
    ("scene.volume.depth_pitch=-0.1", "found -0.1"),
    ("scene.volume.upsample=0.5", "found 0.5"),
    ("scene.volume.lateral=64", r"\[a, b\], each a whole number from 1 .* voxels, or null; found 64"),
    ("scene.wavelength=0", "a number from 0.0001 to 100 m, or null; found 0"),
    ("scene.wavelength=inf", "found inf"),
    ("scene.wavelength=nan", "found nan"),
    ("scene.threshold=1", "a number above 0 to below 1; found 1"),
    ("scene.falloff=-2", "found -2"),
    ("scene.gate=[600,200]", "a < b, or null; found"),
    ("scene.gate=600", "a < b, or null; found 600"),
    ("scene.gate=[1.5,20]", "a < b, or null; found"),
    ("scene.sum_bins=0", "from 1 to 100000 bins"),
    ("scene.sum_spots=two", "found two"),
    ("scene.format=lctt", "one of auto, ytal, lct, .*; found lctt"),
    ("scene.path=/no/such/file", "a file or folder that is there, or null; found /no/such/file"),
    ("scene.truth=/no/such/file", "a file or folder that is there"),
    ("scene.name=a/b", "a name without slashes; found a/b"),
    ("scene.reader.flip_x=maybe", "true or false, or null; found maybe"),
    ("scene.reader.flip_x=1", "true or false, or null; found 1"),
    ("scene.reader.bin_width_ps=-4", "a number above 0 to 1e\\+06 ps"),
    ("scene.reader.wall_size=[1,2,3]", "above 0 to 1000 m, or"),
    ("scene.reader.wall_size=0", "above 0 to 1000 m, or"),
    ("scene.reader.scan_order=spiral", "one of raster, serpentine, columns, or a list"),
    ("scene.reader.observed=none", "one of all, or null; found none"),
    ("scene.simulate.scan.kind=confocale", "one of confocal, single, exhaustive; found confocale"),
    ("scene.simulate.scan.nx=0", "found 0"),
    ("scene.simulate.sensor.mean_counts=-5", "found -5"),
    ("memory_budget=1.2.3GB", "a size such as 8GiB or 500MB; found 1.2.3GB"),
    ("memory_budget=lots", "found lots"),
    ("model.rays=2", "a whole number from 4"),
    ("model.beta=-1", "found -1"),
    ("model.albedo=fixed", "one of free, residual"),
    ("model.wavelength_range=[2,1]", "a < b"),
    ("model.relative_beta=si", "true or false"),
    ("optimizer.rates.phasor=-0.1", "a number from 0 to 100; found -0.1"),
    ("optimizer.clip=0", "above 0"),
    ("objective.lambda_sparsity=-1", "a number from 0"),
    ("surfels.rounds=0", "a whole number from 1"),
    ("surfels.floor=1.5", "found 1.5"),
    ("export.mesh_depth=99", "from 1 to 14; found 99"),
    ("export.spots=0", "from 1"),
    ("trainer.devices=[a]", "trainer.devices must be"),
    ("trainer.check_val_every_n_epoch=0", "found 0"),
    ("trainer.accelerator=gpuu", "one of auto, cpu, gpu"),
    ("ckpt_path=/no/such.ckpt", "one of last, or a file or folder that is there"),
    ("run=/no/such/run", "run must be a file or folder that is there"),
    ("effects=3", "effects must be a list"),
    ("fit=points", "one of volume, surface"),
    ("refine=yes_please", "true or false"),
    ("scene.volume.depth=[0.5,", "cannot read the argument .* lists in quotes, .* in two sorts"),
    ("scene.volume.depth=[0.5, 1", "cannot read the argument"),
    ("=3", "there is no key ; there are"),
    ("su", "cannot read the argument"),
]


@pytest.mark.parametrize(("argument", "sentence"), MISTAKES, ids=[text for text, _ in MISTAKES])
def test_a_mistake_is_one_sentence(argument, sentence):
    with pytest.raises(UserError, match=sentence) as told:
        check_overrides("train", [argument])
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    "right",
    [
        ["scene=su", "seed=3"],
        ["scene='34'"],
        ["scene=34"],
        ["ablation=glob(*)", "seed=0,1,2"],
        ["seed=range(1,4)", "scene=su,diffuse_s"],
        ["scene=capture", f"scene.path={HERE}", "scene.volume.depth=[0.5,1.5]"],
        ["effects=[wall_reflectance,irf_tail]", "refine=true"],
        ["effects=irf_tail"],
        ["optimizer.method._target_=torch.optim.RAdam", "+optimizer.method.betas=[0.8,0.9]"],
        ["~callbacks.figures", "+callbacks.timer._target_=lightning.pytorch.callbacks.Timer"],
        ["trainer.precision=64-true", "+trainer.max_time=00:01:00:00", "trainer=ddp", "trainer.devices=4"],
        ["hydra.run.dir=/tmp/a", "hydra/launcher=joblib", "experiment=quick"],
        ["scene.volume={depth: [0.5, 1.0]}", "memory_budget=2.5 GB", "ckpt_path=last"],
        ["scene.wavelength=${model.wavelength}", "logger=none", "experiment=null"],
        ["scene.simulate.sensor.kappa=inf"],
    ],
)
def test_what_is_right_goes_through(right):
    check_overrides("train", right)


def test_what_a_run_brings_is_not_given_again():
    with pytest.raises(UserError, match=r"run=FOLDER brings its own scene and model; leave scene out"):
        check_overrides("diagnose", [f"run={ROOT}", "scene=su"])
    check_overrides("diagnose", [f"run={ROOT}", "criticism.toys=3"])
    check_overrides("diagnose", ["run=null", "scene=su"])


JUNK = [
    "maybe",
    "-1",
    "0",
    "0.5",
    "1e30",
    "nan",
    "[]",
    "[1,x]",
    "[null]",
    "{a: 1}",
    "null",
    "''",
    "a=b",
    "${x}",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_no_value_of_any_key_ends_in_anything_but_a_sentence(command):
    tried = refused = 0
    for key in KEYS[command]:
        for value in JUNK:
            tried += 1
            with contextlib.suppress(UserError):
                check_overrides(command, [f"{key}={value}"])
                continue
            refused += 1
    assert refused > 0.6 * tried > 400


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("nxx=3", f"there is no option 'nxx'; {NEAR} nx"),
        ("nx=0", "nx must be a whole number from 1"),
        ("kind=confocl", "one of confocal"),
        ("scene=lettres", "one of default, letters"),
        ("mesh=/no/such.obj", "a file or folder that is there"),
        ("seed=x", "found x"),
        ("exposure=0", "above 0"),
        ("random=-1", "a whole number from 0, or null; found -1"),
        ("letters", "cannot use 'letters': write KEY=VALUE"),
        ("bodies=[{kind: cone", "cannot read .*: brackets, braces or quotes do not match"),
    ],
)
def test_the_simulators_mistakes(argument, sentence):
    with pytest.raises(UserError, match=sentence):
        check_assignments("simulate", [argument])


def test_files_of_conf_are_held_to_the_rules_too(tmp_path, monkeypatch):
    config = OmegaConf.create(compose("train"))
    folder = tmp_path / "run"
    monkeypatch.setattr(arguments, "output_folder", lambda: folder)

    def begin(key, value):
        (folder / ".hydra").mkdir(parents=True)
        (folder / "train.log").write_text("")
        changed = copy.deepcopy(config)
        OmegaConf.update(changed, key, value, merge=False, force_add=True)
        with begun("train", changed):
            (folder / "config.yaml").write_text("")
            if changed.ablation.name == "late":
                raise UserError("the data are not there")

    for key, value, sentence in [
        ("scene.volume.depth", [2, 1], "scene.volume.depth must be"),
        ("scene.volumes", 3, f"there is no key scene.volumes; {NEAR} scene.volume"),
        ("scene.volume", 3, "there is no key scene.volume"),
        ("seed", "${nowhere}", "the config cannot be put together: .*nowhere"),
        ("scene.name", "???", "scene.name is not set; it must be a name"),
        ("ablation.name", "late", "the data are not there"),
    ]:
        with pytest.raises(UserError, match=sentence):
            begin(key, value)
        assert not folder.exists(), key
    begin("seed", 3)
    assert (folder / "config.yaml").exists()
    (folder / "checkpoints").mkdir()  # results are never taken away
    with pytest.raises(UserError), begun("train", OmegaConf.merge(config, {"seed": -1})):
        pass
    assert (folder / "checkpoints").exists()


def run(*words: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (
            "train",
            "scene.threshold: a number above 0 to below 1  # intensity below which there is no surface",
        ),
        (
            "diagnose",
            "criticism.processes: a whole number from 1 to 1024  # that work on them; fits that go on",
        ),
        ("reconstruct", "method.options.snr: a number above 0 to 1e+12  # power of the signal over"),
        ("reconstruct", "  method       bp, dlct, fbp, fk, lct, rsd"),
        ("simulate", "  nx: a whole number from 1 to 10000  # grid points along x and y"),
        ("results", "size=full|reduced"),
    ],
)
def test_help_says_what_a_command_takes(command, told):
    done = run(f"{command}.py", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert told in done.stdout


def test_a_name_that_is_no_text_is_one_sentence(capsys):
    with pytest.raises(SystemExit) as end:
        look_over("train", ["scene=capture", "scene.path=a\udcff\x1b[2J.mat"], "")
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert (
        said == "error: cannot use scene.path=a\\udcff\\x1b[2J.mat: it is no text in UTF-8; rename the file\n"
    )


@pytest.mark.parametrize("command", KEYS)
def test_help_says_what_settings_mean(command):
    """All but those of Lightning's Trainer, which are explained there, and names that say it."""
    told = meanings(command)
    plain = {"ablation.name", "method.name", "scene.source", "optimizer.method"}
    silent = [
        key
        for key in KEYS[command]
        if not (key in told or key.rpartition(".")[0] in told or key in plain)
        and not key.startswith(("trainer.", "ablation.optimise."))
    ]
    assert silent == []
    assert [text for text in told.values() if ":class:" in text or "``" in text or "\n" in text] == []


def test_a_missing_path_is_said_before_the_libraries_are_loaded(tmp_path):
    began = time.perf_counter()
    done = run("train.py", "scene=capture", "scene.path=/no/such", f"hydra.run.dir={tmp_path}/run")
    took = time.perf_counter() - began
    assert (done.returncode, done.stdout) == (2, "")
    sentence = "error: scene.path must be a file or folder that is there, or null; found /no/such\n"
    assert done.stderr == sentence
    assert not Path(tmp_path / "run").exists()
    loaded = run("-X", "importtime", "-c", "import nlos_lit.runtime.arguments").stderr
    assert "lightning" not in loaded
    assert "torch" not in loaded
    assert took < 5  # 0.2 s on a machine that does nothing else
