"""``nlos look``: what it prints, what it draws, and that the commands it names are taken as they stand."""

from __future__ import annotations

import shlex

import pytest

from nlos_lit.capture.errors import UserError
from nlos_lit.commands.look import VOXELS, coarser, look
from nlos_lit.commands.simulate import simulate
from nlos_lit.runtime.arguments import check_overrides
from nlos_lit.runtime.command_line import words_as_settings
from nlos_lit.training.configs import compose

SMALL = ("bin_length=0.01", "n_bins=256", "mean_counts=2000")


def simulated(folder, *settings: str):
    path = folder / "our lab.hdf5"
    simulate([f"out={path}", *SMALL, *settings])
    return path


@pytest.fixture(scope="module")
def confocal(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("confocal"), "nx=16", "ny=16")


def told(path, folder, capsys, *settings: str) -> list[str]:
    look([str(path), *settings, f"out={folder}"])
    return capsys.readouterr().out.splitlines()


def commands(lines: list[str]) -> list[list[str]]:
    found = [line.removeprefix("next").strip() for line in lines if line.startswith("next")]
    return [shlex.split(line) for line in found if not line.startswith("(")]


def test_a_capture_is_checked_pictured_and_gone_on_with(confocal, tmp_path, capsys):
    lines = told(confocal, tmp_path, capsys)
    assert any(line.startswith("plan         scene.sum_bins=") for line in lines)
    assert [line.split()[0] for line in lines if line.split()[-1] == "s"] == ["lct", "fk", "phasor"]
    assert {path.name for path in tmp_path.iterdir()} == {"look.png", "capture.png"}
    named = commands(lines)
    assert [words[1].removesuffix(".py") for words in named] == ["train", "diagnose"]
    for _, program, *words in named:
        command = program.removesuffix(".py")
        assert words == [str(confocal)]
        words = words_as_settings(command, words)
        check_overrides(command, words)
        assert compose(command, words)["scene"]["path"] == str(confocal)


def test_what_is_said_of_the_file_goes_on_to_the_next_commands(confocal, tmp_path, capsys):
    lines = told(confocal, tmp_path, capsys, "scene.volume.depth=[0.5,0.8]")
    assert all("scene.volume.depth=[0.5,0.8]" in words for words in commands(lines))


def test_a_scan_that_is_not_confocal_is_imaged_by_the_phasor_field(tmp_path, capsys):
    path = simulated(tmp_path, "nx=12", "ny=12", "kind=single", "seed=null")
    lines = told(path, tmp_path, capsys)
    assert "lct needs a confocal scan" in next(line for line in lines if line.startswith("lct"))
    assert (tmp_path / "look.png").exists()
    assert [words[1].removesuffix(".py") for words in commands(lines)] == ["train"]
    assert "weighs photon counts; these are expected values" in lines[-1]


class Large:
    """What is asked of a measurement of 256 × 256 spots."""

    scene = {"sum_spots": 1, "volume": {"depth": None}}  # noqa: RUF012
    settings = ()
    path = "large.mat"

    class capture:
        scan_shape = (256, 256)

    @staticmethod
    def plan():
        from data_modules.plan import Plan

        return Plan(0.03, 4, (0, 500), (0.5, 1.0), 0.002)


def test_a_large_scan_is_looked_at_coarsely():
    (setting,) = coarser(Large())
    assert setting == "scene.sum_spots=4"
    side = 4
    assert 256 * 256 / side**2 * 0.5 / (0.002 * side) <= VOXELS


def test_a_file_is_needed(tmp_path):
    with pytest.raises(UserError, match="name a capture file"):
        look(["scene.sum_bins=2"])
    with pytest.raises(UserError, match=r"no.mat does not exist; give a capture file"):
        look([str(tmp_path / "no.mat")])


def test_a_file_with_a_sign_of_assignment_in_its_name_is_a_file(confocal, tmp_path, capsys):
    path = tmp_path / "a=b.hdf5"
    path.symlink_to(confocal)
    lines = told(path, tmp_path / "look", capsys)
    assert commands(lines)[0][-2:] == ["scene=capture", f"scene.path='{path}'"]
