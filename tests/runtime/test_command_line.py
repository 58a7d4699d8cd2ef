"""Words that name no setting, and how a command ends where it cannot go on."""

import pytest

from nlos_lit.capture.errors import UserError
from nlos_lit.runtime.arguments import check_overrides
from nlos_lit.runtime.command_line import quoted, sentence_errors, settings_as_words, words_as_settings
from nlos_lit.training.configs import compose


@pytest.mark.parametrize(
    ("raised", "status", "said"),
    [
        (UserError("nothing is there"), 2, "error: nothing is there\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_a_command_ends_with_a_sentence(raised, status, said, capsys):
    @sentence_errors
    def command() -> None:
        raise raised

    with pytest.raises(SystemExit) as end:
        command()
    assert end.value.code == status
    assert capsys.readouterr().err == said


def test_a_mistake_of_ours_keeps_its_traceback():
    @sentence_errors
    def command() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        command()


def test_a_file_is_taken_as_it_is(tmp_path):
    file, run = tmp_path / "our lab's.mat", tmp_path / "run"
    file.touch()
    run.mkdir()
    (run / "config.yaml").touch()
    (own,) = words_as_settings("train", [str(file)])[1:]
    check_overrides("train", ["scene=capture", own, "seed=1"])
    assert compose("train", ["scene=capture", own])["scene"]["path"] == str(file)
    assert words_as_settings("diagnose", [str(run)]) == [f"run={run}"]
    assert settings_as_words("train", ["scene=capture", own, "seed=1"]) == [str(file), "seed=1"]
    split = words_as_settings(
        "diagnose", [str(run), f"--split-with={run}", "scene.reader.scan_order=columns"]
    )
    assert split == [f"run={run}", f"split_with={run}", "scene.reader.scan_order=columns"]
    check_overrides("diagnose", split)
    assert words_as_settings("simulate", ["mine.mat"]) == ["mine.mat"]
    with pytest.raises(UserError, match=r"nowhere.mat does not exist; give a capture file, or settings"):
        words_as_settings("train", ["nowhere.mat"])
    held = tmp_path / "holds no capture"
    held.mkdir()
    for command, folder, instead in (
        ("train", held, "give a capture file$"),
        ("diagnose", held, "give a capture file, or a finished run's folder$"),
        ("train", run, f"to go on with that run say resume={run}$"),
    ):
        with pytest.raises(UserError, match=f"is a folder without a capture .*; {instead}"):
            words_as_settings(command, [str(folder)])
    with pytest.raises(UserError, match="--split-with needs a capture file behind it"):
        words_as_settings("diagnose", [str(run), "--split-with"])


@pytest.mark.parametrize("name", ["a=b.mat", "-a.mat", "+a.mat", "gone.mat"])
def test_a_file_that_cannot_stand_alone_keeps_its_setting(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if name != "gone.mat":
        (tmp_path / name).touch()
    settings = ["scene=capture", f"scene.path={quoted(name)}", "seed=1"]
    assert settings_as_words("train", settings) == settings
