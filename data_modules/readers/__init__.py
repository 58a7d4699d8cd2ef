"""Captures from the public file formats of the field, one format a module, all turned into the world frame.

World frame: relay wall near z = 0, hidden scene at z > 0, right-handed, metres. Seen from the wall with +y
up, +x points left.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from data_modules.readers import chen, cid, fk, lct, phasor_field, tsai_ahn, ytal, zaragoza
from data_modules.readers.contents import Contents, open_contents
from data_modules.readers.options import ReaderOptions
from data_modules.readers.ytal_write import write_capture
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError

__all__ = ["READERS", "ReaderOptions", "detect_format", "read_capture", "write_capture"]

# Each module has NAME, DESCRIPTION, EXPECTS (what its files hold, for messages), OPTIONS (names it can use),
# matches(contents) and read(path, options).
READERS: tuple[ModuleType, ...] = (ytal, lct, fk, phasor_field, zaragoza, chen, tsai_ahn, cid)


def read_capture(path: str | Path, fmt: str = "auto", *, options: ReaderOptions | None = None) -> Capture:
    """Read a capture file of any known format, turned into the world frame.

    Args:
        path: the file, or the folder of its parts.
        fmt: ``auto`` to recognise the format from the file's content, or the NAME of one of `READERS`.
        options: facts that the file does not say, or says wrongly; None for none.

    Returns:
        the capture, its counts as they are in the file.

    Raises:
        CaptureError: no such file, unknown format, damaged or unusable data, or an option that the format
            cannot use.
    """
    options = options or ReaderOptions()
    reader = _recognise(open_contents(path)) if fmt == "auto" else _named(fmt)
    for name in options.given:
        if name not in reader.OPTIONS:
            raise CaptureError(
                f"the option {name} has no meaning for {Path(path).name}: files of format {reader.NAME} take "
                f"{', '.join(sorted(reader.OPTIONS))}"
            )
    return reader.read(Path(path), options)


def detect_format(path: str | Path) -> str:
    """Name of the format, from the arrays that the file lists (no array is read).

    Raises:
        CaptureError: no such file, or of no known format.
    """
    return _recognise(open_contents(path)).NAME


def _named(fmt: str) -> ModuleType:
    for reader in READERS:
        if fmt == reader.NAME:
            return reader
    raise CaptureError(
        f"unknown format {fmt!r}; choose auto or one of {', '.join(reader.NAME for reader in READERS)}"
    )


def _recognise(contents: Contents) -> ModuleType:
    for reader in READERS:
        if reader.matches(contents):
            return reader
    known = "; ".join(f"{reader.NAME}: {reader.EXPECTS}" for reader in READERS)
    raise CaptureError(
        f"{contents.path.name} holds {contents.summary()}, which is none of the known formats ({known})"
    )
