"""The documentation as a site: it builds, every link in it leads somewhere, every page is in its menu."""

from __future__ import annotations

import functools
import http.server
import importlib.util
import os
import subprocess
import sys
import threading

import pytest
import yaml
from conftest import ROOT

NEEDED = ("mkdocs", "material", "mkdocstrings")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed: pip install -c constraints.txt -e '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def test_the_site_is_built(site):
    reference = (site / "reference" / "capture.html").read_text(encoding="utf-8")
    assert "nlos_lit.capture.capture.Capture" in reference
    assert ":class:<code>" not in reference
    assert 'href="benchmarks.html"' in (site / "speed.html").read_text(encoding="utf-8")
    readme = (site / "readme.html").read_text(encoding="utf-8")
    assert "<code>CITATION.cff</code>" in readme  # no page, so named and not linked


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def address(site):
    """Of the site, served as a web server does."""
    handler = functools.partial(Quiet, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize(("word", "leads_to"), [("drift", "effects.html"), ("install", "how-to.html")])
def test_a_word_is_found_by_the_search(address, browser, word, leads_to):
    page = browser.new_page()
    outside = []
    page.on("request", lambda asked: None if asked.url.startswith(address) else outside.append(asked.url))
    page.goto(f"{address}/index.html", wait_until="networkidle")
    page.click(".md-search__input")
    page.keyboard.insert_text(word[:-1])
    page.keyboard.press(word[-1])  # the search listens to keys, and answers to each
    page.wait_for_selector(".md-search-result__item a")
    found = page.eval_on_selector_all(".md-search-result__item a", "links => links.map(link => link.href)")
    first = [link.removeprefix(f"{address}/").split("?")[0].split("#")[0] for link in found[:8]]
    assert leads_to in first
    page.click(".md-search-result__item a")
    page.wait_for_load_state()
    assert word.lower() in page.inner_text("article").lower()
    assert outside == []
    page.close()


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
