"""The wheel holds what every command needs, and works where there is no checkout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterable
from pathlib import Path

import pytest
from conftest import ROOT

from nlos_lit.commands.nlos import COMMANDS

# Composes every config of an installation, and says from where.
COMPOSE = """
import json
from nlos_lit.places import CONF
from nlos_lit.training.configs import compose
scenes = sorted(path.stem for path in (CONF / "scene").glob("[!_]*.yaml"))
made = [compose("reconstruct", [f"scene='{scene}'"])["scene"]["name"] for scene in scenes]
others = [compose(command)["scene"]["name"] for command in ("train", "diagnose")]
print(json.dumps({"conf": str(CONF), "scenes": scenes, "made": made, "others": others}))
"""


SOURCE = (
    *("nlos_lit", "data_modules", "conf"),
    *("pyproject.toml", "setup.py", "README.md", "LICENSE", "MANIFEST.in", "Makefile", "train.py"),
)


def source(folder: Path, names: Iterable[str] = SOURCE) -> Path:
    """A copy of what a build reads, so that it leaves nothing in the checkout."""
    for name in names:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder)
    return folder


def outside() -> dict[str, str]:
    """The environment without what would put the checkout in front of an installation."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def python(*arguments: str, cwd: Path, path: Path | None = None) -> str:
    """What Python prints, outside the checkout, with an installation in front of all other packages."""
    env = outside() if path is None else {**outside(), "PYTHONPATH": str(path)}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """The wheel and the source archive, built with the packages that are installed here."""
    folder = source(tmp_path_factory.mktemp("source"))
    code = "import os, setuptools.build_meta as b; os.makedirs('dist'); "
    python("-c", code + "b.build_wheel('dist'); b.build_sdist('dist')", cwd=folder)
    return folder / "dist"


@pytest.fixture(scope="module")
def installed(dist, tmp_path_factory):
    """The wheel, unpacked as an installer does."""
    place = tmp_path_factory.mktemp("installed")
    (wheel,) = dist.glob("*.whl")
    options = ("--quiet", "--no-deps", "--no-index", "--disable-pip-version-check", "--target", str(place))
    python("-m", "pip", "install", *options, str(wheel), cwd=place)
    return place


def tracked(*folders: str) -> set[str]:
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files", *folders], capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    return {name for name in listed.stdout.split() if (ROOT / name).exists()}


def test_the_wheel_holds_every_file_of_the_packages(dist):
    (wheel,) = dist.glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {f"nlos_lit/{name}" if name.startswith("conf/") else name for name in
              tracked("nlos_lit", "data_modules", "conf")}  # fmt: skip
    assert wanted <= held
    assert {name.split("/")[0] for name in held if ".dist-info" not in name} == {"nlos_lit", "data_modules"}
    assert any(name.endswith("entry_points.txt") for name in held)


def test_the_image_copies_what_a_build_needs(dist, tmp_path):
    """Without Docker: what the Dockerfile copies and .dockerignore lets through gives the same wheel."""
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    copied = [name for line in lines if line.startswith("COPY ") for name in line.split()[1:-1]]
    let_through = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert {f"!{name}" for name in copied} <= set(let_through)
    assert "constraints.txt" in copied
    folder = source(tmp_path, copied)
    python("-c", "import setuptools.build_meta as b; b.build_wheel('.')", cwd=folder)
    (mine,), (wheel,) = folder.glob("*.whl"), dist.glob("*.whl")
    assert zipfile.ZipFile(mine).namelist() == zipfile.ZipFile(wheel).namelist()
    assert "RUN pip install --no-cache-dir -c constraints.txt ." in lines
    assert lines[-1] == 'ENTRYPOINT ["nlos"]'


def test_the_source_archive_can_be_built(dist):
    (archive,) = dist.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    assert {"pyproject.toml", "setup.py", "conf/train.yaml", "conf/scene/su.yaml", "train.py"} <= names
    assert "nlos_lit/py.typed" in names


def test_commands_work_outside_the_checkout(installed, tmp_path):
    program = installed / "bin" / "nlos"
    assert program.exists()
    listed = python(str(program), "--help", cwd=tmp_path, path=installed)
    assert all(f"nlos {name}" in listed for name in COMMANDS)
    assert "nlos train" in python(str(program), "train", "--help", cwd=tmp_path, path=installed)
    made = python(
        str(program), "simulate", "nx=8", "ny=8", "n_bins=128", "out=mine.hdf5", cwd=tmp_path, path=installed
    )
    assert "64 spots" in made
    told = python(str(program), "inspect", "mine.hdf5", cwd=tmp_path, path=installed)
    assert "photon counts" in told
    assert (tmp_path / "mine_capture.png").exists()


def test_every_scene_is_composed_outside_the_checkout(installed, tmp_path):
    found = json.loads(python("-c", COMPOSE, cwd=tmp_path, path=installed))
    assert found["conf"] == str(installed / "nlos_lit" / "conf")
    scenes = {path.stem for path in (ROOT / "conf" / "scene").glob("[!_]*.yaml")}
    assert set(found["scenes"]) == scenes
    assert len(found["made"]) == len(scenes)
    assert found["others"] == ["default", "default"]


def test_the_program_starts_at_once():
    """Before any command is opened it loads none of the libraries they work with; 0.05 s where measured."""
    code = "import sys, nlos_lit.commands.nlos; print(*{n.split('.')[0] for n in sys.modules})"
    began = time.perf_counter()
    loaded = set(python("-c", code, cwd=ROOT).split())
    assert time.perf_counter() - began < 1
    assert not loaded & {"numpy", "torch", "hydra", "omegaconf", "lightning", "matplotlib", "h5py", "scipy"}


@pytest.mark.slow
def test_a_fresh_environment_takes_wheel_and_source(dist, tmp_path):
    """As a user installs it, dependencies from the package index included, up to a picture of a capture."""
    python("-m", "venv", "fresh", cwd=tmp_path)
    place = tmp_path / "fresh" / "bin"
    pinned = ["install", "--quiet", "--constraint", str(ROOT / "constraints.txt")]
    (wheel,), (archive,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    done = subprocess.run([place / "pip", *pinned, str(wheel)], capture_output=True, text=True, check=False)
    if done.returncode and "No matching distribution" in done.stderr:
        pytest.skip("the package index cannot be reached")
    assert done.returncode == 0, done.stderr
    simulate = ["simulate", "scene=letters", "nx=32", "ny=32", "overwrite=true", "out=mine.hdf5"]
    for again in ([], [place / "pip", *pinned, "--no-deps", "--force-reinstall", str(archive)]):
        if again:
            subprocess.run(again, check=True)
        for words in (["--version"], simulate, ["look", "mine.hdf5"]):
            subprocess.run([place / "nlos", *words], cwd=tmp_path, env=outside(), check=True)
        assert (tmp_path / "outputs" / "mine" / "look" / "look.png").exists()
        shutil.rmtree(tmp_path / "outputs")
