"""The program ``nlos``: one name for all commands, each opened by its own module when it is asked for."""

from __future__ import annotations

import functools
import importlib
import os
import select
import sys
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import ParamSpec

import nlos_lit
from nlos_lit.places import STARTED


@dataclass(frozen=True)
class Command:
    """A command.

    Args:
        does: what it does, in a line.
        example: its arguments, for the list of all commands.
        more: further paragraphs of its ``--help``.
        help: all of its ``--help``, printed before the module is loaded; empty where it has another.
        module: of ``nlos_lit.commands``, whose ``main`` takes the arguments and returns the exit status; None
            is that of the command's own name.
        settings: its arguments are ``KEY=VALUE``, looked over before the module is loaded.
        paths: its words are files or folders, which are looked for before the module is loaded.
    """

    does: str
    example: str
    more: str = ""
    help: str = ""
    module: str | None = None
    settings: bool = False
    paths: bool = False

    @property
    def about(self) -> str:
        """The first lines of its ``--help``."""
        return f"{self.does[0].upper()}{self.does[1:]}." + (f"\n\n{self.more.rstrip()}" if self.more else "")


P = ParamSpec("P")
HELP = {"-h", "--help"}
LOOK = """\
Look at a capture file: recognise, check, plan and picture it, and say what to do next.

    nlos look FILE
    nlos look FILE scene.reader.bin_width_ps=16 out=FOLDER

FILE is a capture file, or a folder of C_i, C_d, sub_Sig. Settings are those of nlos reconstruct --help. The
pictures go to outputs/NAME/look, or to the folder that out= names."""
COMPARE = """\
Show where finished runs differ, and what came out.

    nlos compare RUN RUN …

RUN is the folder of a finished run. A row is a run, the best last: its folder, the settings in which it
differs from the others, its errors. Runs that differ in the seed alone are put together below."""
SIMULATE = """\
Writes OUT, a y-tal HDF5 capture, and OUT's name with _truth.h5: depth, normals and albedo as seen from the
wall, and the mesh. A scene of one's own: 'bodies=[{kind: cone, at: [0, 0, 0.6]}]'; one drawn at random:
random=7 (docs/simulator.md). With physical effects, each with strengths as EFFECT.PARAMETER=VALUE
(docs/effects.md):

    nlos simulate scene=letters 'effects=[pile_up]' pile_up.detections=0.3 out=X.hdf5
"""
DIAGNOSE = """\
Where it leaves two names open, the report says which further capture would tell. Taken, it is asked by

    nlos diagnose RUN --split-with FILE

RUN is the folder of the first diagnosis (or the first capture's file, which is diagnosed first). The second
capture is read as the first was; settings of the scene that differ are given behind it, such as
scene.reader.scan_order=columns.
"""
RESULTS = """\
Names are experiments, all, or page, which rewrites the generated parts of docs/results.md from what is
stored.

size=full|reduced   full (default): real captures, renders and the bunny; about an hour on one core.
                    reduced: small procedural scenes in their places, every command once in a few minutes
data=DIR            folder that is searched for captures and meshes (default: data)
out=DIR             where results are kept and found again (default: outputs/evidence/SIZE); finished
                    trainings are never repeated
docs=FILE           the page (default: docs/results.md)"""
COMMANDS = MappingProxyType(
    {
        "look": Command(
            "look at a capture file: recognise, check, plan and picture it, and say what to do next",
            "FILE",
            help=LOOK,
            paths=True,
        ),
        "train": Command("reconstruct a hidden scene by self-calibration", "FILE", settings=True),
        "diagnose": Command(
            "say what the simulation gets wrong about a capture, or about a finished run",
            "FILE",
            more=DIAGNOSE,
            settings=True,
        ),
        "reconstruct": Command(
            "reconstruct by a classical method, without fitting", "FILE method=lct", settings=True
        ),
        "simulate": Command(
            "simulate a capture of a hidden scene",
            "scene=letters out=letters.hdf5",
            more=SIMULATE,
            settings=True,
        ),
        "inspect": Command(
            "print and plot what a capture file holds", "FILE", module="inspect_capture", paths=True
        ),
        "compare": Command(
            "show where finished runs differ, and what came out", "RUN RUN", help=COMPARE, paths=True
        ),
        "view": Command("open the page of a run or a diagnosis", "RUN", paths=True),
        "results": Command(
            "make the paper's tables and figures",
            "table1 size=reduced",
            more=RESULTS,
            settings=True,
        ),
        "completion": Command("print what makes a shell complete these commands", "bash"),
    }
)


def for_readers(command: Callable[P, int]) -> Callable[P, int]:
    """End without a word where whoever reads what is printed has read enough: ``nlos train --help | head``.

    Args:
        command: returns the exit status.

    Returns:
        the same; 141 where the reader has gone, as of programs that SIGPIPE ends.
    """

    @functools.wraps(command)
    def wrapped(*given: P.args, **named: P.kwargs) -> int:
        try:
            try:
                return command(*given, **named)
            finally:
                sys.stdout.flush()
        except BrokenPipeError:
            out, readers = sys.stdout.fileno(), select.poll()
            readers.register(out, select.POLLOUT)
            if not any(event & select.POLLERR for _, event in readers.poll(0)):
                raise  # it was another pipe
            os.dup2(os.open(os.devnull, os.O_WRONLY), out)
            return 141

    return wrapped


@for_readers
def main(arguments: list[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: its name and its own arguments; None takes them from the command line.

    Returns:
        The exit status.
    """
    given = sys.argv[1:] if arguments is None else arguments
    if STARTED in os.environ and os.environ.get("LOCAL_RANK", "0") != "0":
        given = [os.environ[STARTED], *given]  # Lightning starts helpers with the command's arguments alone
    name = given[0] if given else "--help"
    if name in HELP:
        print(listed())
        return 0
    if name == "--version":
        print(nlos_lit.__version__)
        return 0
    if name not in COMMANDS:
        from nlos_lit.capture.errors import suggest  # loads numpy

        print(f"error: there is no command {name!r}; {suggest(name, COMMANDS)}", file=sys.stderr)
        return 2
    os.environ[STARTED] = name
    return open_command(name, given[1:])


@for_readers
def open_command(name: str, arguments: list[str]) -> int:
    """Load a command and run it.

    Args:
        name: in :data:`COMMANDS`.
        arguments: without the name.

    Returns:
        The exit status.
    """
    command = COMMANDS[name]
    if command.help and HELP & set(arguments):
        from nlos_lit.runtime.command_line import as_typed

        print(as_typed(command.help))
        return 0
    if command.paths and (missing := _missing(arguments)):
        what = "capture file" if command.example == "FILE" else "folder that a run has named at its end"
        print(f"error: {missing} does not exist; give a {what}", file=sys.stderr)
        return 2
    if command.settings:
        from nlos_lit.runtime.arguments import look_over
        from nlos_lit.runtime.command_line import OF_CAPTURES, sentence_errors, typed, words_as_settings

        if name in OF_CAPTURES and not arguments:
            yours = f"{typed(name)} FILE"
            print(f"no capture is named: this is the scene that is built in; for yours, {yours}", flush=True)
        arguments = sentence_errors(words_as_settings)(name, arguments)
        look_over(name, arguments, command.about)
    module = importlib.import_module(f"nlos_lit.commands.{command.module or name}")
    status: int = module.main(arguments)
    return status


def _missing(arguments: list[str]) -> str | None:
    """The first word that names neither a file nor a folder; options end the words that are looked at."""
    for word in arguments:
        if word.startswith("-"):
            return None
        if "=" not in word and not os.path.exists(word):
            return word
    return None


def listed() -> str:
    """All commands with what they do, as ``nlos --help`` shows them."""
    width = max(len(f"{name} {command.example}") for name, command in COMMANDS.items())
    lines = [
        f"  nlos {f'{name} {command.example}':{width}s}  {command.does}" for name, command in COMMANDS.items()
    ]
    return "\n".join(
        [
            "Non-line-of-sight imaging that calibrates and criticises its own simulation.",
            "",
            *lines,
            "",
            "nlos COMMAND --help lists what a command takes; nlos --version is the version.",
        ]
    )
