"""Memory and disk: how much there is, how much a run may take, how much it will take."""

from __future__ import annotations

import re
import resource
import shutil
import sys
from pathlib import Path

from nlos_lit.capture.errors import MemoryBudgetError, UserError

_BINARY = {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30, "TIB": 2**40}
_DECIMAL = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_UNITS = _BINARY | _DECIMAL
# What makes the phasor field smaller.
SMALLER = (
    "sum spots or bins (scene.sum_spots, scene.sum_bins) or take fewer depth planes "
    "(scene.volume.depth_pitch)"
)


def parse_bytes(text: str | int | float) -> int:
    """``"8GiB"``, ``"500 MB"`` or a number of bytes as an integer.

    Raises:
        UserError: the text is no size.

    Examples:
        >>> parse_bytes("8GiB"), parse_bytes("500 MB"), parse_bytes(1024)
        (8589934592, 500000000, 1024)
    """
    match = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([A-Za-z]*)\s*", str(text))
    if not match or match[2].upper() not in _UNITS:
        raise UserError(f"memory_budget must be a size such as 8GiB or 500MB; found {text!r}")
    return int(float(match[1]) * _UNITS[match[2].upper()])


def check_machine(needed: int, what: str, smaller: str = SMALLER) -> None:
    """Refuse what the machine cannot hold.

    Args:
        needed: bytes.
        what: takes them.
        smaller: what would take less, for the message.

    Raises:
        MemoryBudgetError: more than the memory that is free now.
    """
    import psutil  # not on the path of a machine that has torch alone

    free = psutil.virtual_memory().available
    if needed > free:
        raise MemoryBudgetError(
            f"{what} needs about {needed / 2**30:.1f} GiB, this machine has {free / 2**30:.1f} GiB free; "
            + smaller
        )


def check_disk(folder: Path, needed: int, what: str) -> None:
    """Refuse what the disk cannot hold.

    Args:
        folder: to be written to; it need not be there yet.
        needed: bytes.
        what: takes them.

    Raises:
        UserError: more than is free now.
    """
    there = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    free = shutil.disk_usage(there).free
    if needed > free:
        raise UserError(
            f"{what} takes about {needed / 2**20:.0f} MiB, {there} has {free / 2**20:.0f} MiB free; "
            "make room, or write elsewhere"
        )


def resident_bytes() -> int:
    """What this process holds now."""
    import psutil

    return psutil.Process().memory_info().rss


def peak_bytes() -> int:
    """Largest resident memory of this process so far.

    Linux keeps it for each program; getrusage(2), which is asked elsewhere, starts with that of the program
    that started this one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        return 1024 * int(
            next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:")).split()[1]
        )
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
