"""The documentation as a site: it builds, every link in it leads somewhere, every page is in its menu."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest
import yaml
from conftest import ROOT

NEEDED = ("mkdocs", "material", "mkdocstrings")


def test_the_site_builds_strictly(tmp_path):
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed: pip install -c constraints.txt -e '.[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    reference = (tmp_path / "site" / "reference" / "capture.html").read_text(encoding="utf-8")
    assert "nlos_lit.capture.capture.Capture" in reference
    assert ":class:<code>" not in reference
    assert 'href="../benchmarks.html"' in (tmp_path / "site" / "speed.html").read_text(encoding="utf-8") or (
        'href="benchmarks.html"' in (tmp_path / "site" / "speed.html").read_text(encoding="utf-8")
    )


def entries(menu: list) -> list[str]:
    found = []
    for item in menu:
        inside = item if isinstance(item, str) else next(iter(item.values()))
        found += [inside] if isinstance(inside, str) else entries(inside)
    return found


def test_every_page_is_in_the_menu():
    menu = entries(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"])
    written = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert written - set(menu) == set()
    assert len(menu) == len(set(menu))
