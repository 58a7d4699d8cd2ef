"""What settings mean, in a line each: from the comments of ``conf/`` and the docstrings of what takes them.

The files are parsed and not imported, so that ``--help`` needs none of the libraries that they load.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

from nlos_lit.places import ABOVE, CONF

# Section of the settings → file and what in it takes them as arguments.
SCAN, SENSOR = (
    ("data_modules/simulate/plan.py", "ScanPlan"),
    ("data_modules/simulate/sensor.py", "SensorModel"),
)
ARGUMENTS = (
    ("model", "nlos_lit/model/build.py", "PipelineSettings"),
    ("surfels", "nlos_lit/surfels/fit.py", "SurfelSettings"),
    ("criticism", "nlos_lit/inference/settings.py", "CriticismSettings"),
    ("scene.simulate.scan", *SCAN),
    ("scene.simulate.sensor", *SENSOR),
    ("method.options", "nlos_lit/baselines/rsd.py", "rsd"),
    ("method.options", "nlos_lit/baselines/light_cone.py", "lct"),
)
# The same of the command simulate, whose settings stand beside each other without sections.
OF_SIMULATE = (("", "nlos_lit/commands/simulate.py", "Options"), ("", *SCAN), ("", *SENSOR))
# Section of the settings → files of conf/ whose comments say what they mean.
COMMENTS = (
    ("scene", "scene/_base.yaml"),
    ("objective", "objective/default.yaml"),
    ("optimizer", "optimizer/adam.yaml"),
    ("", "train.yaml"),  # what the commands share is explained there
)


def meanings(command: str) -> dict[str, str]:
    """Dotted key → what it means, as far as that is written down.

    Args:
        command: as in :data:`~nlos_lit.runtime.keys.KEYS`.

    Returns:
        Text of one line a key.
    """
    found: dict[str, str] = {}
    for section, file, name in OF_SIMULATE if command == "simulate" else ARGUMENTS:
        found |= _below(section, arguments_of(ABOVE / file, name))
    if command != "simulate":
        for section, file in (*COMMENTS, ("", f"{command}.yaml")):
            found |= _below(section, comments(CONF / file))
    return found


def comments(file: Path) -> dict[str, str]:
    """Dotted key → the comment behind it, of a YAML file."""
    found, above = {}, [(-1, "")]
    for line in file.read_text(encoding="utf-8").splitlines():
        match = re.match(r"( *)(\w+):(.*)$", line)
        if not match:
            continue
        indent, name, rest = len(match[1]), match[2], match[3]
        while above[-1][0] >= indent:
            above.pop()
        key = f"{above[-1][1]}{name}"
        above.append((indent, f"{key}."))
        if "# " in rest:
            found[key] = rest.partition("# ")[2].strip()
    return found


def arguments_of(file: Path, name: str) -> dict[str, str]:
    """Argument → what a docstring says of it, without the marks that docstrings have.

    Args:
        file: of the class or function.
        name: of the class or function.

    Returns:
        Text of one line an argument.

    Examples:
        >>> arguments_of(ABOVE / "nlos_lit/surfels/fit.py", "SurfelSettings")["batch"]
        'spots a step'
    """
    tree = ast.parse(file.read_text(encoding="utf-8"))
    named = (node for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef))
    (found,) = (node for node in named if node.name == name)
    text = ast.get_docstring(found) or ""
    section = re.search(r"^Args:\n((?:(?: .*)?\n?)*)", text, re.MULTILINE)
    entries = re.findall(r"^ {4}(\w[\w, ]*?): (.*(?:\n {8}.*)*)", section[1] if section else "", re.MULTILINE)
    return {key: _plain(told) for names, told in entries for key in names.split(", ")}


def _plain(text: str) -> str:
    text = re.sub(r":\w+:`~?(?:[\w]+\.)*(\w+)`", r"\1", re.sub(r"\s+", " ", text)).replace("``", "")
    return re.sub(r"\bNone\b", "null", text).rstrip(".").strip()


def _below(section: str, found: dict[str, str]) -> dict[str, str]:
    return {f"{section}.{key}" if section else key: told for key, told in found.items()}
