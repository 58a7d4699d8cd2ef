"""A folder that is written to belongs to one process at a time."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from nlos_lit.capture.errors import UserError

LOCK = ".lock"
_held: dict[Path, int] = {}


def refuse_links(folder: Path) -> None:
    """Refuse the folder of a run, which may come from anywhere, with links to files elsewhere.

    Raises:
        UserError: a link leads out of it.
    """
    folder = folder.resolve()
    for path in folder.rglob("*"):
        if path.is_symlink() and not path.resolve().is_relative_to(folder):
            raise UserError(f"{path} is a link out of its run's folder; put what it leads to in its place")


def claim(folder: Path) -> None:
    """Hold a folder until this process ends, however it ends; the folder is made where it is not there.

    The lock is the kernel's (flock(2)) on a file in the folder, so that none is left behind by a kill.

    Raises:
        UserError: another process holds it.
    """
    folder = folder.resolve()
    if folder in _held:
        return
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise UserError(
            f"another process is at work in {folder}; wait until it has ended, or choose another folder"
        ) from error
    _held[folder] = handle
