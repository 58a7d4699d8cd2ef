"""Fuzz one format's reader, guided by the coverage of its code where atheris is installed.

``python tests/robust/fuzz_readers.py OUT.jsonl format=ytal [seed=0] [runs=100000] [seconds=3600]`` adds a
row; what fails is left in ``OUT.failures/`` and becomes, once mended, a file of ``corpus/FORMAT/``. Without
atheris the bytes are drawn at random. The work is done in a process of its own: a file that ends it (a fault
in a C library), or on which it stays, is a failure, and the next process goes on.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rows import add

WORKER = "worker"  # the first argument of a process that does the work
if sys.argv[1:2] == [WORKER]:
    try:
        import atheris
    except ImportError:
        atheris = None

MEMORY = 3 * 2**30  # bytes of address space
LONGEST = 80  # bytes of an input
STUCK = 120.0  # s without another file after which a process is ended
SHOWN = 50  # failures that are told apart


class Came(NamedTuple):
    """What came of the files so far, as the processes share it, and the input at hand."""

    tried: int = 0
    read: int = 0
    refused: int = 0
    guided: int = 0
    slowest: float = 0.0
    data: bytes = b""


FORM = f"<4qdB{LONGEST}s"


class Shared:
    """A :class:`Came` in a file that outlives the process that fills it."""

    def __init__(self, file: Path) -> None:
        with file.open("a+b") as held:
            held.truncate(struct.calcsize(FORM))
            self.memory = mmap.mmap(held.fileno(), 0)

    def put(self, came: Came) -> None:
        struct.pack_into(FORM, self.memory, 0, *came[:5], len(came.data), came.data)

    def get(self) -> Came:
        *numbers, length, data = struct.unpack_from(FORM, self.memory)
        return Came(*numbers, data[:length])


class Fuzz:
    """Reads one file after another, and keeps what fails.

    Args:
        fmt: of the files.
        runs: files in all.
        until: when to end, by the clock of the system.
        place: folder that all processes of a run share.
    """

    def __init__(self, fmt: str, runs: int, until: float, place: Path) -> None:
        self.fmt, self.runs, self.until, self.place = fmt, runs, until, place
        self.shared, self.told = Shared(place / "came"), set((place / "told").read_text().splitlines())
        self.folder = place / "files"
        self.folder.mkdir(exist_ok=True)
        files.beside(fmt, self.folder)

    def one(self, data: bytes) -> None:
        before, began = self.shared.get(), time.monotonic()
        came = before._replace(tried=before.tried + 1, data=data[:LONGEST])
        self.shared.put(came)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                how = files.outcome(self.fmt, data, self.folder)
            came = came._replace(**{how: getattr(came, how) + 1})
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            told = " ".join(f"{type(error).__name__} {where.name}:{where.lineno} {error}"[:160].split())
            if told not in self.told and len(self.told) < SHOWN:
                self.told.add(told)
                keep(self.place, data, told)
                print(traceback.format_exc(), file=sys.stderr, flush=True)
        self.shared.put(came._replace(slowest=max(came.slowest, time.monotonic() - began)))
        if came.tried >= self.runs or time.time() > self.until:
            os._exit(0)  # libFuzzer does not return either


def keep(place: Path, data: bytes, told: str) -> None:
    """Add to the failures."""
    (place / "failures").mkdir(exist_ok=True)
    (place / "failures" / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
    with (place / "told").open("a") as lines:
        lines.write(told + "\n")


def work(fmt: str, seed: int, runs: int, until: float, place: Path) -> None:
    """Read files until all were, the time is over, or one of them ends this process."""
    known = len(files.seeds(fmt))  # MATLAB's and HDF5's libraries are loaded by now
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    fuzz = Fuzz(fmt, runs, until, place)
    if atheris is None:
        rng = np.random.default_rng(seed)
        while True:
            fuzz.one(rng.bytes(int(rng.integers(6, LONGEST))))
    fuzz.shared.put(fuzz.shared.get()._replace(guided=1))
    held = place / "inputs"
    if not held.exists():
        held.mkdir()
        for index in range(known):
            (held / str(index)).write_bytes(index.to_bytes(3) if known > 256 else bytes([index]))
    options = [f"-max_len={LONGEST}", f"-seed={seed + 1}", "-rss_limit_mb=0", "-verbosity=0"]
    atheris.Setup([sys.argv[0], *options, f"-artifact_prefix={place}/", str(held)], fuzz.one)
    atheris.Fuzz()


def watched(process: subprocess.Popen, shared: Shared, longest: float = STUCK) -> int:
    """How a process ends; one that gets no further is ended: a C library does not heed a timer."""
    tried, since = -1, time.time()
    while process.poll() is None:
        time.sleep(0.2)
        if shared.get().tried != tried:
            tried, since = shared.get().tried, time.time()
        elif time.time() - since > longest:
            process.kill()
    return process.wait()


def main(arguments: list[str]) -> None:
    given = dict(argument.split("=", 1) for argument in arguments[1:])
    fmt, seed, runs = given["format"], int(given.get("seed", 0)), int(given.get("runs", 100_000))
    began, seconds = time.time(), float(given.get("seconds", 3600))
    until = began + seconds
    place = Path(tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
    (place / "told").touch()
    shared, turn = Shared(place / "came"), 0
    while shared.get().tried < runs and time.time() < until:
        asked = [WORKER, fmt, str(seed + 1000 * turn), str(runs), str(until), str(place)]
        status = watched(subprocess.Popen([sys.executable, __file__, *asked]), shared)
        if status:
            data = shared.get().data
            keep(place, data, f"ended by {hashlib.sha256(data).hexdigest()[:12]}, status {status}")
        turn += 1
    came = shared.get()
    failures = (place / "told").read_text().splitlines()
    if failures:
        shutil.copytree(
            place / "failures", Path(arguments[0]).with_suffix(".failures") / fmt, dirs_exist_ok=True
        )
    row = {
        "part": "readers", "format": fmt, "guided": bool(came.guided), "seed": seed, "tried": came.tried,
        "read": came.read, "refused": came.refused, "failures": failures,
        "slowest_s": round(came.slowest, 2), "seconds": round(time.time() - began),
    }  # fmt: skip
    add(arguments[0], row)
    shutil.rmtree(place)


if __name__ == "__main__":
    if sys.argv[1:2] != [WORKER]:
        main(sys.argv[1:])
    else:
        sys.path[:0] = [str(Path(__file__).parents[1] / "readers"), str(Path(__file__).parents[2])]
        if atheris is None:
            import fuzzed_files as files
        else:
            with atheris.instrument_imports(include=["data_modules", "nlos_lit"]):
                import fuzzed_files as files
        work(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5]), Path(sys.argv[6]))
