"""What the pages speak of exists: files, links, Python names, config choices and keys. Lines are short."""

from __future__ import annotations

import ast
import functools
import importlib
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from conftest import ROOT

from nlos_lit.training.configs import compose

LONGEST = 110
PAGES = sorted(
    [*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks/NOTES.md"]
)
ALL = [*PAGES, ROOT / "CHANGELOG.md"]  # which names what is no more
FOLDERS = "nlos_lit|data_modules|conf|tests|docs|benchmarks|scripts"
MADE_LATER = ("benchmarks/results", "docs/results/")  # by commands
EXAMPLES = ("laser_afterglow", "NAME")  # that a reader is told to write
IN_A_RUN = {"config.yaml", "table.md"}
GROUPS = {"scene", "model", "ablation", "trainer", "logger", "experiment", "surfels", "method", "criticism"}
OPTIONS = GROUPS | {"optimizer", "objective", "callbacks", "heldout", "export"}


def tracked() -> list[str]:
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode:
        pytest.skip("not a git checkout", allow_module_level=True)
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()]


TRACKED = tracked()


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


each_page = pytest.mark.parametrize("page", PAGES, ids=named)
every_page = pytest.mark.parametrize("page", ALL, ids=named)


def paths(text: str) -> Iterator[str]:
    """Paths from the project's root."""
    for match in re.finditer(rf"(?<![\w./-])(?:{FOLDERS})/[\w./*-]*", text):
        path = match[0].rstrip(".")
        if not any(word in path for word in EXAMPLES) and not path.startswith(MADE_LATER):
            yield path


def bare_files(text: str) -> Iterator[str]:
    """Files of the project named with a part of their path."""
    for span in re.findall(r"`([^`\n]+)`", text):
        for match in re.finditer(r"(?<![\w./<-])[\w./-]+\.(?:py|md|yaml)\b", span):
            if match[0] not in IN_A_RUN and not any(word in match[0] for word in EXAMPLES):
                yield match[0]


def links(text: str) -> Iterator[str]:
    """Targets of links and images within the project."""
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(text)):
        if not re.match(r"[a-z]+:", target):
            yield target


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def code_blocks(text: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def anchors(text: str) -> set[str]:
    """Of the headings, as the usual renderers make them."""
    heads = re.findall(r"^#+ (.*)$", without_code(text), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def prose(text: str) -> Iterator[tuple[int, str]]:
    """Lines, with their numbers, outside tables, code, and what a command has written.

    The latter begins at a comment and ends at one that begins with ``/`` or ``end``, or with the page.
    """
    fenced = generated = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("```"):
            fenced = not fenced
        elif line.startswith("<!-- "):
            generated = not line.startswith(("<!-- /", "<!-- end"))
        elif not (fenced or generated or line.startswith(("|", "    "))):
            yield number, line


@each_page
def test_files_are_where_the_page_says(page):
    text = page.read_text(encoding="utf-8")
    assert [path for path in paths(text) if not (list(ROOT.glob(path)) or (ROOT / path).exists())] == []
    assert [f for f in bare_files(text) if not any(f == t or t.endswith("/" + f) for t in TRACKED)] == []


@every_page
def test_links_lead_somewhere(page):
    lost = []
    for target in links(page.read_text(encoding="utf-8")):
        place, _, anchor = target.partition("#")
        file = page.parent / place if place else page
        if not file.exists() or (anchor and anchor not in anchors(file.read_text(encoding="utf-8"))):
            lost.append(target)
    assert lost == []


def exists(dotted: str) -> bool:
    """Whether it is a module, or an attribute of one."""
    parts = dotted.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for name in parts[end:]:
            if not hasattr(found, name):
                return False
            found = getattr(found, name)
        return True
    return False


@each_page
def test_python_names_exist(page):
    text = page.read_text(encoding="utf-8")
    names = set(re.findall(r"(?<![\w/.])(?:nlos_lit|data_modules)(?:\.\w+)+", text))
    for block in code_blocks(text):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module.startswith(("nlos_lit", "data_modules")):
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
    assert sorted(n for n in names if not any(e in n for e in EXAMPLES) and not exists(n)) == []


@functools.cache
def composed() -> tuple[dict, ...]:
    """Of the commands that Hydra runs."""
    return tuple(compose(command) for command in ("train", "diagnose", "reconstruct"))


def overrides(text: str) -> Iterator[tuple[str, str]]:
    """``(key, value)`` of what is set in commands and inline code, where Hydra reads it."""
    for line in text.splitlines():
        code = line if line.startswith("    ") else " ".join(re.findall(r"`([^`]+)`", line))
        if "simulate.py" not in code and "results.py" not in code and "benchmarks/" not in code:
            yield from re.findall(r"(?<![\w./-])\+?([a-z_][\w./]*)=([^\s'`]+)", code)


@each_page
def test_config_choices_and_keys_exist(page):
    lost = []
    for key, value in overrides(page.read_text(encoding="utf-8")):
        head, *rest = key.split(".")
        if not rest and head in GROUPS:
            values = [v for v in value.split(",") if re.fullmatch(r"\w+", v) and v not in EXAMPLES]
            lost += [f"{head}={v}" for v in values if not (ROOT / "conf" / head / f"{v}.yaml").exists()]
        elif rest and head in OPTIONS and rest[0] not in EXAMPLES:
            lost += [] if any(holds(config, [head, *rest]) for config in composed()) else [key]
    assert lost == []


def holds(config: dict, keys: list[str]) -> bool:
    for key in keys:
        if not isinstance(config, dict) or key not in config:
            return False
        config = config[key]
    return True


@every_page
def test_prose_lines_are_readable(page):
    text = page.read_text(encoding="utf-8")
    assert [f"{n}: {line[:60]}…" for n, line in prose(text) if len(line) > LONGEST] == []


def test_the_readme_is_one_screen():
    """A picture, two commands to begin with, five tasks of three commands at most."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
    assert text.count("![") == 1
    assert [line.split()[0] for line in text.splitlines() if line.startswith("    ")] == ["python3", "nlos"]
    tasks = [line for line in text.splitlines() if line.startswith("| ") and "`nlos " in line]
    assert len(tasks) == 5
    assert all(1 <= len(re.findall("`nlos [^`]+`", task)) <= 3 for task in tasks)


def test_the_citation_is_complete():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors", "type", "license"} <= set(cited)
    assert cited["cff-version"] == "1.2.0"
    assert (cited["title"], cited["license"], cited["type"]) == ("nlos_lit", "MIT", "software")
    (paper,) = cited["references"]
    assert {"type", "title", "authors"} <= set(paper)
    assert paper["doi"] == "10.1145/3610548.3618140"


def test_commit_hooks_use_the_projects_own_tools():
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert repository["repo"] == "local"  # nothing is fetched
    assert {hook["language"] for hook in repository["hooks"]} == {"system"}
    assert all(hook["entry"].startswith(".venv/bin/") for hook in repository["hooks"])


PAGE = """# A page

Prose `nlos_lit/gone.py` and `gone/away.py`, [a link](no.md), [an anchor](#a-page), `train.py scene=su`.

<!-- table -->
| generated |
<!-- /table -->
```python
from nlos_lit.capture import Capture
```
    python train.py scene=nowhere heldout.every=4
"""


def test_the_tests_see_what_they_are_for():
    assert list(paths(PAGE)) == ["nlos_lit/gone.py"]
    assert list(bare_files(PAGE)) == ["nlos_lit/gone.py", "gone/away.py", "train.py"]
    assert list(links(PAGE)) == ["no.md", "#a-page"]
    assert anchors(PAGE) == {"a-page"}
    assert [number for number, line in prose(PAGE) if line] == [1, 3]
    assert list(overrides(PAGE)) == [("scene", "su"), ("scene", "nowhere"), ("heldout.every", "4")]
    assert exists("nlos_lit.capture.Capture")
    assert not exists("nlos_lit.gone")
    assert not exists("nlos_lit.capture.Gone")
    assert not holds({"a": {"b": 1}}, ["a", "c"])
