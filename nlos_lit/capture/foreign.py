"""Files that may come from anywhere: how much is read of them is bounded before any of it is."""

from __future__ import annotations

import stat
import zipfile
from pathlib import Path

from nlos_lit.capture.errors import UserError

TEXT = 2**24  # bytes, of words and numbers
PACKED = 2**30  # bytes, of what a packed archive holds


def bounded(file: Path, most: int = TEXT) -> bytes:
    """The content of a regular file that is not larger than it should be.

    Args:
        file: to read.
        most: bytes.

    Returns:
        all of its bytes.

    Raises:
        OSError: it is not there, or cannot be read.
        UserError: it is a pipe or a device, or larger.
    """
    found = file.stat()
    if not stat.S_ISREG(found.st_mode):
        raise UserError(f"{file} is no regular file")
    if found.st_size > most:
        raise UserError(f"{file} has {found.st_size / 1e6:.0f} MB; it may have {most / 1e6:.1f} MB at most")
    with file.open("rb") as stream:
        return stream.read(most)


def archived(file: Path, packed: bool = False) -> Path:
    """A zip archive (of NumPy or PyTorch) that unpacks to no more than its own size and the free memory.

    Args:
        file: to be read.
        packed: it was compressed, so that it may hold more than its own size, up to :data:`PACKED`.

    Returns:
        ``file``.

    Raises:
        OSError: it is not there, or cannot be read.
        UserError: it is a pipe or a device, or holds more.
        zipfile.BadZipFile: it is no archive.
    """
    import psutil  # not on the path of a machine that has torch alone

    found = file.stat()
    if not stat.S_ISREG(found.st_mode):
        raise UserError(f"{file} is no regular file")
    with zipfile.ZipFile(file) as archive:
        held = sum(part.file_size for part in archive.infolist())
    most = max(found.st_size, PACKED) if packed else found.st_size
    most = min(most, psutil.virtual_memory().available)
    if held > most:
        raise UserError(f"{file} unpacks to {held / 1e9:.2g} GB, where {most / 1e9:.2g} GB are allowed")
    return file
