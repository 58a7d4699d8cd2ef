"""What mkdocs asks while it builds the site: pages from outside docs/, names in docstrings."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
# Pages beside docs/, and what they are called in the site.
OUTSIDE = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "benchmarks/NOTES.md": "benchmarks.md",
}
LINK = re.compile(r"\[([^\[\]]*)\]\(([^)\s#:]+)(#[^)\s]*)?\)")
BEHIND = 0.2  # weight of the reference in a search
ROLE = re.compile(r":(?:func|class|meth|mod|data|attr):<code>~?(?:[\w]+\.)*(\w+)</code>")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside."""
    for source, name in OUTSIDE.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links lead to where their pages are in the site; what is not in it is only named.

    Names of the reference are found behind pages that explain: a search for a word means these.
    """
    if page.file.src_uri.startswith("reference/"):
        page.meta.setdefault("search", {"boost": BEHIND})
    sources = {name: source for source, name in OUTSIDE.items()}
    here = sources.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def moved(match: re.Match[str]) -> str:
        text, named, anchor = match.groups()
        target = posixpath.normpath(posixpath.join(posixpath.dirname(here), named))
        if target in OUTSIDE:
            inside = OUTSIDE[target]
        elif target.startswith("docs/") and not target.endswith(".jsonl"):
            inside = target.removeprefix("docs/")
        else:
            return f"`{target}`" if text.endswith(posixpath.basename(target)) else f"{text} in `{target}`"
        start = posixpath.dirname(page.file.src_uri) or "."
        return f"[{text}]({posixpath.relpath(inside, start)}{anchor or ''})"

    return LINK.sub(moved, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Sphinx's roles, as docstrings have them, without their marks."""
    return ROLE.sub(r"<code>\1</code>", html)
