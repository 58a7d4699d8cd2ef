"""Mistakes in every setting of every command, judged by what its default is and not by the table of rules.

``python tests/robust/mistakes.py OUT.jsonl`` adds a row a command: values of another kind than the default's,
numbers far out of any range, and misspelt keys, each given to the command as a user would.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import sys
from collections.abc import Iterator
from typing import Any

from rows import add

from data_modules.simulate import ScanPlan, SensorModel
from nlos_lit.commands.simulate import Options
from nlos_lit.runtime.arguments import look_over
from nlos_lit.runtime.keys import FOREIGN_SECTIONS, KEYS
from nlos_lit.training.configs import compose

OF_NUMBERS = ("ten", "true", "[1,2,3,4,5]", "{a: 1}", "nan", "1e30", "-1e30", "")
OF_FLAGS = ("7", "maybe", "[true]", "{a: true}", "0.5")
OF_LISTS = ("word", "{a: 1}", "[[1]]")
# Numbers as their defaults say, and what else they may be; texts that may be anything.
ALLOWED = {("memory_budget", "1e30"), ("falloff", "0.37"), ("cycles", "0.37")}
PATTERNS = {"trainer"}  # sections whose own library checks further


def defaults(command: str) -> dict[str, Any]:
    """Dotted key → default value."""
    if command == "simulate":
        found: dict[str, Any] = {}
        for section in (Options, ScanPlan, SensorModel):
            found |= {f.name: f.default for f in dataclasses.fields(section)}  # type: ignore[arg-type]
        return found
    return dict(_leaves(compose(command)))


def _leaves(config: dict[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in config.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def mistakes(command: str) -> Iterator[str]:
    """Arguments that no command should take."""
    for key, default in defaults(command).items():
        if (
            any(f"{key}.".startswith(f"{section}.") for section in FOREIGN_SECTIONS)
            or key not in KEYS[command]
        ):
            continue
        wrong: tuple[str, ...] = ()
        if isinstance(default, bool):
            wrong = OF_FLAGS
        elif isinstance(default, int | float):
            wrong = OF_NUMBERS + (("0.37",) if isinstance(default, int) else ())
        elif isinstance(default, list | tuple):
            wrong = OF_LISTS if default and not isinstance(default[0], str | dict) else ()
        short = key.rpartition(".")[2]
        if key.split(".")[0] in PATTERNS:
            wrong = tuple(value for value in wrong if value in ("nan", "maybe", "[[1]]"))
        yield from (f"{key}={value}" for value in wrong if (short, value) not in ALLOWED)
        if len(short) > 3:
            yield f"{key[:-2]}{key[-1]}{key[-2]}q={default}"


def outcome(command: str, argument: str) -> tuple[str, str]:
    """What a command says to an argument before it loads anything."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            look_over(command, [f"{command}.py", argument], "")
    except SystemExit as end:
        text = said.getvalue().rstrip("\n")
        whole = end.code == 2 and text.startswith("error: ") and "\n" not in text
        return ("refused" if whole else "failed"), text
    except Exception as error:
        return "failed", f"{type(error).__name__}: {error}"
    return "accepted", ""


def main(arguments: list[str]) -> None:
    for command in KEYS:
        came: dict[str, int] = {"refused": 0, "accepted": 0, "failed": 0}
        told = []
        for argument in mistakes(command):
            how, said = outcome(command, argument)
            came[how] += 1
            if how != "refused":
                told.append(f"{argument}: {how} {said[:100]}")
        row = {"part": "mistakes", "kind": command, "tried": sum(came.values()), **came, "failures": told}
        add(arguments[0], row)


if __name__ == "__main__":
    main(sys.argv[1:])
