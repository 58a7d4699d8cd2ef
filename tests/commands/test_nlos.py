"""One program for all commands: what it lists, opens, refuses and completes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest
from conftest import ROOT

from nlos_lit.commands import nlos
from nlos_lit.commands.completion import bash, words_of, zsh
from nlos_lit.commands.completion import main as completion
from nlos_lit.commands.nlos import COMMANDS, STARTED, main, open_command
from nlos_lit.commands.view import main as view
from nlos_lit.runtime import command_line
from nlos_lit.runtime.command_line import as_typed, typed


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_module(name):
    file = ROOT / "nlos_lit" / "commands" / f"{COMMANDS[name].module or name}.py"
    assert "def main(arguments: list[str]" in file.read_text(encoding="utf-8")


def test_a_misspelt_command_is_answered_with_the_nearest(capsys, monkeypatch):
    monkeypatch.delenv(STARTED, raising=False)
    assert main(["trian"]) == 2
    assert "there is no command 'trian'; did you mean train?" in capsys.readouterr().err
    assert main(["xyz"]) == 2
    assert f"there are {', '.join(COMMANDS)}" in capsys.readouterr().err
    for words in ([], ["--help"]):
        assert main(words) == 0
        assert "nlos look FILE" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["look", "nowhere.mat"], "a capture file"),
        (["inspect", "nowhere.mat"], "a capture file"),
        (["view", "nowhere.mat"], "a folder that a run has named"),
        (["compare", ".", "nowhere.mat"], "a folder that a run has named"),
    ],
)
def test_a_missing_file_is_said_before_anything_is_loaded(words, wanted, capsys, monkeypatch):
    monkeypatch.delenv(STARTED, raising=False)
    monkeypatch.setattr(nlos.importlib, "import_module", lambda name: pytest.fail("a module was loaded"))
    assert main(words) == 2
    assert f"error: nowhere.mat does not exist; give {wanted}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["look", "--help"], "Look at a capture file: recognise, "),
        (["compare", "-h"], "Show where finished runs differ, "),
    ],
)
def test_help_is_told_before_anything_is_loaded(words, told, capsys, monkeypatch):
    monkeypatch.delenv(STARTED, raising=False)
    monkeypatch.setattr(nlos.importlib, "import_module", lambda name: pytest.fail("a module was loaded"))
    assert main(words) == 0
    assert capsys.readouterr().out.startswith(told)


def test_processes_that_help_with_a_run_open_its_command(monkeypatch):
    opened = []
    monkeypatch.setattr(nlos, "open_command", lambda name, words: opened.append((name, words)) or 0)
    monkeypatch.setenv(STARTED, "before")
    monkeypatch.setenv("LOCAL_RANK", "0")
    assert main(["train", "trainer=ddp"]) == 0
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert main(["trainer=ddp"]) == 0
    assert opened == [("train", ["trainer=ddp"])] * 2


def test_commands_are_told_as_they_are_typed(monkeypatch):
    monkeypatch.setattr(command_line.sys, "argv", ["/somewhere/bin/nlos"])
    assert typed("train") == "nlos train"
    assert as_typed("python inspect_capture.py X, python train.py") == "nlos inspect X, nlos train"
    monkeypatch.setattr(command_line.sys, "argv", ["train.py"])
    assert as_typed("nlos inspect X, nlos train") == "python inspect_capture.py X, python train.py"


def completed(line: str) -> list[str]:
    """What bash offers behind a line."""
    code = f"""{bash()}
COMP_LINE={line!r} COMP_POINT={len(line)}
COMP_WORDS=({line.replace("=", " = ")})
COMP_CWORD=$(( ${{#COMP_WORDS[@]}} - 1 ))
[[ $COMP_LINE == *" " ]] && COMP_CWORD=$(( COMP_CWORD + 1 ))
compopt() {{ :; }}
_nlos
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


def test_bash_completes_commands_keys_and_choices():
    assert completed("nlos re") == ["reconstruct", "results"]
    assert completed("nlos train scene=s") == ["su"]
    assert completed("nlos train scene.iter") == ["scene.iterations="]
    assert completed("nlos reconstruct method=f") == ["fbp", "fk"]


def test_zsh_reads_the_completion(capsys):
    assert completion(["zsh"]) == 0
    assert capsys.readouterr().out.strip() == zsh().strip()
    assert all(word in zsh() for word in words_of("train"))
    if shutil.which("zsh") is None:
        pytest.skip("zsh is not installed: the script is not read by it")
    subprocess.run(["zsh", "-n"], input=zsh(), text=True, check=True)


def test_a_command_without_a_capture_says_what_it_works_on(capsys, monkeypatch):
    monkeypatch.setattr(nlos.importlib, "import_module", lambda name: SimpleNamespace(main=lambda words: 0))
    assert open_command("reconstruct", []) == 0
    assert "no capture is named: this is the scene that is built in" in capsys.readouterr().out
    assert open_command("reconstruct", ["scene=su"]) == 0
    assert capsys.readouterr().out == ""


def test_a_file_is_no_run(tmp_path, capsys):
    (tmp_path / "mine.mat").touch()
    with pytest.raises(SystemExit) as end:
        view([str(tmp_path / "mine.mat")])
    assert end.value.code == 2
    assert "mine.mat is a file; give the folder that" in capsys.readouterr().err


def test_completion_names_the_shells(capsys):
    assert completion([]) == 2
    assert capsys.readouterr().err == "error: name a shell; there are bash, zsh\n"
    assert completion(["bsh"]) == 2
    assert "did you mean bash" in capsys.readouterr().err
    assert completion(["--help"]) == 0


@pytest.mark.parametrize("words", ["--help", "look --help", "train --help"])
def test_a_reader_who_has_read_enough_ends_it_without_a_word(words):
    """A pipe that nobody reads, as behind ``| head`` once that has gone."""
    code = "import sys; from nlos_lit.commands.nlos import main; sys.exit(main())"
    command = [sys.executable, "-c", code, *words.split()]
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")
