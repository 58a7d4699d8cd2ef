"""Print and plot what a capture file holds, before a long run."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from data_modules.examine import describe, examine
from data_modules.readers import READERS, ReaderOptions, detect_format, read_capture
from nlos_lit.capture.errors import UserError, printable
from nlos_lit.report.capture_figure import draw_capture
from nlos_lit.runtime.command_line import typed

LONGEST = 60  # characters of a capture's name that its picture's keeps: file names have room for 255 bytes
AXES = {
    "flip-x": "the file's x runs the other way",
    "flip-y": "the file's y runs the other way",
    "swap-xy": "the file's axes change places",
}


def main(arguments: list[str]) -> int:
    """Print what the file named by ``arguments`` holds, draw it, and return the exit status."""
    given = parse(arguments).__dict__
    path, fmt, out = given.pop("file"), given.pop("format"), given.pop("out")
    size, gate = given.pop("wall_size"), given.pop("gate")
    try:
        wall_size = None if size is None else (size[0] if len(size) == 1 else tuple(size))
        options = ReaderOptions(wall_size=wall_size, gate=tuple(gate) if gate else None, **given)
        capture = read_capture(path, fmt, options=options)
        findings = examine(capture)
        print(printable(describe(capture, detect_format(path) if fmt == "auto" else fmt, findings)))
        picture = out / f"{path.stem[:LONGEST]}_capture.png"
        try:
            out.mkdir(parents=True, exist_ok=True)
            draw_capture(capture, findings.mean, findings.totals, picture)
        except OSError as error:
            raise UserError(f"cannot write {picture}: {error.strerror or error}") from error
        print(printable(f"picture      {picture}"))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def parse(arguments: list[str]) -> argparse.Namespace:
    """What the command line says."""
    return _parser().parse_args(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=typed("inspect"), description="Print and plot what a capture file holds."
    )
    parser.add_argument("file", type=Path, help="capture file, or folder of C_i, C_d, sub_Sig")
    parser.add_argument(
        "--format", default="auto", help=f"auto, or one of {', '.join(reader.NAME for reader in READERS)}"
    )
    parser.add_argument("--bin-width-ps", type=float, metavar="PS", help="width of a time bin as recorded")
    parser.add_argument(
        "--wall-size",
        type=float,
        nargs="+",
        metavar="M",
        help="side of the scanned square, or its two sides, m",
    )
    parser.add_argument("--t-start", type=float, metavar="M", help="path at the start of bin 0, m")
    parser.add_argument("--gate", type=int, nargs=2, metavar=("FIRST", "LAST"), help="bins to fit")
    for name, told in AXES.items():
        parser.add_argument(f"--{name}", action="store_true", default=None, help=told)
    parser.add_argument(
        "--raw-scale", action=argparse.BooleanOptionalAction, help="the file carries tal's raw scale, or not"
    )
    parser.add_argument(
        "--counts", action=argparse.BooleanOptionalAction, help="the values are photon counts, or not"
    )
    parser.add_argument(
        "--observed", choices=("all",), help="all: every zero is a measurement, look for no unrecorded bins"
    )
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="where the picture goes")
    return parser
