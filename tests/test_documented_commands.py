"""Every command of the pages, configs and docstrings reaches its program as printed, which takes it."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from conftest import ROOT

from nlos_lit.commands import inspect_capture, results, view
from nlos_lit.commands.nlos import COMMANDS
from nlos_lit.places import CONF
from nlos_lit.runtime import schema
from nlos_lit.runtime.arguments import check_assignments, check_overrides, help_of
from nlos_lit.runtime.command_line import words_as_settings
from nlos_lit.runtime.keys import KEYS

PAGES = sorted([*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
PROGRAMS = ("train", "diagnose", "reconstruct", "simulate", "results", "inspect_capture", "compare", "view")
START = rf"(?:(?:\.venv/bin/)?python (?:{'|'.join(PROGRAMS)})\.py|nlos (?:{'|'.join(COMMANDS)}))\b"


def printed(text: str) -> list[str]:
    """Commands on lines of their own (with what follows a backslash), and in inline code."""
    text = re.sub(r" *\\\n *", " ", text)
    alone = re.findall(rf"^(?: {{4}}|# )?({START}.*)$", text, re.MULTILINE)
    inline = [re.sub(r"\s+", " ", code) for code in re.findall(rf"(?<!`)`{{1,2}}({START}[^`]*)`", text)]
    return [command for command in alone + inline if "=NAME" not in command]


def sources() -> dict[str, str]:
    files = [*PAGES, *CONF.rglob("*.yaml"), ROOT / "nlos_lit/commands/nlos.py"]
    files += [ROOT / f"{program}.py" for program in PROGRAMS]
    return {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in files}


def reaching(commands: list[str], folder: Path) -> list[list[str]]:
    """What a shell hands to the program of each command; an unquoted pattern fails, as it does in zsh."""
    script = "shopt -s failglob\npython() { printf '%s\\0' \"$@\"; printf '\\n\\0'; }\n"
    script += 'nlos() { python "$@"; }\n'
    script += "\n".join(command.removeprefix(".venv/bin/") for command in commands)
    done = subprocess.run(["bash", "-c", script], cwd=folder, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    handed: list[list[str]] = [[]]
    for word in done.stdout.split("\0")[:-1]:
        if word == "\n":
            handed.append([])
        else:
            handed[-1].append(word)
    assert len(handed) == len(commands) + 1
    return handed[:-1]


@pytest.mark.parametrize("name", [name for name, text in sources().items() if printed(text)])
def test_commands_reach_their_programs(name, tmp_path, monkeypatch):
    monkeypatch.setattr(schema.os.path, "exists", lambda path: True)
    for program, *words in reaching(printed(sources()[name]), tmp_path):
        command = {"inspect_capture": "inspect"}.get(program.removesuffix(".py"), program.removesuffix(".py"))
        words = words_as_settings(command, words)
        given = [word.replace("…", "X") for word in words if word != "…" and word[0] != "-"]
        if (CONF / f"{command}.yaml").exists():
            check_overrides(command, given)
        elif command in KEYS:
            check_assignments(command, given)
        elif command == "results":
            results.parse(given)
        elif command == "inspect":
            inspect_capture.parse(words)
        elif command == "look":
            file, *settings = [word for word in given if not word.startswith("out=")]
            assert "=" not in file
            check_overrides("reconstruct", settings)
        elif command == "view":
            view.parse(words)
        else:
            assert len(given) == {"compare": 2, "completion": 1}[command]


def test_commands_are_found():
    page = (
        "`python train.py scene=su`:\n\n    python simulate.py scene=letters \\\n        out=X.hdf5  # so\n"
    )
    assert printed(page) == ["python simulate.py scene=letters out=X.hdf5  # so", "python train.py scene=su"]
    assert printed("# `nlos look FILE`, then nothing") == ["nlos look FILE"]
    assert sum(len(printed(text)) for text in sources().values()) > 60


def test_an_unquoted_list_does_not_reach_its_program(tmp_path):
    assert reaching(["python train.py 'effects=[a,b]'  # quoted"], tmp_path) == [
        ["train.py", "effects=[a,b]"]
    ]
    with pytest.raises(AssertionError, match="no match"):
        reaching(["python train.py effects=[a,b]"], tmp_path)


def test_the_readme_says_how_to_reach_the_environment():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.index("source .venv/bin/activate") < text.index("nlos look")
    for command in ("train", "simulate"):
        assert "effects=[" not in help_of(command, "").replace("'effects=[", "")
