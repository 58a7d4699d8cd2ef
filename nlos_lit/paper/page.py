"""The generated parts of docs/results.md, from stored experiments.

What stands between the generated parts is written by hand and kept.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

from nlos_lit.capture.errors import UserError
from nlos_lit.io.files import whole_file
from nlos_lit.io.tables import markdown_table
from nlos_lit.paper.experiments import EXPERIMENTS
from nlos_lit.paper.record import read_record

GLANCE = "glance"
ORDER = (
    "table1",
    "figure5",
    "figure6",
    "figure7",
    "figure8",
    "figure9",
    "figure10",
    "supplement2",
    "profiles",
)


def begin(name: str) -> str:
    """The line above a generated part."""
    return f"<!-- generated: {name} -->"


END = "<!-- end -->"


def update_page(page: Path, results: Path) -> list[str]:
    """Rewrite the generated parts whose experiments are stored; copy figures and tables beside the page.

    Args:
        page: docs/results.md, or a copy.
        results: folder that holds a folder an experiment.

    Returns:
        the experiments that were written.

    Raises:
        UserError: the page lacks the place of an experiment, or nothing is stored.
    """
    stored = {
        name: read_record(results / name) for name in ORDER if (results / name / "evidence.json").exists()
    }
    if not stored:
        raise UserError(f"no finished experiment below {results}; run python results.py all first")
    text = page.read_text(encoding="utf-8")
    for name, record in stored.items():
        text = replace_part(text, name, section(name, record))
        copy_files(results / name, page.parent, record)
    for name in ORDER:
        text = text.replace(
            f"{begin(name)}\n{END}", f"{begin(name)}\nNot measured yet: `python results.py {name}`.\n{END}"
        )
    text = replace_part(text, GLANCE, glance(stored))
    with whole_file(page) as partial:
        partial.write_text(text, encoding="utf-8")
    return list(stored)


def replace_part(text: str, name: str, content: str) -> str:
    """A page with one generated part exchanged.

    Args:
        text: of the page.
        name: of the part.
        content: what comes between the part's marks.

    Returns:
        the page's new text.

    Raises:
        UserError: the marks are not there, once.

    Examples:
        >>> print(replace_part("\\n".join(["by hand", begin("a"), "old", END]), "a", "new"))
        by hand
        <!-- generated: a -->
        new
        <!-- end -->
    """
    pattern = re.compile(re.escape(begin(name)) + r"\n.*?" + re.escape(END), re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise UserError(f"the page must hold one part between {begin(name)} and {END}")
    return pattern.sub(lambda _: f"{begin(name)}\n{content}\n{END}", text)


def section(name: str, record: dict[str, Any]) -> str:
    """Command, data, table and figures of one experiment, as Markdown.

    Args:
        name: of the experiment.
        record: what `read_record` found.

    Returns:
        the lines between the experiment's marks.
    """
    lines = [
        f"    python results.py {name}",
        "",
        f"**Paper**: {record['paper']}",
        "",
        f"**Here**: {record['here']}",
        "",
    ]
    commit = f", commit {record['git']['commit'][:10]}" if record["git"] else ""
    lines += [markdown_table(record["rows"]), "", f"[At full precision](results/{name}.csv){commit}"]
    for figure, caption in record["captions"].items():
        lines += ["", f"![{name} {figure}](images/results_{name}_{figure}.png)", "", f"*{caption}*"]
    return "\n".join(lines)


def glance(records: dict[str, dict[str, Any]]) -> str:
    """Every comparison of every experiment in one table, and which experiments are not in it."""
    rows = [{"from": name, **row} for name, record in records.items() for row in record["glance"]]
    missing = [name for name in EXPERIMENTS if name not in records]
    return markdown_table(rows) + (f"\n\nNot measured yet: {', '.join(missing)}." if missing else "")


def copy_files(folder: Path, docs: Path, record: dict[str, Any]) -> None:
    """A record's figures into ``docs/images`` and its table into ``docs/results``.

    Args:
        folder: of the experiment.
        docs: folder of the page.
        record: what `read_record` found there.
    """
    for place in (docs / "images", docs / "results"):
        place.mkdir(exist_ok=True)
    for figure in record["captions"]:
        shutil.copy(folder / f"{figure}.png", docs / "images" / f"results_{record['name']}_{figure}.png")
    shutil.copy(folder / "table.csv", docs / "results" / f"{record['name']}.csv")
